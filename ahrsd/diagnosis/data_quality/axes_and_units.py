"""Units, axes and signs of the magnetometer and the gyro, checked against each other and gravity.

Do gyro and magnetometer use the same axes and the same unit (`rank_frames`)?  A field that is fixed
in the world turns against the sensor.  With hard iron b, gyro bias -c, and P the gyro's axes and
unit relative to the magnetometer's,

    dm/dt = (m - b) x (P w + c) = m x P w - (b x) P w + m x c - b x c

This is linear in [P, (b x) P, c, b x c].  Integrated over windows it needs no derivative of a noisy
reading.  The normal equations of all 24 unknowns, built once, contain those of each of the 48
signed permutations P = s Pi: 10 unknowns [s, s b, c, b x c], of which the 24 are a linear map.
Soft iron is neglected here: it affects all 48 alike.

A turn at a constant rate c is part of each of the 48 models, whatever the gyro reads.  Frames are
therefore compared by what they explain beyond such a turn.

Which sensor has the wrong axes, and is the magnetometer mirrored or turned
(`find_magnetometer_axis_error`)?  Gyro and magnetometer alone determine a signed permutation P
between the two, true rate = P reading, and nothing more: a field m and its negative turn alike.  So
a proper P, which would turn the gyro, is also what two kinds of wrong magnetometer show: a mirrored
one, whose readings are right as Q m with Q = -P^T, and a turned one, Q = P^T.  To confuse the two
turns every heading by 180 degrees.

Axes that are turned by an angle other than a quarter turn (`find_misalignment`) are found as a
general 3 x 3 map, after hard and soft iron are removed by an ellipsoid fit to the readings, which
needs no gyro.

The accelerometer shows which sensor is wrong: it agrees either with the gyro as recorded or with
the magnetometer.  Of the two ways to correct the magnetometer, one has the field point into the
ground, which is right north of the magnetic equator.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import fit_ellipsoid, fit_sphere_centre
from ahrsd.diagnosis.data_quality.facts import Fact, whole_recording
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array
from ahrsd.so3 import skew

_PARTS = 4  # into which a recording is cut
#: unit, its size in gauss, and the range of median readings that the Earth's field (0.2 to 0.7 G)
#: has in it
MAG_UNITS = (
    ("uT", 1e-2, 20.0, 70.0),
    ("mG", 1e-3, 200.0, 700.0),
    ("nT", 1e-5, 2e4, 7e4),
    ("T", 1e4, 2e-5, 7e-5),
)
GYRO_UNITS = (("deg/s", np.pi / 180), ("mrad/s", 1e-3), ("rpm", 2 * np.pi / 60))
_WINDOW_S = 0.5
_ROWS, _WINDOWS = 4000, 80  # samples and windows that are used, those with the largest turns
_AXES = "xyz"


def axis_and_unit_errors(track: Track) -> list[Fact]:
    """Wrong units, axes and signs.  No fit means anything before they are corrected."""
    return magnetometer_unit_error(track) + _gyro_axis_and_unit_errors(track)


def magnetometer_unit_error(track: Track) -> list[Fact]:
    """The magnetometer in another unit, recognised by the size of the Earth's field alone."""
    size = track.usual_gauss
    for name, factor, low, high in MAG_UNITS:
        if low <= size <= high:
            words = f"the magnetometer reads {size:.3g}: that is {name}, not gauss"
            return [
                _unit_error(track, words, 1 / factor, {"sensor": "mag", "unit": name}, "sensor")
            ]
    return []


def _gyro_axis_and_unit_errors(track: Track) -> list[Fact]:
    """Wrong axes, signs and unit of the gyro, compared with the magnetometer."""
    equations = window_equations(track)
    if equations is None:
        return []
    misalignment = find_misalignment(track, _is_clearly_worse)
    if misalignment is not None:
        return [_misalignment_fact(track, misalignment)]
    frames = rank_frames(equations)
    identity = next((one for one in frames if one.is_identity), None)
    if not frames:
        return []
    best = frames[0]
    if best.cost > priors.FRAME_EXPLAINED:
        return (
            _gyro_unit(track, best) if _is_surely_in_degrees(track, best, equations.count) else []
        )
    if identity is not None and (
        identity.cost < priors.FRAME_BENT * best.cost
        or not _is_clearly_worse(identity.cost, best.cost, equations.count)
    ):
        best = identity
    facts = []
    if not best.is_identity:
        equal = [
            one for one in frames if not _is_clearly_worse(one.cost, best.cost, equations.count)
        ]
        facts.append(_frame_error(track, min(equal, key=_count_changes), len(equal)))
    if not 1 / priors.OTHER_UNIT < best.scale < priors.OTHER_UNIT:
        facts += _gyro_unit(track, best)
    return facts


def _is_surely_in_degrees(track: Track, best: SignedPermutation, count: int) -> bool:
    """Whether rates that explain only part of the field's change are beyond doubt in degrees.

    In a room, or near a motor, no frame explains most of the change.  But no vehicle turns at
    3 rad/s for a tenth of the time while its field turns at a fifty-seventh of that.
    """
    clear = best.is_identity and -1.5 * count * np.log(max(best.cost, 1e-12)) > priors.FRAME_NATS
    size = np.linalg.norm(track.gyro_b_rad_s, axis=1)
    fast = float(np.nanpercentile(size, 90)) > priors.FAST_RAD_S
    return bool(
        clear and fast and abs(np.log(best.scale * 180 / np.pi)) < np.log(priors.DEGREES_NEAR)
    )


def _is_clearly_worse(cost: float, best: float, count: int) -> bool:
    """Whether a frame explains so much less than the best one that it is excluded."""
    ratio = max(cost, 1e-12) / max(best, 1e-12)
    return ratio > priors.FRAME_BETTER and 1.5 * count * np.log(ratio) > priors.FRAME_NATS


def _frame_error(track: Track, best: SignedPermutation, equal: int) -> Fact:
    """The finding of wrong axes.  equal: number of frames that explain the recording as well, this
    one included.
    """
    odd = find_magnetometer_axis_error(track, best.matrix)
    words = _frame_words(track, best) if odd is None else odd.words
    if equal > 1:
        words += (
            f"; or one of {equal - 1} other assignments of axes and signs, which this motion does "
            "not distinguish: record turns about all axes"
        )
    return Fact(
        "frame_error",
        words,
        Where(whole_recording(track), ("x", "y", "z"), "gyro" if odd is None else "sensor"),
        1.0 if equal == 1 else priors.SURE_OF_READINGS,  # probability that it is one of them
        (Value("present", 1.0, 0.0, "1"),),
        # the true rate is signs * reading[axes]
        {"axes": list(best.axes), "signs": list(best.signs)},
        stops=True,
    )


def _misalignment_fact(track: Track, misalignment: SensorMisalignment) -> Fact:
    """The finding that gyro and magnetometer are turned by an angle that is no quarter turn."""
    names = (f"angle_{axis}" for axis in "xyz")
    return Fact(
        "mag_gyro_misalignment",
        misalignment.words,
        Where(
            whole_recording(track),
            ("x", "y", "z"),
            "sensor" if misalignment.of_magnetometer else "gyro",
        ),
        priors.SURE_OF_READINGS,
        tuple(
            Value(name, float(value), 0.0, "rad")
            for name, value in zip(names, misalignment.rotation_rad, strict=True)
        ),
        stops=True,
    )


def _count_changes(frame: SignedPermutation) -> int:
    """Number of axes and signs that differ from the recorded ones."""
    swapped = sum(axis != place for place, axis in enumerate(frame.axes))
    return swapped + sum(sign < 0 for sign in frame.signs)


def _frame_words(track: Track, best: SignedPermutation) -> str:
    """How the gyro's axes are described; both corrections if either sensor may be wrong."""
    P = best.matrix
    words = f"the gyro's x y z are the magnetometer's {' '.join(_inverse_axis_words(best))}"
    if np.linalg.det(P) < 0:
        return f"{words} (left-handed)"
    if gyro_matches_accelerometer(track, P):
        return f"{words} and the accelerometer's"
    return (
        f"{words}, or the magnetometer is left-handed ({axis_correction_words(-P.T)}): "
        "correct neither before you know which one is wrong; the wrong correction turns every "
        "heading by 180 deg"
    )


def _inverse_axis_words(frame: SignedPermutation) -> list[str]:
    """The axes of the reading, expressed in the magnetometer's frame."""
    out = [""] * 3
    for true_axis, (axis, sign) in enumerate(zip(frame.axes, frame.signs, strict=True)):
        out[axis] = f"{'-' if sign < 0 else ''}{'xyz'[true_axis]}"
    return out


def _gyro_unit(track: Track, best: SignedPermutation) -> list[Fact]:
    """A wrong unit of the gyro: the one with the nearest factor, or an unnamed one."""
    tried = [(name, f) for name, factor in GYRO_UNITS for f in (factor, 1 / factor)]
    name, factor = min(tried, key=lambda pair: abs(np.log(best.scale / pair[1])))
    large = best.scale < 1
    off = f"{1 / best.scale:.3g} times too large" if large else f"{best.scale:.3g} times too small"
    if abs(np.log(best.scale / factor)) > np.log(priors.SAME_UNIT):
        if _noise_hides_scale(track) or _unit_is_right_in_part(track):
            return []
        usual = 1 / factor if large else factor
        words = (
            f"the gyro's rates are {off} for the turns of the field: the rates or the time stamps "
            f"are in another unit ({name} would be a factor of {usual:.3g})"
        )
        factor, name = best.scale, "another unit"
    else:
        way = f"in {name}" if large else f"divided by {factor:.4g} once too often"
        words = f"the gyro's rates are {off}: they are {way}"
    setting = {"sensor": "gyro", "unit": name}
    return [_unit_error(track, words, 1 / factor, setting, "gyro")]


def _noise_hides_scale(track: Track) -> bool:
    """Whether noise is a considerable part of the rates, even averaged over the frames' windows.

    The estimated scale of rates that are mostly noise is too small, whatever their unit is.
    """
    rows = rows_per_window(track)
    whole = len(track) // rows * rows
    if not whole:
        return True
    means = np.nan_to_num(track.gyro_b_rad_s[:whole]).reshape(-1, rows, 3).mean(axis=1)
    noise = 3 * noise_of_differences(track)[1] ** 2 / rows
    return bool(noise > priors.RATES_NOISE_SHARE * np.sum(np.var(means, axis=0)))


def _unit_is_right_in_part(track: Track) -> bool:
    """Whether the rates match the field's turns in their own unit in some part of the recording.

    A unit holds for the whole recording.  But while a magnet is being mounted, the field's
    changes are not caused by turns.
    """
    edges = np.linspace(0, len(track), _PARTS + 1).astype(int)
    parts = [window_equations(track, slice(int(a), int(b))) for a, b in itertools.pairwise(edges)]
    frames = [frame for one in parts if one is not None for frame in rank_frames(one)]
    return any(
        one.is_identity
        and one.cost < priors.PART_EXPLAINED
        and 1 / priors.OTHER_UNIT < one.scale < priors.OTHER_UNIT
        for one in frames
    )


def _unit_error(
    track: Track, words: str, too_large: float, setting: dict[str, str], frame: str
) -> Fact:
    """The finding of a wrong unit.  too_large: factor by which the readings are too large."""
    parameters = (Value("factor_less_one", too_large - 1, 0.0, "1"),)
    where = Where(whole_recording(track), ("x", "y", "z"), frame)
    return Fact(
        "unit_error", words, where, priors.SURE_OF_READINGS, parameters, dict(setting), stops=True
    )


@dataclass(frozen=True, slots=True, eq=False)
class SignedPermutation:
    """One of the 48 frames: gyro_true_i = signs_i * gyro_(axes_i) * scale.

    cost: residual sum of squares relative to that of a turn at a constant rate, 0..1
    """

    axes: tuple[int, int, int]
    signs: tuple[int, int, int]
    scale: float
    cost: float

    @property
    def is_identity(self) -> bool:
        """Whether no axis is swapped or negated."""
        return self.axes == (0, 1, 2) and self.signs == (1, 1, 1)

    @property
    def matrix(self) -> Array:
        """(3, 3) the signed permutation P, true rate = P reading."""
        P = np.zeros((3, 3))
        P[range(3), self.axes] = self.signs
        return P


@dataclass(frozen=True, slots=True, eq=False)
class WindowEquations:
    """Normal equations over the windows.

    gram: (24, 24);  right: (24,) right-hand side;  total: sum of squares of the readings' changes
    count: number of windows
    """

    gram: Array
    right: Array
    total: float
    count: int


def rows_per_window(track: Track) -> int:
    """Number of samples in a window."""
    return max(4, round(_WINDOW_S / track.step_s))


def window_equations(track: Track, part: slice | None = None) -> WindowEquations | None:
    """Normal equations of the windows with the largest turns; None if there are too few windows.

    part: rows of the track; None for all
    """
    length = rows_per_window(track)
    whole = part or slice(0, len(track))
    blocks = [one for one in _blocks(track, length) if whole.start <= one.start < whole.stop]
    if len(blocks) < 12:
        return None
    turn = np.array([np.sum(np.abs(track.gyro_b_rad_s[rows]), axis=0).max() for rows in blocks])
    chosen = np.argsort(-turn)[: max(_WINDOWS, _ROWS // length)]
    rows = np.concatenate([np.arange(blocks[k].start, blocks[k].stop) for k in np.sort(chosen)])
    m0, m1 = track.mag_b_gauss[rows - 1], track.mag_b_gauss[rows]
    middle, dt = (m0 + m1) / 2, track.dt_s[rows][:, None]
    rate = track.gyro_b_rad_s[rows] * dt
    starts = np.arange(0, len(rows), length)
    cross = skew(middle)
    parts = [
        np.einsum("nab,nj->nabj", cross, rate).reshape(-1, 3, 9),
        np.einsum("ab,nj->nabj", np.eye(3), rate).reshape(-1, 3, 9),
        cross * dt[:, :, None],
        np.eye(3) * dt[:, :, None],
    ]
    X = np.add.reduceat(np.concatenate(parts, axis=2), starts, axis=0).reshape(-1, 24)
    y = np.add.reduceat(m1 - m0, starts, axis=0).ravel()
    if not (np.isfinite(X).all() and np.isfinite(y).all()):
        good = np.isfinite(X).all(axis=1) & np.isfinite(y)
        X, y = X[good], y[good]
    return WindowEquations(X.T @ X, X.T @ y, float(y @ y), len(starts))


def _blocks(track: Track, length: int) -> Iterator[slice]:
    """Consecutive windows of `length` rows within the runs."""
    for run in track.runs or (slice(0, len(track)),):
        for first in range(run.start + 1, run.stop - length + 1, length):
            yield slice(first, first + length)


def rank_frames(equations: WindowEquations) -> list[SignedPermutation]:
    """The frames by increasing cost; of a frame and its negative, the one with positive scale."""
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    constant_turn_cost = max(equations.total - _solve_constrained(equations, constant)[1], 1e-300)
    out = []
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), axes] = signs
            scale, explained = _fit_frame(equations, P)
            if scale > 0:
                i, j, k = axes
                a, b, c = signs
                out.append(
                    SignedPermutation(
                        (i, j, k),
                        (a, b, c),
                        scale,
                        (equations.total - explained) / constant_turn_cost,
                    )
                )
    return sorted(out, key=lambda frame: frame.cost)


#: relative size below which a number is rounding error
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LinearMap:
    """A general linear map (3, 3) between the two sensors, true rate = matrix @ reading.

    deviation: largest standard deviation of its entries;  cost: as of a `SignedPermutation`
    """

    matrix: Array
    deviation: float
    cost: float


def fit_linear_map(equations: WindowEquations) -> LinearMap:
    """The least-squares map with all 24 unknowns free.

    Its deviation is the largest of its entries', infinite if one of them was never excited.
    """
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    constant_turn_cost = max(equations.total - _solve_constrained(equations, constant)[1], 1e-300)
    solved, explained = _solve_constrained(equations, np.eye(24))
    residual = max(equations.total - explained, 0.0)
    scale = np.sqrt(np.maximum(np.diag(equations.gram), 0.0))
    if not np.all(scale[:9] > _ROUNDING * np.max(scale)):
        return LinearMap(np.eye(3), np.inf, 1.0)
    scale = np.maximum(scale, _ROUNDING * np.max(scale))
    spread = np.linalg.inv(equations.gram / scale[:, None] / scale + 1e-9 * np.eye(24))
    variance = np.diag(spread)[:9] / scale[:9] ** 2 * residual / max(3 * equations.count - 24, 1)
    return LinearMap(
        solved[:9].reshape(3, 3), float(np.sqrt(variance.max())), residual / constant_turn_cost
    )


def _fit_frame(equations: WindowEquations, P: Array) -> tuple[float, float]:
    """Scale of P = s Pi and the sum of squares that it explains, with free hard iron and bias."""
    T = np.zeros((24, 10))
    T[:9, 0] = P.ravel()
    for axis in range(3):
        T[9:18, 1 + axis] = -(skew(np.eye(3)[axis]) @ P).ravel()
    T[18:, 4:] = np.eye(6)
    solved, explained = _solve_constrained(equations, T)
    return float(solved[0]), explained


def _solve_constrained(equations: WindowEquations, T: Array) -> tuple[Array, float]:
    """Least squares with the 24 unknowns as a linear map (24, k) of k others.

    Returns these (k,) and the sum of squares that they explain.
    """
    gram, right = T.T @ equations.gram @ T, T.T @ equations.right
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    normal = gram / scale[:, None] / scale + 1e-9 * np.eye(T.shape[1])
    solved = np.linalg.solve(normal, right / scale)
    # twice the linear part less the quadratic one: exact also where the ridge matters
    explained = 2 * solved @ (right / scale) - solved @ (gram / scale[:, None] / scale) @ solved
    return np.asarray(solved / scale), float(explained)


@dataclass(frozen=True, slots=True, eq=False)
class MagnetometerAxisError:
    """A magnetometer with wrong axes.

    right, other: (3, 3) signed permutations that correct its readings: the most probable one, and
                  the one that is right on the other hemisphere
    """

    right: Array
    other: Array

    @property
    def mirrored(self) -> bool:
        """Whether its readings are left-handed."""
        return bool(np.linalg.det(self.right) < 0)

    @property
    def words(self) -> str:
        """One line: what is wrong, how to correct it, and where the other correction is right."""
        what = "is left-handed" if self.mirrored else "is turned against the gyro"
        return (
            f"the magnetometer {what}: {axis_correction_words(self.right)} "
            f"(south of the magnetic equator, where the field points out of the ground: "
            f"{axis_correction_words(self.other)})"
        )


def find_magnetometer_axis_error(track: Track, gyro: Array) -> MagnetometerAxisError | None:
    """The magnetometer's axis error; None if the gyro's axes may be the wrong ones.

    gyro: (3, 3) the signed permutation P that would turn the gyro's readings into the
          magnetometer's axes
    """
    if np.linalg.det(gyro) < 0.0 or not gyro_matches_accelerometer(track, np.eye(3)):
        return None
    ways = sorted((gyro.T, -gyro.T), key=_count_negations)
    if _sine_of_inclination(track, ways[0]) < -priors.STEEP:
        ways.reverse()
    return MagnetometerAxisError(ways[0], ways[1])


@dataclass(frozen=True, slots=True, eq=False)
class SensorMisalignment:
    """Gyro and magnetometer turned against each other by an angle that is no quarter turn.

    turn: (3, 3) rotation R_mg, from the gyro's axes to the magnetometer's
    of_magnetometer: whether the magnetometer is the one that is turned; None if nothing shows it
    points_up: whether the corrected field points out of the ground, right only in the south
    """

    turn: Array
    of_magnetometer: bool | None
    points_up: bool

    @property
    def rotation_rad(self) -> Array:
        """Rotation vector (3,)."""
        return np.asarray(so3.log(self.turn[None])[0])

    @property
    def words(self) -> str:
        """One line: the angle and its axis, and how to correct it."""
        vector = np.degrees(self.rotation_rad)
        angle = float(np.linalg.norm(vector))
        most = int(np.argmax(np.abs(vector)))
        about = (
            f" about its {_AXES[most]}" if abs(vector[most]) > priors.ASKEW_ABOUT * angle else ""
        )
        numbers = ", ".join(f"{value:.1f}" for value in vector)
        rows = "; ".join(" ".join(f"{value:.3f}" for value in row) for row in self.turn.T)
        words = (
            f"the magnetometer is turned against the gyro by {angle:.1f} deg{about} "
            f"(rotation vector {numbers} deg): the correct x y z are [{rows}] times its readings"
        )
        if self.of_magnetometer is not True:
            words += ", or the gyro is the one that is turned: gravity does not show which"
        if self.points_up:
            words += (
                "; then the field points out of the ground: north of the magnetic equator its "
                "readings are negated as well, which turns every heading by 180 deg"
            )
        return words


def find_misalignment(
    track: Track, explains_less: Callable[[float, float, int], bool]
) -> SensorMisalignment | None:
    """The rotation between the two sensors; None if there is none, or if it cannot be determined.

    explains_less: (cost, best, windows) whether a model of that cost is excluded by the best one
    """
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    iron = (
        fit_ellipsoid(track.mag_b_gauss[seen])
        if np.count_nonzero(seen) > priors.ELLIPSOID_READINGS
        else None
    )
    if iron is None:
        return None
    field = (track.mag_b_gauss - iron[1]) @ np.linalg.inv(iron[0])
    seen_windows = window_equations(replace(track, mag_b_gauss=field))
    turn = None if seen_windows is None else _misalignment_rotation(seen_windows, explains_less)
    if turn is None:
        return None
    gravity = gyro_matches_accelerometer(track, np.eye(3))
    right = replace(track, mag_b_gauss=field)
    return SensorMisalignment(
        turn, True if gravity else None, _sine_of_inclination(right, turn.T) < -priors.STEEP
    )


def _misalignment_rotation(
    equations: WindowEquations, explains_less: Callable[[float, float, int], bool]
) -> Array | None:
    """The rotation (3, 3) nearest to the free map.

    None unless the map is a rotation, no quarter turn, and explains clearly more than any frame.
    """
    free, frames = fit_linear_map(equations), rank_frames(equations)
    if (
        free.cost > priors.GRAVITY_EXPLAINED
        or not frames
        or not explains_less(frames[0].cost, free.cost, equations.count)
    ):
        return None
    U, axes, V = np.linalg.svd(free.matrix)
    turn = U @ V
    if np.linalg.det(turn) < 0.0 or axes[0] > priors.ASKEW_ROUND * axes[2]:
        return None
    quarter = frames[0].matrix
    beyond = (
        float(np.linalg.norm(so3.log((turn @ quarter.T)[None])[0]))
        if (np.linalg.det(quarter) > 0.0)
        else np.pi
    )
    significant = beyond * axes[2] > priors.ASKEW_TOLD * free.deviation
    return turn if significant and np.degrees(beyond) > priors.ASKEW_DEG else None


def gyro_matches_accelerometer(track: Track, P: Array) -> bool:
    """Whether P (3, 3) clearly maps the gyro's readings to the accelerometer's."""
    accel = track.accel_b_m_s2
    equations = None if accel is None else window_equations(replace(track, mag_b_gauss=accel))
    frames = [] if equations is None else rank_frames(equations)
    if (
        len(frames) < 2
        or frames[0].cost > priors.GRAVITY_EXPLAINED
        or frames[1].cost < priors.GRAVITY_BETTER * frames[0].cost
    ):
        return False
    return bool(np.array_equal(frames[0].matrix, P))


def _sine_of_inclination(track: Track, way: Array) -> float:
    """Median sine of the field's inclination, the readings corrected by a signed permutation."""
    accel = track.accel_b_m_s2
    if accel is None:
        return 0.0
    known = np.isfinite(track.mag_b_gauss).all(axis=1) & np.isfinite(accel).all(axis=1)
    mag = track.mag_b_gauss[known]
    field, down = (mag - fit_sphere_centre(mag)) @ way.T, -accel[known]
    size = np.linalg.norm(field, axis=1) * np.linalg.norm(down, axis=1)
    return float(np.median(np.sum(field * down, axis=1) / np.maximum(size, 1e-300)))


def _count_negations(way: Array) -> int:
    """Number of negative entries of a signed permutation."""
    return int(np.count_nonzero(way < 0.0))


def axis_correction_words(way: Array) -> str:
    """The correction in words: `negate its y`, or what its right x y z are."""
    negated = [_AXES[k] for k in range(3) if way[k, k] < 0.0]
    if np.all(np.diag(way) != 0.0) and negated:
        return f"negate its {' and '.join(negated)}"
    return f"its correct x y z are its {' '.join(_axis_words(row) for row in way)} as read"


def _axis_words(row: Sequence[float] | Array) -> str:
    """A row of a signed permutation in words: `-y`."""
    axis = int(np.flatnonzero(np.asarray(row))[0])
    return f"{'-' if row[axis] < 0 else ''}{_AXES[axis]}"
