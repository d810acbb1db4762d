"""What the members of a set are: their coefficients, what they add, and whether it is ordinary."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.added_field import heading_error_deg
from ahrsd.diagnosis.answer.diagnosis import Cost
from ahrsd.diagnosis.calibration_fit.null_fit import calibration_prior
from ahrsd.diagnosis.inference.components.component import Sized
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.components.ordinary_remainder import still_spells
from ahrsd.diagnosis.inference.likelihood.linearisation import CALIBRATION, model_of
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.samples import Array


def coefficients(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, Array]:
    """Likeliest coefficients of a member and their deviations."""
    begin = 0
    for one in best.keys:
        width = all_sets.component(one).width
        if one == key:
            part = slice(begin, begin + width)
            return best.at.mean[part], best.at.deviation[part]
        begin += width
    raise KeyError(key)


def added_by(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, str]:
    """(N, 3) what a member adds to the readings, and its unit: gauss, or rad/s of the gyro's."""
    one, track = all_sets.component(key), all_sets.made.context.track
    value, _ = coefficients(all_sets, best, key)
    matrix = one.columns.mag if one.columns.on_mag else one.columns.gyro
    added = np.zeros((len(track), 3)) if matrix is None else np.asarray(matrix @ value)
    return added, "gauss" if one.columns.on_mag else "rad/s"


def size_of(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """How large a member surely is: an effect in its usual scales, all else in its unit.

    Of an effect what is beyond two deviations: where the motion hardly shows a coefficient, a large
    one says nothing.
    """
    one = all_sets.component(key)
    if one.effect is not None and isinstance(one.law, Sized):
        value, deviation = coefficients(all_sets, best, key)
        return float(np.max(np.maximum(np.abs(value) - 2.0 * deviation, 0.0) / one.law.scale))
    psi = all_sets.psi_of(best)[key]
    return float(np.exp(psi[0])) * float(getattr(one.law, "unit", 1.0))


def names_of(all_sets: Hypotheses, best: Hypothesis) -> Sequence[str]:
    """Effects in a set, sorted."""
    return sorted(one for key in best.names if (one := all_sets.component(key).effect))


def library_members(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Members that the library has, without the delay."""
    known = [key for key in sorted(best.names) if all_sets.component(key).row is not None]
    return [key for key in known if key != LAG]


def is_ordinary(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether a member is no larger than what real recordings ordinarily have of its kind."""
    if key == LAG or not all_sets.is_real(best.names):
        return False
    one = all_sets.component(key)
    if one.jumps and _is_place(all_sets, key):
        return True
    course = priors.ORDINARY_COURSE.get(one.frame, 0.0)
    return size_of(all_sets, best, key) < (course if one.row is None else one.row.ordinary)


def _is_place(all_sets: Hypotheses, key: str) -> bool:
    """Whether a step of the field is where the sensor is lifted off a place or put down on it."""
    one, recorded = all_sets.component(key), all_sets.made.point.problem.recorded
    spells = still_spells(recorded.time_s, recorded.gyro_b_rad_s)
    if not spells or one.frame != "world":
        return False
    off = np.abs(np.ravel(spells)[:, None] - one.moments_s)
    return bool(np.min(off) < 2.0 * priors.TRANSITION_S)


def nats_of_remainder(all_sets: Hypotheses, best: Hypothesis) -> float:
    """By how much likelier a set is with what recordings ordinarily leave."""
    without = best.names - frozenset(all_sets.remainder)
    return 0.0 if without == best.names else best.score - all_sets.judge(without).score


def cost_if_left_out(all_sets: Hypotheses, best: Hypothesis, key: str) -> Cost:
    """What the calibration would be off by in the set without a member."""
    made = all_sets.made
    middle, here = calibration_prior(made.point.problem.track).mean, made.point.filtered.model
    fewer = all_sets.judge(all_sets.without(best.names, key), best)
    left_out, known = (
        model_of(coefficients(all_sets, one, CALIBRATION)[0] + middle, here)
        for one in (fewer, best)
    )
    shift = np.linalg.norm(left_out.hard_iron_gauss - known.hard_iron_gauss)
    return Cost(float(shift), heading_error_deg(left_out, known, made.context.field_b))
