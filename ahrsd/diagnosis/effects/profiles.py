"""Covariates of an ordinary working vehicle, for simulated recordings: one column or more per role.

current, rpm, speed   levels that change every 10 to 40 s, rounded off
temperature           a warm-up of 8 K with a time constant of 5 minutes
position              a lawn-mower pattern, legs of 40 m, 8 m apart, at 0.6 m/s
angle                 a rudder that is put over now and then;  switch, ping: on and off
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.samples import Array

_LEG_M, _APART_M, _SPEED_M_S = 40.0, 8.0, 0.6
_PING_S = 1.7
_FAR = 12.0  # roundings after which a change of level is over to the last digit but three

Columns = dict[str, Array]


def columns_for(effects: Iterable[Effect], time_s: Array, seed: int) -> Columns:
    """The columns that the effects need, on the times (N,); the same seed gives the same columns.

    Where one of several roles will do, the first that is a column of its own is made.
    """
    wanted: dict[str, None] = {}
    for effect in effects:
        for need in effect.needs:
            made = [role for role in need.split("|") if role not in roles.SENSORS]
            wanted.update(dict.fromkeys(made[:1]))
    out: Columns = {}
    for role in wanted:
        number = list(roles.ROLES).index(role)
        out |= PROFILES[role](time_s - time_s[0], np.random.default_rng([seed, 11, number]))
    return out


def _levels(
    time_s: Array, rng: np.random.Generator, span: tuple[float, float], rounding_s: float
) -> Array:
    """Levels within the span that hold for 10 to 40 s, passed from one to the next smoothly."""
    length = float(time_s[-1]) + 1.0
    starts = np.cumsum(rng.uniform(10.0, 40.0, int(length / 10.0) + 2))
    values = rng.uniform(*span, len(starts) + 1)
    out = values[np.searchsorted(starts, time_s, side="right")]
    for start, step in zip(starts, np.diff(values), strict=True):
        near = slice(
            *np.searchsorted(time_s, (start - _FAR * rounding_s, start + _FAR * rounding_s))
        )
        apart = (time_s[near] - start) / rounding_s
        out[near] += step * (0.5 + 0.5 * np.tanh(apart) - (apart >= 0))
    return np.asarray(out)


def _current(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"motor_current_a": _levels(time_s, rng, (0.5, 12.0), 0.4)}


def _temperature(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"temperature_c": rng.uniform(12.0, 24.0) + 8.0 * (1 - np.exp(-time_s / 300.0))}


def _position(time_s: Array, rng: np.random.Generator) -> Columns:
    """Along, across, along back; corners are rounded over about two seconds."""
    way = _SPEED_M_S * time_s
    lap, along = np.divmod(way, _LEG_M + _APART_M)
    there = np.minimum(along, _LEG_M)
    north = np.where(lap % 2 == 0, there, _LEG_M - there)
    east = _APART_M * lap + np.maximum(along - _LEG_M, 0.0)
    return {
        "position_north_m": _rounded(north, time_s),
        "position_east_m": _rounded(east, time_s),
        "position_down_m": _levels(time_s, rng, (4.0, 7.0), 5.0),
    }


def _rounded(values: Array, time_s: Array) -> Array:
    rows = max(round(2.0 / float(np.median(np.diff(time_s)))), 1)
    padded = np.pad(values, (rows, rows), mode="reflect", reflect_type="odd")
    return np.convolve(padded, np.hanning(2 * rows + 3)[1:-1] / (rows + 1), mode="valid")


def _altitude(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"altitude_m": _levels(time_s, rng, (2.0, 9.0), 4.0)}


def _angle(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"rudder_angle_rad": _levels(time_s, rng, (-0.6, 0.6), 1.0)}


def _speed(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"speed_m_s": _levels(time_s, rng, (0.2, 2.0), 3.0)}


def _rpm(time_s: Array, rng: np.random.Generator) -> Columns:
    return {"shaft_rpm": _levels(time_s, rng, (500.0, 1400.0), 1.0)}


def _ping(time_s: Array, rng: np.random.Generator) -> Columns:
    count = np.floor((time_s + rng.uniform(0, _PING_S)) / _PING_S)
    return {"sonar_ping": np.diff(count, prepend=count[0])}


def _switch(time_s: Array, rng: np.random.Generator) -> Columns:
    flips = np.cumsum(rng.uniform(10.0, 40.0, int(float(time_s[-1]) / 10.0) + 2))
    return {"lamp_on": np.searchsorted(flips, time_s).astype(np.float64) % 2}


PROFILES: Mapping[str, Callable[[Array, np.random.Generator], Columns]] = {
    "current": _current,
    "temperature": _temperature,
    "position": _position,
    "altitude": _altitude,
    "angle": _angle,
    "speed": _speed,
    "rpm": _rpm,
    "ping": _ping,
    "switch": _switch,
}
