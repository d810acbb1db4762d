"""Which sensor has the odd axes, and whether a magnetometer is mirrored or turned.

Gyro and magnetometer alone tell a signed permutation P between the two, true rate = P reading, and
P only: a field m and its negative turn alike.  So a proper P, by which the gyro would be turned, is
also what a mirrored magnetometer shows whose readings are right as Q m with Q = -P^T, and what a
turned one shows, Q = P^T.  To take the one for the other turns every heading by 180 degrees.

Axes that are turned by another angle than of a quarter are told by a map of any nine numbers, once
the iron is undone by the ellipsoid of the readings, which needs no gyro.

The accelerometer says which sensor is odd: it agrees with the gyro as recorded or with the
magnetometer.  Of the two ways to put the magnetometer right one has the field point into the
ground, which it does north of the magnetic equator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.null_fit import ellipsoid, sphere_centre
from ahrsd.diagnosis.data_quality.frames import Windows, free_frame, ranked, windows
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_AXES = "xyz"
#: part of gravity's turns that the gyro must explain, and by how much better than by other axes
_EXPLAINED, _BETTER = 0.5, 1.5
_FEWEST = 100  # readings of an ellipsoid
#: sine of the inclination from which up and down are told
_STEEP = 0.15
#: turn beyond any quarter from which a mount is askew, and no crooked sensor any more
_ASKEW_DEG = 10.0
#: of a map that is a turn: its longest axis over its shortest; deviations by which it is no quarter
_ROUND, _TOLD = 1.25, 4.0
_ABOUT = 0.97  # cosine of a turn's axis to the sensor's, to be called by its name


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
    if _down(track, ways[0]) < -_STEEP:
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
        about = f" about its {_AXES[most]}" if abs(vector[most]) > _ABOUT * angle else ""
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
    found = ellipsoid(track.mag_b_gauss[seen]) if np.count_nonzero(seen) > _FEWEST else None
    if found is None:
        return None
    field = (track.mag_b_gauss - found[1]) @ np.linalg.inv(found[0])
    seen_windows = windows(replace(track, mag_b_gauss=field))
    turn = None if seen_windows is None else _turn(seen_windows, worse)
    if turn is None:
        return None
    gravity = turns_gravity(track, np.eye(3))
    right = replace(track, mag_b_gauss=field)
    return Askew(turn, True if gravity else None, _down(right, turn.T) < -_STEEP)


def _turn(found: Windows, worse: Callable[[float, float, int], bool]) -> Array | None:
    """The rotation (3, 3) of the free map, where it is one, no quarter, and explains more."""
    free, order = free_frame(found), ranked(found)
    if free.cost > _EXPLAINED or not order or not worse(order[0].cost, free.cost, found.count):
        return None
    U, axes, V = np.linalg.svd(free.matrix)
    turn = U @ V
    if np.linalg.det(turn) < 0.0 or axes[0] > _ROUND * axes[2]:
        return None
    quarter = order[0].matrix
    beyond = (
        float(np.linalg.norm(so3.log((turn @ quarter.T)[None])[0]))
        if (np.linalg.det(quarter) > 0.0)
        else np.pi
    )
    told = beyond * axes[2] > _TOLD * free.deviation
    return turn if told and np.degrees(beyond) > _ASKEW_DEG else None


def turns_gravity(track: Track, P: Array) -> bool:
    """Whether the gyro's readings are the accelerometer's by P (3, 3), clearly."""
    accel = track.accel_b_m_s2
    found = None if accel is None else windows(replace(track, mag_b_gauss=accel))
    order = [] if found is None else ranked(found)
    if len(order) < 2 or order[0].cost > _EXPLAINED or order[1].cost < _BETTER * order[0].cost:
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
