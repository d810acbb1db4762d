"""What no method can use, said before it is tried.

The bounds are far from anything a working sensor does: they catch units, saturation, a sensor at
rest and motion about one axis, which leaves the field's readings in a plane. Every published method
but magfactor3 then has a family of answers; a fit of noise would pick one of them.
"""

from __future__ import annotations

import numpy as np

from ahrsd.methods.data import Data, MethodError, Settings
from ahrsd.samples import Array

MINIMUM_SAMPLES = 20
_FIELD_GAUSS = (0.01, 10.0)  # median magnitude; the earth has 0.22 to 0.67 and iron adds to it
_RATE_RAD_S = 70.0  # twice what the VN-100's gyroscope can measure
_STUCK = 0.05  # part of the samples at an axis' very largest or smallest reading
_NOISE_SPREADS = 5.0  # a direction needs this many sigmas of spread to count as moved in
_LEAST_NOISE_GAUSS = 1e-9  # simulated readings may have none
_FLATNESS = 0.015  # third spread over first; a car that circles has 0.05 to 0.09, LAM 0.13 to 0.2
_WEAK = 0.1  # the same, below which the answer across that plane rests on little


def mag_noise(data: Data, settings: Settings) -> float:
    """Sigma of one reading in gauss: as set, else from third differences: too quick for motion."""
    if settings.sigma_mag_gauss is not None:
        return settings.sigma_mag_gauss
    parts = [np.diff(data.raw_b_gauss[rows], n=3, axis=0) for rows in data.segments()]
    third = np.vstack([part for part in parts if len(part)] or [np.zeros((1, 3))])
    # the median absolute value of a Gaussian is 0.6745 sigma; 1, 3, 3, 1 squared and summed is 20
    sigma = float(np.median(np.abs(third)) / (0.6745 * np.sqrt(20.0)))
    return max(sigma, _LEAST_NOISE_GAUSS)


def usable(data: Data) -> None:
    """MethodError naming the first thing that makes these samples unusable for every method."""
    if len(data) < MINIMUM_SAMPLES:
        raise MethodError(f"{len(data)} samples: at least {MINIMUM_SAMPLES} are needed")
    for name in ("time_s", "raw_b_gauss", "gyro_b_rad_s"):
        good = np.isfinite(getattr(data, name)).reshape(len(data), -1).all(axis=1)
        if not good.all():
            raise MethodError(f"{name} of row {int(np.argmin(good))} is not finite")
    inner = np.ones(len(data), dtype=bool)
    inner[list(data.starts)] = False
    good = ~inner | ((data.dt_s > 0) & np.isfinite(data.dt_s))
    if not good.all():
        k = int(np.argmin(good))
        raise MethodError(f"dt_s of row {k} is {data.dt_s[k]}: time must go forward")
    size = float(np.median(np.linalg.norm(data.raw_b_gauss, axis=1)))
    if not _FIELD_GAUSS[0] < size < _FIELD_GAUSS[1]:
        raise MethodError(f"the readings are about {size:.3g} in size: is the unit gauss?")
    rate = float(np.max(np.abs(data.gyro_b_rad_s)))
    if rate > _RATE_RAD_S:
        raise MethodError(f"the gyroscope reads up to {rate:.3g}: is the unit rad/s?")


def spreads(field: Array) -> Array:
    """Standard deviations of readings (N, 3) along their principal axes, descending, in gauss."""
    scales = np.linalg.svd(field - field.mean(axis=0), compute_uv=False)
    return np.asarray(scales / np.sqrt(len(field)), dtype=np.float64)


def moved(data: Data, settings: Settings, axes: int) -> str:
    """A remark where the motion is weak, else "".

    MethodError unless the field's readings vary along `axes` principal directions (2 or 3).
    """
    spread = spreads(data.raw_b_gauss)
    noise = mag_noise(data, settings)
    if spread[1] < max(_NOISE_SPREADS * noise, 1e-4):
        raise MethodError(
            f"the sensor hardly turned: readings spread by {1e3 * spread[0]:.2g} mG, "
            f"noise is {1e3 * noise:.2g} mG"
        )
    if axes >= 3 and spread[2] < max(_NOISE_SPREADS * noise, _FLATNESS * spread[0]):
        raise MethodError(
            "the sensor turned about one axis only: readings lie in a plane "
            f"({1e3 * spread[2]:.2g} mG off it, noise is {1e3 * noise:.2g} mG); pitch and roll too"
        )
    for i, axis in enumerate("xyz"):
        values = data.raw_b_gauss[:, i]
        for limit in (values.min(), values.max()):
            if np.mean(values == limit) > _STUCK:
                raise MethodError(f"readings of {axis} stick at {limit:.4g} gauss: saturated")
    if axes >= 3 and spread[2] < _WEAK * spread[0]:
        return f"weak motion: readings leave a plane by {1e3 * spread[2]:.2g} mG only"
    return ""
