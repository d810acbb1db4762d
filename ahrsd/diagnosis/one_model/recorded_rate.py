"""What only the recording's own rate shows: fields that alternate, rotors, pulses, single readings.

Averaging to the working rate loses a field that changes many times a second, or folds it to another
frequency.  So the recording as it came is filtered with the calibration and all that the search
found, and the library's quick effects are searched there, by the same evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis.delay import without_lag
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.innovation import run_filter
from ahrsd.diagnosis.one_model import decision, noise_model, priors, rich
from ahrsd.diagnosis.one_model.effect_components import component
from ahrsd.diagnosis.one_model.linearised import (
    CALIBRATION,
    Linearised,
    Point,
    added,
    by_key,
    linearised,
    moved,
    relevelled,
)
from ahrsd.diagnosis.one_model.model_search import Hypotheses, Hypothesis, Space, searched
from ahrsd.diagnosis.problem import Problem, model_at_rate
from ahrsd.diagnosis.thin import thinned
from ahrsd.samples import Array

#: how often rows are weighed anew beside what was found
LEVELLED = 2


@dataclass(frozen=True, slots=True, eq=False)
class Quick:
    """An answer at the recorded rate.

    left: the recording with all that was found taken out;  all_sets, space: what was searched
    slower: the problem of a search that begins anew without what was found, None where nothing was
    """

    answer: decision.Answer
    left: Point
    slower: Problem | None
    all_sets: Hypotheses
    space: Space


def quick(
    made: Linearised, best: Hypothesis, library: Mapping[str, Effect], *, real: bool
) -> Quick:
    """The quick effects beside a set that was found at the working rate.

    real: whether that set leaves what real recordings do: then a column has to tell, for a room has
          alternating fields of its own
    """
    point = at_recorded_rate(moved(made, best.keys, best.at))
    fast, all_sets, space, found = _searched(point, library, real=real)
    for _ in range(LEVELLED if found.names else 0):  # rows far off for what is found are not now
        point = relevelled(fast, found.keys, found.at)
        fast, all_sets, space, found = _searched(point, library, real=real)
    answer = decision.decided(all_sets, space, found, library)
    slower = None
    if answer.findings:
        slower = _without(point.problem, made.point.problem, fast, answer.best)
    return Quick(answer, point, slower, all_sets, space)


def _searched(
    point: Point, library: Mapping[str, Effect], *, real: bool
) -> tuple[Linearised, Hypotheses, Space, Hypothesis]:
    """The likeliest set of quick effects at a point."""
    fast = linearised(point, point.context)
    candidates = {}
    for name, effect in library.items():
        settings = effect.settings(fast.context) if effect.quick else ()
        settings = tuple(one for one in settings if "covariate" in one or not real)
        parts = [component(fast.context, effect, one, len(settings)) for one in settings]
        fast.add(parts)
        if parts:
            candidates[name] = [one.key for one in parts]
    step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
    noise = rich.fitted(fast, (CALIBRATION,), step).log_noise
    all_sets = Hypotheses(fast, (), noise, {}, real=real)
    space = Space(candidates, (), lambda *_: [], lambda _: None, lambda _: [])
    return fast, all_sets, space, searched(all_sets, space, [frozenset()])[0]


def at_recorded_rate(slow: Point) -> Point:
    """A point at the recording's own rate: all that is taken out is drawn between working rows."""
    problem = slow.problem
    track = without_lag(problem.recorded, problem.lag_s, instants=problem.instants)
    at_s, time_s = slow.filtered.track.time_s, track.time_s

    def drawn(values: Array | None) -> Array | None:
        if values is None:
            return None
        return np.column_stack([np.interp(time_s, at_s, column) for column in values.T])

    mag, gyro = drawn(slow.terms_mag), drawn(slow.terms_gyro)
    filtered = run_filter(track, model_at_rate(slow.filtered.model, problem), mag, gyro)
    fast = replace(problem, track=track, thin=1, averaged=1.0)
    loud = noise_model.loudness(filtered.whitened, filtered.used, fast.rate_hz)
    return Point(fast, filtered, {}, mag, gyro, loud)


def _without(fast: Problem, slow: Problem, made: Linearised, best: Hypothesis) -> Problem:
    """The problem of the working rate, without what was found at the recorded one."""
    values = {key: v for key, v in by_key(made, best.keys, best.at).items() if key in best.names}
    known = {key: made.seen[key].component for key in values}
    mag, _ = added(len(fast.track), known, values)
    recorded = replace(slow.recorded, mag_b_gauss=slow.recorded.mag_b_gauss - mag)
    track = thinned(recorded, slow.thin, slow.cold)
    return replace(slow, recorded=recorded, track=track, lag_s=0.0, instants=False)
