"""Effects that are put on top of a real recording: each changes its Rows and says what it did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from blind_trials.world.chain import Planted, nine, xyz
from blind_trials.world.motion import DEG
from blind_trials.world.on_link import signed_permutations
from blind_trials.world.rotations import direction, turned


@dataclass(frozen=True)
class Injected:
    """A row of the table.

    least:  limit where a recording's remainder would show even less
    most:   physically largest strength
    right:  names for the very same signal
    own:    what the recording may have of the same kind, +1 or -1 times its own delay
    timed:  whether it has an instant or a course that could have been another one
    shown:  another way to the same signal, which does not move the noise with it
    """

    key: str
    least: float
    most: float
    unit: str
    apply: object
    right: tuple[str, ...] = ()
    scaled: bool = True  # whether its signal to noise can be said
    own: int = 0
    timed: bool = False
    shown: object = None

    @property
    def names(self):
        """All that are right."""
        return self.right or (self.key,)


def _moment(rows, rng):
    return float(rows.time_s[0] + rng.uniform(0.3, 0.7) * np.ptp(rows.time_s))


def _delayed(rows, values, strength):
    """A signal of a moment ago."""
    spline = CubicSpline(rows.time_s, values, axis=0)
    return spline(np.maximum(rows.time_s - strength, rows.time_s[0]))


def _mag_lag(rows, strength, rng):
    rows.mag = _delayed(rows, rows.mag, strength)
    return Planted("sensor", (("lag", strength, "s"),))


def _gyro_lag(rows, strength, rng):
    rows.gyro = _delayed(rows, rows.gyro, strength)
    return Planted("gyro", (("lag", strength, "s"),))


def _misalign(rows, strength, rng):
    angle = direction(rng) * strength
    rows.mag = turned(rows.mag, angle)
    return Planted("sensor", xyz("angle", angle, "rad"))


def _scale(rows, strength, rng):
    scale = direction(rng) * strength
    rows.gyro = rows.gyro * (1 + scale)
    return Planted("gyro", xyz("scale", scale, "1"))


def _stepped(rows, t0, frame, parameters):
    return Planted(frame, parameters, t0, ((t0, float(rows.time_s[-1])),))


def _iron_step(rows, strength, rng):
    t0, step = _moment(rows, rng), direction(rng) * strength
    rows.mag = rows.mag + (rows.time_s >= t0)[:, None] * step
    return _stepped(rows, t0, "sensor", xyz("step", step, "gauss"))


def _gyro_step(rows, strength, rng):
    t0, step = _moment(rows, rng), direction(rng) * strength
    rows.gyro = rows.gyro + (rows.time_s >= t0)[:, None] * step
    return _stepped(rows, t0, "gyro", xyz("step", step, "rad/s"))


def _g_sensitivity(rows, strength, rng):
    """Strength in rad/s per m/s^2."""
    G = rng.normal(size=(3, 3))
    G *= strength / np.linalg.norm(G) * np.sqrt(3)
    rows.gyro = rows.gyro + rows.force @ G.T
    return Planted("gyro", nine("per_g", 9.81 * G, "rad/s/g"))


def _signal(rows, column):
    """Of a machine, from its least value on."""
    signal = rows.columns[column]
    return signal - signal.min() * (column == "temperature_c")


def _field_of(column, unit):
    """A field that follows a column; strength at its extreme."""

    def apply(rows, strength, rng):
        signal = _signal(rows, column)
        per_unit = direction(rng) * strength / np.max(signal)
        rows.mag = rows.mag + signal[:, None] * per_unit
        return Planted("sensor", xyz("field", per_unit, unit))

    return apply


def _bias_of_temperature(rows, strength, rng):
    """Strength in rad/s per degree."""
    per_degree = direction(rng) * strength
    rows.gyro = rows.gyro + _signal(rows, "temperature_c")[:, None] * per_degree
    return Planted("gyro", xyz("per_degree", per_degree, "rad/s/degC"))


def _swapped(rows, strength, rng):
    order, signs = signed_permutations()[rng.integers(47)]
    rows.gyro = rows.gyro[:, order] * signs
    return Planted("link")


def _gyro_unit(rows, strength, rng):
    rows.gyro = np.degrees(rows.gyro)
    return Planted("link")


def _mag_unit(rows, strength, rng):
    rows.mag = rows.mag * rng.choice([100.0, 1000.0])  # microtesla, milligauss
    return Planted("link")


def _clipped(rows, strength, rng):
    """The converter ends where a share `strength`, on the axis that has most, would be larger."""
    limit = float(np.max(np.quantile(np.abs(rows.mag), 1 - strength, axis=0)))
    rows.mag = np.clip(rows.mag, -limit, limit)
    return Planted("sensor", (("limit", limit, "gauss"),))


LAGS = ("mag_time_lag", "gyro_time_lag", "gyro_integration", "mag_low_pass")
_G = 0.05 * DEG / 9.81
_ROWS = (
    Injected("mag_time_lag", 4e-3, 80e-3, "s", _mag_lag, LAGS, own=1, shown=_gyro_lag),
    Injected("gyro_time_lag", 4e-3, 80e-3, "s", _gyro_lag, LAGS, own=-1),
    Injected("mag_gyro_misalignment", 0.6 * DEG, 10 * DEG, "rad", _misalign),
    Injected("gyro_scale", 0.01, 0.2, "1", _scale, ("gyro_scale", "clock_rate")),
    Injected("gyro_g_sensitivity", 3 * _G, 40 * _G, "rad/s/(m/s^2)", _g_sensitivity),
    Injected("hard_iron_step", 4e-3, 0.3, "gauss", _iron_step, timed=True),
    Injected("gyro_bias_step", 0.06 * DEG, 2 * DEG, "rad/s", _gyro_step, timed=True),
    Injected("gyro_bias_temperature", 0.02 * DEG, 0.3 * DEG, "rad/s/degC",
             _bias_of_temperature, timed=True),
    Injected("motor_current_field", 4e-3, 0.3, "gauss",
             _field_of("motor_current_a", "gauss/A"), timed=True),
    Injected("switched_device", 4e-3, 0.3, "gauss", _field_of("lamp_on", "gauss"), timed=True),
    Injected("mag_bias_temperature", 4e-3, 0.1, "gauss",
             _field_of("temperature_c", "gauss/degC"), timed=True),
    Injected("mag_saturation", 0.01, 0.1, "1", _clipped, scaled=False),
    Injected("frame_error", 1.0, 1.0, "1", _swapped, scaled=False),
    Injected("unit_error_gyro", 1.0, 1.0, "1", _gyro_unit, ("unit_error",), scaled=False),
    Injected("unit_error_mag", 1.0, 1.0, "1", _mag_unit, ("unit_error",), scaled=False),
)  # fmt: skip

INJECTED = {row.key: row for row in _ROWS}
