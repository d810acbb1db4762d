"""Names that stand out beside what no name explains.

A real recording always leaves something: against white noise it hides what is weaker, and spoils
the first names that are tried.  Here what is left is noise with a spectrum in the world
(`spectrum`), and the library is held against that.  A candidate's spectrum is measured beside it,
so that its evidence is how much less is left with it, whatever is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.calibration_fit.resting import at_rest
from ahrsd.diagnosis.effects.base import Setting
from ahrsd.diagnosis.innovation_filter.score import Score
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.discrepancy import UNIT_GAUSS, UNIT_RAD_S, by_rate, every_direction
from ahrsd.diagnosis.rules.exam import IMITATORS
from ahrsd.diagnosis.rules.moved import ONSET_SHARE
from ahrsd.diagnosis.rules.name import Judged, judge
from ahrsd.diagnosis.rules.nested import simplest
from ahrsd.diagnosis.rules.often import OFTEN, logged_often
from ahrsd.diagnosis.rules.regression import Base, Candidate, candidate_gram, columns_of, quieter
from ahrsd.diagnosis.rules.reweighted import reweighted
from ahrsd.diagnosis.rules.rivals import OWN_SHARE, by_matrix, by_memory, compared, more
from ahrsd.diagnosis.rules.search import (
    STEPS,
    State,
    Survey,
    added,
    formed_basis_of,
    term_group,
    without_term,
)
from ahrsd.diagnosis.rules.settings import best_settings, closest_onset, evidence_of
from ahrsd.diagnosis.rules.spectrum import Spectrum, against, spectrum_of
from ahrsd.diagnosis.rules.stand_ins import IN_TIME
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.samples import Array

#: of what has the shape of time: what is logged, and steps that are sharp
SAID = ("switched_device", "hard_iron_step", "gyro_bias_step")
#: evidence of a step over that of the next one, in all frames, that the rest has: a room walked
#: through has many, and of jumps with heavy tails the largest is seldom so far ahead
SHARPER_THAN = 5.0
#: nats that a step must be worth: the largest change of any course is one, to some extent.  Of 20
#: real recordings three had one of the field of 63 to 106 of their own, none one of the gyro of 15;
#: of the 50 controls of five semi-real rounds none had one of the hard iron that passed all else
#: and was worth more than 53
STEP_NATS = {"hard_iron_step": 75.0, "field_step": 100.0, "gyro_bias_step": 25.0}
#: what a room or an unlogged source does from place to place and from minute to minute, and what a
#: sensor does that is not quite linear: beside a rest such names say no more than the rest does
OF_THE_REST = (
    *IMITATORS,
    *(name for name in sorted(IN_TIME) if name not in SAID),
    "field_gradient",
    "onboard_calibration_active",
    "flexible_mount",
    "mag_cross_axis",
    "mag_nonlinearity",
    "gyro_nonlinearity",
)
#: what differs between recordings of one sensor by this much, or is laid to it, says nothing of it
OF_ITSELF = {
    "mag_gyro_misalignment": 0.055,
    "gyro_scale": 0.04,
    "clock_rate": 0.03,
    "gyro_nonorthogonality": 0.055,
}
#: why a name is not said that is laid to the sensor itself
SIZE = "size"
#: courses in time alone, by the family of an effect whose logged cause may be as smooth as they
DRIFTS = {
    "sensor": ("hard_iron_drift", "onboard_calibration_active"),
    "world": ("geomagnetic_drift",),
    "gyro": ("gyro_startup", "gyro_bias_drift"),
}
#: candidates whose spectra are measured
LOOKED_AT = 8
_APART_S = 2.0  # two steps of one name


def named_beside(
    state: State,
    surveys: list[Survey],
    left: unknown.Remainder,
    stood_in: frozenset[str] = frozenset(),
    *,
    hidden: bool = False,
    steps: Sequence[Candidate] = (),
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state with the names that stand out beside the rest, where there is one.

    stood_in: names by a logged cause that only stood in for another form, which stays so: what
              bends with the temperature has no offset by it
    hidden: whether names were taken out again that were worth no more than what they left.  Then
            there is a rest, too, also where no course in time shows it
    steps:  steps with the onsets that they have in white noise: in a spectrum that holds a step as
            noise its own onset may be none
    """
    limits = state.problem.limits
    if not (hidden or unknown.detected(left, limits)):
        return state, surveys, left
    given = state, surveys, left
    state = reweighted(state)
    refused = set(stood_in)
    while len(state.named) < limits.most_terms:
        seen = look(state, refused, steps)
        standing = sayable(seen.judged)
        if not standing:
            break
        best = simplest(standing)
        if _no_more_than_a_drift(state, best):
            refused.add(best.candidate.name)
            continue
        tried = reweighted(added(state, best))
        if not _holds(tried):
            refused.add(best.candidate.name)
            continue
        state, surveys = tried, [*surveys, seen]
        left = unknown.remainder(formed_basis_of(state))
    return given if len(state.named) == len(given[0].named) else (state, surveys, left)


def sayable(judged: Sequence[Judged]) -> list[Judged]:
    """The names that may be said, the likeliest first; none where one that may not is likelier.

    What is laid to the sensor itself and not said, a mount of half a degree that gives, looks in
    part like other names: they must be more than half of it.
    """
    own = max((one.evidence for one in judged if SIZE in one.refused), default=0.0)
    others = [one for one in judged if SIZE not in one.refused]
    if not others or not others[0].accepted:
        return []
    return [one for one in others if one.accepted and one.evidence > OWN_SHARE * own]


def _no_more_than_a_drift(state: State, judged: Judged) -> bool:
    """Whether a course in time alone is as likely as a name by what was logged.

    What was logged may be as smooth as a drift is: then it explains what drifts.  Its own effect
    follows it more closely than a line or what settles.  What changes often is not asked: beside a
    rest a drift may be likelier for what it explains of that.
    """
    often = logged_often(state.problem.track, judged.candidate)
    if "covariate" not in judged.candidate.setting or often:
        return False
    wanted = DRIFTS.get(judged.candidate.effect.family, ())
    courses = {name: one for name, one in state.problem.library.items() if name in wanted}
    basis = formed_basis_of(state)
    plain = spectrum_of(basis)
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named]
    near = best_settings(against(basis, plain), courses, taken)
    return any(
        _judged(state, basis, plain, one, len(near)).evidence
        > judged.evidence - state.problem.limits.lead_nats
        for one in near
    )


def _holds(state: State) -> bool:
    """Whether the newest term is of no other form, and a step is sharper than what is left."""
    last = len(state.named) - 1
    basis = formed_basis_of(state)
    quiet = against(basis, spectrum_of(basis))
    if state.names[last] not in STEPS.values():
        return not _of_another_form(state, last, quiet)
    mine = evidence_of(without_term(state, last, quiet), state.named[last].candidate)
    steps = {name: state.problem.library[name] for name in STEPS.values()}
    usual = best_settings(quiet, steps, [])[0].evidence
    return mine > SHARPER_THAN * usual


def look(
    state: State, refused: Sequence[str] | set[str] = (), steps: Sequence[Candidate] = ()
) -> Survey:
    """The library held against the spectrum of what is left, steps with these onsets as well."""
    problem, basis = state.problem, formed_basis_of(state)
    plain = spectrum_of(basis)
    quiet = against(basis, plain)
    silent = {*OF_THE_REST, *refused}
    if any(name in DELAYS for name in state.names):
        silent |= set(DELAYS)
    library = {name: e for name, e in problem.library.items() if name not in silent}
    if at_rest(state.fit):
        library = {name: effect for name, effect in library.items() if effect.family == "gyro"}
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named]
    candidates = best_settings(quiet, library, taken)
    near = [one for one in steps if one.name in library and _new(one, taken)]
    judged = [
        _judged(state, basis, plain, one, len(candidates))
        for one in (*candidates[:LOOKED_AT], *near)
    ]
    judged = _best_of_each(judged)
    evidence = {one.candidate.name: one.evidence for one in judged}
    own = {one.candidate.name for one in judged if SIZE in one.refused}
    told = [
        replace(c, evidence=evidence.get(c.name, c.evidence))
        for c in candidates
        if c.name not in own
    ]
    return Survey(quiet, tuple(sorted(told, key=lambda c: -c.evidence)), tuple(judged))


def _new(step: Candidate, taken: Sequence[tuple[str, Setting]]) -> bool:
    """Whether no step of that name is named there yet."""
    onset = step.setting["onset_s"]
    return not any(
        name == step.name and abs(setting["onset_s"] - onset) < _APART_S for name, setting in taken
    )


def _best_of_each(judged: Sequence[Judged]) -> list[Judged]:
    """The likeliest of each name, the likeliest first."""
    best: dict[str, Judged] = {}
    for one in sorted(judged, key=lambda one: -one.evidence):
        best.setdefault(one.candidate.name, one)
    return list(best.values())


def _judged(state: State, basis: Base, plain: Spectrum, one: Candidate, tried: int) -> Judged:
    """A candidate held against the spectrum that is left beside it."""
    problem, limits = state.problem, state.problem.limits
    columns = columns_of(basis, [one])[one.name]
    noise = spectrum_of(basis, columns)
    quiet = against(basis, noise)
    if one.name in STEPS.values():
        one = closest_onset(quiet, one, ONSET_SHARE * state.problem.track.duration_s)
        columns = columns_of(basis, [one])[one.name]
        noise = spectrum_of(basis, columns)
        quiet = against(basis, noise)
    seen = noise.whitened(columns)
    quiet = quieter(quiet, seen)
    gram = candidate_gram(quiet, {one.name: seen}, state.problem.block_s)
    held = judge(one, gram, seen, quiet, tried, limits)
    if held.what.rank < len(one.scale):  # directions that are not paid for explain nothing
        noise = spectrum_of(basis, columns @ held.what.basis)
    gain = (noise.nats - plain.nats) / quiet.colour
    evidence = gain - _paid(held.what, one.scale) - one.paid
    checks = {
        "evidence": evidence > _least_nats(one, problem),
        SIZE: material(one, held.what.value),
    }
    others = (why for why in held.refused if why not in checks)
    refused = (*others, *(why for why, passed in checks.items() if not passed))
    return replace(held, evidence=evidence, refused=refused)


def _least_nats(one: Candidate, problem: Problem) -> float:
    """What a name must be worth beside the rest: more, the easier the rest imitates it."""
    if one.name in STEP_NATS:
        return STEP_NATS[one.name]
    often = logged_often(problem.track, one, 2 * OFTEN)
    return problem.limits.beside_logged_nats if often else problem.limits.beside_nats


def _paid(what: Score, scale: Array) -> float:
    """Nats that coefficients cost: of one prior deviation, or as much as they are."""
    if what.rank == 0:
        return 0.0
    size2 = float(np.mean((what.value / scale) ** 2))
    return 0.5 * float(np.sum(np.log1p(max(size2, 1e-4) * what.information)))


def material(one: Candidate, value: Array) -> bool:
    """Whether a value (p,) is larger than what sensors have by themselves that looks like it."""
    return one.name not in OF_ITSELF or float(np.linalg.norm(value)) > OF_ITSELF[one.name]


def _of_another_form(state: State, number: int, quiet: Base) -> bool:
    """Whether a free form is more than a term, which beside it keeps less than half of its own."""
    context = quiet.context
    left = without_term(state, number, quiet)
    scale = state.named[number].candidate.scale
    mine = quiet.known[:, :, quiet.groups[term_group(number)]] * scale
    forms = [by_rate(context), by_memory(context), by_matrix(context)]
    units = [UNIT_RAD_S, UNIT_GAUSS, UNIT_GAUSS]
    if (gain := _as_a_gain(state, number, context)) is not None:
        forms, units = [*forms, gain], [*units, UNIT_GAUSS]
    free = [part * unit for part, unit in zip(quiet.whitened(forms), units, strict=True)]
    slow = np.cos(np.linspace(0.0, np.pi, len(mine)))[:, None, None]
    noise = max(1.0, quiet.colour)
    for part in (slow * mine, *free):
        name, form, both = compared(left, mine, part, noise)
        if form > name + more(name) and both - form < OWN_SHARE * name:
            return True
    return False


def _as_a_gain(state: State, number: int, context: Context) -> Columns | None:
    """A matrix on the field that follows a field's logged cause; None where there is no such cause.

    A supply that sags changes the scale of what is read, and the offset by what that is.
    """
    term = state.fit.terms[number]
    columns = term.columns(context).mag
    if columns is None or "covariate" not in state.named[number].candidate.setting:
        return None
    added = columns @ term.value
    course = added @ np.linalg.svd(added.T @ added)[0][:, 0]
    return every_direction(course[:, None] * context.field_b)
