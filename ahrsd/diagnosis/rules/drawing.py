"""What a report draws of a search: innovations, what each term adds, what is left by regime.

The map by regime stands in the noise that the repaired model leaves, both before and after: an
effect that is not in the model must not pass for noise in its own map.
"""

from __future__ import annotations

from collections.abc import Sequence

from ahrsd.diagnosis.answer.diagnosis import (
    Contribution,
    Drawn,
    Finding,
    RegimeMap,
    Unexplained,
    Validation,
)
from ahrsd.diagnosis.calibration_fit.descent import NullFit
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.findings import added_value, contribution
from ahrsd.diagnosis.rules.heldout import gain_of, gain_of_all, gain_together
from ahrsd.diagnosis.rules.quick import Quick
from ahrsd.diagnosis.rules.regression import Base, candidate_gram, group_gram
from ahrsd.diagnosis.rules.search import State, Survey, basis_of
from ahrsd.diagnosis.rules.validate import folds
from ahrsd.diagnosis.where_and_when.locate import Located
from ahrsd.diagnosis.where_and_when.regime import Regime, regime_columns, regimes


def drawn(
    start: NullFit, state: State, fast: Quick, first: Survey, courses: tuple[Located, ...]
) -> Drawn:
    """The pictures' numbers.  start: the calibration alone;  first: the survey of it."""
    basis = basis_of(state)
    return Drawn(
        basis.context.track.time_s,
        start.filtered.whitened,
        state.fit.filtered.whitened,
        start.filtered.innovation,
        state.fit.filtered.innovation,
        (*_added(state, basis, 0), *_added(fast.state, fast.last.basis, fast.known)),
        courses,
        {candidate.name: candidate.evidence for candidate in first.candidates},
    )


def _added(state: State, basis: Base, since: int) -> list[Contribution]:
    """What the state's terms add, from number `since` on; a delay's as it is in the recording."""
    return [
        Contribution(
            state.names[number],
            basis.context.track.time_s,
            contribution(state.named[number], added_value(state, number), basis),
            "rad/s" if _turns(state, basis, number) else "gauss",
        )
        for number in range(since, len(state.named))
    ]


def _turns(state: State, basis: Base, number: int) -> bool:
    candidate = state.named[number].candidate
    return candidate.effect.columns(basis.context, candidate.setting).mag is None


def regime_map(start: State, state: State) -> tuple[RegimeMap, ...]:
    """What is left by heading, tilt, rate and every logged column, the strongest first."""
    after, before = basis_of(state), basis_of(start)
    found = []
    for one in regimes(after.context):
        left = _nats(after, one, after.colour)
        whole = _nats(before, one, after.colour) if state.named else left
        edges = tuple(float(edge) for edge in one.edges)
        found.append(RegimeMap(one.quantity, edges, whole, left))
    return tuple(sorted(found, key=lambda one: -max(one.before)))


def _nats(basis: Base, one: Regime, colour: float) -> tuple[float, ...]:
    """(bins,) what a field of each bin's own gains beside what the basis knows."""
    total = group_gram(basis, {one.group: regime_columns(one)}).total
    out = []
    for k in range(len(one.edges) - 1):
        where = slice(3 * k, 3 * k + 3)
        s = total[where, -1]
        out.append(float(s @ solve(total[where, where], s[:, None])[:, 0]) / (2.0 * colour))
    return tuple(out)


def validation(state: State, findings: Sequence[Finding], left: Unexplained) -> Validation:
    """All names together on what was not fitted, and beside them what they leave.

    What only the recorded rate shows is not in the fifths, and counts by itself.
    """
    heldout = [one.heldout for one in findings if one.heldout is not None]
    quickly = sum(
        one.heldout.nll_gain_per_sample
        for one in findings
        if one.heldout is not None and (one.term or 0) >= len(state.named)
    )
    placebo = max([0.0, *(one.placebo_gain for one in heldout)])
    free = 0.0 if left.heldout is None else left.heldout.nll_gain_per_sample
    return Validation(_together(state) / state.problem.thin + quickly, free, placebo)


def _together(state: State) -> float:
    """Nats per row of all names.

    Of fifths of the recording; where those know too little of one name, of the gate's stretches.
    """
    if not state.named:
        return 0.0
    values = [added_value(state, number) for number in range(len(state.named))]
    scales = [judged.candidate.scale for judged in state.named]
    each = [gain_of(state.fit, k, values[k], scales[k]) for k in range(len(values))]
    if all(gain is not None for gain in each):
        return gain_of_all(state.fit, values, scales).nats_per_sample
    blocks = candidate_gram(basis_of(state), {}, state.problem.block_s)
    return gain_together(blocks, values, scales, folds).nats_per_sample
