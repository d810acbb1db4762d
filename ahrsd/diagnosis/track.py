"""A recording as the mismatch engine wants it: one clock, a row per sample, covariates by name."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd.samples import Array


class NothingToFit(ValueError):
    """Why nothing can be fitted to a recording, in words for a person."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """N samples in the sensor frame, time increasing.

    time_s:        (N,)
    dt_s:          (N,) length of the step that ends at the sample; nan at the first sample of a run
    mag_b_gauss:   (N, 3) magnetometer readings
    gyro_b_rad_s:  (N, 3) gyro readings, the mean rate over the step that ends at the sample
    accel_b_m_s2:  (N, 3) specific force, None where it was not recorded
    covariates:    (N,) columns by name (`motor_current_a`, `temperature_c`, ...); may hold nan
    runs:          slices of the gap-free runs, in order, which cover every row
    lost_turns:    (N,) how many of the device's steps are expected to be lost in a step, nobody
                   knows in which, beyond those that were put right; None where none are
    step_share:    part of a step's turn that one step of the device is
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
        """The same with other covariates."""
        return replace(self, covariates=covariates)

    @property
    def duration_s(self) -> float:
        """From the first sample to the last, seconds."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    @property
    def step_s(self) -> float:
        """The usual step between samples, 1 where none is known."""
        known = self.dt_s[np.isfinite(self.dt_s)]
        return float(np.median(known)) if len(known) else 1.0

    @property
    def usual_gauss(self) -> float:
        """The usual size of a reading of the magnetometer that is not 0 0 0; 0 where none is."""
        size = np.linalg.norm(self.mag_b_gauss, axis=1)
        size = size[np.isfinite(size) & (size > 0.0)]
        return float(np.median(size)) if len(size) else 0.0


@dataclass(frozen=True, slots=True)
class Spec:
    """What the user knows of the sensor; None is estimated.  Deviations are per sample.

    shaken_gyro_rad_s: found, not told: what the gyro's differences are, where most of that is the
                       motion's; its noise may be far less
    """

    sigma_mag_gauss: float | None = None
    sigma_gyro_rad_s: float | None = None
    rate_hz: float | None = None
    field_gauss: float | None = None
    shaken_gyro_rad_s: float | None = None
