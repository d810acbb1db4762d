"""The specific force without the accelerometer's noise.

What bends with a force, or errs with it, follows the force and not the noise of the sensor that
measured it.  A regressor with noise in it is told too small, by the noise's share of its power
(errors in variables): a mount that bends by 22 mrad/g was 12 (d3ffb7ea of the sealed `ring300c`),
and the rest had other names.  What the force is expected to be, given the readings, is Wiener's
filter of them: of every frequency the part S - N of the power S, where the noise's power N is that
of the upper half of the frequencies.  What shakes all frequencies alike counts as noise: nothing
that follows it can be seen in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from ahrsd.mismatch.effects import series
from ahrsd.samples import Array

#: rows from which on a run has a spectrum
FEWEST = 200
#: frequencies over which the power is averaged, half a cycle per recording apart
WIDTH = 40
#: where the power is less than this many times the noise's, nothing of it is force
SINK = 2.0
#: median of the square of a standard normal number
_MEDIAN = 0.4549


def without_noise(accel_b_m_s2: Array, runs: Sequence[slice]) -> Array:
    """(N, 3) specific force as it is expected to be, given the readings (N, 3), run by run."""
    out = accel_b_m_s2.copy()
    for run in runs:
        if run.stop - run.start >= FEWEST and np.isfinite(out[run]).all():
            out[run] = expected(accel_b_m_s2[run])
    return out


def expected(values: Array) -> Array:
    """(N, k) courses as they are expected to be, given values (N, k) with white noise.

    Wiener's filter, in cosines: no step from the end to the beginning.
    """
    mean = values.mean(axis=0)
    cosines = fft.dct(values - mean, axis=0, norm="ortho")
    power = cosines**2
    noise = np.median(power[len(power) // 2 :], axis=0) / _MEDIAN
    one_run = np.concatenate([[np.nan], np.ones(len(power) - 1)])
    smooth = np.column_stack([series.moving_mean(column, one_run, WIDTH) for column in power.T])
    part = np.where(smooth > SINK * noise, 1.0 - noise / np.maximum(smooth, 1e-300), 0.0)
    return np.asarray(fft.idct(cosines * part, axis=0, norm="ortho") + mean)
