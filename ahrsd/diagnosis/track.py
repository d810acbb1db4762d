"""A recording as the diagnosis uses it: one clock, a row per sample, covariates by column name."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd.samples import Array


class NothingToFit(ValueError):
    """Nothing can be fitted to a recording; the message tells the user why."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """N samples in the sensor frame, time increasing.

    time_s:        (N,)
    dt_s:          (N,) length of the step that ends at the sample; nan at the first sample of a run
    mag_b_gauss:   (N, 3) magnetometer readings
    gyro_b_rad_s:  (N, 3) gyro readings, the mean rate over the step that ends at the sample
    accel_b_m_s2:  (N, 3) specific force, None where it was not recorded
    covariates:    (N,) columns by name (`motor_current_a`, `temperature_c`, ...); may hold nan
    runs:          slices of the gap-free runs, in order; they cover every row
    lost_turns:    (N,) expected number of device steps lost in each step at unknown times, beyond
                   those already corrected; None where there are none
    step_share:    turn of one device step, as a fraction of a step's turn
    """

    time_s: Array
    dt_s: Array
    mag_b_gauss: Array
    gyro_b_rad_s: Array
    accel_b_m_s2: Array | None
    covariates: dict[str, Array] = field(default_factory=dict)
    runs: tuple[slice, ...] = ()
    lost_turns: Array | None = None
    step_share: float = 1.0

    def __len__(self) -> int:
        return len(self.time_s)

    def with_columns(self, covariates: dict[str, Array]) -> Track:
        """The same track with other covariates."""
        return replace(self, covariates=covariates)

    @property
    def duration_s(self) -> float:
        """From the first sample to the last, seconds."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    @property
    def step_s(self) -> float:
        """The median step between samples, 1 where none is known."""
        known = self.dt_s[np.isfinite(self.dt_s)]
        return float(np.median(known)) if len(known) else 1.0

    @property
    def usual_gauss(self) -> float:
        """Median magnitude of the magnetometer's readings other than 0 0 0; 0 if there are none."""
        size = np.linalg.norm(self.mag_b_gauss, axis=1)
        size = size[np.isfinite(size) & (size > 0.0)]
        return float(np.median(size)) if len(size) else 0.0


@dataclass(frozen=True, slots=True)
class Spec:
    """What the user knows of the sensor; None is estimated.  Standard deviations are per sample.

    shaken_gyro_rad_s: estimated, not given by the user: the scatter of the gyro's differences where
                       most of it is motion; the noise may be far lower
    """

    sigma_mag_gauss: float | None = None
    sigma_gyro_rad_s: float | None = None
    rate_hz: float | None = None
    field_gauss: float | None = None
    shaken_gyro_rad_s: float | None = None
