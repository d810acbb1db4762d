"""NMEA 0183 sentences: magnetic heading (HDM), and pitch, roll and temperature (XDR).

$HCHDM,093.8,M*2B             degrees from magnetic north to the vehicle's x axis, to the east
$HCHDM,,M*07                  the heading is not known: an empty field, as the standard has it
$YXXDR,A,1.4,D,PITCH,A,-0.3,D,ROLL,C,24.6,C,TEMP*2D

Talkers: HC, a magnetic compass; YX, a transducer. Transducer types A (angle, units D: degrees) and
C (temperature, units C). PITCH is positive with the bow up, ROLL with the right side down; the
names are those of the standard's list of 2019 (Pitch, Roll), in capitals, as older programs compare
them.

**Attitude** for these sentences: the up direction of each sample, in the frame of the device's
outputs (body).

If the stream has the device's own pitch and roll, they are used. Otherwise the up direction is
propagated with the gyro and corrected towards the specific force. One sample of a vehicle that
brakes or turns does not show the vertical, so each sample corrects by dt / 5 s only, and a sample
whose specific force is not about 1 g does not correct at all. The filter needs 5 s of samples to
settle, at the start and after each gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array
from drivers.vn100.messages import encode

# -- Sentences -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transducer:
    """One measurement of an XDR sentence; `value` None: unknown, an empty field."""

    type: str
    value: float | None
    units: str
    name: str


def hdm(heading_deg: float | None) -> bytes:
    """The sentence of the magnetic heading; None: unknown."""
    if heading_deg is None:
        return encode("HCHDM,,M")
    return encode(f"HCHDM,{round(heading_deg % 360.0, 1) % 360.0:05.1f},M")


def xdr(transducers: list[Transducer]) -> bytes:
    """The sentence of these transducers; at most four fit in its 82 characters."""
    fields = [f"{t.type},{_format_number(t.value)},{t.units},{t.name}" for t in transducers]
    return encode("YXXDR," + ",".join(fields))


def attitude_transducers(
    pitch_deg: float | None, roll_deg: float | None, temperature_c: float | None
) -> list[Transducer]:
    """Transducers of pitch and roll, and of the sensor's temperature if it is known."""
    found = [Transducer("A", pitch_deg, "D", "PITCH"), Transducer("A", roll_deg, "D", "ROLL")]
    if temperature_c is not None:
        found.append(Transducer("C", temperature_c, "C", "TEMP"))
    return found


def _format_number(value: float | None) -> str:
    return "" if value is None else f"{round(value, 1) + 0.0:.1f}"  # no -0.0


# -- Up direction ----------------------------------------------------------------------------------


SETTLED_S = 5.0  # time constant of the correction, and time until the direction is used
_LOST_S = 15.0  # without a specific force of about 1 g: then the direction is unknown
_LONGEST_STEP_S = 0.5  # a longer time step restarts the direction
_G_M_S2, _NEAR_G = 9.81, 0.1  # largest relative difference from 1 g that counts as gravity
_STEEP = math.sin(math.radians(60.0))  # pitch above which heading is undefined: it turns into roll


class Tilt:
    """Estimates the up direction of one stream; samples in order."""

    def __init__(self) -> None:
        self._up: tuple[float, float, float] | None = None
        self._rate = [0.0, 0.0, 0.0]
        self._at_s = self._age_s = self._without_gravity_s = 0.0

    def up(
        self,
        time_s: Array,
        gyro_body_rad_s: Array,
        accel_body_m_s2: Array,
        pitch_roll_rad: tuple[Array, Array] | None = None,
    ) -> Array:
        """(N, 3) unit vectors that point up, nan if unknown."""
        if pitch_roll_rad is not None:
            pitch, roll = pitch_roll_rad
            level = np.cos(pitch)
            return np.stack([np.sin(pitch), -level * np.sin(roll), -level * np.cos(roll)], axis=1)
        rows = zip(time_s.tolist(), gyro_body_rad_s.tolist(), accel_body_m_s2.tolist(), strict=True)
        return np.array([self._update(*row) for row in rows]).reshape(-1, 3)

    def _update(self, at_s: float, rate: list[float], force: list[float]) -> tuple[float, ...]:
        dt_s, self._at_s = at_s - self._at_s, at_s
        before, self._rate = self._rate, rate
        size = math.sqrt(sum(part * part for part in force))  # nan if the stream has none
        gravity_like = abs(size / _G_M_S2 - 1.0) < _NEAR_G
        if self._up is None or not 0.0 < dt_s < _LONGEST_STEP_S:
            self._up = (force[0] / size, force[1] / size, force[2] / size) if gravity_like else None
            self._age_s = self._without_gravity_s = 0.0
            return (math.nan,) * 3
        angle = [0.5 * dt_s * (a + b) for a, b in zip(before, rate, strict=True)]
        x, y, z = _rotate_back(self._up, angle)
        if gravity_like:
            gain = min(dt_s / SETTLED_S, 1.0)
            x, y, z = (u + gain * (f / size - u) for u, f in zip((x, y, z), force, strict=True))
        length = math.sqrt(x * x + y * y + z * z)
        self._up = (x / length, y / length, z / length)
        self._age_s += dt_s
        self._without_gravity_s = 0.0 if gravity_like else self._without_gravity_s + dt_s
        if self._without_gravity_s > _LOST_S:
            self._up = None
        known = self._up is not None and self._age_s >= SETTLED_S
        return self._up if known and self._up is not None else (math.nan,) * 3


def _rotate_back(u: tuple[float, float, float], by_rad: list[float]) -> tuple[float, float, float]:
    """A fixed vector in a frame that turned by this small rotation vector; to second order."""
    first = _cross(by_rad, u)
    second = _cross(by_rad, first)
    return (
        u[0] - first[0] + 0.5 * second[0],
        u[1] - first[1] + 0.5 * second[1],
        u[2] - first[2] + 0.5 * second[2],
    )


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def pitch_deg(up_body: Array) -> Array:
    """(N,) pitch, positive with the x axis up."""
    return np.asarray(np.degrees(np.arcsin(np.clip(up_body[:, 0], -1.0, 1.0))))


def roll_deg(up_body: Array) -> Array:
    """(N,) roll, positive with the y axis down."""
    return np.asarray(np.degrees(np.arctan2(-up_body[:, 1], -up_body[:, 2])))


def has_heading(up_body: Array) -> Array:
    """(N,) whether up is known and the pitch is below 60 deg."""
    return np.asarray(np.abs(up_body[:, 0]) < _STEEP)
