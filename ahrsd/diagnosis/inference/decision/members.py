"""The members of a set: coefficients, contributions, sizes, and whether they are ordinary."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.added_field import heading_error_deg
from ahrsd.diagnosis.answer.diagnosis import Cost
from ahrsd.diagnosis.calibration_fit.null_fit import calibration_prior
from ahrsd.diagnosis.inference.components.component import ScaledLaw
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.components.ordinary_remainder import still_intervals
from ahrsd.diagnosis.inference.likelihood.linearisation import CALIBRATION, model_from_coefficients
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.samples import Array


def coefficients(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, Array]:
    """Posterior mean and deviation of a member's coefficients."""
    begin = 0
    for one in best.keys:
        width = all_sets.component(one).width
        if one == key:
            part = slice(begin, begin + width)
            return best.at.mean[part], best.at.deviation[part]
        begin += width
    raise KeyError(key)


def contribution_of(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, str]:
    """(N, 3) what a member adds to the readings, and its unit: gauss, or rad/s for a gyro."""
    component, track = all_sets.component(key), all_sets.made.context.track
    value, _ = coefficients(all_sets, best, key)
    matrix = component.columns.mag if component.columns.on_mag else component.columns.gyro
    contribution = np.zeros((len(track), 3)) if matrix is None else np.asarray(matrix @ value)
    return contribution, "gauss" if component.columns.on_mag else "rad/s"


def size_of(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """A lower limit of a member's size: of an effect in usual scales, of all else in its unit.

    Of an effect: the largest coefficient less two deviations.  Where the motion hardly shows a
    coefficient, a large value of it means nothing.
    """
    component = all_sets.component(key)
    if component.effect is not None and isinstance(component.law, ScaledLaw):
        value, deviation = coefficients(all_sets, best, key)
        return float(np.max(np.maximum(np.abs(value) - 2.0 * deviation, 0.0) / component.law.scale))
    psi = all_sets.psi_of(best)[key]
    return float(np.exp(psi[0])) * float(getattr(component.law, "unit", 1.0))


def effects_of(all_sets: Hypotheses, best: Hypothesis) -> Sequence[str]:
    """Identifiers of the effects in a set, sorted."""
    return sorted(one for key in best.names if (one := all_sets.component(key).effect))


def library_members(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Keys of the members that are effects of the library, without the delay."""
    effects = [key for key in sorted(best.names) if all_sets.component(key).row is not None]
    return [key for key in effects if key != LAG]


def is_ordinary(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether a member is no larger than what real recordings ordinarily have of its kind."""
    if key == LAG or not all_sets.is_real(best.names):
        return False
    component = all_sets.component(key)
    if component.jumps and _is_place_change(all_sets, key):
        return True
    ordinary_size = priors.ORDINARY_COURSE.get(component.frame, 0.0)
    return size_of(all_sets, best, key) < (
        ordinary_size if component.row is None else component.row.ordinary
    )


def _is_place_change(all_sets: Hypotheses, key: str) -> bool:
    """Whether a step of the field is the sensor lifted off a place or put down on one."""
    component, recorded = all_sets.component(key), all_sets.made.point.problem.recorded
    intervals = still_intervals(recorded.time_s, recorded.gyro_b_rad_s)
    if not intervals or component.frame != "world":
        return False
    separation_s = np.abs(np.ravel(intervals)[:, None] - component.moments_s)
    return bool(np.min(separation_s) < 2.0 * priors.TRANSITION_S)


def nats_of_remainder(all_sets: Hypotheses, best: Hypothesis) -> float:
    """By how many nats a set is more probable than without its ordinary remainder."""
    without = best.names - frozenset(all_sets.remainder)
    return 0.0 if without == best.names else best.score - all_sets.judge(without).score


def cost_if_left_out(all_sets: Hypotheses, best: Hypothesis, key: str) -> Cost:
    """How far off the calibration of the set would be without a member."""
    made = all_sets.made
    prior_mean, current = (
        calibration_prior(made.point.problem.track).mean,
        made.point.filtered.model,
    )
    reduced = all_sets.judge(all_sets.without_member(best.names, key), best)
    model_without, model_with = (
        model_from_coefficients(coefficients(all_sets, one, CALIBRATION)[0] + prior_mean, current)
        for one in (reduced, best)
    )
    shift = np.linalg.norm(model_without.hard_iron_gauss - model_with.hard_iron_gauss)
    return Cost(float(shift), heading_error_deg(model_without, model_with, made.context.field_b))
