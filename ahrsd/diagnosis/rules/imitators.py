"""Iron that remembers, named for what two others do together.

Six coefficients and a time follow any slow course in part, and a little of a second effect with it:
so they may be the strongest name while two effects are still missing, and stay, a second time even,
when only one of the two is found beside them.  So where such a name stands beside others, names are
sought once more without it; they are taken where they are likelier, all together.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.exam import IMITATORS, pruned
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import State, formed_basis_of, refitted, without_term
from ahrsd.diagnosis.rules.selection import forward
from ahrsd.diagnosis.rules.settings import evidence_of


def without_imitators(state: State) -> State:
    """The state, or the likelier one without such names.

    Delays are of another track: beside them nothing is asked.
    """
    names = state.names
    imitate = set(IMITATORS) & set(names)
    if len(names) < 2 or not imitate or set(DELAYS) & set(names):
        return state
    library = {k: effect for k, effect in state.problem.library.items() if k not in imitate}
    kept = tuple(j for j in state.named if j.candidate.name not in imitate)
    poorer = replace(state, problem=replace(state.problem, library=library))
    other = pruned(forward(refitted(poorer, kept))[0])
    if set(DELAYS) & set(other.names) or other.walk != state.walk or len(other.named) > len(names):
        return state
    bare = formed_basis_of(state)
    for k in range(len(names)):
        bare = without_term(state, k, bare)
    if _together(other, bare) <= _together(state, bare):
        return state
    return replace(other, problem=replace(other.problem, library=state.problem.library))


def _together(state: State, bare: Base) -> float:
    """Evidence of all names together, nats; bare: the basis without any."""
    total = 0.0
    for k, judged in enumerate(state.named):
        one = judged.candidate
        total += evidence_of(bare, one)
        columns = one.effect.columns(bare.context, one.setting)
        bare = bare.beside(f"beside {k}", bare.whitened([columns])[0])
    return total
