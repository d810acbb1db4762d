"""A diagnosis with columns that were logged badly: with holes, seldom, noise, or a wrong clock.

What a column can still say is asked first; it counts only if an effect is named by it.  Else the
answer is the one that the recording gives without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import roles
from ahrsd.diagnosis.clocks import Late, clock_of, suspects
from ahrsd.diagnosis.delays import DELAYS
from ahrsd.diagnosis.diagnosis import Diagnosis
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.engine import diagnose as by_rules
from ahrsd.diagnosis.held_columns import drawn_between, held_columns
from ahrsd.diagnosis.hygiene import hygiene, put_right
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.logger_noise import cleaned
from ahrsd.diagnosis.null import fit_null
from ahrsd.diagnosis.ordinary import beyond_ordinary
from ahrsd.diagnosis.problem import problem_of
from ahrsd.diagnosis.search import State, formed_basis_of
from ahrsd.diagnosis.shown import shown
from ahrsd.diagnosis.track import Spec, Track

#: an engine: a track and what is known of the sensor
Ask = Callable[[Track, Spec | None], Diagnosis]
#: of the unknown that may be left when a column is at its true time, or without its noise
LEFT = 0.5
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


def with_columns_as_logged(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """An engine's answer, with what columns with holes and wrong clocks can still say.

    With columns that have holes where an effect is named by one.
    """
    holed = roles.holed(track)
    if holed:
        filled = track.with_columns(
            {**track.covariates, **{k: one.values for k, one in holed.items()}}
        )
        missing = np.zeros(len(track), dtype=bool)
        for one in holed.values():
            missing |= one.missing
        found = _straight(_blind(filled, missing), spec, ask)
        used = [name for name in holed if name in causes(found)]
        if used:
            notes = tuple(holed[name].words for name in used)
            return replace(found, notes=(*notes, *found.notes))
    return _straight(track, spec, ask)


def _straight(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """The diagnosis, with columns that were held between their values drawn straight if better.

    Better is what gains more, all names together, on what was not fitted.
    """
    found = _as_logged(track, spec, ask)
    seldom = held_columns(roles.prepared(track)[0])
    by = set(causes(found))
    if not seldom or not (found.unexplained.detected or by & {one.name for one in seldom}):
        return found
    again = _as_logged(drawn_between(track, seldom), spec, ask)
    used = [one for one in seldom if one.name in causes(again)]
    if used and _gain(again) > _gain(found):
        words = ", ".join(f"{shown(one.name)} ({one.often})" for one in used)
        said = f"logged more seldom than the sensor and drawn straight between its values: {words}"
        return replace(again, notes=(said, *again.notes))
    near = by | {one.channel for one in found.unexplained.follows}
    late = ", ".join(f"{shown(one.name)} ({one.often})" for one in seldom if one.name in near)
    if not late or not found.unexplained.detected:
        return found
    said = f"logged more seldom than the sensor: {late}; what is quicker cannot be told by it"
    return replace(found, notes=(said, *found.notes))


def _gain(found: Diagnosis) -> float:
    return 0.0 if found.validation is None else found.validation.named


def _as_logged(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """The diagnosis, with the logger's noise taken out of a cause where that leaves less.

    Noise in a cause is told too small, and itself as a source that nobody knows.
    """
    found = ask(track, spec)
    usable = roles.prepared(track)[0]
    by = tuple(name for name in causes(found) if name in usable.covariates)
    clean = cleaned(usable, by) if found.unexplained.detected else None
    if clean is None:
        return found
    again = ask(clean, spec)
    if not (_names(again) == _names(found) and _less(again, found)):
        return found
    own = [name for name in by if clean.covariates[name] is not usable.covariates[name]]
    names = ", ".join(map(shown, own))
    said = f"column {names} has noise of its own: what follows it is judged without it"
    return replace(again, notes=(said, *again.notes))


def _names(found: Diagnosis) -> list[str]:
    return [one.effect for one in found.findings]


def _less(again: Diagnosis, found: Diagnosis) -> bool:
    """Whether less than half of the unknown is left."""
    before, after = found.unexplained, again.unexplained
    return not after.detected or after.evidence_nats < LEFT * before.evidence_nats


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
    if not by_it or not (_less(again, found) or worth > found.unexplained.evidence_nats):
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


def causes(found: Diagnosis) -> tuple[str, ...]:
    """Columns by which effects are named."""
    names = (one.setting.get("covariate") for one in found.findings)
    by_place = any(one.effect in ("field_gradient", "field_anomaly") for one in found.findings)
    position = ("position_north_m", "position_east_m", "position_down_m") if by_place else ()
    return (*(name for name in names if isinstance(name, str)), *position)


def _blind(track: Track, rows: NDArray[np.bool]) -> Track:
    """The track without the magnetometer's readings of these rows."""
    return replace(track, mag_b_gauss=np.where(rows[:, None], np.nan, track.mag_b_gauss))
