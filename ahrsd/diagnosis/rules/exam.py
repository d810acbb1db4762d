"""Names held against what the whole model leaves, which on a real recording is never nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.innovation_filter.evidence import CLEAR_PEAK
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.discrepancy import Discrepancy, beyond, discrepancy
from ahrsd.diagnosis.rules.foretold import in_time_alone
from ahrsd.diagnosis.rules.name import believable, judge
from ahrsd.diagnosis.rules.nested import contained, without_wider
from ahrsd.diagnosis.rules.regression import Base, candidate_gram, columns_of
from ahrsd.diagnosis.rules.search import (
    COUNTERPART_NATS,
    STEPS,
    State,
    counterpart,
    formed_basis_of,
    refitted,
    term_group,
    without_term,
)
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.slow_noise import lawful
from ahrsd.samples import Array

#: names of iron and metal that remember or follow the turns: half of any unlogged course looks so
IMITATORS = ("viscous_magnetisation", "hysteresis", "eddy_current")

#: fields that a room has by itself: of several names that are too weak these go first, beside which
#: a magnet that comes as the vehicle moves off may have looked no larger than they
OF_A_ROOM = ("field_step", "field_anomaly", "geomagnetic_drift")


def pruned(state: State) -> State:
    """Terms that the others have made superfluous taken out, one at a time.

    A single one, too, where the bias may wander: it may have been named before it could.
    """
    while len(state.named) > (state.walk == 0.0):
        basis = formed_basis_of(state)
        evidence = []
        for k, judged in enumerate(state.named):
            if contained(state, k):
                evidence.append(-np.inf)
                continue
            left = without_wider(state, k, without_term(state, k, basis))
            columns = columns_of(left, [judged.candidate])
            gram = candidate_gram(left, columns, state.problem.block_s)
            own = columns[judged.candidate.name]
            again = judge(judged.candidate, gram, own, left, 1, state.problem.limits)
            evidence.append(again.evidence)
        weakest = int(np.argmin(evidence))
        if evidence[weakest] > state.problem.limits.evidence_nats:
            break
        state = refitted(state, tuple(j for k, j in enumerate(state.named) if k != weakest))
    return state


def examined(state: State) -> tuple[State, bool]:
    """The state without the names that are no more than what the model leaves anyway.

    One at a time, the weakest first, everything else fitted anew after each; and whether anything
    is left beside the names.
    """
    limits = state.problem.limits
    while state.named:
        basis = formed_basis_of(state)
        found = rest_of(state, basis)
        if found is None:
            return state, False
        small = limits.unknown_nats + found.unknown  # of a small rest even the form is not much
        bar = max(min(limits.beyond_nats, small), limits.beyond_share * found.unknown)
        enough = max(bar, found.unknown)  # no question is how much more than that
        worth = [_worth(state, basis, found, k, enough) for k in range(len(state.named))]
        poor = [k for k in range(len(worth)) if worth[k] <= bar]
        poor = [k for k in poor if state.names[k] in OF_A_ROOM] or poor
        poor = poor or [k for k in range(len(worth)) if _imitates(state.names[k], worth[k], found)]
        if not poor:
            break
        weakest = min(poor, key=lambda k: worth[k])
        kept = tuple(judged for k, judged in enumerate(state.named) if k != weakest)
        state = refitted(state, kept)
    return state, True


def _imitates(name: str, worth: float, found: Discrepancy) -> bool:
    """Whether a name that needs no logged cause is worth less than what it leaves unexplained."""
    return name in IMITATORS and worth < found.unknown


def rest_of(state: State, basis: Base) -> Discrepancy | None:
    """What the model leaves, None where that is no more than noise."""
    if not state.named:
        return None
    found = random_effects(state, basis)
    if found.nats <= state.problem.limits.unknown_nats or _is_slow_noise(state, basis, found):
        return None
    return found


def _is_slow_noise(state: State, basis: Base, found: Discrepancy) -> bool:
    """Whether it is noise that forgets within seconds, beside which every name holds."""
    if basis.colour <= CLEAR_PEAK:
        return False
    made = state.fit.made
    if "slow noise" not in made:
        limits = state.problem.limits
        quiet = lawful(basis, unknown.remainder(basis, with_bins=False))
        worth = [
            evidence_of(without_term(state, k, quiet), one.candidate)
            for k, one in enumerate(state.named)
        ]
        # what has a moment of its own was sought at many
        least = [
            limits.beyond_nats if in_time_alone(one.candidate) else limits.unknown_nats
            for one in state.named
        ]
        made["slow noise"] = discrepancy(quiet).nats <= limits.unknown_nats and all(
            nats > bar and not _imitates(name, nats, found)
            for name, nats, bar in zip(state.names, worth, least, strict=True)
        )
    noise: bool = made["slow noise"]
    return noise


def random_effects(state: State, basis: Base) -> Discrepancy:
    """Those that the state needs, with its formed basis."""
    made = state.fit.made
    if "rest" not in made:
        made["rest"] = discrepancy(basis)
    found: Discrepancy = made["rest"]
    return found


def paired(state: State) -> State:
    """Steps of about the same size in two frames made one thing, put on and taken off, if they can.

    What comes while the vehicle stands is as good in either frame; what goes while it turns is not.
    """
    for k, name in enumerate(state.names):
        for other in {n for n in state.names if n in STEPS.values()} - {name}:
            if name not in STEPS.values() or counterpart(state, k) is not None:
                continue
            effect = state.problem.library[other]
            candidate = replace(state.named[k].candidate, effect=effect)
            left = without_term(state, k)
            loss = evidence_of(left, state.named[k].candidate) - evidence_of(left, candidate)
            if loss < COUNTERPART_NATS:
                judged = replace(state.named[k], candidate=candidate)
                tried = refitted(state, (*state.named[:k], judged, *state.named[k + 1 :]))
                state = tried if counterpart(tried, k) is not None else state
    return state


def _worth(state: State, basis: Base, found: Discrepancy, number: int, enough: float) -> float:
    """Nats by which a name, with its counterpart if it has one, is more than what is left.

    At least `enough`, where it is more.
    """
    judged = state.named[number]
    value = state.fit.terms[number].value
    if not believable(judged.candidate, judged.what, value, basis.colour):
        return -np.inf
    left = without_wider(state, number, without_term(state, number, basis))
    columns = _columns(basis, number)
    scale = judged.candidate.scale
    other = counterpart(state, number)
    if other is not None:
        left = left.without(term_group(other), state.fit.terms[other].value)
        columns = np.concatenate([columns, _columns(basis, other)], axis=2)
        scale = np.concatenate([scale, scale])
    return beyond(found, left, columns, scale, enough)


def _columns(basis: Base, number: int) -> Array:
    return np.asarray(basis.known[:, :, basis.groups[term_group(number)]])
