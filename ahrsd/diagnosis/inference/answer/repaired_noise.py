"""The noise of the repaired model: the scatter that remains given the findings alone.

The repaired model consists of calibration, effects and noise.  What real recordings ordinarily
leave belongs to no effect and is noise in this model.  So the noise law is fitted with only the
effects removed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import (
    Finding,
)
from ahrsd.diagnosis.answer.predictive_checks import constant_level_noise
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.data_quality.facts import (
    Fact,
    burst_is_explained,
    lost_turn_intervals,
    rounding,
)
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    Point,
    coefficients_by_key,
    step_to_maximum,
    total_contribution,
)
from ahrsd.diagnosis.inference.recorded_rate import RecordedRateResult, point_at_recorded_rate
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult
from ahrsd.diagnosis.innovation_filter.noise import level_facts
from ahrsd.diagnosis.model import Noise


def repaired_noise(
    found: ModelSearchResult,
    fast: RecordedRateResult,
    library: Mapping[str, Effect],
    facts: Sequence[Fact],
    level_intervals: Sequence[tuple[float, float]],
) -> Noise:
    """The noise law at the recorded rate.  level_intervals: intervals of another noise level, s."""
    point, answer = fast.point, found.answer
    if found.all_sets.is_real(answer.best.names):
        point = point_at_recorded_rate(_remove_effects_only(found))
    filtered = point.filtered
    fit = NullFit(
        filtered.model, filtered, True, np.zeros((11, 11)), point.terms_mag, point.terms_gyro
    )
    # a delay has been removed from the track, and quick effects from the recording
    kept = [term for term in answer.terms if not library[term.identifier].delay]
    return constant_level_noise(fit, level_intervals, (*kept, *rounding(facts)), library)


def _remove_effects_only(found: ModelSearchResult) -> Point:
    """The point of an answer with only its effects removed from the readings."""
    all_sets, best = found.all_sets, found.answer.best
    values = coefficients_by_key(all_sets.made, best.keys, best.at)
    effects = {key: all_sets.component(key) for key in found.answer.keys if key != LAG}
    count = len(all_sets.made.context.track)
    mag, gyro = total_contribution(count, effects, {key: values[key] for key in effects})
    point = step_to_maximum(all_sets.made, best.keys, best.at)
    return replace(point, terms_mag=mag, terms_gyro=gyro)


def noise_level_facts(
    found: ModelSearchResult,
    fast: RecordedRateResult,
    facts: Sequence[Fact],
    findings: Sequence[Finding],
    *,
    spec_given: bool,
) -> list[Fact]:
    """Facts about the noise level.

    None are reported with the ordinary remainder or with a source along one direction, because both
    come and go; nor with coarse numbers, which scatter by themselves.  A burst is not noise where
    turns were lost or an object was passed.
    """
    real = found.all_sets.is_real(found.answer.best.names)
    if real or found.source is not None or rounding(facts):
        return []
    passing = [
        span for one in findings if one.where.frame == "world" for span in one.where.intervals_s
        if span[1] - span[0] < priors.PASSING_S
    ]  # fmt: skip
    moments = [*lost_turn_intervals(facts), *passing]
    levels = level_facts(fast.point.filtered, spec_given=spec_given)
    return [fact for fact in levels if not burst_is_explained(fact, moments)]
