"""A field on the vehicle that is a function of the heading: harmonics, of which no name has all.

A turret that keeps its direction, a crane, a boom that swings back turn against the vehicle: iron
that turns with the heading, once or several times.  In time it comes and goes with every turn,
within seconds, and is no one source, so that it counts as the colour of the noise.  By heading it
is the same each time.  The calibration takes what soft iron does.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.model import Columns, Context

#: waves in a turn, at most; the variance of each falls with the square of its number
HARMONICS = 6


def heading_columns(context: Context) -> Columns:
    """A field in the sensor's axes, 3 columns a wave, wave-major, each of its prior deviation."""
    order = np.arange(1, HARMONICS + 1)
    phase = context.heading_rad[:, None] * order
    waves = np.concatenate([np.cos(phase) / order, np.sin(phase) / order], axis=1)
    axes = np.eye(3)
    return Columns(mag=np.einsum("nj,ki->nkji", waves, axes).reshape(len(phase), 3, -1))
