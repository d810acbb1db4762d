"""Accuracy of a heading: its errors against a reference, and the errors of dead reckoning with it.

The reference is the course over fixes, an optical attitude, or another heading. The course at fix k
is the direction from fix k-1 to fix k+1; it represents the mean heading between them. Its frame is
true north; the frame of an optical system has an arbitrary yaw, and so has the mount of the sensor.
So one constant is removed from every comparison, and reported.

**Dead reckoning**: velocity and heading integrated to a position ([R] 2.3-2.4), against a
reference.

    p(t) = integral of R_nb v_b,   north and east only

The velocity is that of a Doppler log (columns velocity_{x,y,z}_m_s, sensor frame), a speed along
the heading (column speed_m_s), or the speed of the fixes themselves, which then tests the heading
alone. The one constant of the heading (mount, declination) is the rotation that best aligns the
steps between fixes with those of the reference; both begin at the first fix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ahrsd import so3
from ahrsd.evaluation.track import EvaluationError, EvaluationTrack
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.samples import Array

# -- References ------------------------------------------------------------------------------------


_EARTH_M = 6_371_000.0
_UNBROKEN = 1.6  # times the median time between fixes; a longer one is a gap
_LEAST_FIXES = 10
_LEAST_FORCE_M_S2 = 1.0  # of the mean in world axes; a smaller one is not gravity
_LEAST_INSTANTS = 10
_DEVICE_DETAIL = "its own filter's opinion, not the truth"
QUATERNION = ("ref_qw", "ref_qx", "ref_qy", "ref_qz")
POSITION = ("position_north_m", "position_east_m")


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """M positions on the recording's clock, in metres north and east of the first one."""

    time_s: Array
    north_m: Array
    east_m: Array
    source: str

    def velocity(self) -> tuple[Array, Array, float]:
        """Times (K,), velocity north + i east (K,) in m/s, and half of the time that each spans in
        s.

        Central differences over two steps; none across a gap.
        """
        span_s = self.time_s[2:] - self.time_s[:-2]
        usual_s = float(np.median(span_s))
        position = self.north_m + 1j * self.east_m
        whole = span_s < _UNBROKEN * usual_s
        velocity = ((position[2:] - position[:-2]) / span_s)[whole]
        return self.time_s[1:-1][whole], velocity, usual_s / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class HeadingReference:
    """Headings to compare with.

    name, detail: for titles; further information for the reader
    truth: false for another estimate, such as the device's own
    time_s: (M,) instants; each represents the mean over time_s -+ half_width_s
    heading_rad: (M,) from any fixed direction, positive to the east
    up_b: (N, 3) the vertical in the sensor frame at the track's samples, or None
    """

    name: str
    truth: bool
    time_s: Array
    heading_rad: Array
    half_width_s: float = 0.0
    up_b: Array | None = None
    detail: str = ""


def fixes_from_degrees(time_s: Array, lat_deg: Array, lon_deg: Array, source: str) -> Fixes:
    """Fixes of a receiver. EvaluationError, naming `source`, if the arrays are not positions in
    degrees.
    """
    known = np.isfinite(time_s) & is_place(lat_deg, lon_deg)
    time_s, lat_deg, lon_deg = time_s[known], lat_deg[known], lon_deg[known]
    if len(time_s) < _LEAST_FIXES:
        raise EvaluationError(
            f"{source}: {len(time_s)} fixes with time and position; {_LEAST_FIXES} are needed"
        )
    if np.max(np.abs(lat_deg)) > 90.0 or np.max(np.abs(lon_deg)) > 360.0:
        raise EvaluationError(f"{source}: positions are no degrees; lat_deg, lon_deg are needed")
    if not np.all(np.diff(time_s) > 0):
        row = int(np.argmin(np.diff(time_s) > 0)) + 1
        raise EvaluationError(f"{source}: time does not go forward at fix {row}; sort by time")
    north = np.radians(lat_deg - lat_deg[0]) * _EARTH_M
    east = np.unwrap(np.radians(lon_deg))
    east_m = (east - east[0]) * _EARTH_M * np.cos(np.radians(lat_deg[0]))
    return Fixes(time_s, north, east_m, "GPS")


def is_place(lat_deg: Array, lon_deg: Array) -> NDArray[np.bool]:
    """(N,) which positions are any; receivers without a fix write 0, 0 or nothing."""
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    return np.asarray(known & ((lat_deg != 0.0) | (lon_deg != 0.0)))


def fixes_of_track(track: EvaluationTrack) -> Fixes | None:
    """Positions in the recording itself; None if there are none."""
    if not all(name in track.covariates for name in POSITION):
        return None
    north, east = (track.covariates[name] for name in POSITION)
    known = np.isfinite(north) & np.isfinite(east)
    if np.count_nonzero(known) < _LEAST_FIXES:
        return None
    time_s, north, east = track.time_s[known], north[known], east[known]
    first = np.flatnonzero(np.r_[True, np.diff(np.floor(time_s)) > 0])  # one a second, as GPS
    if len(first) < _LEAST_FIXES:
        return None
    north, east = north[first] - north[0], east[first] - east[0]
    return Fixes(time_s[first], north, east, "position")


def course_reference(fixes: Fixes, least_speed_m_s: float) -> HeadingReference:
    """Course over ground at higher speeds than the least one. EvaluationError if there
    are too few.
    """
    time_s, velocity, half_width_s = fixes.velocity()
    fast = np.abs(velocity) > least_speed_m_s
    if np.count_nonzero(fast) < _LEAST_INSTANTS:
        raise EvaluationError(
            f"{fixes.source}: {np.count_nonzero(fast)} fixes faster than {least_speed_m_s:g} m/s, "
            f"{_LEAST_INSTANTS} are needed: no course to compare with (--min-speed sets it)"
        )
    heading = np.angle(velocity[fast])
    detail = f"speed > {least_speed_m_s:g} m/s"
    return HeadingReference(
        f"{fixes.source} course", True, time_s[fast], heading, half_width_s, detail=detail
    )


def optical_reference(track: EvaluationTrack) -> HeadingReference | None:
    """From the attitude columns ref_q*, sensor to world, scalar first; None without.

    The vertical of that world is measured: the mean specific force, or its z axis if there is none.
    """
    if not all(name in track.covariates for name in QUATERNION):
        return None
    q = np.column_stack([track.covariates[name] for name in QUATERNION])
    norms = np.linalg.norm(q, axis=1)
    known = np.isfinite(norms) & (norms > 0.5)
    if np.count_nonzero(known) < _LEAST_INSTANTS:
        return None
    R_wb = Rotation.from_quat(q[known], scalar_first=True).as_matrix()
    up_w = np.array([0.0, 0.0, 1.0])
    if track.has_accel:
        force_w = np.mean(np.einsum("kij,kj->ki", R_wb, track.accel_b_m_s2[known]), axis=0)
        if (size := float(np.linalg.norm(force_w))) > _LEAST_FORCE_M_S2:
            up_w = force_w / size
    x_w = R_wb[:, :, 0]
    helper = np.array([1.0, 0.0, 0.0]) if abs(up_w[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    ahead = helper - up_w * (helper @ up_w)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(-up_w, ahead)
    up_b = np.full((len(track), 3), np.nan)
    up_b[known] = np.einsum("kji,j->ki", R_wb, up_w)
    heading = np.arctan2(x_w @ right, x_w @ ahead)
    return HeadingReference("optical attitude", True, track.time_s[known], heading, up_b=up_b)


def device_heading(track: EvaluationTrack) -> HeadingReference | None:
    """The device's own yaw, which is not the truth; None without."""
    attitude = track.device_attitude()
    if attitude is None:
        return None
    known = np.isfinite(attitude[0])
    return HeadingReference(
        "the device's yaw", False, track.time_s[known], attitude[0][known], detail=_DEVICE_DETAIL
    )


def column_reference(track: EvaluationTrack, name: str) -> HeadingReference:
    """A heading column in deg or rad, by its suffix. EvaluationError if there is none."""
    if name not in track.covariates:
        others = ", ".join(sorted(track.covariates)) or "none"
        raise EvaluationError(f"the recording has no column {name}; further columns: {others}")
    if not name.endswith(("_deg", "_rad")):
        raise EvaluationError(f"column {name}: its name must end in _deg or _rad")
    values = track.covariates[name] * (np.pi / 180.0 if name.endswith("_deg") else 1.0)
    known = np.isfinite(values)
    if np.count_nonzero(known) < _LEAST_INSTANTS:
        raise EvaluationError(f"column {name} holds {np.count_nonzero(known)} numbers only")
    device = name in ("vn_yaw_deg", "yaw_rad")
    detail = _DEVICE_DETAIL if device else ""
    return HeadingReference(
        f"column {name}", not device, track.time_s[known], values[known], detail=detail
    )


# -- Whether a reference turns as the gyro does ----------------------------------------------------


_WINDOW_S = 1.0  # over which both turn, and twice the half width of a mean on top
_LEAST_TURN_RAD, _MOST_TURN_RAD = 0.1, 2.5  # by the gyro, of windows that tell something
_FEWEST_TURNS, _MOST_TURNS = 20, 2000
#: correlations below and within which it is no heading of this craft
_OTHER_WAY, _UNLIKE = -0.5, 0.3
_OTHER_UNIT = 0.1  # of the gyro's turn; in rad where deg are wanted it is 0.017
_CONVENTION = "a heading is positive to the right (north over east), in the unit of its name"
_ATTITUDE_CONVENTION = "ref_q{w,x,y,z} turns the sensor's own axes into the world's, scalar first"


def turning_fault(track: EvaluationTrack, reference: HeadingReference, up_b: Array) -> str | None:
    """What a reference is not, by its turns within a second against the gyro's; None: nothing.

    up_b (N, 3): the vertical that its headings are compared with. None too where it hardly turns.
    """
    starts, ends = _windows(track, reference)
    at = np.clip(np.searchsorted(track.time_s, reference.time_s), 0, len(track) - 1)
    gyro_rad = _gyro_turns(track, up_b, at[starts], at[ends])
    own_rad = wrapped(reference.heading_rad[ends] - reference.heading_rad[starts])
    size = np.abs(gyro_rad)
    usable = (size > _LEAST_TURN_RAD) & (size < _MOST_TURN_RAD) & np.isfinite(own_rad)
    if np.count_nonzero(usable) < _FEWEST_TURNS:
        return None
    a, b = gyro_rad[usable], own_rad[usable]
    both, gyro, own = float(a @ b), float(a @ a), float(b @ b)
    alike, ratio = both / np.sqrt(gyro * own) if own > 0.0 else 0.0, both / gyro
    convention = _CONVENTION if reference.up_b is None else _ATTITUDE_CONVENTION
    if alike < _OTHER_WAY:
        return f"turns the other way than the gyro says: {convention}"
    if alike > _UNLIKE and ratio < _OTHER_UNIT:
        return f"turns {1.0 / ratio:.3g} times less than the gyro says: it is in another unit"
    if abs(alike) < _UNLIKE:
        return f"does not turn as the gyro says: {convention}, on the recording's clock"
    return None


def _windows(
    track: EvaluationTrack, reference: HeadingReference
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last instant of each window of the reference, none across a gap of the track."""
    time_s = reference.time_s
    length_s = _WINDOW_S + 2.0 * reference.half_width_s
    starts = np.arange(0, len(time_s), max(len(time_s) // _MOST_TURNS, 1))
    ends = np.minimum(np.searchsorted(time_s, time_s[starts] + length_s), len(time_s) - 1)
    begins = track.time_s[list(track.starts)]
    piece = np.searchsorted(begins, time_s, side="right")
    span_s = time_s[ends] - time_s[starts]
    inside = (time_s[starts] >= track.time_s[0]) & (time_s[ends] <= track.time_s[-1])
    kept = inside & (span_s > 0.0) & (span_s < 2.0 * length_s) & (piece[starts] == piece[ends])
    return starts[kept], ends[kept]


def _gyro_turns(
    track: EvaluationTrack, up_b: Array, first: NDArray[np.intp], last: NDArray[np.intp]
) -> Array:
    """(K,) how far x turns to the right about the vertical from one sample to another, rad; nan
    where it points up or down."""
    dt_s = np.diff(track.time_s, prepend=track.time_s[0])
    R_0b = so3.products(so3.exp(track.gyro_b_rad_s * dt_s[:, None]))
    up_0 = np.einsum("kij,kj->ki", R_0b[first], up_b[first])
    with np.errstate(invalid="ignore", divide="ignore"):
        up_0 = up_0 / np.linalg.norm(up_0, axis=1, keepdims=True)
    x = [R_0b[k][:, :, 0] for k in (first, last)]
    level = [one - up_0 * np.einsum("kj,kj->k", one, up_0)[:, None] for one in x]
    right = -np.sum(np.cross(level[0], level[1]) * up_0, axis=1)
    turn = np.arctan2(right, np.sum(level[0] * level[1], axis=1))
    least = np.min([np.linalg.norm(one, axis=1) for one in level], axis=0)
    return np.where(least > _LEVEL_ENOUGH, turn, np.nan)


# -- Errors against a reference --------------------------------------------------------------------


FOLDS = 5
_LEVEL_ENOUGH = 0.3  # least horizontal part of the x axis for a heading
_LEAST_OVERLAP = 10
_BLOCK_S, _LEAST_BLOCKS = 20.0, 5  # errors in different blocks count as independent
_DRAWS = 2000


@dataclass(frozen=True, slots=True, eq=False)
class HeadingFigures:
    """Errors of one calibration at M instants.

    offset_deg: the constant that was removed: heading minus reference
    fold_rms_deg: RMS in each fifth of the instants, in order of time
    fold_spread_deg: their standard deviation
    time_s, reference_deg, error_deg: (M,)
    """

    rms_deg: float
    worst_deg: float
    offset_deg: float
    fold_rms_deg: tuple[float, ...]
    fold_spread_deg: float
    time_s: Array
    reference_deg: Array
    error_deg: Array


def heading_figures(
    time_s: Array,
    field_b: Array,
    up_b: Array,
    reference: HeadingReference,
    declination_rad: float = 0.0,
) -> HeadingFigures:
    """Errors of corrected fields (N, 3) at (N,) instants, levelled by up_b (N, 3).

    Samples without a direction are left out. Raises EvaluationError if the reference and the
    recording hardly overlap.
    """
    with np.errstate(invalid="ignore", divide="ignore"):  # what has no direction is left out
        heading = tilt_compensated_heading(field_b, up_b) + declination_rad
        usable = np.isfinite(heading)
        if reference.up_b is None:  # else the error is that of the field's azimuth, whatever x does
            level = np.linalg.norm(up_b[:, 1:], axis=1) / np.linalg.norm(up_b, axis=1)
            usable &= level > _LEVEL_ENOUGH
    headings, has_samples = _mean_heading_at(time_s[usable], heading[usable], reference)
    if np.count_nonzero(has_samples) < _LEAST_OVERLAP:
        raise EvaluationError(
            f"{reference.name}: {np.count_nonzero(has_samples)} instants within the recording, "
            f"{_LEAST_OVERLAP} are needed; are both on the same clock?"
        )
    raw = headings[has_samples] - reference.heading_rad[has_samples]
    offset = float(np.angle(np.mean(np.exp(1j * raw))))
    error_deg = np.degrees(wrapped(raw - offset))
    folds = tuple(_rms(part) for part in np.array_split(error_deg, FOLDS))
    return HeadingFigures(
        rms_deg=_rms(error_deg),
        worst_deg=float(np.max(np.abs(error_deg))),
        offset_deg=float(np.degrees(offset)),
        fold_rms_deg=folds,
        fold_spread_deg=float(np.std(folds)),
        time_s=reference.time_s[has_samples],
        reference_deg=np.mod(np.degrees(reference.heading_rad[has_samples]), 360.0),
        error_deg=error_deg,
    )


def rms_difference(one: HeadingFigures, other: HeadingFigures) -> tuple[float, float] | None:
    """95 % interval of the RMS of one less that of the other, deg; at the same instants.

    A paired block bootstrap: blocks of 20 s are resampled, the same ones for both, so that effects
    of places and turns common to both cancel. None if the instants differ or cover too little.
    """
    if not np.array_equal(one.time_s, other.time_s):
        return None
    _, block = np.unique(np.floor(one.time_s / _BLOCK_S), return_inverse=True)
    blocks = int(block.max()) + 1
    if blocks < _LEAST_BLOCKS:
        return None
    count, *sums = (np.bincount(block, v) for v in (None, one.error_deg**2, other.error_deg**2))
    drawn = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), _DRAWS)
    first, second = (np.sqrt((drawn @ total) / (drawn @ count)) for total in sums)
    low, high = np.quantile(first - second, [0.025, 0.975])
    return float(low), float(high)


def _mean_heading_at(
    time_s: Array, heading_rad: Array, reference: HeadingReference
) -> tuple[Array, NDArray[np.bool_]]:
    """Circular mean heading (M,) around each instant, and which of them have samples there."""
    if not len(time_s):
        return np.zeros(len(reference.time_s)), np.zeros(len(reference.time_s), dtype=bool)
    half = max(reference.half_width_s, 0.51 * float(np.median(np.diff(time_s, append=np.inf))))
    sums = np.concatenate([[0.0], np.cumsum(np.exp(1j * heading_rad))])
    if reference.half_width_s == 0.0:  # the nearest sample
        right = np.clip(np.searchsorted(time_s, reference.time_s), 1, max(len(time_s) - 1, 1))
        left = np.clip(right - 1, 0, len(time_s) - 1)
        right = np.clip(right, 0, len(time_s) - 1)
        before, after = reference.time_s - time_s[left], time_s[right] - reference.time_s
        nearest = np.where(before <= after, left, right)
        return heading_rad[nearest], np.abs(time_s[nearest] - reference.time_s) <= half
    first = np.searchsorted(time_s, reference.time_s - half)
    last = np.searchsorted(time_s, reference.time_s + half, side="right")
    usual = np.median(last - first)
    return np.angle(sums[last] - sums[first]), np.asarray(last - first > 0.5 * usual)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# -- Dead reckoning --------------------------------------------------------------------------------


DOPPLER = ("velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s")
SPEED = "speed_m_s"
_LEAST_M = 20.0  # least distance for a percentage


@dataclass(frozen=True, slots=True, eq=False)
class ReckoningFigures:
    """Horizontal position errors of one calibration, relative to the distance travelled.

    rms_percent, final_percent: of the distance; worst_m. north_m, east_m: (M,) the reckoned
    position at the fixes.
    """

    rms_percent: float
    final_percent: float
    worst_m: float
    offset_deg: float
    north_m: Array
    east_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """Velocity for dead reckoning: v_b (N, 3) in the sensor frame, or speed (N,) along x."""

    source: str
    v_b_m_s: Array | None
    speed_m_s: Array | None


def velocity_of(track: EvaluationTrack, fixes: Fixes) -> Velocity:
    """The best velocity that the recording has."""
    if all(name in track.covariates for name in DOPPLER):
        v_b = np.column_stack([track.covariates[name] for name in DOPPLER])
        return Velocity("Doppler velocity (velocity_{x,y,z}_m_s)", np.nan_to_num(v_b), None)
    if SPEED in track.covariates:
        return Velocity(f"column {SPEED}", None, np.nan_to_num(track.covariates[SPEED]))
    time_s, velocity, _ = fixes.velocity()
    speed = np.interp(track.time_s, time_s, np.abs(velocity))
    return Velocity(f"speed of {fixes.source}", None, speed)


def fixes_within(track: EvaluationTrack, fixes: Fixes) -> Fixes | None:
    """The fixes during the recording, relative to the first of them; None if there are too few."""
    inside = (fixes.time_s >= track.time_s[0]) & (fixes.time_s <= track.time_s[-1])
    if np.count_nonzero(inside) < _LEAST_FIXES:
        return None
    north, east = fixes.north_m[inside], fixes.east_m[inside]
    return Fixes(fixes.time_s[inside], north - north[0], east - east[0], fixes.source)


def distance_travelled(track: EvaluationTrack, velocity: Velocity, fixes: Fixes) -> float | None:
    """Distance between the first and the last fix, m; None if it is too short."""
    speed = velocity.speed_m_s
    if velocity.v_b_m_s is not None:
        speed = np.linalg.norm(velocity.v_b_m_s, axis=1)
    assert speed is not None
    inside = (track.time_s >= fixes.time_s[0]) & (track.time_s <= fixes.time_s[-1])
    way = float(np.trapezoid(np.abs(speed[inside]), track.time_s[inside]))
    return way if way >= _LEAST_M else None


def reckoning_figures(
    track: EvaluationTrack,
    field_b: Array,
    up_b: Array,
    velocity: Velocity,
    fixes: Fixes,
    way_m: float,
) -> ReckoningFigures:
    """Figures of corrected fields (N, 3), with fixes of `fixes_within` and way_m of
    `distance_travelled`.
    """
    with np.errstate(invalid="ignore", divide="ignore"):  # no heading, no way: looks up or down
        v = np.nan_to_num(_level_velocity(field_b, up_b, velocity))
    dt_s = np.diff(track.time_s)
    path = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * dt_s)])
    position = np.interp(fixes.time_s, track.time_s, path)
    position -= position[0]
    true = fixes.north_m + 1j * fixes.east_m
    offset = np.angle(np.sum(np.diff(position) * np.conj(np.diff(true))))
    position = position * np.exp(-1j * offset)
    error = np.abs(position - true)
    return ReckoningFigures(
        rms_percent=100.0 * float(np.sqrt(np.mean(error**2))) / way_m,
        final_percent=100.0 * float(error[-1]) / way_m,
        worst_m=float(np.max(error)),
        offset_deg=float(np.degrees(offset)),
        north_m=np.real(position),
        east_m=np.imag(position),
    )


def _level_velocity(field_b: Array, up_b: Array, velocity: Velocity) -> Array:
    """North + i east (N,) in m/s, relative to magnetic north."""
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
