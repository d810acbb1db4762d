"""The specific force without the accelerometer's noise.

What bends with a force, or errs with it, follows the force and not the noise of the sensor that
measured it.  A regressor with noise in it is told too small, by the noise's share of its power
(errors in variables): a mount that bends by 22 mrad/g was 12,
and the rest had other names.  What the force is expected to be, given the readings, is Wiener's
filter of them.  What shakes all frequencies alike counts as noise: nothing that follows it can be
seen in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.innovation_filter.wiener import FEWEST, expected
from ahrsd.samples import Array


def without_noise(accel_b_m_s2: Array, runs: Sequence[slice]) -> Array:
    """(N, 3) specific force as it is expected to be, given the readings (N, 3), run by run."""
    out = accel_b_m_s2.copy()
    for run in runs:
        if run.stop - run.start >= FEWEST and np.isfinite(out[run]).all():
            out[run] = expected(accel_b_m_s2[run])
    return out
