"""The sets of effects that a search over a recording may choose from."""

from __future__ import annotations

from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Space
from ahrsd.diagnosis.inference.search.search_space import build_search_space
from ahrsd.diagnosis.track import Spec, Track


def sets_of(track: Track) -> tuple[Hypotheses, Space]:
    """Sets at the richest model of a recording, none of them fitted, and what they may contain."""
    problem, cold = build_problem(track, Spec())
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    fitted = richest_model.fit_richest_model(problem, fit.filtered, EFFECTS)
    return build_search_space(fitted, EFFECTS, ())


def middle_setting(space: Space, effect: str) -> str:
    """The key of an effect in the middle one of its settings."""
    return space.effects[effect][len(space.effects[effect]) // 2]
