"""The answer of the rules, with columns that were logged badly; one by a wrong clock, too.

A column whose clock is wrong is taken at its true time where an effect is then named by it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.columns.clocks import Late, suspects
from ahrsd.diagnosis.columns.logged import Ask, causes, leaves_less, with_columns_as_logged
from ahrsd.diagnosis.data_quality.hygiene import hygiene, put_right
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.clocks import clock_of
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.engine import diagnose as by_rules
from ahrsd.diagnosis.rules.ordinary import beyond_ordinary
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.track import Spec, Track

#: columns whose clock is sought, the likeliest first
MOST_ASKED = 2
#: a column that explains most at a smaller lag is asked last
ON_TIME_S = 1.0


def diagnose_logged(
    track: Track, spec: Spec | None = None, *, recording: str = "", simulated: bool = False
) -> Diagnosis:
    """The answer of the rules, with what columns with holes and wrong clocks can still say.

    What is left of a recording that is not known to be simulated is unknown only where it is beyond
    the ordinary.
    ValueError, one line, where nothing can be fitted.
    """
    ask = partial(by_rules, recording=recording)
    found = with_columns_as_logged(track, spec, partial(_on_time, ask=ask))
    return beyond_ordinary(found, simulated=simulated)


def _on_time(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """The diagnosis, with a column whose clock is wrong at its true time where that names it."""
    found = ask(track, spec)
    usable = roles.prepared(track)[0]
    clock = _clock(found, usable, spec or Spec())
    if clock is None:
        return found
    again = ask(clock.moved(usable), spec)
    by_it = [one for one in again.findings if one.setting.get("covariate") == clock.column]
    worth = max((one.evidence_nats for one in by_it), default=0.0)
    if not by_it or not (leaves_less(again, found) or worth > found.unexplained.evidence_nats):
        return found
    said = f"{clock.words}: its cause is judged at the sensor's time"
    return replace(again, notes=(said, *again.notes))


def _clock(found: Diagnosis, track: Track, spec: Spec) -> Late | None:
    """The clock of a column that explains what is left better at another time."""
    left = found.unexplained
    if not left.detected or left.where is None or found.drawn is None:
        return None
    if left.where.frame != "sensor":
        return None
    course = next(one for one in found.drawn.courses if one.frame == "sensor")
    named = {one.channel for one in left.follows} & set(causes(found))
    asked = [(0.0, name) for name in sorted(named)] or suspects(course, track)
    if not asked:
        return None
    problem, cold = problem_of(put_right(track, hygiene(track)), spec, EFFECTS, LIMITS)
    problem = problem.lagging(_lag_s(found))
    basis = formed_basis_of(State(problem, fit_null(problem.track, problem.spec, cold)))
    asked.sort(key=lambda one: abs(one[0]) < ON_TIME_S)  # what is on time has no clock to be told
    clocks = (clock_of(basis, name, lag_s) for lag_s, name in asked[:MOST_ASKED])
    return next((clock for clock in clocks if clock is not None), None)


def _lag_s(found: Diagnosis) -> float:
    """The magnetometer's delay that is named; what it would leave hides the column."""
    return sum(
        DELAYS[one.effect] * one.parameters[0].value
        for one in found.findings
        if one.effect in DELAYS and one.parameters[0].unit == "s"
    )
