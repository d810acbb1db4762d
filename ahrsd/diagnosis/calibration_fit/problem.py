"""What a search works on: the recording averaged to a working rate, and what is known about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.delay import (
    delayed_values,
    is_magnetometer_lag,
    without_early_readings,
    without_lag,
)
from ahrsd.diagnosis.calibration_fit.gyro_readings import (
    averaging_model,
    find_lower_gyro_noise,
    with_delta_angles,
)
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import cold_start
from ahrsd.diagnosis.calibration_fit.resampling import average_groups, working_factor
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import NothingToFit, Spec, Track
from ahrsd.samples import Array

MEAN_RATES = (
    "the gyro's values are mean rates: the turning of their axis within a step (coning) was added"
)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The track to diagnose, and what is known about the sensor.

    recorded: the track as it was recorded;  thin, cold: number of samples per working row, and the
              calibration used for averaging, from a cold start or a better fit
    lag_s:    lag of the magnetometer that is already removed from the track
    instants: the gyro's values are rates at instants: half a step of that lag is due to them
    riding:   (recorded rows, 3) gauss fixed in the sensor's axes, beyond the hard iron, as far as
              known, without that lag: averaged and not turned; None for none
    averaged: magnetometer readings per working row that has any: less than `thin` if the
              magnetometer is read less often than the gyro
    notes:    what a person should know about how the rates were read
    unread_s: intervals, begin and end, whose readings are left out: something was moved there
    logged:   settings, by column, of columns that differ from the recorded ones
    """

    track: Track
    spec: Spec
    recorded: Track
    thin: int
    cold: NullModel
    lag_s: float = 0.0
    averaged: float = 1.0
    notes: tuple[str, ...] = ()
    riding: Array | None = None
    instants: bool = False
    unread_s: tuple[tuple[float, float], ...] = ()
    logged: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def rate_hz(self) -> float:
        """Rows per second."""
        return 1.0 / float(np.nanmedian(self.track.dt_s))

    def with_lag(self, lag_s: float) -> Problem:
        """The same with a lag of the magnetometer removed."""
        riding = self.riding
        if riding is not None and is_magnetometer_lag(self.recorded, lag_s):
            riding = delayed_values(self.recorded, riding, lag_s)
        without_delay = without_lag(self.recorded, lag_s, instants=self.instants)
        track = average_groups(without_delay, self.thin, self.cold, riding)
        return replace(self, track=track, lag_s=lag_s)

    def averaged_with(self, riding: Array, model: NullModel, lag_s: float) -> Problem:
        """The same with another lag, averaged with a better calibration.

        riding: (working rows, 3) gauss fixed in the sensor's axes, beyond the model's hard iron
        """
        if self.thin == 1:
            return self if lag_s == self.lag_s else self.with_lag(lag_s)
        at_s, time_s = self.track.time_s, self.recorded.time_s
        drawn = np.column_stack([np.interp(time_s, at_s, column) for column in riding.T])
        if is_magnetometer_lag(self.recorded, lag_s):
            drawn = delayed_values(self.recorded, drawn, -lag_s)
        return replace(self, riding=drawn, cold=model).with_lag(lag_s)


def build_problem(track: Track, spec: Spec) -> tuple[Problem, NullModel]:
    """The recording at the working rate, and a calibration to start from."""
    cold = cold_start(track, spec)
    converted = with_delta_angles(track, cold)
    notes = () if converted is track else (MEAN_RATES,)
    track = without_early_readings(converted)
    m = working_factor(track, averaging_model(track, cold))
    work = average_groups(track, m, cold)
    if not _count_readings(work):
        raise NothingToFit("the magnetometer has no usable reading: all are stuck or missing")
    averaged = _count_readings(track) / _count_readings(work)
    start = replace(
        cold,
        sigma_mag_gauss=cold.sigma_mag_gauss / float(np.sqrt(averaged)),
        sigma_gyro_rad_s=cold.sigma_gyro_rad_s / float(np.sqrt(m)),
    )
    known = noise_of_averages(spec, averaged, m)
    if (found := find_lower_gyro_noise(track, work, known, start)) is not None:
        known, start = found
    elif (
        spec.sigma_gyro_rad_s is None
        and start.sigma_gyro_rad_s < priors.SHAKEN_QUIETER * noise_of_differences(work)[1]
    ):
        # the differences of the gyro at the working rate are due to motion
        known = replace(known, sigma_gyro_rad_s=start.sigma_gyro_rad_s)
    made = Problem(work, known, track, m, cold, averaged=averaged, notes=notes)
    return made, start


def noise_of_averages(spec: Spec, mag: float, gyro: float) -> Spec:
    """The known noise levels, for averages of so many samples."""

    def of_mean(sigma: float | None, count: float) -> float | None:
        return None if sigma is None else sigma / float(np.sqrt(count))

    return replace(
        spec,
        sigma_mag_gauss=of_mean(spec.sigma_mag_gauss, mag),
        sigma_gyro_rad_s=of_mean(spec.sigma_gyro_rad_s, gyro),
        shaken_gyro_rad_s=of_mean(spec.shaken_gyro_rad_s, gyro),
    )


def model_of_samples(model: NullModel, problem: Problem) -> NullModel:
    """A model of the working rows, converted to single samples."""
    return replace(
        model,
        sigma_mag_gauss=model.sigma_mag_gauss * float(np.sqrt(problem.averaged)),
        sigma_gyro_rad_s=model.sigma_gyro_rad_s * float(np.sqrt(problem.thin)),
    )


def _count_readings(track: Track) -> int:
    """Number of complete readings of the magnetometer."""
    return int(np.count_nonzero(np.isfinite(track.mag_b_gauss).all(axis=1)))
