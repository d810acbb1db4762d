"""Whether an unknown is no more than noise that is louder for a while.

Readings of a louder time are held against the noise of all: what they have of structure by chance
looks like a source that comes and goes.  So what is to be told is looked for once more where each
reading counts by the noise of its time.  Not sooner: the filter weighs all readings alike, and what
a louder time leaves in its state is slow where the readings are quiet again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.innovation_filter.evidence import colour
from ahrsd.diagnosis.innovation_filter.noise import louder
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import framed
from ahrsd.diagnosis.rules.cut_out import without
from ahrsd.diagnosis.rules.directions import weighed
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import State, formed_basis_of, refitted
from ahrsd.diagnosis.rules.spells import with_spells
from ahrsd.diagnosis.rules.unknown import Remainder


def in_even_noise(basis: Base, left: Remainder, limits: Limits) -> Remainder:
    """The remainder, or, where noise of two levels is all that is seen, that of even rows.

    basis: the model's, from which the remainder was taken.  A name that was taken out again for its
    form is there.
    """
    if left.stood_in is not None or not unknown.detected(left, limits):
        return left
    level = even(basis)
    if level is basis:
        return left
    again = unknown.remainder(level, with_bins=bool(left.bins))
    again = with_spells(framed(level, again, limits) if left.one_source else again)
    return left if unknown.detected(again, limits) else again


def beside_bursts(state: State, left: Remainder, limits: Limits) -> Remainder:
    """The remainder, or, where bursts of noise are all that is seen, that without their readings.

    What they leave in the filter's state is slow, whatever the rows weigh.
    """
    found = louder(state.fit.filtered) if unknown.detected(left, limits) else None
    if found is None or not found.burst or left.stood_in is not None:
        return left
    quiet = replace(state, problem=without(state.problem, found.spans_s))
    quiet = refitted(quiet, state.named)
    basis = formed_basis_of(quiet)
    again = framed(basis, unknown.remainder(basis, with_bins=bool(left.bins)), limits)
    again = with_spells(again)
    return left if unknown.detected(again, limits) else again


def even(basis: Base) -> Base:
    """The basis with its rows weighed by the noise of their time, where it has two levels."""
    found = louder(basis.filtered)
    if found is None:
        return basis
    time_s = basis.context.track.time_s
    loud = np.zeros(len(time_s), dtype=bool)
    for begin, end in found.spans_s:
        loud |= (time_s >= begin) & (time_s <= end)
    weight = 1.0 / np.sqrt(np.where(loud, found.loud, found.quiet))
    done = weighed(basis, weight[:, None, None] * np.eye(3))
    return replace(done, colour=colour(done.innovation, done.rate_hz))
