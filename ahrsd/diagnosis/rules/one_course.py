"""Several names, each for a part of one smooth course.

A field that changes from place to place, along a way that nobody logged, swells and fades: a bump
takes its middle, a scale that follows the temperature its trend, a gain that somebody changed its
end.  Each of them passes the gate, since a part of the course has its shape, and together they are
exact.  But one course in one frame explains all of them at once.  Its prior is smooth: cosines in
time whose variances fall with the fourth power of their number, of any size.  True names are
likelier than it, by some nats at the least, for a form that is known pays for fewer coefficients.

A single name may be such a course, too, if its form was sought: iron that remembers follows the
headings of the minutes before, which on parallel legs are a function of the place.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.rules.discrepancy import UNIT_GAUSS, fitted
from ahrsd.diagnosis.rules.findings import added_value
from ahrsd.diagnosis.rules.random_effect import effect_nats
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.rivals import compared
from ahrsd.diagnosis.rules.search import State, term_group, without_term
from ahrsd.diagnosis.rules.settings import scale_of
from ahrsd.diagnosis.rules.together import projected
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

#: cosines of a course: half a wave in the recording, and as many more
MODES = 30
#: power of a mode's number with which its variance falls: that of a course without corners
SMOOTH = 4.0
#: part of a name's evidence that it may have beside the course and still be a part of it
OWN = 0.1
COURSES: tuple[Frame, ...] = ("world", "sensor")


def of_one_course(state: State, basis: Base) -> tuple[list[int], Frame | None]:
    """Numbers of two terms or more that one smooth course explains better, and its frame."""
    if len(state.named) < 2:
        return [], None
    noise = max(1.0, basis.colour)
    for frame, free in _courses(basis):
        worth = [_own(state, basis, k, free, noise) for k in range(len(state.named))]
        parts = [k for k, (name, own) in enumerate(worth) if own < OWN * name]
        paid = sum(price(state.named[k].candidate, worth[k][0]) for k in parts)
        if len(parts) > 1 and _lead(state, basis, parts, free, noise) < paid:
            return parts, frame
    return [], None


def as_smooth(
    state: State, basis: Base, asked: Mapping[tuple[int, ...], float]
) -> tuple[list[int], Frame | None]:
    """Numbers of the terms that are hardly likelier than one smooth course.

    asked: terms that are asked as one, and nats by which they must be, once their own price is
    paid.  The frame is the last ones'.
    """
    noise = max(1.0, basis.colour)
    found: list[int] = []
    whose: Frame | None = None
    courses = _courses(basis) if asked else []
    for terms, least in asked.items():
        leads = {frame: _lead(state, basis, list(terms), free, noise) for frame, free in courses}
        frame = min(leads, key=lambda one: leads[one])
        named = [state.named[k] for k in terms]
        paid = sum(price(one.candidate, float(one.evidence)) for one in named)
        if leads[frame] < least + paid:
            found.extend(terms)
            whose = frame
    return found, whose


def smooth_nats(basis: Base) -> dict[Frame, float]:
    """Evidence of a smooth course in each frame, nats, in noise of the basis's colour."""
    return {frame: effect_nats(basis, free) for frame, free in _courses(basis)}


def _courses(basis: Base) -> list[tuple[Frame, Array]]:
    """Each frame's smooth course as the innovation sees it, of unit size."""
    seen = basis.whitened([smooth_course(basis.context, frame) for frame in COURSES])
    return [(frame, one * UNIT_GAUSS) for frame, one in zip(COURSES, seen, strict=True)]


def price(candidate: Candidate, nats: float) -> float:
    """Nats that a term's onset, scale and place cost, which were sought among all: Laplace's.

    Half the logarithm of the information on each, in units of its range, is about that of what the
    term explains.  At least what the choice among the settings has cost.
    """
    setting = candidate.setting
    sought = ("onset_s" in setting) + (scale_of(candidate) is not None) + 3 * ("place_m" in setting)
    return max(candidate.paid, 0.5 * sought * float(np.log1p(2 * max(nats, 0.0))))


def smooth_course(context: Context, frame: Frame) -> Columns:
    """A field in the frame's axes, 3 columns a mode, mode-major, each of its prior deviation."""
    time_s = context.track.time_s
    order = np.arange(1, MODES + 1)
    phase = np.pi * (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    modes = np.cos(phase[:, None] * order) * order ** (-SMOOTH / 2)
    axes = np.broadcast_to(np.eye(3), (len(time_s), 3, 3))
    if frame == "world":
        axes = context.model.soft_iron @ np.swapaxes(context.R_nb, 1, 2)
    return Columns(mag=np.einsum("nj,nki->nkji", modes, axes).reshape(len(time_s), 3, -1))


def _own(
    state: State, basis: Base, number: int, course: Array, noise: float
) -> tuple[float, float]:
    """Nats of a term, the others as they are, and what it has of them beside the course."""
    left = without_term(state, number, basis)
    name, form, both = compared(left, _columns(state, basis, number), course, noise)
    return name, both - form


def _lead(state: State, basis: Base, terms: list[int], course: Array, noise: float) -> float:
    """Nats by which these terms together are likelier than the course."""
    left = basis
    for k in terms:
        left = left.without(term_group(k), added_value(state, k))
    columns = [_columns(state, basis, k) for k in terms]
    group = np.repeat(np.arange(len(terms)), [part.shape[2] for part in columns])
    G, s = projected(left, np.concatenate(columns, axis=2))
    names, _ = fitted(G, s, group, noise, np.zeros(len(terms)))
    return names - effect_nats(left, course)


def _columns(state: State, basis: Base, number: int) -> Array:
    scale = state.named[number].candidate.scale
    return np.asarray(basis.known[:, :, basis.groups[term_group(number)]] * scale)
