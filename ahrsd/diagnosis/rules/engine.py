"""One diagnosis: null fit, names with a joint refit after each, what is left, what it costs.

hygiene -> null fit -> survey -> (name -> joint refit -> survey)* -> prune -> swap
        -> what no name explains -> findings, or what this recording would have shown
        -> beside a loud gyro: whether that is beyond chance
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.diagnosis.answer.chance import Answered, beyond_chance
from ahrsd.diagnosis.answer.diagnosis import Check, Diagnosis, Finding, Unexplained, Whiteness
from ahrsd.diagnosis.answer.omnibus import omnibus
from ahrsd.diagnosis.answer.predictive import checks, usual_noise
from ahrsd.diagnosis.calibration_fit.descent import NullFit
from ahrsd.diagnosis.calibration_fit.null import baseline, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem, model_at_rate, problem_of
from ahrsd.diagnosis.calibration_fit.resting import HARDLY_TURNED, at_rest, resting
from ahrsd.diagnosis.data_quality.facts import Fact, around, lost_at, of_fact, rounding
from ahrsd.diagnosis.data_quality.hygiene import would_have_shown
from ahrsd.diagnosis.data_quality.missing import differ, lost_turns
from ahrsd.diagnosis.data_quality.prepared import Prepared, prepared
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.noise import level_facts
from ahrsd.diagnosis.limits import LIMITS, Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import framed
from ahrsd.diagnosis.rules.beside import named_beside
from ahrsd.diagnosis.rules.bursts import bursts
from ahrsd.diagnosis.rules.cut_out import beside_brief
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.drawing import drawn, regime_map, validation
from ahrsd.diagnosis.rules.exam import rest_of
from ahrsd.diagnosis.rules.explained import explained
from ahrsd.diagnosis.rules.findings import finding, whole_term
from ahrsd.diagnosis.rules.foretold import without_unforetold
from ahrsd.diagnosis.rules.free_course import with_free_course
from ahrsd.diagnosis.rules.free_source import without_names_of_a_source
from ahrsd.diagnosis.rules.gyro_noise import loud_gyro
from ahrsd.diagnosis.rules.humming import heard
from ahrsd.diagnosis.rules.levels import without_levels
from ahrsd.diagnosis.rules.likelier_forms import without_likelier_forms
from ahrsd.diagnosis.rules.lost import believed, beyond_lost, lost_beside
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.ordinary import held_against, is_course_on_sensor
from ahrsd.diagnosis.rules.own_form import without_trifles
from ahrsd.diagnosis.rules.passing import without_passing
from ahrsd.diagnosis.rules.quick import Quick, cleaned, quick, without_quick
from ahrsd.diagnosis.rules.refined import left_alone, refined
from ahrsd.diagnosis.rules.remainder_sizes import sizes_left
from ahrsd.diagnosis.rules.search import STEPS, State, Survey, basis_of, formed_basis_of, settled
from ahrsd.diagnosis.rules.sought import sought
from ahrsd.diagnosis.rules.spectrum import against, spectrum_of
from ahrsd.diagnosis.rules.unplaced import without_unplaced
from ahrsd.diagnosis.rules.wandering import wandering
from ahrsd.diagnosis.rules.would_show import would_show
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.diagnosis.values import NullModel, Term

#: of the outside field: an object that is passed by
_MOMENT_S = 30.0


def diagnose(
    track: Track,
    spec: Spec | None = None,
    *,
    library: Mapping[str, Effect] = EFFECTS,
    limits: Limits = LIMITS,
    recording: str = "",
) -> Diagnosis:
    """Where the recording and the model differ, and which physics was left out.

    Deterministic.  ValueError, one line, where nothing can be fitted.
    """
    ask = partial(
        _answered, spec=spec or Spec(), library=library, limits=limits, recording=recording
    )
    return beyond_chance(track, ask, limits)


def _answered(
    track: Track, spec: Spec, library: Mapping[str, Effect], limits: Limits, recording: str
) -> Answered:
    """The answer, whatever is to be expected of it by chance."""
    asked = prepared(track)
    if (nothing := asked.stopped(recording, EFFECTS)) is not None:
        return Answered(nothing)
    problem, cold = problem_of(asked.put_right(), spec, library, limits)
    whole, lost = problem, lost_turns(problem.recorded, problem.cold)
    if lost:
        problem, cold = problem_of(asked.with_facts(lost).put_right(), spec, library, limits)
    done, fast = _named(problem, cold)
    beside = lost_beside(whole, fast.state, lost)
    if differ(lost, beside):
        other, cold = problem_of(asked.with_facts(beside).put_right(), spec, library, limits)
        again = _named(other, cold)
        if not believed(lost, done.state, beside, again[0].state):
            lost, problem, (done, fast) = beside, other, again
    still = (HARDLY_TURNED,) if at_rest(done.start) else ()
    notes = (*asked.notes, *still, *done.state.problem.notes)
    told = _told(recording, problem, done, fast, asked.with_facts(lost), notes)
    return Answered(told, problem, done.start)


def _named(problem: Problem, cold: NullModel) -> tuple[_Searched, Quick]:
    """The search, and what only the recorded rate shows; with that taken out the search anew."""
    done = _searched(without_quick(problem), cold)
    fast = quick(done.state, problem)
    if fast:
        done = _searched(cleaned(fast, problem), done.start.model)
        fast = quick(done.state, problem)
    return done, fast


@dataclass(frozen=True, slots=True, eq=False)
class _Searched:
    """The null fit, the state with all names, the surveys without each of them, what is left.

    short: bursts, where they are what is left;  beside: whether all was fitted anew against a rest
    alone: what is left where nothing is named, by the limits of that
    """

    start: NullFit
    state: State
    surveys: list[Survey]
    first: Survey
    last: Survey
    left: unknown.Remainder
    short: Unexplained | None = None
    beside: bool = False
    alone: unknown.Remainder | None = None


def _searched(problem: Problem, model: NullModel) -> _Searched:
    start = fit_null(problem.track, problem.spec, model, walk=False)
    done, brief = beside_brief(wandering(sought(State(problem, start))))
    steps = [one for one in done.first.candidates if one.name in STEPS.values()]
    given = done.state, done.surveys, done.left, done.stood_in
    state, surveys, left = named_beside(*given, hidden=done.hidden, steps=steps)
    beside = len(state.named) > len(done.state.named)
    state, surveys, left = without_unforetold(state, surveys, left, known=len(done.state.named))
    state, surveys, left = without_trifles(*without_unplaced(state, surveys, left))
    short = brief or bursts(formed_basis_of(state))
    if short is None or unknown.detected(left, problem.limits):
        left = framed(formed_basis_of(state), left, problem.limits)
    burst_nats = 0.0 if short is None else short.evidence_nats
    state, surveys, left = without_levels(state, surveys, left)
    state, surveys, left = without_passing(state, surveys, left, burst_nats)
    state, surveys, left = without_names_of_a_source(state, surveys, left)
    left = refined(start, state, left, short, problem.limits)
    against_rest = frozenset(state.names) - frozenset(done.state.names)
    fewer = without_likelier_forms(state, surveys, left, against_rest)
    if fewer[0] is not state:
        state, surveys, rest = fewer
        rest_framed = framed(formed_basis_of(state), rest, problem.limits)
        left = refined(start, state, rest_framed, short, problem.limits)
        if not unknown.detected(left, problem.limits):
            left = replace(left, stood_in=rest.strongest.frame)
    if short is not None and short.evidence_nats <= left.strongest.evidence:
        short = None
    last, alone = done.last, None
    if short is None and not state.named:
        state, left, alone = left_alone(start, state, left)
        named = None
        if alone is not None and not done.before.named:
            named = explained(state, alone, problem.limits.alone())
        if named is not None:
            (state, surveys, last, left), alone = named, None
    if short is None and unknown.detected(left, problem.limits):
        left = with_free_course(state, left)
    return _Searched(start, settled(state), surveys, done.first, last, left, short, beside, alone)


def _told(
    recording: str,
    problem: Problem,
    done: _Searched,
    fast: Quick,
    asked: Prepared,
    notes: tuple[str, ...],
) -> Diagnosis:
    """Everything that was found, in the contract's form."""
    facts = asked.facts
    state, library, limits = done.state, problem.library, problem.limits
    basis = basis_of(state)
    named, terms = _names(done, fast)
    noise = _noise_facts(problem, fast, facts, done, named)
    left = _left(done, problem, facts, fast)
    if burst := loud_gyro(left, problem.recorded):
        noise, left = [*noise, burst], Unexplained(False)
    found = (
        *asked.told(library),
        *sorted(named, key=_least_gain),
        *(of_fact(fact, library) for fact in noise),
        *(resting(done.start.context(), library, limits) if at_rest(done.start) else ()),
    )
    seen = (*state.named, *fast.state.named[fast.known :])
    found = tuple(_doubted(one, 1 - limits.doubt) for one in found)
    if not (found or left.detected) and done.alone is not None:
        done = replace(done, left=with_free_course(state, done.alone))
        left = unknown.described(done.left, problem, limits.alone())
    checked, white = _checked(done, fast, terms, library, (*facts, *noise)), _whiteness(done)
    left = unknown.borne_out(left, checked, white)
    left = _sized(left, done)
    something = bool(found) or left.detected
    steps = rounding(facts)
    return Diagnosis(
        recording=recording,
        baseline=baseline(done.start),
        mismatch=something,
        p_value=_p_value(seen, found, done.left, left),
        findings=found,
        unexplained=left,
        posterior_predictive=checked,
        sensitivity=() if something else would_show(problem, basis, done.first, fast),
        notes=(*notes, *asked.lesser, *(() if something else would_have_shown(problem.recorded))),
        model=model_at_rate(state.fit.model, problem),
        noise=usual_noise(
            fast.state.fit, _loud(noise), (*_in_track(terms, fast.state), *steps), library
        ),
        terms=(*terms, *steps),
        drawn=drawn(done.start, state, fast, done.first, done.left.courses),
        omnibus=white,
        validation=validation(state, named, left),
        regime_map=regime_map(State(state.problem, done.start), state),
    )


def _names(done: _Searched, fast: Quick) -> tuple[list[Finding], tuple[Term, ...]]:
    """Findings and whole terms of the search's names, then of what only the recorded rate shows."""
    state, basis, last = done.state, basis_of(done.state), fast.last.basis
    beside = None if rest_of(state, basis) is None else against(basis, spectrum_of(basis))
    slow = [
        finding(state, basis, k, seen, done.last, beside) for k, seen in enumerate(done.surveys)
    ]
    quickly = [
        finding(fast.state, last, k, seen, fast.last)
        for k, seen in enumerate(fast.surveys, start=fast.known)
    ]
    terms = [whole_term(state, basis, k, one.effect, beside) for k, one in enumerate(slow)]
    terms += [
        whole_term(fast.state, last, k, one.effect)
        for k, one in enumerate(quickly, start=fast.known)
    ]
    return [*slow, *quickly], tuple(terms)


def _noise_facts(
    problem: Problem,
    fast: Quick,
    facts: Sequence[Fact],
    done: _Searched,
    named: Sequence[Finding],
) -> list[Fact]:
    """What is to be said of the noise's level; coarse numbers scatter by themselves.

    What no name explains is noise to the fit: beside it the level says nothing, and where all was
    fitted anew against it, nor does its coming and going.  What a moment leaves of its form is a
    burst there.
    """
    if done.beside or any(fact.effect == "mag_quantisation" for fact in facts):
        return []
    beside_unknown = unknown.detected(done.left, problem.limits)
    given = problem.spec.sigma_mag_gauss is not None
    found = level_facts(fast.state.fit.filtered, spec_given=given)
    moments = [*lost_at(facts), *(span for one in named for span in _moments(one))]
    return [
        fact
        for fact in found
        if not (beside_unknown and fact.effect == "noise_level") and not around(fact, moments)
    ]


def _moments(one: Finding) -> list[tuple[float, float]]:
    """Where a name of the outside field shows, if for a moment only."""
    spans = one.where.intervals_s if one.where.frame == "world" else ()
    return [(begin, end) for begin, end in spans if end - begin < _MOMENT_S]


def _doubted(one: Finding, sure: float) -> Finding:
    """The finding with all its confidences that much less."""
    others = tuple(replace(share, confidence=share.confidence * sure) for share in one.alternatives)
    return replace(one, confidence=one.confidence * sure, alternatives=others)


def _left(done: _Searched, problem: Problem, facts: Sequence[Fact], fast: Quick) -> Unexplained:
    """What no name explains."""
    if done.short is not None:
        return done.short
    if beyond_lost(done.left, facts, problem):
        return unknown.described(done.left, problem, problem.limits)
    # a turn put together from what is left, and the error of coarse steps, ring by themselves
    itself = any(fact.turned is not None or fact.effect == "mag_quantisation" for fact in facts)
    return Unexplained(False) if itself else heard(done.state, fast)


def _sized(left: Unexplained, done: _Searched) -> Unexplained:
    """What is left beside what recordings ordinarily leave; of bursts and hums nobody knows."""
    course = left.detected and done.short is None
    if not course or left.where is None or left.where.band_hz is not None:
        return left
    sizes = sizes_left(done.state)
    return replace(left, ordinary=held_against(sizes, on_sensor=is_course_on_sensor(left)))


def _whiteness(done: _Searched) -> dict[str, Whiteness]:
    """The omnibus tests of the null and of the repaired model."""
    before, after = (omnibus(fit.filtered, fit.context()) for fit in (done.start, done.state.fit))
    later = {test.name: test.p_value for test in after}
    return {
        test.name: Whiteness(test.words, test.p_value, later.get(test.name, 1.0)) for test in before
    }


def _least_gain(one: Finding) -> float:
    return 0.0 if one.heldout is None else -one.heldout.nll_gain_per_sample


def _checked(
    done: _Searched,
    fast: Quick,
    terms: tuple[Term, ...],
    library: Mapping[str, Effect],
    facts: Sequence[Fact],
) -> dict[str, Check]:
    """Posterior predictive checks; a delay that is out of the track stays out of the model.

    At the working rate, unless something was found that only the recorded rate shows.
    """
    state, null = done.state, done.start
    steps = rounding(facts)
    if fast or steps:
        state = fast.state
        null = fit_null(state.problem.track, state.problem.spec, done.start.model, walk=False)
    elif state.problem.lag_s != 0.0:
        null = fit_null(state.problem.track, state.problem.spec, null.model, walk=False)
    kept = (*_in_track(terms, state), *steps)
    return checks(null, state.fit, kept, library=library, loud=_loud(facts))


def _in_track(terms: Sequence[Term], state: State) -> tuple[Term, ...]:
    """The terms as they are in the state's track, out of which its delay was taken."""
    return tuple(
        replace(term, value=fitted.value) if fitted.identifier in DELAYS else term
        for term, fitted in zip(terms, state.fit.terms, strict=True)
    )


def _loud(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    """Where the noise is at another level, seconds."""
    levels = ("noise_burst", "noise_level")
    return [span for fact in facts if fact.effect in levels for span in fact.where.intervals_s]


def _p_value(
    named: Sequence[Judged],
    found: tuple[Finding, ...],
    seen: unknown.Remainder,
    left: Unexplained,
) -> float:
    """The smallest family-wise probability of what is told, or of what was looked at in vain."""
    counted = [0.0] if len(found) > len(named) else []
    told = [judged.family_p for judged in named]
    frames = [min(1.0, 3.0 * one.p_value) for one in seen.located.values()]
    bins = [min(1.0, len(seen.bins) * p) for _, _, p in seen.bins]
    if not left.detected:  # what nothing else bears out is no evidence of a mismatch either
        return float(min([1.0, *told, *counted]))
    return float(min([1.0, *told, *counted, *frames, *bins, np.exp(-left.evidence_nats)]))
