"""Columns that many effects share: time series on the axes of a frame.

A time series is (N, k): k numbers per sample.  Each of the k has three parameters (x, y, z), in
this order.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects.effect import Parameter, Readings, Setting
from ahrsd.samples import Array

#: an example direction, of unit length: real disturbances are along no axis of the sensor
DIRECTION = (0.6, -0.64, 0.48)
GRAVITY_M_S2 = 9.80665
#: Symmetric matrices by the names of their entries.
SYMMETRIC = (("xx", 0, 0), ("yy", 1, 1), ("zz", 2, 2), ("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
_ONSETS = 16


def vector(name: str, unit: str, scale: float, bound: float) -> tuple[Parameter, ...]:
    """Three parameters NAME_x, NAME_y, NAME_z."""
    return tuple(Parameter(f"{name}_{axis}", unit, scale, bound) for axis in "xyz")


def matrix(name: str, unit: str, scale: float, bound: float) -> tuple[Parameter, ...]:
    """Nine parameters NAME_xx, NAME_xy ... by rows."""
    return tuple(Parameter(f"{name}_{i}{j}", unit, scale, bound) for i in "xyz" for j in "xyz")


def symmetric(name: str, unit: str, scale: float, bound: float) -> tuple[Parameter, ...]:
    """Six parameters, the diagonal first."""
    return tuple(Parameter(f"{name}_{entry}", unit, scale, bound) for entry, _, _ in SYMMETRIC)


def along(size: float, courses: int = 1) -> tuple[float, ...]:
    """A typical value: `size` along DIRECTION for each time series."""
    return tuple(size * part for part in DIRECTION) * courses


def on_axes(course: Array) -> Array:
    """Columns (N, 3, 3k): each time series on each axis."""
    return np.asarray(np.einsum("nk,ij->nikj", course, np.eye(3)).reshape(len(course), 3, -1))


@lru_cache(maxsize=2)
def world_axes(readings: Readings) -> Array:
    """(N, 3, 3) a unit field along each axis of the world, as the magnetometer reads it."""
    return np.asarray(readings.soft_iron @ np.swapaxes(readings.R_nb, 1, 2))


def in_world(readings: Readings, course: Array) -> Array:
    """Columns (N, 3, 3k) on the magnetometer: each time series on each axis of the world."""
    columns = np.einsum("nij,nk->nikj", world_axes(readings), course)
    return np.asarray(columns.reshape(len(course), 3, -1))


def times_matrix(vectors: Array) -> Array:
    """Columns (N, 3, 9) of M v for a matrix M by rows."""
    return np.asarray(np.einsum("ai,nb->naib", np.eye(3), vectors).reshape(len(vectors), 3, 9))


def times_symmetric(vectors: Array) -> Array:
    """Columns (N, 3, 6) of S v for a symmetric S."""
    out = np.zeros((len(vectors), 3, 6))
    for column, (_, i, j) in enumerate(SYMMETRIC):
        out[:, i, column] = vectors[:, j]
        out[:, j, column] = vectors[:, i]
    return out


def cross_columns(vectors: Array) -> Array:
    """Columns (N, 3, 3) of phi x v for a rotation vector phi."""
    return np.stack([np.cross(axis, vectors) for axis in np.eye(3)], axis=2)


def settings_per_covariate(readings: Readings, role: str, **more: object) -> tuple[Setting, ...]:
    """One setting per column of that role, with the value at which its effect is zero."""
    return tuple(
        {
            "covariate": name,
            "reference": roles.zero_reference(role, readings.covariates[name]),
            **more,
        }
        for name in roles.usable_columns(readings.covariates, role)
    )


def covariate_series(readings: Readings, setting: Setting) -> Array:
    """The setting's covariate minus its reference, (N, 1), corrected for its logging.

    late_s: delay of the logged column
    mean_s: length of the mean that the logger takes.  Its attenuation is compensated by a third of
            the difference between the column and the mean of its neighbours half a mean_s
            away: exact for slow changes, and at most two thirds more
    """
    values, time_s = readings.covariates[setting["covariate"]], readings.time_s
    late_s, half_s = setting.get("late_s", 0.0), setting.get("mean_s", 0.0) / 2
    if late_s or half_s:
        before, at, behind = (
            np.interp(time_s + late_s + by_s, time_s, values) for by_s in (-half_s, 0.0, half_s)
        )
        values = at + (2.0 * at - before - behind) / 6.0
    return np.asarray(values - setting["reference"])[:, None]


def onset_settings(readings: Readings) -> tuple[Setting, ...]:
    """Onset times on a coarse grid, away from the ends of the recording."""
    first, last = float(readings.time_s[0]), float(readings.time_s[-1])
    grid = np.linspace(first, last, _ONSETS + 2)[1:-1]
    return tuple({"onset_s": round(float(t), 3)} for t in grid)


def after_onset(readings: Readings, setting: Setting) -> Array:
    """1 from the onset on, until the end where there is one (`end_s`), else 0, (N, 1)."""
    ended = readings.time_s >= setting.get("end_s", np.inf)
    return np.where((readings.time_s >= setting["onset_s"]) & ~ended, 1.0, 0.0)[:, None]


def middle_s(readings: Readings) -> float:
    """The middle time of the recording, to a millisecond."""
    return round(float(readings.time_s[0] + readings.time_s[-1]) / 2, 3)


def span_setting(readings: Readings) -> Setting:
    """Start and length of the recording, for time series that refer to it."""
    first, last = float(readings.time_s[0]), float(readings.time_s[-1])
    return {"start_s": first, "span_s": max(last - first, 1e-3)}


def elapsed_fraction(readings: Readings, setting: Setting) -> Array:
    """Time since the setting's start as a fraction of its span, (N, 1)."""
    return np.asarray((readings.time_s - setting["start_s"]) / setting["span_s"])[:, None]


def specific_force_g(readings: Readings) -> Array:
    """Specific force (N, 3) in g."""
    force = readings.force_b_m_s2
    return np.asarray((readings.accel_b_m_s2 if force is None else force) / GRAVITY_M_S2)


def has_accel(readings: Readings) -> bool:
    """Whether the recording has an accelerometer."""
    return bool(np.isfinite(readings.accel_b_m_s2).all())
