"""Searches at one linearisation after the other, until what is found stays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis.descent import NullFit
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.one_model import decision, priors, rich
from ahrsd.diagnosis.one_model.effect_components import LAG, PIECES
from ahrsd.diagnosis.one_model.linearised import unread
from ahrsd.diagnosis.one_model.model_search import Hypotheses, Hypothesis, Space
from ahrsd.diagnosis.one_model.search_space import best_at
from ahrsd.diagnosis.problem import Problem

#: linearisations with a search each, at most
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """An answer, and the sets at the last linearisation that it was chosen of."""

    answer: decision.Answer
    all_sets: Hypotheses
    space: Space


def answered(problem: Problem, start: NullFit, library: Mapping[str, Effect]) -> Searched:
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
        real = all_sets.is_real(answer.best.names)
        spans = moved_in(all_sets, answer.best)
        point = unread(all_sets.made.point, spans) if spans else all_sets.made.point
        found = rich.settled(point, library, named)
        all_sets, space, best = best_at(found, library, named, real)
        answer = decision.decided(all_sets, space, best, library)
        if decision.names_of(all_sets, answer.best) == before and not spans:
            break
    return Searched(answer, all_sets, space)


def moved_in(all_sets: Hypotheses, best: Hypothesis) -> list[tuple[float, float]]:
    """When something was moved, (from, to) s: where the forms of steps are far beyond the noise.

    A step has its two levels right, but a form of some pieces is not the way from one to the other:
    what it leaves is louder than all else, and other names are told for it.
    """
    point = all_sets.made.point
    track, sigma = point.filtered.track, point.filtered.model.sigma_mag_gauss
    read = np.isfinite(track.mag_b_gauss).all(axis=1)
    out = []
    for key, form in all_sets.forms.items():
        one = all_sets.component(form)
        if key not in best.names or one.columns.mag is None or "onset_s" not in one.setting:
            continue
        value, _ = decision.coefficients(all_sets, best, form)
        added = np.linalg.norm(one.columns.mag @ value, axis=1)
        loud = np.flatnonzero(read & (added > priors.MOVED * sigma))
        if len(loud):
            half_s = priors.APPROACH_S / 2 / PIECES
            begin, end = float(track.time_s[loud[0]]), float(track.time_s[loud[-1]])
            out.append((begin - half_s, end + half_s))
    return out
