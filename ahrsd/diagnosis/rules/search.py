"""Terms named one after the other with a joint refit after each, then pruning and swapping.

A name changes what all the others explain, and outside the linear range (a misalignment of three
degrees) an unrefitted model invents terms: so every accepted term is fitted together with the
calibration before the library is asked again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.delay import beyond_the_lag
from ahrsd.diagnosis.calibration_fit.descent import FitProblem, FittedTerm, NullFit, descended
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.prior import prior_of
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.calibration_fit.resting import at_rest
from ahrsd.diagnosis.effects.shapes import LOGGED
from ahrsd.diagnosis.innovation_filter.context import Given, build_context
from ahrsd.diagnosis.innovation_filter.innovation import bearings
from ahrsd.diagnosis.rules.delays import DELAYS, plain
from ahrsd.diagnosis.rules.late import QUICK_CAUSES, in_time, on_time
from ahrsd.diagnosis.rules.memory import with_memory
from ahrsd.diagnosis.rules.moments import as_found, at_one_moment
from ahrsd.diagnosis.rules.moved import SCALE_AGAIN, both, moved_together
from ahrsd.diagnosis.rules.name import Judged, judge, ranked
from ahrsd.diagnosis.rules.regression import (
    Base,
    Candidate,
    base,
    candidate_gram,
    columns_of,
    quieter,
)
from ahrsd.diagnosis.rules.settings import (
    as_read,
    best_settings,
    closest_scale,
    evidence_of,
    scale_of,
)
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import NullModel
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

#: candidates that are held against the gate in one round, strongest first
LOOKED_AT = 8
#: settings that are a form of the course, of which another may be likelier once all is fitted
FORMS = ("power", "form", "shape", "of", "products")
#: nats by which a frame must lead before steps in it are believed
FRAME_LEAD = 10.0
#: a jump in each frame
STEPS: Mapping[Frame, str] = {
    "sensor": "hard_iron_step",
    "world": "field_step",
    "gyro": "gyro_bias_step",
}
#: nats by which another onset or scale must be better to be taken
SHAPED_NATS, SHAPED_PASSES = 1.0, 5
#: group of what a low-pass does beyond a delay
FORM = "form of the delay"
#: steps that cancel to this share are one thing that was put on and taken off again
CANCELS = 0.25
#: nats that such a coincidence of three coefficients is worth
COUNTERPART_NATS = 3 * float(np.log(1 / CANCELS))
SMALL_LAG_S = 2e-3
LAG_STEPS = 3
#: what a vehicle that hardly turns can tell of the field: what no turn and no drift does
ALTERNATING = ("ac_interference", "rotor_field", "sync_pulses")
#: fields of the sensor that need no turning: those, and the logged causes whose manoeuvre is a rest
AT_REST = (*ALTERNATING, "motor_current_field", "switched_device")
#: names of a gyro bias that changes with time alone
WANDERING = ("gyro_bias_drift", "gyro_bias_step", "gyro_startup", "gyro_bias_temperature")


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A fit with its named terms, in the order in which they were named.

    problem: with the lag that is taken out
    walk: rad/s per root second by which the gyro's bias may wander; 0: it stays
    """

    problem: Problem
    fit: NullFit
    named: tuple[Judged, ...] = ()
    walk: float = 0.0

    def lag_s(self, number: int) -> float:
        """The whole delay that a delay's term stands for, in the term's own sign."""
        term = self.fit.terms[number]
        return DELAYS[term.identifier] * self.problem.lag_s + float(term.value[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Identifiers."""
        return tuple(judged.candidate.name for judged in self.named)


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The library held against one state: all candidates, and those near the top judged."""

    basis: Base
    candidates: tuple[Candidate, ...]
    judged: tuple[Judged, ...]


def term_group(number: int) -> str:
    """Group of a named term in a Gram."""
    return f"term {number}"


def basis_of(state: State) -> Base:
    """Whitened columns of calibration and terms at the state's fit."""
    fit = state.fit
    if "basis" not in fit.made:
        context = fit.context()
        terms = [(term_group(k), term.columns(context)) for k, term in enumerate(fit.terms)]
        fit.made["basis"] = base(context, fit.filtered, terms, state.problem.rate_hz)
    basis: Base = fit.made["basis"]
    return basis


def formed_basis_of(state: State) -> Base:
    """The same with what a low-pass does beyond a delay known too, where one was found.

    Which of the two it is, is told in the end (`delays`): until then the difference is no physics
    of its own, which a filter of 100 ms would leave for others to explain.
    """
    basis, lag_s = basis_of(state), state.problem.lag_s
    if lag_s <= 0.0 or not any(name in DELAYS for name in state.names):
        return basis
    if "formed" not in state.fit.made:
        form = basis.whitened([beyond_the_lag(basis.context, lag_s)])[0]
        state.fit.made["formed"] = basis.beside(FORM, form)
    formed: Base = state.fit.made["formed"]
    return formed


def survey(state: State, basis: Base | None = None, own: Candidate | None = None) -> Survey:
    """Every effect in its best setting, and the strongest of them held against the gate.

    own: a name whose setting is known, which no search for it may miss
    """
    problem = state.problem
    basis = basis or formed_basis_of(state)
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named]
    library = problem.library
    if at_rest(state.fit):
        library = {k: e for k, e in library.items() if e.family == "gyro" or k in AT_REST}
    if any(name in DELAYS for name in state.names):
        library = {name: effect for name, effect in library.items() if name not in DELAYS}
    seen = as_found(basis, best_settings(basis, library, taken), own)
    candidates = at_one_moment(basis, [in_time(basis, c) for c in seen])
    if not candidates or candidates[0].evidence <= problem.limits.evidence_nats:
        return Survey(basis, candidates, ())
    quiet = quieter(basis, columns_of(basis, candidates[:1])[candidates[0].name])
    candidates = ranked(basis, quiet, candidates)
    near = [c for c in candidates if c.evidence > problem.limits.evidence_nats][:LOOKED_AT]
    columns = columns_of(basis, near)
    gram = candidate_gram(basis, columns, problem.block_s)
    judged = [judge(c, gram, columns[c.name], quiet, len(candidates), problem.limits) for c in near]
    return Survey(basis, candidates, tuple(judged))


def added(state: State, judged: Judged) -> State:
    """The state with one more term, everything fitted together."""
    name = judged.candidate.name
    if name not in DELAYS:
        more = _scaled_again(refitted(state, (*state.named, judged)))
        # when a cause was logged was sought in noise that held what it does
        return _as_logged(shaped_again(_riding_apart(more), newest=name in QUICK_CAUSES))
    step_s = float(np.nanmedian(state.problem.track.dt_s)) / 2
    lag_s = DELAYS[name] * float(judged.what.value[0])
    lag_s *= step_s if name == "gyro_integration" else 1.0
    effect = state.problem.library[plain(lag_s)]
    lag = replace(judged, candidate=replace(judged.candidate, effect=effect, setting={}))
    return shaped_again(_lag_taken_out(state, lag, lag_s), newest=False)


def _as_logged(state: State) -> State:
    """The state with the newest term's cause as it was logged, where the names by it explain more.

    Read late, a current has some of what its change does, as long as that has no name.
    """
    column = state.named[-1].candidate.setting.get("covariate")
    by_it = [j for j in state.named if j.candidate.setting.get("covariate") == column]
    read = any(key in j.candidate.setting for j in by_it for key in LOGGED)
    if column is None or len(by_it) < 2 or not read:
        return state
    basis = formed_basis_of(state)
    named = [
        replace(j, candidate=on_time(basis, j.candidate)) if j in by_it else j for j in state.named
    ]
    tried = refitted(state, tuple(named))
    return tried if tried.fit.log_likelihood > state.fit.log_likelihood else state


def _riding_apart(state: State) -> State:
    """The state with its newest term's field averaged, not turned, in the working rows.

    What rides with the sensor was not known when the readings of a row were turned to its middle.
    """
    problem, judged = state.problem, state.named[-1]
    if problem.thin == 1 or not judged.candidate.effect.rides:
        return state
    model = state.fit.model
    context = build_context(problem.recorded, Given(bearings(problem.recorded, model)))
    riding = np.zeros((len(problem.recorded), 3))
    for term in state.fit.terms:
        columns = term.columns(context).mag
        if problem.library[term.identifier].rides and columns is not None:
            riding += columns @ term.value
    return refitted(replace(state, problem=problem.beside(riding, model)), state.named)


def shaped_again(state: State, *, newest: bool) -> State:
    """Every term's onset, time constant or radius sought anew beside the others; all fitted again.

    newest: the last one's too.  What was named first was sought while the others were not there:
    its onset may be far off, and what it then leaves would be named a second time.
    """
    last = len(state.named) - 1
    for _ in range(SHAPED_PASSES):
        basis, named = formed_basis_of(state), list(state.named)
        for k in range(last + newest):
            left, at = without_term(state, k, basis), named[k].candidate
            found = _sought_again(state, k, basis, left)
            if found is not None and _unpaid(found) > evidence_of(left, at) + SHAPED_NATS:
                named[k] = replace(named[k], candidate=found)
        if all(new is old for new, old in zip(named, state.named, strict=True)):
            break
        state = refitted(state, tuple(named))
    return state


def _sought_again(state: State, number: int, basis: Base, left: Base) -> Candidate | None:
    """A term in its best setting; None where there is nothing to seek.

    left: the basis without it.  What has an onset and a scale is moved along both at once: later
    with a shorter time constant looks nearly the same.
    """
    at = state.named[number].candidate
    if at.name in QUICK_CAUSES:  # late as the magnetometer was taken to be when it was named
        return in_time(left, on_time(left, at))
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named if j.candidate is not at]
    if (read := as_read(at.setting, taken)) != at.setting:
        moved = replace(at, setting=read)
        return replace(moved, tried=1, alike=1.0, evidence=evidence_of(left, moved))
    key = scale_of(at)
    if key is None and not any(name in at.setting for name in ("onset_s", *FORMS)):
        return None
    if "place_m" in at.setting:
        return replace(closest_scale(left, at, SCALE_AGAIN), tried=1, alike=1.0)
    if keys := both(at):
        setting = moved_together(basis, at, keys, state.fit.terms[number].value)
        found = replace(at, setting=setting)
        return replace(found, tried=1, alike=1.0, evidence=evidence_of(left, found))
    return next(iter(best_settings(left, {at.name: at.effect}, taken)), None)


def _unpaid(candidate: Candidate) -> float:
    return candidate.evidence + candidate.paid


def _scaled_again(state: State) -> State:
    """The newest term's time constant or radius sought once more, beside the fit with it."""
    last = len(state.named) - 1
    judged = state.named[last]
    if scale_of(judged.candidate) is None:
        return state
    if both(judged.candidate):
        return shaped_again(state, newest=True)
    left = formed_basis_of(state).without(term_group(last), state.fit.terms[last].value)
    closer = with_memory(left, closest_scale(left, judged.candidate, SCALE_AGAIN))
    if closer.setting == judged.candidate.setting:
        return state
    candidate = replace(judged.candidate, setting=closer.setting)
    return refitted(state, (*state.named[:last], replace(judged, candidate=candidate)))


def refitted(state: State, named: tuple[Judged, ...]) -> State:
    """Calibration, noise and the given terms fitted together, from where the last fit ended."""
    known = {(term.identifier, str(term.setting)): term for term in state.fit.terms}
    fitted = []
    for judged in named:
        value = judged.what.value
        if judged.candidate.name in DELAYS:  # the delay itself is out of the track
            value = np.zeros(1)
        term = fitted_term(judged.candidate, value)
        fitted.append(known.get((term.identifier, str(term.setting)), term))
    start, problem = state.fit.model, state.problem
    if problem.lag_s != 0.0 and not any(one.candidate.name in DELAYS for one in named):
        problem = problem.lagging(0.0)  # what nobody names is not taken out of the track
    walks = state.walk > 0.0
    start = replace(start, gyro_walk_rad_s_sqrt_s=state.walk)
    fit = fit_null(problem.track, problem.spec, start, tuple(fitted), noise=not walks, walk=walks)
    return replace(state, problem=problem, fit=fit, named=named)


def settled(state: State) -> State:
    """The state with its noise as large as it is where a walking bias has taken over a part of it.

    While names are sought it stays as it was: what is still to be named would count as noise.
    """
    if not state.walk:
        return state
    fit, problem = state.fit, state.problem
    again = noise_fit.rescaled(fit.filtered, problem.spec)
    if again.sigma_mag_gauss > fit.model.sigma_mag_gauss * (1 - noise_fit.SAME):
        return state
    fit = fit_null(problem.track, problem.spec, again, fit.terms, noise=False)
    return replace(state, fit=fit)


def _lag_taken_out(state: State, judged: Judged, lag_s: float) -> State:
    """A delay taken out of the track until what is left is linear; its term stays in the fit.

    State.lag_s is the whole of it.
    """
    sign = DELAYS[judged.candidate.name]
    named = (*state.named, judged)
    for _ in range(LAG_STEPS):
        problem = state.problem.lagging(state.problem.lag_s + lag_s)
        rest = fitted_term(judged.candidate, np.zeros(1))
        fit = replace(state.fit, terms=(*state.fit.terms[: len(named) - 1], rest))
        state = refitted(replace(state, problem=problem, fit=fit), named)
        lag_s = sign * float(state.fit.terms[len(named) - 1].value[0])
        if abs(lag_s) < SMALL_LAG_S:
            break
    return state


def fitted_term(candidate: Candidate, value: Array) -> FittedTerm:
    """A candidate as a term of the joint fit."""
    return FittedTerm(
        identifier=candidate.name,
        columns=partial(candidate.effect.columns, setting=candidate.setting),
        value=value,
        scale=candidate.effect.loose * candidate.scale,
        setting=dict(candidate.setting),
    )


def counterpart(state: State, number: int) -> int | None:
    """The step that takes back what this one brought, or the other way round."""
    name = state.names[number]
    if name not in STEPS.values():
        return None
    value = state.fit.terms[number].value
    for k, other in enumerate(state.names):
        if k != number and other == name:
            whole = np.linalg.norm(value) + np.linalg.norm(state.fit.terms[k].value)
            if 2 * np.linalg.norm(value + state.fit.terms[k].value) < CANCELS * whole:
                return k
    return None


def in_its_place(candidate: Candidate, last: Survey) -> float:
    """Evidence that a candidate has without a term and no more has with it: what both explain."""
    beside = {c.name: c.evidence for c in last.candidates}.get(candidate.name, 0.0)
    return candidate.evidence - max(0.0, beside)


def without_term(state: State, number: int, basis: Base | None = None) -> Base:
    """The basis with one term left out and all that it explains put back."""
    basis = basis or formed_basis_of(state)
    value = state.fit.terms[number].value
    if state.named[number].candidate.name in DELAYS:
        value = np.array([state.lag_s(number)])
    return basis.without(term_group(number), value)


def at_model(track: Track, model: NullModel, terms: Sequence[FittedTerm]) -> NullFit:
    """The filter at a model and terms of the same data cut otherwise; nothing is fitted."""
    return descended(FitProblem(track, tuple(terms), prior_of(track)), model, 0)
