"""Dead reckoning: velocity through heading to a position ([R] 2.3-2.4), beside a reference.

    p(t) = integral of R_nb v_b,   north and east only

The velocity is a Doppler log's (columns velocity_{x,y,z}_m_s, sensor frame), a speed along the
heading (column speed_m_s), or the fixes' own speed: that judges the heading alone. The one constant
of the heading (mount, declination) is the rotation that lays the steps between fixes best onto the
reference's; both begin at the first fix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.evaluation.heading import Fixes
from ahrsd.evaluation.track import EvaluationTrack
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array

DOPPLER = ("velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s")
SPEED = "speed_m_s"
_LEAST_FIXES = 10
_LEAST_M = 20.0  # of way, below which a percentage says nothing


@dataclass(frozen=True, slots=True, eq=False)
class ReckoningFigures:
    """XY position errors of one calibration over the distance travelled.

    rms_percent, final_percent: of the distance; worst_m
    north_m, east_m: (M,) the reckoned position at the fixes
    """

    rms_percent: float
    final_percent: float
    worst_m: float
    offset_deg: float
    north_m: Array
    east_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """Where the velocity comes from: v_b (N, 3) in the sensor frame, or speed (N,) along x."""

    source: str
    v_b_m_s: Array | None
    speed_m_s: Array | None


def velocity_of(track: EvaluationTrack, fixes: Fixes) -> Velocity:
    """The best that the recording has."""
    if all(name in track.covariates for name in DOPPLER):
        v_b = np.column_stack([track.covariates[name] for name in DOPPLER])
        return Velocity("Doppler velocity (velocity_{x,y,z}_m_s)", np.nan_to_num(v_b), None)
    if SPEED in track.covariates:
        return Velocity(f"column {SPEED}", None, np.nan_to_num(track.covariates[SPEED]))
    time_s, velocity, _ = fixes.velocity()
    speed = np.interp(track.time_s, time_s, np.abs(velocity))
    return Velocity(f"speed of {fixes.source}", None, speed)


def within(track: EvaluationTrack, fixes: Fixes) -> Fixes | None:
    """The fixes during the recording, from the first one; None where they are too few."""
    inside = (fixes.time_s >= track.time_s[0]) & (fixes.time_s <= track.time_s[-1])
    if np.count_nonzero(inside) < _LEAST_FIXES:
        return None
    north, east = fixes.north_m[inside], fixes.east_m[inside]
    return Fixes(fixes.time_s[inside], north - north[0], east - east[0], fixes.source)


def distance_m(track: EvaluationTrack, velocity: Velocity, fixes: Fixes) -> float | None:
    """Way travelled between the first and the last fix; None where it is next to nothing."""
    speed = velocity.speed_m_s
    if velocity.v_b_m_s is not None:
        speed = np.linalg.norm(velocity.v_b_m_s, axis=1)
    assert speed is not None
    inside = (track.time_s >= fixes.time_s[0]) & (track.time_s <= fixes.time_s[-1])
    way = float(np.trapezoid(np.abs(speed[inside]), track.time_s[inside]))
    return way if way >= _LEAST_M else None


def reckon(
    track: EvaluationTrack,
    field_b: Array,
    up_b: Array,
    velocity: Velocity,
    fixes: Fixes,
    way_m: float,
) -> ReckoningFigures:
    """Figures of corrected fields (N, 3), with `fixes` of `within` and `way_m` of `distance_m`."""
    with np.errstate(invalid="ignore", divide="ignore"):  # no heading, no way: looks up or down
        v = np.nan_to_num(_level_velocity(field_b, up_b, velocity))
    dt_s = np.diff(track.time_s)
    path = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * dt_s)])
    found = np.interp(fixes.time_s, track.time_s, path)
    found -= found[0]
    true = fixes.north_m + 1j * fixes.east_m
    offset = np.angle(np.sum(np.diff(found) * np.conj(np.diff(true))))
    found = found * np.exp(-1j * offset)
    error = np.abs(found - true)
    return ReckoningFigures(
        rms_percent=100.0 * float(np.sqrt(np.mean(error**2))) / way_m,
        final_percent=100.0 * float(error[-1]) / way_m,
        worst_m=float(np.max(error)),
        offset_deg=float(np.degrees(offset)),
        north_m=np.real(found),
        east_m=np.imag(found),
    )


def _level_velocity(field_b: Array, up_b: Array, velocity: Velocity) -> Array:
    """North + i east (N,) in m/s, of magnetic north."""
    if velocity.v_b_m_s is None:
        assert velocity.speed_m_s is not None
        heading = tilt_compensated_heading(field_b, up_b)
        return np.asarray(velocity.speed_m_s * np.exp(1j * heading))
    down = -up_b / np.linalg.norm(up_b, axis=1, keepdims=True)
    north = field_b - down * np.sum(down * field_b, axis=1, keepdims=True)
    north = north / np.linalg.norm(north, axis=1, keepdims=True)
    east = np.cross(down, north)
    v_b = velocity.v_b_m_s
    return np.asarray(np.sum(v_b * north, axis=1) + 1j * np.sum(v_b * east, axis=1))
