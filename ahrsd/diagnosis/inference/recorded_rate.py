"""Effects that only the recorded rate shows: alternating fields, rotors, pulses, single readings.

Averaging to the working rate removes a field that changes many times a second, or aliases it to
another frequency.  So the recording at its own rate is filtered with the calibration and all that
the search found, and the library's quick effects are searched there, by the same evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Unexplained
from ahrsd.diagnosis.calibration_fit.delay import without_lag
from ahrsd.diagnosis.calibration_fit.problem import Problem, model_of_samples
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.effect_components import effect_component, form_component
from ahrsd.diagnosis.inference.decision import decision
from ahrsd.diagnosis.inference.likelihood import noise_model, richest_model
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    CALIBRATION,
    Linearised,
    Point,
    coefficients_by_key,
    linearise,
    refit_noise_level,
    step_to_maximum,
    total_contribution,
)
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Names,
    Space,
    beam_search,
)
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.where_and_when.narrow_band import loudest_band, unexplained_band
from ahrsd.samples import Array

#: how often the noise level is estimated anew with the accepted effects in the model
NOISE_REFITS = 2


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRateResult:
    """An answer at the recorded rate.

    point: the recording with all that was found at the working rate removed
    all_sets, space: what was searched
    band: a band of a high noise level that no effect explains
    reduced_problem: the problem of a new search without what was found, None if nothing was found
    """

    answer: decision.Answer
    point: Point
    reduced_problem: Problem | None
    all_sets: Hypotheses
    space: Space
    band: Unexplained


def search_recorded_rate(
    made: Linearised,
    best: Hypothesis,
    library: Mapping[str, Effect],
    *,
    real: bool,
    source_nats: float = 0.0,
) -> RecordedRateResult:
    """Search the quick effects, given a set that was found at the working rate.

    real: whether that set has the ordinary remainder; then only effects by a logged column are
          tested, because a room has alternating fields of its own
    source_nats: evidence of a switching source in that set
    """
    point = point_at_recorded_rate(step_to_maximum(made, best.keys, best.at))
    fast, all_sets, space, found = _search_with_band(point, library, real=real)
    # readings that were outliers may be none with what was found in the model
    for _ in range(NOISE_REFITS if found.names else 0):
        point = refit_noise_level(fast, found.keys, found.at)
        del fast, all_sets, space  # the sets of the previous point take as much memory
        fast, all_sets, space, found = _search_with_band(point, library, real=real)
    all_sets.unknown_nats = source_nats
    answer = decision.decide(all_sets, space, found, library)
    reduced_problem = None
    if answer.findings:
        reduced_problem = _remove_found(point.problem, made.point.problem, fast, answer.best)
    return RecordedRateResult(
        answer, point, reduced_problem, all_sets, space, _find_unexplained_band(fast, answer.best)
    )


def _search_with_band(
    point: Point, library: Mapping[str, Effect], *, real: bool
) -> tuple[Linearised, Hypotheses, Space, Hypothesis]:
    """The most probable set of quick effects at a point.

    If a band stands out, it may be noise as well.  Then the effects found without it have to be
    more probable than a band of any power.
    """
    plain = linearise(point, point.context)
    first = _search_in_noise(plain, library, (), real=real)
    if real:
        return first
    null = first[1].judge(frozenset())
    rate_hz = point.problem.rate_hz
    # repeated readings are not used, so the magnetometer's own rate is lower
    highest_hz = 0.5 * rate_hz * float(np.mean(point.filtered.used))
    band = loudest_band(plain.residual(null.keys, null.at), rate_hz, highest_hz)
    if band is None:
        return first
    first_members = first[3].names
    del plain, first, null  # at the recorded rate each takes a hundred megabytes
    with_band = linearise(point, point.context, band[:2])
    return _search_in_noise(with_band, library, [first_members], real=real)


def _search_in_noise(
    fast: Linearised, library: Mapping[str, Effect], starts: Sequence[Names], *, real: bool
) -> tuple[Linearised, Hypotheses, Space, Hypothesis]:
    """The most probable set with one form of the noise.  starts: sets besides the empty one."""
    candidates: dict[str, list[str]] = {}
    forms: dict[str, Component] = {}
    for effect_key, effect in library.items():
        settings = effect.settings(fast.context) if effect.quick else ()
        settings = tuple(one for one in settings if "covariate" in one or not real)
        parts = [effect_component(fast.context, effect, one, len(settings)) for one in settings]
        unlogged = [one for one in parts if "covariate" not in one.setting]
        unlogged_forms = [(one.key, form_component(one, fast.context, library)) for one in unlogged]
        forms |= {key: form for key, form in unlogged_forms if form is not None}
        fast.add(parts)
        fast.make_columns_lazy(parts)
        if parts:
            candidates[effect_key] = [one.key for one in parts]
    step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
    noise = richest_model.fit_hyperparameters(fast, (CALIBRATION,), step).log_noise
    fast.add(list(forms.values()))
    form_keys = {key: form.key for key, form in forms.items()}
    all_sets = Hypotheses(fast, (), noise, {}, form_keys, real=real)
    space = Space(
        candidates, (), lambda *_: [], lambda *_: [], lambda _: None, lambda _: [], lambda *_: []
    )
    return fast, all_sets, space, beam_search(all_sets, space, [frozenset(), *starts])[0]


def _find_unexplained_band(fast: Linearised, best: Hypothesis) -> Unexplained:
    """The band with a noise level of its own, if it stands out given the accepted effects."""
    alone = fast.alone
    if alone is None:
        return Unexplained(False)
    log_noise = best.at.log_noise
    sides = [k for k in (alone.start - 1, alone.stop) if 0 <= k < len(log_noise)]
    side_level = float(max(log_noise[k] for k in sides))
    ratio = np.exp(log_noise[alone] - side_level)
    rows = 1.5 * np.diff(fast.edges)[alone]
    nats = float(np.sum(rows * (ratio - 1.0 - np.log(ratio))))
    if np.max(ratio) < priors.STANDS_OUT or nats < priors.UNKNOWN_ODDS:
        return Unexplained(False)
    low, high = float(fast.edges[alone.start]), float(fast.edges[alone.stop])
    rate_hz, count = fast.point.problem.rate_hz, int(fast.edges[-1])
    side_noise = replace(best.at, log_noise=np.full(len(log_noise), side_level))
    residual = fast.residual(best.keys, side_noise)
    band_hz = (rate_hz * low / (2 * count), rate_hz * high / (2 * count))
    return unexplained_band(fast.context, residual, rate_hz, band_hz, nats)


def point_at_recorded_rate(slow: Point) -> Point:
    """A point at the recorded rate; what was removed is interpolated between the working rows."""
    problem = slow.problem
    track = without_lag(problem.recorded, problem.lag_s, instants=problem.instants)
    at_s, time_s = slow.filtered.track.time_s, track.time_s

    def interpolate(values: Array | None) -> Array | None:
        if values is None:
            return None
        return np.column_stack([np.interp(time_s, at_s, column) for column in values.T])

    mag, gyro = interpolate(slow.terms_mag), interpolate(slow.terms_gyro)
    filtered = run_filter(track, model_of_samples(slow.filtered.model, problem), mag, gyro)
    fast = replace(problem, track=track, thin=1, averaged=1.0)
    levels = noise_model.fit_noise_levels(filtered.whitened, filtered.used, fast.rate_hz)
    return Point(fast, filtered, {}, mag, gyro, levels)


def _remove_found(fast: Problem, slow: Problem, made: Linearised, best: Hypothesis) -> Problem:
    """The problem at the working rate, without what was found at the recorded rate."""
    values = {
        key: value
        for key, value in coefficients_by_key(made, best.keys, best.at).items()
        if key in best.names
    }
    components = {key: made.seen[key].component for key in values}
    mag, _ = total_contribution(len(fast.track), components, values)
    recorded = replace(slow.recorded, mag_b_gauss=slow.recorded.mag_b_gauss - mag)
    return replace(slow, recorded=recorded, instants=False).with_lag(0.0)
