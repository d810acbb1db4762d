"""From the world to samples: field, iron, sensor, sampling.  An effect changes a `Stages`.

field in the world -> body -> (mount) -> iron and body sources -> sensor electronics -> delay
-> the value at the sample's instant
body rate -> gyro errors -> delay -> mean over the step that ends at the sample:
    delta angles with coning, so that an ideal gyro turns the attitude exactly
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from blind_trials.world.motion import STEP_S
from blind_trials.world.rotations import to_body, turned
from blind_trials.world.world import BEFORE_S


@dataclass(eq=False)
class Stages:
    """What effects add.  Arrays are on the 1 kHz grid, (N, 3) or (N,)."""

    field_n: list = field(default_factory=list)  # added in the world, gauss
    mount: list = field(default_factory=list)  # rotation vectors that turn the field in the sensor
    soft_iron: list = field(default_factory=list)  # (weight (N,), dA (3, 3))
    field_rate: list = field(default_factory=list)  # E (3, 3), seconds: E dh/dt
    from_field: list = field(default_factory=list)  # functions of h (N, 3) that are added
    body: list = field(default_factory=list)  # added to the reading, gauss
    electronics: list = field(default_factory=list)  # reading (N, 3) -> reading
    mag_delay_s: float = 0.0
    rate: list = field(default_factory=list)  # rate (N, 3) -> rate
    gyro_bias: list = field(default_factory=list)  # added to the rate, rad/s
    gyro_delay_s: float = 0.0
    gyro_at_instant: bool = False
    clock_error: float = 0.0  # the logger's seconds are so much longer
    mag_noise_factor: list = field(default_factory=list)  # of the sample times, (K,)
    edits: list = field(default_factory=list)  # Rows -> Rows, after the noise


@dataclass(eq=False)
class Rows:
    """What a logger wrote: K rows; `columns` are the covariates by name."""

    time_s: np.ndarray
    mag: np.ndarray
    gyro: np.ndarray
    force: np.ndarray
    columns: dict

    def kept(self, rows):
        """The rows of a mask or of indices."""
        return Rows(
            self.time_s[rows],
            self.mag[rows],
            self.gyro[rows],
            self.force[rows],
            {name: column[rows] for name, column in self.columns.items()},
        )


@dataclass(frozen=True, eq=False)
class Planted:
    """What an effect did: the key's entry.  Times are the recording's."""

    frame: str
    parameters: tuple = ()  # (name, value, unit)
    onset_s: float | None = None
    intervals_s: tuple = ()


def xyz(name, vector, unit):
    """Parameters of a vector."""
    return tuple((f"{name}_{axis}", float(v), unit) for axis, v in zip("xyz", vector))


def nine(name, matrix, unit):
    """Parameters of a matrix."""
    return tuple(
        (f"{name}_{a}{b}", float(matrix[i, j]), unit)
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
    )


def six(name, matrix, unit):
    """Parameters of a symmetric matrix."""
    return tuple(entry for entry in nine(name, matrix, unit) if entry[0][-2] <= entry[0][-1])


def sample_times(world, rate_hz):
    """Instants of the samples on the world's clock; whole milliseconds."""
    step_ms = round(1000 / rate_hz)
    last_ms = round(world.time_s[-1] * 1000)
    return np.arange(round(BEFORE_S * 1000), last_ms + 1, step_ms) * 1e-3


def body_field(world, stages):
    """The Earth's field in the sensor's axes, (N, 3)."""
    field_n = np.broadcast_to(world.field_n, world.motion.force_b.shape)
    for extra in stages.field_n:
        field_n = field_n + extra
    h = to_body(world.motion.R_nb, field_n)
    for angle in stages.mount:
        h = turned(h, angle)
    return h


def magnetometer(world, stages):
    """The continuous reading, before delay and sampling, (N, 3) gauss."""
    h = body_field(world, stages)
    m = h @ world.soft_iron.T + world.hard_iron
    for weight, dA in stages.soft_iron:
        m = m + weight[:, None] * (h @ dA.T)
    if stages.field_rate:
        slope = np.gradient(h, STEP_S, axis=0)
        for E in stages.field_rate:
            m = m + slope @ E.T
    for function in stages.from_field:
        m = m + function(h)
    for extra in stages.body:
        m = m + extra
    for change in stages.electronics:
        m = change(m)
    return m


def gyroscope(world, stages):
    """The continuous rate as the gyro has it, (N, 3) rad/s."""
    w = world.motion.rate_b
    for change in stages.rate:
        w = change(w)
    for extra in stages.gyro_bias:
        w = w + extra
    return w + world.gyro_bias


def _at(signal, times, instants):
    """A signal (N, ...) on the grid at any instants; without rounding where they are on it."""
    index = np.rint(instants / STEP_S).astype(int)
    if np.allclose(index * STEP_S, instants, atol=1e-9):
        return signal[index]
    return CubicSpline(times, signal, axis=0)(instants)


def _integral(x):
    """Of a signal (N, 3) on the grid, from its first instant on."""
    return np.vstack([np.zeros(3), np.cumsum(0.5 * (x[1:] + x[:-1]), axis=0) * STEP_S])


def _turn(w, t, ends):
    """Rotation vectors (K, 3) between K + 1 instants, as a gyro's delta angles: coning included.

    The integral of the rate and, to second order, of (angle since the step began) x rate / 2.
    """
    angle = _integral(w)
    area = _integral(np.cross(angle, w))
    angles, areas = _at(angle, t, ends), _at(area, t, ends)
    turned_by = np.diff(angles, axis=0)
    return turned_by + 0.5 * (np.diff(areas, axis=0) - np.cross(angles[:-1], turned_by))


def readings(world, stages, rate_hz):
    """Noise-free (instants (K,), magnetometer (K, 3), gyro (K, 3)) of the sensors."""
    t = world.time_s
    at = sample_times(world, rate_hz)
    mag = _at(magnetometer(world, stages), t, at - stages.mag_delay_s)
    w = gyroscope(world, stages)
    if stages.gyro_at_instant:
        return at, mag, _at(w, t, at - stages.gyro_delay_s)
    step = at[1] - at[0]
    return at, mag, _turn(w, t, np.concatenate([at[:1] - step, at]) - stages.gyro_delay_s) / step
