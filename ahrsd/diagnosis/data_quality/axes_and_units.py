"""Units, axes and signs of the magnetometer and the gyro, against each other and gravity.

Do gyro and magnetometer mean the same axes and the same unit (`ranked`)?  A field that is fixed in
the world turns against the sensor: with iron b, gyro bias -c, and the gyro's axes and unit P
between it and the magnetometer,

    dm/dt = (m - b) x (P w + c) = m x P w - (b x) P w + m x c - b x c

linear in [P, (b x) P, c, b x c].  Integrated over windows it needs no derivative of a noisy
reading, and the normal equations of all 24 unknowns, made once, hold those of each of the 48
signed permutations P = s Pi: 10 unknowns [s, s b, c, b x c], for which the 24 are a linear map.
Iron that deforms is left out here; it bends all 48 alike.

A turn at a constant rate c is in every one of them, whatever the gyro says: a frame is told by what
it explains beyond that.

Which sensor has the odd axes, and is the magnetometer mirrored or turned (`odd_magnetometer`)?
Gyro and magnetometer alone tell a signed permutation P between the two, true rate = P reading, and
P only: a field m and its negative turn alike.  So a proper P, by which the gyro would be turned, is
also what a mirrored magnetometer shows whose readings are right as Q m with Q = -P^T, and what a
turned one shows, Q = P^T.  To take the one for the other turns every heading by 180 degrees.

Axes that are turned by another angle than of a quarter (`askew`) are told by a map of any nine
numbers, once the iron is undone by the ellipsoid of the readings, which needs no gyro.

The accelerometer says which sensor is odd: it agrees with the gyro as recorded or with the
magnetometer.  Of the two ways to put the magnetometer right one has the field point into the
ground, which it does north of the magnetic equator.
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
from ahrsd.diagnosis.calibration_fit.null_fit import ellipsoid, sphere_centre
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array
from ahrsd.so3 import skew

_PARTS = 4  # of a recording
#: median readings in gauss of the Earth's field (0.2 to 0.7 G) taken in other units
MAG_UNITS = (
    ("uT", 1e-2, 20.0, 70.0),
    ("mG", 1e-3, 200.0, 700.0),
    ("nT", 1e-5, 2e4, 7e4),
    ("T", 1e4, 2e-5, 7e-5),
)
GYRO_UNITS = (("deg/s", np.pi / 180), ("mrad/s", 1e-3), ("rpm", 2 * np.pi / 60))
_WINDOW_S = 0.5
_ROWS, _WINDOWS = 4000, 80  # samples and windows, those that turn most
_AXES = "xyz"


def as_recorded(track: Track) -> list[Fact]:
    """Units, axes and signs that are wrong: nothing fitted before they are right means anything."""
    return mag_unit(track) + _gyro(track)


def mag_unit(track: Track) -> list[Fact]:
    """The magnetometer in another unit, told by the Earth's field only."""
    size = track.usual_gauss
    for name, factor, low, high in MAG_UNITS:
        if low <= size <= high:
            words = f"the magnetometer reads {size:.3g}: that is {name}, not gauss"
            return [
                _unit_error(track, words, 1 / factor, {"sensor": "mag", "unit": name}, "sensor")
            ]
    return []


def _gyro(track: Track) -> list[Fact]:
    """Axes, signs and unit of the gyro against the magnetometer."""
    found = windows(track)
    if found is None:
        return []
    turned = askew(track, _worse)
    if turned is not None:
        return [_turned(track, turned)]
    order = ranked(found)
    same = next((one for one in order if one.is_identity), None)
    if not order:
        return []
    best = order[0]
    if best.cost > priors.FRAME_EXPLAINED:
        return _gyro_unit(track, best) if _in_degrees(track, best, found.count) else []
    if same is not None and (
        same.cost < priors.FRAME_BENT * best.cost or not _worse(same.cost, best.cost, found.count)
    ):
        best = same
    facts = []
    if not best.is_identity:
        equal = [one for one in order if not _worse(one.cost, best.cost, found.count)]
        facts.append(_frame_error(track, min(equal, key=_changes), len(equal)))
    if not 1 / priors.OTHER_UNIT < best.scale < priors.OTHER_UNIT:
        facts += _gyro_unit(track, best)
    return facts


def _in_degrees(track: Track, best: SignedPermutation, count: int) -> bool:
    """Whether rates that explain the field only in part are in degrees beyond doubt.

    In a room, or beside a motor, no frame explains most; but no vehicle turns at 3 rad/s a tenth
    of the time while its field turns at a fifty-seventh of that.
    """
    clear = best.is_identity and -1.5 * count * np.log(max(best.cost, 1e-12)) > priors.FRAME_NATS
    size = np.linalg.norm(track.gyro_b_rad_s, axis=1)
    fast = float(np.nanpercentile(size, 90)) > priors.FAST_RAD_S
    return bool(
        clear and fast and abs(np.log(best.scale * 180 / np.pi)) < np.log(priors.DEGREES_NEAR)
    )


def _worse(cost: float, best: float, count: int) -> bool:
    """Whether a frame explains so much less that it is out."""
    ratio = max(cost, 1e-12) / max(best, 1e-12)
    return ratio > priors.FRAME_BETTER and 1.5 * count * np.log(ratio) > priors.FRAME_NATS


def _frame_error(track: Track, best: SignedPermutation, equal: int) -> Fact:
    """equal: how many frames explain the recording as well, this one among them."""
    odd = odd_magnetometer(track, best.matrix)
    words = _frame_words(track, best) if odd is None else odd.words
    if equal > 1:
        words += (
            f"; this or one of {equal - 1} other ways of axes and signs, which the motion does not "
            "tell apart: turn it about all axes to know"
        )
    return Fact(
        "frame_error",
        words,
        Where(_whole(track), ("x", "y", "z"), "gyro" if odd is None else "sensor"),
        1.0 if equal == 1 else priors.SURE_OF_READINGS,  # that it is one of them
        (Value("present", 1.0, 0.0, "1"),),
        # the true rate is signs * reading[axes]
        {"axes": list(best.axes), "signs": list(best.signs)},
        stops=True,
    )


def _turned(track: Track, turned: Askew) -> Fact:
    names = (f"angle_{axis}" for axis in "xyz")
    return Fact(
        "mag_gyro_misalignment",
        turned.words,
        Where(_whole(track), ("x", "y", "z"), "sensor" if turned.of_magnetometer else "gyro"),
        priors.SURE_OF_READINGS,
        tuple(
            Value(name, float(value), 0.0, "rad")
            for name, value in zip(names, turned.rotation_rad, strict=True)
        ),
        stops=True,
    )


def _changes(frame: SignedPermutation) -> int:
    """How many axes and signs are not as recorded."""
    moved = sum(axis != place for place, axis in enumerate(frame.axes))
    return moved + sum(sign < 0 for sign in frame.signs)


def _frame_words(track: Track, best: SignedPermutation) -> str:
    """What is said of the gyro's axes; with both ways where nothing tells which sensor is odd."""
    P = best.matrix
    words = f"the gyro's x y z are the magnetometer's {' '.join(_inverse_words(best))}"
    if np.linalg.det(P) < 0:
        return f"{words} (left-handed)"
    if turns_gravity(track, P):
        return f"{words} and the accelerometer's"
    return (
        f"{words}, or the magnetometer is left-handed ({advice(-P.T)}): turn none of them before "
        "you know which, the wrong one turns every heading by 180 deg"
    )


def _inverse_words(frame: SignedPermutation) -> list[str]:
    """What the reading's axes are in the magnetometer's frame."""
    out = [""] * 3
    for true_axis, (axis, sign) in enumerate(zip(frame.axes, frame.signs, strict=True)):
        out[axis] = f"{'-' if sign < 0 else ''}{'xyz'[true_axis]}"
    return out


def _gyro_unit(track: Track, best: SignedPermutation) -> list[Fact]:
    """The unit whose factor is nearest; where none is near, that it is another one."""
    tried = [(name, f) for name, factor in GYRO_UNITS for f in (factor, 1 / factor)]
    name, factor = min(tried, key=lambda pair: abs(np.log(best.scale / pair[1])))
    large = best.scale < 1
    off = f"{1 / best.scale:.3g} times too large" if large else f"{best.scale:.3g} times too small"
    if abs(np.log(best.scale / factor)) > np.log(priors.SAME_UNIT):
        if _hidden(track) or _right_in_part(track):
            return []
        usual = 1 / factor if large else factor
        words = (
            f"the gyro's rates are {off} for the turns of the field: they are in another unit, or "
            f"the time is ({name} would be {usual:.3g} times)"
        )
        factor, name = best.scale, "another unit"
    else:
        way = f"in {name}" if large else f"divided by {factor:.4g} once too often"
        words = f"the gyro's rates are {off}: they are {way}"
    setting = {"sensor": "gyro", "unit": name}
    return [_unit_error(track, words, 1 / factor, setting, "gyro")]


def _hidden(track: Track) -> bool:
    """Whether a fair part of the rates is noise, even as means over the frames' windows.

    The scale of rates that are mostly noise is too small, whatever their unit is.
    """
    rows = window_rows(track)
    whole = len(track) // rows * rows
    if not whole:
        return True
    means = np.nan_to_num(track.gyro_b_rad_s[:whole]).reshape(-1, rows, 3).mean(axis=1)
    noise = 3 * noise_of_differences(track)[1] ** 2 / rows
    return bool(noise > priors.RATES_NOISE_SHARE * np.sum(np.var(means, axis=0)))


def _right_in_part(track: Track) -> bool:
    """Whether the rates have the field's turns at their own unit in some part of the recording.

    A unit holds all along.  While a magnet is put on, the field's changes are none of a turn.
    """
    edges = np.linspace(0, len(track), _PARTS + 1).astype(int)
    found = [windows(track, slice(int(a), int(b))) for a, b in itertools.pairwise(edges)]
    order = [frame for one in found if one is not None for frame in ranked(one)]
    return any(
        one.is_identity
        and one.cost < priors.PART_EXPLAINED
        and 1 / priors.OTHER_UNIT < one.scale < priors.OTHER_UNIT
        for one in order
    )


def _unit_error(
    track: Track, words: str, too_large: float, setting: dict[str, str], frame: str
) -> Fact:
    parameters = (Value("factor_less_one", too_large - 1, 0.0, "1"),)
    where = Where(_whole(track), ("x", "y", "z"), frame)
    return Fact(
        "unit_error", words, where, priors.SURE_OF_READINGS, parameters, dict(setting), stops=True
    )


def _whole(track: Track) -> tuple[tuple[float, float], ...]:
    return ((float(track.time_s[0]), float(track.time_s[-1])),)


@dataclass(frozen=True, slots=True, eq=False)
class SignedPermutation:
    """One of the 48: gyro_true_i = signs_i * gyro_(axes_i) * scale.

    cost: residual sum of squares over that of a turn at a constant rate, 0..1
    """

    axes: tuple[int, int, int]
    signs: tuple[int, int, int]
    scale: float
    cost: float

    @property
    def is_identity(self) -> bool:
        """Whether nothing is swapped or negated."""
        return self.axes == (0, 1, 2) and self.signs == (1, 1, 1)

    @property
    def matrix(self) -> Array:
        """(3, 3) the signed permutation P, true rate = P reading."""
        P = np.zeros((3, 3))
        P[range(3), self.axes] = self.signs
        return P


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Normal equations of windows: gram (24, 24), right (24,), total of the readings' changes."""

    gram: Array
    right: Array
    total: float
    count: int


def window_rows(track: Track) -> int:
    """Samples of a window."""
    return max(4, round(_WINDOW_S / track.step_s))


def windows(track: Track, part: slice | None = None) -> Windows | None:
    """Normal equations of the windows that turn most; None where there is too little.

    part: rows of the track, None: all
    """
    length = window_rows(track)
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
    return Windows(X.T @ X, X.T @ y, float(y @ y), len(starts))


def _blocks(track: Track, length: int) -> Iterator[slice]:
    for run in track.runs or (slice(0, len(track)),):
        for first in range(run.start + 1, run.stop - length + 1, length):
            yield slice(first, first + length)


def ranked(found: Windows) -> list[SignedPermutation]:
    """The best first; of each frame and its negative, the one whose scale is positive."""
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    usual = max(found.total - _solved(found, constant)[1], 1e-300)
    out = []
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), axes] = signs
            scale, gained = _fitted(found, P)
            if scale > 0:
                i, j, k = axes
                a, b, c = signs
                out.append(
                    SignedPermutation((i, j, k), (a, b, c), scale, (found.total - gained) / usual)
                )
    return sorted(out, key=lambda frame: frame.cost)


#: relative: what is smaller is nothing but rounding
_UNSEEN = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LinearMap:
    """Any linear map (3, 3) between the two, true rate = matrix @ reading, with its deviation.

    cost: as of a `Frame`
    """

    matrix: Array
    deviation: float
    cost: float


def linear_map(found: Windows) -> LinearMap:
    """The map with which all 24 unknowns explain most; deviation: the largest of its entries,
    infinite where one was never seen."""
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    usual = max(found.total - _solved(found, constant)[1], 1e-300)
    solved, gained = _solved(found, np.eye(24))
    left = max(found.total - gained, 0.0)
    scale = np.sqrt(np.maximum(np.diag(found.gram), 0.0))
    if not np.all(scale[:9] > _UNSEEN * np.max(scale)):
        return LinearMap(np.eye(3), np.inf, 1.0)
    scale = np.maximum(scale, _UNSEEN * np.max(scale))
    spread = np.linalg.inv(found.gram / scale[:, None] / scale + 1e-9 * np.eye(24))
    variance = np.diag(spread)[:9] / scale[:9] ** 2 * left / max(3 * found.count - 24, 1)
    return LinearMap(solved[:9].reshape(3, 3), float(np.sqrt(variance.max())), left / usual)


def _fitted(found: Windows, P: Array) -> tuple[float, float]:
    """Scale of P = s Pi and what it explains, the hard iron and the bias free."""
    T = np.zeros((24, 10))
    T[:9, 0] = P.ravel()
    for axis in range(3):
        T[9:18, 1 + axis] = -(skew(np.eye(3)[axis]) @ P).ravel()
    T[18:, 4:] = np.eye(6)
    solved, gained = _solved(found, T)
    return float(solved[0]), gained


def _solved(found: Windows, T: Array) -> tuple[Array, float]:
    """Unknowns (k,) of which the 24 are a linear map (24, k), and what they explain."""
    gram, right = T.T @ found.gram @ T, T.T @ found.right
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    normal = gram / scale[:, None] / scale + 1e-9 * np.eye(T.shape[1])
    solved = np.linalg.solve(normal, right / scale)
    # twice the linear part less the quadratic one: right also where the ridge acts
    gained = 2 * solved @ (right / scale) - solved @ (gram / scale[:, None] / scale) @ solved
    return np.asarray(solved / scale), float(gained)


@dataclass(frozen=True, slots=True, eq=False)
class Odd:
    """A magnetometer with odd axes.

    right, other: (3, 3) signed permutations by which its readings are right, and right on the other
                  half of the Earth
    """

    right: Array
    other: Array

    @property
    def mirrored(self) -> bool:
        """Whether its readings are left-handed."""
        return bool(np.linalg.det(self.right) < 0)

    @property
    def words(self) -> str:
        """One line: what is odd, what to do, and when it is the other one."""
        what = "is left-handed" if self.mirrored else "is turned against the gyro"
        return (
            f"the magnetometer {what}: {advice(self.right)} (where the field points out of the "
            f"ground, south of the magnetic equator: {advice(self.other)})"
        )


def odd_magnetometer(track: Track, gyro: Array) -> Odd | None:
    """The magnetometer's own odd axes; None where the gyro's may be the odd ones.

    gyro: (3, 3) the signed permutation P by which the gyro's readings would be the magnetometer's
    """
    if np.linalg.det(gyro) < 0.0 or not turns_gravity(track, np.eye(3)):
        return None
    ways = sorted((gyro.T, -gyro.T), key=_negations)
    if _down(track, ways[0]) < -priors.STEEP:
        ways.reverse()
    return Odd(ways[0], ways[1])


@dataclass(frozen=True, slots=True, eq=False)
class Askew:
    """Gyro and magnetometer that are turned against each other by no quarter turns.

    turn: (3, 3) rotation R_mg, from the gyro's axes to the magnetometer's
    of_magnetometer: whether the magnetometer is the one that is turned; None where nothing tells
    points_up: whether the field points out of the ground then, which it does in the south only
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
        """One line: by how much about which axis, and what to do."""
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
            f"(rotation vector {numbers} deg): its right x y z are [{rows}] times its readings"
        )
        if self.of_magnetometer is not True:
            words += ", or the gyro is the one that is turned: gravity says nothing of it"
        if self.points_up:
            words += (
                "; with that the field points out of the ground: north of the magnetic equator its "
                "readings are negated as well, and turn every heading by 180 deg"
            )
        return words


def askew(track: Track, worse: Callable[[float, float, int], bool]) -> Askew | None:
    """How the two are turned against each other; None where they are not, or nobody can tell.

    worse: (cost, best, windows) whether what costs so much is out beside the best
    """
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    found = (
        ellipsoid(track.mag_b_gauss[seen])
        if np.count_nonzero(seen) > priors.ELLIPSOID_READINGS
        else None
    )
    if found is None:
        return None
    field = (track.mag_b_gauss - found[1]) @ np.linalg.inv(found[0])
    seen_windows = windows(replace(track, mag_b_gauss=field))
    turn = None if seen_windows is None else _turn(seen_windows, worse)
    if turn is None:
        return None
    gravity = turns_gravity(track, np.eye(3))
    right = replace(track, mag_b_gauss=field)
    return Askew(turn, True if gravity else None, _down(right, turn.T) < -priors.STEEP)


def _turn(found: Windows, worse: Callable[[float, float, int], bool]) -> Array | None:
    """The rotation (3, 3) of the free map, where it is one, no quarter, and explains more."""
    free, order = linear_map(found), ranked(found)
    if (
        free.cost > priors.GRAVITY_EXPLAINED
        or not order
        or not worse(order[0].cost, free.cost, found.count)
    ):
        return None
    U, axes, V = np.linalg.svd(free.matrix)
    turn = U @ V
    if np.linalg.det(turn) < 0.0 or axes[0] > priors.ASKEW_ROUND * axes[2]:
        return None
    quarter = order[0].matrix
    beyond = (
        float(np.linalg.norm(so3.log((turn @ quarter.T)[None])[0]))
        if (np.linalg.det(quarter) > 0.0)
        else np.pi
    )
    told = beyond * axes[2] > priors.ASKEW_TOLD * free.deviation
    return turn if told and np.degrees(beyond) > priors.ASKEW_DEG else None


def turns_gravity(track: Track, P: Array) -> bool:
    """Whether the gyro's readings are the accelerometer's by P (3, 3), clearly."""
    accel = track.accel_b_m_s2
    found = None if accel is None else windows(replace(track, mag_b_gauss=accel))
    order = [] if found is None else ranked(found)
    if (
        len(order) < 2
        or order[0].cost > priors.GRAVITY_EXPLAINED
        or order[1].cost < priors.GRAVITY_BETTER * order[0].cost
    ):
        return False
    return bool(np.array_equal(order[0].matrix, P))


def _down(track: Track, way: Array) -> float:
    """Sine of the field's mean inclination with the readings put right by a permutation."""
    accel = track.accel_b_m_s2
    if accel is None:
        return 0.0
    known = np.isfinite(track.mag_b_gauss).all(axis=1) & np.isfinite(accel).all(axis=1)
    mag = track.mag_b_gauss[known]
    field, down = (mag - sphere_centre(mag)) @ way.T, -accel[known]
    size = np.linalg.norm(field, axis=1) * np.linalg.norm(down, axis=1)
    return float(np.median(np.sum(field * down, axis=1) / np.maximum(size, 1e-300)))


def _negations(way: Array) -> int:
    return int(np.count_nonzero(way < 0.0))


def advice(way: Array) -> str:
    """`negate its y`, or what its right x y z are."""
    negated = [_AXES[k] for k in range(3) if way[k, k] < 0.0]
    if np.all(np.diag(way) != 0.0) and negated:
        return f"negate its {' and '.join(negated)}"
    return f"its right x y z are its {' '.join(_reading(row) for row in way)} as read"


def _reading(row: Sequence[float] | Array) -> str:
    axis = int(np.flatnonzero(np.asarray(row))[0])
    return f"{'-' if row[axis] < 0 else ''}{_AXES[axis]}"
