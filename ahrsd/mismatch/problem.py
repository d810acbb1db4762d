"""What a search works on: the recording averaged to a working rate, and what is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.mismatch.delay import delayed_gyro
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.limits import Limits
from ahrsd.mismatch.null import cold_start
from ahrsd.mismatch.thin import thinned, working_factor
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel

BLOCKS = 80
BLOCK_S = (2.0, 10.0)
#: samples per working row from which the gyro's noise is taken from the recorded rate
OVERSAMPLED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is asked: the track, what is known of the sensor, the library, the thresholds.

    recorded: the track as it was recorded;  thin, cold: what made the working `track` from it
    lag_s:    lag of the magnetometer that is already taken out of the track
    """

    track: Track
    spec: Spec
    library: Mapping[str, Effect]
    limits: Limits
    recorded: Track
    thin: int
    cold: NullModel
    lag_s: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Rows per second."""
        return 1.0 / float(np.nanmedian(self.track.dt_s))

    @property
    def block_s(self) -> float:
        """Length of the Gram's blocks: about 80, longer than correlated noise where possible."""
        return float(np.clip(self.track.duration_s / BLOCKS, *BLOCK_S))

    def lagging(self, lag_s: float) -> Problem:
        """The same with a lag of the magnetometer taken out."""
        track = thinned(delayed_gyro(self.recorded, lag_s), self.thin, self.cold)
        return replace(self, track=track, lag_s=lag_s)


def problem_of(
    track: Track, spec: Spec, library: Mapping[str, Effect], limits: Limits
) -> tuple[Problem, NullModel]:
    """The recording at working rate, and a calibration to start from."""
    cold = cold_start(track, spec)
    m = working_factor(track)
    root = float(np.sqrt(m))
    start = replace(
        cold,
        sigma_mag_gauss=cold.sigma_mag_gauss / root,
        sigma_gyro_rad_s=cold.sigma_gyro_rad_s / root,
    )
    work = thinned(track, m, cold)
    known = spec
    if m >= OVERSAMPLED and spec.sigma_gyro_rad_s is None:
        # the gyro's differences at the working rate would be its motion
        known = replace(spec, sigma_gyro_rad_s=cold.sigma_gyro_rad_s)
    return Problem(work, noise_of_thinned(known, m), library, limits, track, m, cold), start


def noise_of_thinned(spec: Spec, m: float) -> Spec:
    """What is known of the noise, for averages of m samples."""
    root = float(np.sqrt(m))
    return replace(
        spec,
        sigma_mag_gauss=None if spec.sigma_mag_gauss is None else spec.sigma_mag_gauss / root,
        sigma_gyro_rad_s=None if spec.sigma_gyro_rad_s is None else spec.sigma_gyro_rad_s / root,
    )
