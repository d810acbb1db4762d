"""Searches at one linearisation after the other, until what is found stays."""

from __future__ import annotations

from collections.abc import Mapping

from ahrsd.diagnosis.descent import NullFit
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.one_model import decision, rich
from ahrsd.diagnosis.one_model.effect_components import LAG
from ahrsd.diagnosis.one_model.linearised import Linearised
from ahrsd.diagnosis.one_model.search_space import best_at
from ahrsd.diagnosis.problem import Problem

#: linearisations with a search each, at most
ROUNDS = 2


def answered(
    problem: Problem, start: NullFit, library: Mapping[str, Effect]
) -> tuple[decision.Answer, Linearised]:
    """Searched at the richest model, and again at what was found, until that stays."""
    found = rich.richest(problem, start.filtered, library)
    all_sets, space, best = best_at(found, library, (), was_real=True)
    answer = decision.decided(all_sets, space, best, library)
    for _ in range(ROUNDS - 1):
        before = decision.names_of(all_sets, answer.best)
        members = [all_sets.component(key) for key in answer.best.names]
        named = [one for one in members if one.effect is not None and one.key != LAG]
        if not named:
            break
        real = any(key in all_sets.remainder for key in answer.best.names)
        found = rich.settled(all_sets.made.point, library, named)
        all_sets, space, best = best_at(found, library, named, real)
        answer = decision.decided(all_sets, space, best, library)
        if decision.names_of(all_sets, answer.best) == before:
            break
    return answer, all_sets.made
