"""One source with one direction, whose course changes within seconds.

A current that nobody logged goes on and off within seconds: to coefficients of twenty seconds it is
noise, and it counts as the noise's colour.  But it always points the same way: one course times one
direction, against three courses that have nothing to do with each other, which is what slow noise
of the magnetometer is.  Both have the same prior, a Gaussian course that forgets within times from
one stretch to half a minute, of any size: the ratio of their evidences is what the direction alone
says, and noise of whatever colour has none.

One direction noise does have: the filter remembers the field's size for good and its direction for
seconds, so slow noise stays along the field.  A course along the field, wherever that points, is
held against it, too: where the field hardly turns in a frame, in the world never, a source along
it is none.

Where the noise is white nothing has to be held against slow noise: a course of whatever direction
that is likelier than white noise is something (`with_any_course`), asked where nothing else is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis.rules.course_gram import course_gram
from ahrsd.diagnosis.rules.locate import UNITS, group_name, locate
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.unknown import FINE, Remainder
from ahrsd.diagnosis.where_and_when.locate import FRAMES, Frame, Located, Segments, segments
from ahrsd.samples import Array

#: stretches are no shorter than the colour of ordinary noise is long
SHORTEST_S = 3.0
#: and no fewer than this, or they say little of a direction
FEWEST = 20
#: odds of 1000 to 1 (Markov's inequality: noise has them once in 1000 recordings at most)
NATS = float(np.log(1000.0))
#: odds of 100 to 1 (once in 100 recordings at most), where noise is white and a course of whatever
#: direction is asked for: the dossier allows one null in a hundred to be called unknown
ANY_NATS = float(np.log(100.0))
#: times within which a course forgets, in stretches
TIMES = (0.25, 1.0, 2.5, 6.0)
#: of a prior course's modes, those kept
MODES, LEAST_MODE = 60, 1e-3
#: sizes of a course over which the evidence is averaged, in units of its frame
SIZES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
DIRECTIONS, COARSE = 48, 12
#: steps in which the noise's power is tried
POWER_STEP = 2.0
_SMALLEST = 1e-9


def with_one_source(left: Remainder) -> Remainder:
    """The remainder with the frame in which a single quick source shows, if one does."""
    basis = left.basis
    count = min(FINE, int(basis.context.track.duration_s / SHORTEST_S))
    if count < FEWEST:
        return left
    cut = segments(basis.context.track.time_s, count)
    told = {frame: _asked(basis, frame, cut) for frame in FRAMES[:2]}
    seen: dict[Frame, Located] = {frame: course for frame, (_, course) in told.items()}
    found = {frame: nats for frame, (nats, _) in told.items()}
    left = replace(left, quick=seen)
    clear = [frame for frame, nats in found.items() if nats >= NATS]
    if not clear:
        return left
    frame = max(clear, key=lambda one: seen[one].evidence)
    nats = found[frame]
    one = left.located[frame]
    if one.evidence < nats:
        one = _sure(seen[frame], nats)
    return replace(left, located={**left.located, frame: one}, one_source=True)


def _asked(basis: Base, frame: Frame, cut: Segments) -> tuple[float, Located]:
    """Nats by which a frame's quick course has one direction, and the course, in nats over white.

    No slow noise stays along the field in an error of the gyro: there it is asked as in the sensor.
    """
    gram = course_gram(basis, frame, cut)
    where = gram.groups[group_name(frame)]
    information, score = gram.total[where, where], gram.total[where, -1]
    field = field_in(basis, "sensor" if frame == "gyro" else frame, cut)
    told = directed(information, score, UNITS[frame], basis.colour, field)
    course = locate(gram, frame, cut, basis.colour)
    return told.beyond_noise, replace(course, evidence=told.beyond_white)


def with_gyro_course(left: Remainder) -> Remainder:
    """The remainder with a quick course of the gyro's error among those of the fields, if any."""
    if not left.quick:
        return left
    cut = left.quick["sensor"].cut
    return replace(left, quick={**left.quick, "gyro": _asked(left.basis, "gyro", cut)[1]})


def with_any_course(left: Remainder, least: float = ANY_NATS) -> Remainder:
    """The remainder with the frame of a course of whatever direction, if a field has one."""
    fields = [*left.quick.values(), *(left.located[frame] for frame in FRAMES[:2])]
    best = max(fields, key=lambda one: one.evidence)
    if best.evidence < max(least, left.strongest.evidence) or not left.quick:
        return left
    return with_course(left, best, best.evidence)


def with_course(left: Remainder, one: Located, nats: float) -> Remainder:
    """The remainder with a frame's course that is there, so much likelier than noise."""
    return replace(left, located={**left.located, one.frame: _sure(one, nats)}, one_source=True)


def _sure(one: Located, nats: float) -> Located:
    return replace(one, evidence=nats, p_value=float(np.exp(-nats)))


@dataclass(frozen=True, slots=True, eq=False)
class Directed:
    """What a frame's quick course is likely to be.

    beyond_noise: nats by which one direction is likelier than three, the field's and none at all
    beyond_white: nats by which a course, whichever of them, is likelier than white noise
    direction: (3,) of the one
    """

    beyond_noise: float
    beyond_white: float
    direction: Array


def directed(information: Array, score: Array, unit: float, most: float, field: Array) -> Directed:
    """Held against each other: one direction, three, the field's, none.

    information (3 J, 3 J) and score (3 J,), stretch-major, of white noise of unit power.
    most: power of the noise, at most: a quick source counts as its colour, so less is tried too
    field: (J, 3) unit vectors of the stretches, along which slow noise stays
    """
    count = len(score) // 3
    sizes = unit * np.asarray(SIZES)
    blocks, scores = information.reshape(count, 3, count, 3), score.reshape(count, 3)
    powers = np.geomspace(1.0, most, max(1, round(np.log(most) / np.log(POWER_STEP)) + 1))
    noise = _likelihood(information, score, powers)
    within = np.einsum("ja,jakb,kb->jk", field, blocks, field, optimize=True)
    along = np.sum(field * scores, axis=1)
    three, fields, inners = [], [], []
    for time in TIMES:
        root = course_root(count, time)
        inner = np.einsum("jr,jakb,ks->rasb", root, blocks, root, optimize=True)
        turned = root.T @ scores
        width = turned.size
        three.append(_evidence(inner.reshape(width, width), turned.ravel(), sizes, powers) + noise)
        fields.append(_evidence(root.T @ within @ root, root.T @ along, sizes, powers) + noise)
        inners.append((inner, turned))
    none, slow = _mean(noise), [_mean(np.asarray(one)) for one in (three, fields)]
    other = max(none, *slow)
    for number in (COARSE, DIRECTIONS):
        directions = half_sphere(number)
        likely = np.asarray([_along(*one, directions, sizes, powers) for one in inners]) + noise
        # any direction is within some 20 degrees of a coarse one, a ninth of what it explains
        if float(likely.max()) - other < NATS / 2:
            break
    best = directions[np.unravel_index(int(np.argmax(likely)), likely.shape)[1]]
    one = _mean(likely)
    return Directed(one - other, _mean(np.array([one, *slow])) - none, best)


def _along(inner: Array, turned: Array, directions: Array, sizes: Array, powers: Array) -> Array:
    """(directions, sizes, powers) evidence of courses (r modes) along one direction each.

    inner (r, 3, r, 3) information and turned (r, 3) score of the modes' coefficients
    """
    along = np.einsum("rasb,da,db->drs", inner, directions, directions, optimize=True)
    pairs = zip(along, directions, strict=True)
    return np.asarray([_evidence(G, turned @ u, sizes, powers) for G, u in pairs])


def course_root(count: int, time: float) -> Array:
    """(J, r) root of the covariance of a course of unit size that forgets within `time` stretches.

    Of zero mean: a constant is the calibration's.
    """
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    centred = np.exp(-apart / time)
    centred = centred - centred.mean(0) - centred.mean(1)[:, None] + centred.mean()
    values, vectors = np.linalg.eigh(centred)
    kept = values > LEAST_MODE * values[-1]
    kept[:-MODES] = False
    root = vectors[:, kept] * np.sqrt(values[kept])
    return np.asarray(root * np.sqrt(count / np.sum(root**2)))


def half_sphere(count: int) -> Array:
    """(count, 3) directions spread evenly over half a sphere, a spiral of golden sections."""
    k = np.arange(count) + 0.5
    height, angle = k / count, np.pi * (1 + np.sqrt(5.0)) * k
    radius = np.sqrt(1 - height**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])


def field_in(basis: Base, frame: Frame, cut: Segments) -> Array:
    """(J, 3) unit vectors of the field in the stretches."""
    context = basis.context
    field = context.field_b
    if frame == "world":
        field = np.einsum("nij,nj->ni", context.R_nb, field)
    inside = cut.index >= 0
    sums = np.zeros((len(cut), 3))
    np.add.at(sums, cut.index[inside], field[inside])
    size = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray(sums / np.maximum(size, _SMALLEST))


def _evidence(information: Array, score: Array, sizes: Array, powers: Array) -> Array:
    """(sizes, powers) log Bayes factor of unit coefficients of each size in noise of each power."""
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    values = np.maximum(values, 0.0) / powers[:, None]
    square = ((vectors.T @ score) / powers[:, None]) ** 2
    variance = sizes[:, None, None] ** 2
    gained = square / (values + 1.0 / variance) - np.log1p(variance * values)
    return np.asarray(0.5 * np.sum(gained, axis=2))


def _likelihood(information: Array, score: Array, powers: Array) -> Array:
    """(powers,) log likelihood of the score under noise alone."""
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    kept = values > _SMALLEST * values[-1]
    square = float(np.sum((vectors.T @ score)[kept] ** 2 / values[kept]))
    return np.asarray(-0.5 * (square / powers + np.count_nonzero(kept) * np.log(powers)))


def _mean(nats: Array) -> float:
    return float(np.logaddexp.reduce(nats.ravel()) - np.log(nats.size))
