"""What a course is expected to be, given values of it with white noise (Wiener's filter).

Of every frequency the part S - N of the power S is kept, where the noise's power N is that of the
upper half of the frequencies.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from ahrsd.diagnosis.effects import series
from ahrsd.samples import Array

#: rows from which on values have a spectrum
FEWEST = 200
#: frequencies over which the power is averaged, half a cycle per recording apart
WIDTH = 40
#: where the power is less than this many times the noise's, nothing of it is the course's
SINK = 2.0
#: median of the square of a standard normal number
_MEDIAN = 0.4549


def expected(values: Array) -> Array:
    """(N, k) courses as they are expected to be, given values (N, k) with white noise.

    In cosines: no step from the end to the beginning.
    """
    mean = values.mean(axis=0)
    cosines = fft.dct(values - mean, axis=0, norm="ortho")
    power = cosines**2
    noise = np.median(power[len(power) // 2 :], axis=0) / _MEDIAN
    one_run = np.concatenate([[np.nan], np.ones(len(power) - 1)])
    smooth = np.column_stack([series.moving_mean(column, one_run, WIDTH) for column in power.T])
    part = np.where(smooth > SINK * noise, 1.0 - noise / np.maximum(smooth, 1e-300), 0.0)
    return np.asarray(fft.idct(cosines * part, axis=0, norm="ortho") + mean)
