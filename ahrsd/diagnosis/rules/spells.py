"""When a source is away from its usual level: changes that are few and sharp, by likelihood.

A device that goes on and off, a vehicle that drives by, a bias that comes and goes have a course
that is level most of the time.  To coefficients of twenty seconds with nothing to do with each
other that is a hundred numbers; here it is a few times and a few vectors:

    two states   one vector, on or off: the stretch that raises the likelihood most is turned over
                 until none does
    boxes        stretches with a vector of their own each, the strongest first

in each frame, on a grid of stretches whose joint information is known, so that the filter's memory
from one into the next is not taken for a change.  A change costs the logarithm of the places where
it could be.  What comes and goes smoothly is then sought once more around each spell, as waves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.innovation_filter.evidence import log_bayes
from ahrsd.diagnosis.innovation_filter.gram import RANK_SHARE, Gram
from ahrsd.diagnosis.innovation_filter.score import total_score
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.course_gram import course_gram
from ahrsd.diagnosis.rules.locate import SPAN, UNITS, group_name, locate
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.where_and_when.intervals import spans
from ahrsd.diagnosis.where_and_when.locate import (
    FRAMES,
    Frame,
    Segments,
    frame_columns,
    segments,
    segments_between,
)
from ahrsd.samples import Array

#: stretches of the grid, and no shorter than this
COUNT, SHORTEST_S = 100, 1.0
#: grid on which a spell is sought once more, and how far around it, in its lengths
ZOOM, AROUND = 48, 1.5
#: what is below this share of the largest departure is the usual level
LEAST = 0.01
#: information below which a coefficient is not known at all, in units of its frame
LEAST_KNOWN = 1e-3
MOST_BOXES, ROUNDS = 20, 20
#: powers of half a wave: a box, half a wave, a whole one; and the shortest, in stretches
SHAPES, SHORTEST = (0, 1, 2), 3
MOST_WAVES, MOST_CLOSER = 3, 3

Span = tuple[float, float]


def with_spells(left: Remainder) -> Remainder:
    """The remainder with the frame whose course comes and goes, where that is the likeliest.

    What the free courses show by themselves keeps its frame: of a real recording a few jumps, on
    the ground before and after a flight, are not the source that runs all the time.  Where turns
    were lost and nobody knows at which steps, a few jumps are what they leave.
    """
    basis = left.basis
    if left.spells_s or basis.context.track.lost_turns is not None:
        return left
    count = min(COUNT, int(basis.context.track.duration_s / SHORTEST_S))
    cut = segments(basis.context.track.time_s, count)
    plain = left.one_source or left.strongest.evidence > LIMITS.unknown_nats
    known = left.strongest.frame if plain else left.stood_in
    frames = FRAMES if known is None else (known,)
    courses = [_course(basis, frame, cut) for frame in frames]
    found = [(kind, one) for one in courses for kind in (one.two_states(), one.boxes())]
    (nats, inside), course = max(found, key=lambda each: each[0][0])
    nats -= float(np.log(len(frames)))
    frame = course.frame
    if nats <= max(one.evidence for one in left.located.values()):
        return left
    seen = locate(course.gram, frame, cut, basis.colour)
    one = replace(seen, evidence=nats, p_value=min(1.0, float(np.exp(-nats))))
    spells_s = closer(basis, frame, spans(cut.edges_s, inside))
    return replace(left, located={**left.located, frame: one}, spells_s=tuple(spells_s))


def _course(basis: Base, frame: Frame, cut: Segments, known_s: Sequence[Span] = ()) -> _Course:
    """A frame's course on a grid beside boxes over the given stretches."""
    if known_s:
        boxes = _stretches(basis.context.track.time_s, known_s)
        columns = basis.whitened([frame_columns(basis.context, frame, boxes)])[0]
        basis = basis.beside("boxes", columns)
    return _Course(course_gram(basis, frame, cut), frame, basis.colour)


class _Course:
    """Information (3 J, 3 J) and score (3 J,) of a frame's course, stretch-major."""

    def __init__(self, gram: Gram, frame: Frame, colour: float) -> None:
        where = gram.groups[group_name(frame)]
        self.gram, self.frame = gram, frame
        self.G, self.s = gram.total[where, where] / colour, gram.total[where, -1] / colour
        self.count = len(self.s) // 3
        self.known = gram.information[where] / colour  # before anything was taken out
        unseen = RANK_SHARE * float(self.known.sum()) / 3  # of one axis, all stretches together
        self.ridge = np.eye(3) * (unseen + (SPAN[-1] * UNITS[frame]) ** -2)
        self.change = float(np.log(self.count))  # what a change costs

    def nats(self, X: Array) -> float:
        """Evidence of coefficients on columns X (3 J, p), averaged over their sizes."""
        scale = np.full(X.shape[1], UNITS[self.frame])
        what = total_score(X.T @ self.G @ X, X.T @ self.s, self.known @ X**2, scale, LEAST_KNOWN)
        return log_bayes(what, 1.0, SPAN)

    def two_states(self) -> tuple[float, NDArray[np.bool]]:
        """Evidence of one vector that is on or off, and (J,) where it is away from the usual."""
        on = np.zeros(self.count)
        first, last = best_box(self.G, self.s, self.ridge)
        on[first:last] = 1.0
        for _ in range(ROUNDS):
            X = each_axis(on)
            vector = np.linalg.solve(X.T @ self.G @ X + self.ridge, X.T @ self.s)
            K = np.kron(np.eye(self.count), vector[:, None])
            turned = turned_over(K.T @ self.G @ K, K.T @ self.s, on, self.change)
            if np.array_equal(on, turned):
                break
            on = turned
        changes = np.count_nonzero(np.diff(on))
        away = np.asarray(on > 0.5)
        if changes == 0:  # what is never off is the calibration's, and no switching source
            return -np.inf, np.zeros(self.count, dtype=np.bool)
        if away.mean() > 0.5:
            away = ~away
        return self.nats(each_axis(on)) - float(changes * self.change), away

    def boxes(self) -> tuple[float, NDArray[np.bool]]:
        """Evidence of stretches with a vector of their own each, and (J,) where one is."""
        G, s = self.G, self.s
        X, level = np.zeros((3 * self.count, 0)), np.zeros((self.count, 3))
        best = 0.0
        while X.shape[1] < 3 * MOST_BOXES:
            first, last = best_box(G, s, self.ridge)
            box = np.zeros(self.count)
            box[first:last] = 1.0
            more = np.hstack([X, each_axis(box)])
            nats = self.nats(more) - 2 * self.change * more.shape[1] / 3
            if nats <= best:
                break
            X, best = more, nats
            G, s, value = without(self.G, self.s, X, self.ridge[0, 0])
            level = (X @ value).reshape(-1, 3)
        return best, away_from_usual(level)

    def waves(self) -> Array:
        """(J, 3) a course that is a few boxes, half waves and waves, the strongest first."""
        G, s = self.G, self.s
        X, level, best = np.zeros((3 * self.count, 0)), np.zeros((self.count, 3)), -np.inf
        price = 2 * self.change + float(np.log(len(SHAPES)))
        while X.shape[1] < 3 * MOST_WAVES:
            more = np.hstack([X, each_axis(best_wave(G, s, self.ridge))])
            nats = self.nats(more) - price * more.shape[1] / 3
            if nats <= best:
                break
            X, best = more, nats
            G, s, value = without(self.G, self.s, X, self.ridge[0, 0])
            level = (X @ value).reshape(-1, 3)
        return level


def best_wave(G: Array, s: Array, ridge: Array) -> Array:
    """(J,) the box, half wave or wave of which one vector explains most."""
    count = len(s) // 3
    blocks, scores = G.reshape(count, 3, count, 3).swapaxes(1, 2), s.reshape(count, 3)
    most, found = -1.0, np.zeros(count)
    for length in range(SHORTEST, count + 1):
        rows = np.arange(count - length + 1)[:, None] + np.arange(length)
        inside = blocks[rows[:, :, None], rows[:, None, :]]
        phase = np.pi * (np.arange(length) + 0.5) / length
        for power in SHAPES:
            wave = np.sin(phase) ** power
            inner = np.einsum("njkab,j,k->nab", inside, wave, wave, optimize=True) + ridge
            outer = wave @ scores[rows]
            gained = np.sum(outer * np.linalg.solve(inner, outer[:, :, None])[:, :, 0], axis=1)
            k = int(np.argmax(gained))
            if gained[k] > most:
                most, found = float(gained[k]), np.zeros(count)
                found[k : k + length] = wave
    return found


def best_box(G: Array, s: Array, ridge: Array) -> tuple[int, int]:
    """The stretches [first, last) in which one vector explains most; never all of them."""
    count = len(s) // 3
    blocks = np.zeros((count + 1, count + 1, 3, 3))
    blocks[1:, 1:] = G.reshape(count, 3, count, 3).swapaxes(1, 2).cumsum(0).cumsum(1)
    sums = np.vstack([np.zeros(3), s.reshape(count, 3).cumsum(axis=0)])
    a, b = np.triu_indices(count + 1, 1)
    part = b - a < count
    a, b = a[part], b[part]
    inner = blocks[b, b] - blocks[a, b] - blocks[b, a] + blocks[a, a] + ridge
    outer = sums[b] - sums[a]
    gained = np.sum(outer * np.linalg.solve(inner, outer[:, :, None])[:, :, 0], axis=1)
    k = int(np.argmax(gained))
    return int(a[k]), int(b[k])


def turned_over(G: Array, s: Array, on: Array, change: float) -> Array:
    """(J,) states 0 and 1 after turning over stretches as long as one raises the likelihood.

    G (J, J) information and s (J,) score of the source along its vector; change: nats that one
    costs.
    """
    count = len(on)
    a, b = np.triu_indices(count + 1, 1)
    total = np.zeros((count + 1, count + 1))
    for _ in range(4 * count):
        sign = 1.0 - 2.0 * on
        total[1:, 1:] = (G * np.outer(sign, sign)).cumsum(0).cumsum(1)
        sums = np.concatenate([[0.0], np.cumsum(sign * (s - G @ on))])
        gained = sums[b] - sums[a]
        gained -= (total[b, b] - total[a, b] - total[b, a] + total[a, a]) / 2
        price = np.zeros(count + 1)  # neither end of the recording is a change
        price[1:-1] = np.where(np.diff(on) != 0, -change, change)
        gained -= price[a] + price[b]
        k = int(np.argmax(gained))
        if gained[k] <= 1e-9:
            break
        on = on.copy()
        on[a[k] : b[k]] = 1.0 - on[a[k] : b[k]]
    return on


def away_from_usual(level: Array) -> NDArray[np.bool]:
    """(J,) where a level (J, 3) is away from the one in force for longest."""
    distance = np.linalg.norm(level[:, None] - level[None], axis=2)
    alike = distance <= LEAST * distance.max(initial=0.0)
    return np.asarray(~alike[int(np.argmax(alike.sum(axis=1)))])


def each_axis(shape: Array) -> Array:
    """(3 J, 3) a shape (J,) on each axis."""
    return np.asarray(np.kron(shape[:, None], np.eye(3)))


def without(G: Array, s: Array, X: Array, ridge: float) -> tuple[Array, Array, Array]:
    """Information and score with columns X taken out, and the coefficients of X."""
    cross = X.T @ G
    inner = cross @ X + ridge * np.eye(X.shape[1])
    M = np.linalg.solve(inner, np.column_stack([cross, X.T @ s]))
    return G - cross.T @ M[:, :-1], s - cross.T @ M[:, -1], np.asarray(M[:, -1])


def closer(basis: Base, frame: Frame, found_s: list[Span]) -> list[Span]:
    """The spells sought once more on a finer grid, as waves; many are left as they are."""
    if len(found_s) > MOST_CLOSER:
        return found_s
    return [span for k in range(len(found_s)) for span in _closer(basis, frame, found_s, k)]


def _closer(basis: Base, frame: Frame, found_s: list[Span], number: int) -> list[Span]:
    """One spell, the others known as boxes."""
    time_s = basis.context.track.time_s
    begin, end = found_s[number]
    around_s = AROUND * (end - begin)
    low = max(begin - around_s, float(time_s[0]), *(b for _, b in found_s if b <= begin))
    high = min(end + around_s, float(time_s[-1]), *(a for a, _ in found_s if a >= end))
    cut = segments_between(time_s, np.linspace(low, high, ZOOM + 1))
    others = [span for k, span in enumerate(found_s) if k != number]
    size = np.linalg.norm(_course(basis, frame, cut, others).waves(), axis=1)
    if not size.any():
        return [found_s[number]]
    return spans(cut.edges_s, size > LEAST * size.max())


def _stretches(time_s: Array, spans_s: Sequence[Span]) -> Segments:
    """A segment per span."""
    index = np.full(len(time_s), -1, dtype=np.intp)
    for number, (begin, end) in enumerate(spans_s):
        index[(time_s >= begin) & (time_s < end)] = number
    return Segments(np.arange(len(spans_s) + 1.0), index)
