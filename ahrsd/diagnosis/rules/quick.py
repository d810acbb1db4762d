"""Effects that are too quick for the working rate, sought at the rate of the recording.

Averaging to the working rate loses a field that alternates many times a second, a turning rotor,
pulses of some tens of milliseconds, or folds them to other frequencies.  So the recording as it
came is filtered with the calibration and the terms that the search found, and the quick effects
alone are held against it.  What is found is taken out of the readings, and the search begins anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ahrsd.diagnosis.calibration_fit.delay import without_lag
from ahrsd.diagnosis.calibration_fit.problem import Problem, model_at_rate, noise_of_thinned
from ahrsd.diagnosis.calibration_fit.thin import thinned
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.search import ALTERNATING, State, Survey, at_model, refitted, survey

#: sought at the recorded rate only
QUICK = ALTERNATING
#: sought at both: half of it is lost at the working rate
BOTH = ("current_derivative_field",)


@dataclass(frozen=True, slots=True, eq=False)
class Quick:
    """What was found at the recorded rate.

    state:   with the search's own terms first, `known` of them, and then the quick ones
    surveys: without each of the quick ones;  last: with all
    """

    state: State
    known: int
    surveys: tuple[Survey, ...]
    last: Survey

    def __bool__(self) -> bool:
        return bool(self.surveys)


def without_quick(problem: Problem) -> Problem:
    """The problem of a search that leaves the quick effects to `quick`."""
    library = {name: effect for name, effect in problem.library.items() if name not in QUICK}
    return replace(problem, library=library)


def quick(state: State, whole: Problem) -> Quick:
    """Name quick effects beside the terms of a search.  whole: the problem with all that it had."""
    full = _at_recorded_rate(state, whole)
    surveys: list[Survey] = []
    last = survey(full)
    while len(full.named) < whole.limits.most_terms:
        judged = [j for j in last.judged if not _of_its_pulses(j, full)]
        accepted = [j for j in judged if j.accepted]
        if not accepted or accepted[0].evidence < judged[0].evidence - whole.limits.lead_nats:
            break  # what is likelier by far may not be said: nor may this, which stands for it
        surveys.append(last)
        full = refitted(full, (*full.named, accepted[0]))
        last = survey(full)
    return Quick(full, len(state.named), tuple(surveys), last)


def _of_its_pulses(judged: Judged, state: State) -> bool:
    """Whether a line is a multiple of the rate of named pulses: what their form leaves."""
    at = judged.candidate.setting.get("frequency_hz")
    periods = [one.candidate.setting.get("period_s") for one in state.named]
    resolution_hz = 1.0 / state.problem.track.duration_s
    return at is not None and any(
        abs(at - round(at * period) / period) < resolution_hz for period in periods if period
    )


def cleaned(found: Quick, whole: Problem) -> Problem:
    """The problem of the recording without the quick terms, for a search that begins anew."""
    context = found.state.fit.context()
    mag = whole.recorded.mag_b_gauss.copy()
    for term in found.state.fit.terms[found.known :]:
        columns = term.columns(context).mag
        if columns is not None:
            mag -= columns @ term.value
    recorded = replace(whole.recorded, mag_b_gauss=mag)
    track = thinned(recorded, whole.thin, whole.cold)
    return without_quick(replace(whole, recorded=recorded, track=track))


def _at_recorded_rate(state: State, whole: Problem) -> State:
    library = {name: whole.library[name] for name in (*QUICK, *BOTH) if name in whole.library}
    lag_s = state.problem.lag_s
    problem = replace(
        whole,
        track=without_lag(whole.recorded, lag_s),
        spec=noise_of_thinned(whole.spec, 1.0 / whole.averaged, 1.0 / whole.thin),
        library=library,
        thin=1,
        averaged=1.0,
        lag_s=lag_s,
    )
    fit = at_model(problem.track, model_at_rate(state.fit.model, whole), state.fit.terms)
    return replace(state, problem=problem, fit=fit)
