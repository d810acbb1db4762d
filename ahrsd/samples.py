"""Samples as arrays: the one shape in which sensor data travels behind the driver.

A block never spans a gap: the rows follow each other at the stream's own rate, and `gap_before`
says whether the first row follows the last row of the previous block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REGULAR: Final = 0.1  # of the period: steps that near a multiple of it are made of whole ones
PERIOD_PERCENTILE: Final = 10.0  # of the steps, where no more than nine of ten have samples missing
WINDOW_STEPS: Final = 20  # that last equally long where nothing is missing ...
WINDOW_PERIODS: Final = 1.5  # ... but for one tick of the clock at either end


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """N consecutive samples in the sensor frame, before any user calibration.

    time_s:        (N,) device time since its start-up, strictly increasing
    dt_s:          (N,) length of the step that ends at the sample; nan where unknown (after a gap)
    host_s:        (N,) host time (monotonic seconds) of the same instants by the clock model
    raw_b_gauss:   (N, 3) field as the sensor read it, register 23 undone
    gyro_b_rad_s:  (N, 3) rate as the sensor read it, register 84 undone
    accel_b_m_s2:  (N, 3) specific force, nan where the stream has none
    covariates:    further columns by name (`temperature_c`, `pressure_kpa`, ...), each (N,)
    epoch:         number of the register epoch in force (changes when registers 23/26/84 change)
    gap_before:    true where the first sample does not follow the previous block's last one
    """

    time_s: Array
    dt_s: Array
    host_s: Array
    raw_b_gauss: Array
    gyro_b_rad_s: Array
    accel_b_m_s2: Array
    covariates: dict[str, Array] = field(default_factory=dict)
    epoch: int = 0
    gap_before: bool = False

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, rows: slice | NDArray[np.intp], *, gap_before: bool) -> SampleBlock:
        """These rows, the further columns too, of the same register epoch."""
        return SampleBlock(
            time_s=self.time_s[rows],
            dt_s=self.dt_s[rows],
            host_s=self.host_s[rows],
            raw_b_gauss=self.raw_b_gauss[rows],
            gyro_b_rad_s=self.gyro_b_rad_s[rows],
            accel_b_m_s2=self.accel_b_m_s2[rows],
            covariates={name: values[rows] for name, values in self.covariates.items()},
            epoch=self.epoch,
            gap_before=gap_before,
        )


def known_force(read: Array) -> Array:
    """(N, 3) specific force, nan where it reads 0 on all axes, which not even gravity allows."""
    return np.where(np.any(read != 0.0, axis=1)[:, None], read, np.nan)


def in_periods(step_s: Array) -> Array | None:
    """N positive steps of a regular clock in periods of it (near 2: a sample is missing), or None.

    None where nine of ten steps are no multiples of a period, and where the stamps are rounded to
    ticks nearly as long as a period: those are multiples of the tick, but nothing is missing, so
    the same number of steps lasts equally long everywhere.
    """
    if not len(step_s):
        return None
    ratio = step_s / np.percentile(step_s, PERIOD_PERCENTILE)
    whole = np.maximum(np.rint(ratio), 1.0)
    if np.quantile(np.abs(ratio - whole), 0.9) > REGULAR:
        return None
    if len(step_s) > WINDOW_STEPS:
        ends = np.concatenate([[0.0], np.cumsum(whole)])
        lasts = ends[WINDOW_STEPS:] - ends[:-WINDOW_STEPS]
        if whole.max() > 1.0 and np.ptp(lasts) <= WINDOW_PERIODS:
            return None
    return np.asarray(ratio)
