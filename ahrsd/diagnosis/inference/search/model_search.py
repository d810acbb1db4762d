"""The search over sets of components at one linearisation point.

The score of a set is a function of the set alone: the largest log likelihood together with the log
prior of its hyperparameters, plus the prior odds of its members.  It does not depend on whether the
set was reached by adding or by removing a member.  A beam of a few sets moves by adding, removing
and exchanging members.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import log_ndtr

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.likelihood.candidates import CandidateScan, candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit, maximise_above
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    CALIBRATION,
    Linearised,
    coefficients_by_key,
)
from ahrsd.samples import Array

#: sets in a beam, candidates added to a set in a move, sets expanded of each class
BEAM_WIDTH, MOST_CANDIDATES, MOST_MOVES = 2, 4, 8
#: rounds in which the setting of a candidate is refined; a member's goes on to this many rounds
CANDIDATE_ROUNDS, MEMBER_ROUNDS = 3, 7
#: further steps in each round on the memory from before the recording, if the effect has one
MEMORY_STEPS = 3
#: times at which steps are proposed, and their least separation as a share of the recording
MOST_PEAKS, PEAK_SEPARATION = 4, 0.02

#: keys of the members of a set
Names = frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A set of components with its fit and its score.

    keys: the calibration, the members and their form components, in the order of the coefficients
    score: log posterior odds, up to a constant that all sets at a point share
    """

    names: Names
    keys: tuple[str, ...]
    at: ModelFit
    score: float

    def fit_at_lower_noise(self, other: Hypothesis) -> ModelFit:
        """The fit of another hypothesis, each band's noise the lower one of the two.

        What only one of the two models explains does not count as noise then.
        """
        lower_noise = np.minimum(self.at.log_noise, other.at.log_noise)
        return replace(other.at, log_noise=lower_noise)


@dataclass(eq=False)
class Hypotheses:
    """Sets of components at one linearisation point; each is fitted once.

    remainder: keys of the ordinary remainder, which is in a set as a whole or not at all
    start_noise, start_psi: noise (B,) and psi by key of the richest model, where a fit starts
    forms: key of a component's form component, which is in a set whenever the component is
    projected: by key of a component that contains the delay, the key of its copy with the delay
               projected out
    real: whether every set is treated as one of a real recording, even without the remainder
    unknown_nats: evidence of an unknown source that is no member here: a switching source that was
                  removed from the readings and leaves a residual, or noise along one direction
    too_wide: number of sets that were not fitted because they have too many coefficients
    """

    made: Linearised
    remainder: tuple[str, ...]
    start_noise: Array
    start_psi: Mapping[str, Array]
    forms: dict[str, str] = field(default_factory=dict)
    projected: Mapping[str, str] = field(default_factory=dict)
    judged: dict[Names, Hypothesis] = field(default_factory=dict)
    real: bool = False
    unknown_nats: float = 0.0
    too_wide: int = 0

    def component(self, key: str) -> Component:
        """The component of a key."""
        return self.made.seen[key].component

    def judge(self, member_keys: Iterable[str], near: Hypothesis | None = None) -> Hypothesis:
        """The fitted set of these members and the calibration.  near: see `_maximise`."""
        members = frozenset(member_keys)
        found = self._maximise(members, self._component_keys(members), near, -np.inf)
        if found is None:
            raise ValueError("a set that is asked for has a score")
        return found

    def judge_above(
        self, member_keys: Iterable[str], near: Hypothesis | None, required: float
    ) -> Hypothesis | None:
        """The same; None if the score surely stays below `required`, or if the set is too wide."""
        members = frozenset(member_keys)
        keys = self._component_keys(members)
        if sum(self.component(key).width for key in keys) > priors.WIDEST:
            self.too_wide += 1
            return None
        return self._maximise(members, keys, near, required)

    def _component_keys(self, members: Names) -> tuple[str, ...]:
        """The components of a set: the calibration, the members, the forms of the members."""
        ordered = sorted(members)
        return (
            CALIBRATION,
            *ordered,
            *sorted(self.forms[key] for key in ordered if key in self.forms),
        )

    def _maximise(
        self, members: Names, keys: tuple[str, ...], near: Hypothesis | None, required: float
    ) -> Hypothesis | None:
        """A set at the maximum of its posterior; None if its score surely stays below `required`.

        The climb starts at the noise and the hyperparameters of `near`, if both sets have the
        ordinary remainder or both have none; this is a short way.  Otherwise it starts at those of
        the richest model.  If a band of the starting noise is far above the highest band, all bands
        are lowered to that one at most: at a high noise level, what a member explains still counts
        as noise.  The start of a strict subset of `near` is not lowered.
        """
        if members not in self.judged:
            real = self.is_real(members)
            step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
            products = self.made.products(keys, step)
            laws = [self.component(key).law for key in keys]
            noise, known_psi = self.start_noise, self.start_psi
            if near is not None and real == self.is_real(near.names):
                noise, known_psi = near.at.log_noise, {**known_psi, **self.psi_of(near)}
            psi = [known_psi.get(key, law.start) for key, law in zip(keys, laws, strict=True)]
            start = np.concatenate([*psi, np.zeros(0)])
            is_subset = near is not None and members < near.names
            if not is_subset and np.max(noise) > noise[-1] + priors.LOUD:
                noise = np.minimum(noise, noise[-1])
            log_prior = sum(self.component(key).prior for key in sorted(members))
            log_prior += self._repeat_log_odds(members) + self._class_log_prior(members)
            forms = set(keys) - members - {CALIBRATION}
            small = [k for k, key in enumerate(keys) if key in forms and key not in known_psi]
            at = maximise_above(
                products, laws, (noise, start), required - log_prior, start_small=small
            )
            if at is None:
                return None
            log_prior += self._least_value_log_odds(keys, at)
            self.judged[members] = Hypothesis(members, keys, at, at.nats + log_prior)
        return self.judged[members]

    def most_probable(
        self, best: Hypothesis, tried: Iterable[Names], near: Hypothesis | None = None
    ) -> Hypothesis:
        """The hypothesis of the highest score among `best` and the sets in `tried`.

        Each is fitted from `near`, or from `best`.  A climb that surely stays below the highest
        score so far is given up.
        """
        near = near or best
        for members in tried:
            found = self.judge_above(members, near, best.score)
            if found is not None and found.score > best.score:
                best = found
        return best

    def without_member(self, members: Names, key: str) -> Names:
        """The set without a member.

        If the delay is removed, components that contain it get their whole columns back.
        """
        unprojected = {other: key for key, other in self.projected.items()} if key == LAG else {}
        return frozenset(unprojected.get(one, one) for one in members - {key})

    def with_member(self, members: Names, key: str) -> Names:
        """The set with one more member.

        If the delay is added, it is projected out of the components that contain it.
        """
        projected = self.projected if key == LAG else {}
        return frozenset(projected.get(one, one) for one in members | {key})

    def is_compatible(self, members: Names, key: str) -> bool:
        """Whether a candidate has the right columns for a set.

        A component that contains the delay has its whole columns if the set has no delay, and
        columns with the delay projected out if it has.
        """
        return key not in self.projected if LAG in members else not self.component(key).beside

    def is_real(self, members: Names) -> bool:
        """Whether a set is treated as one of a real recording: the ordinary remainder is in it."""
        return self.real or any(key in members for key in self.remainder)

    def psi_of(self, hypothesis: Hypothesis) -> dict[str, Array]:
        """Hyperparameters of each component of a set, by key."""
        out, begin = {}, 0
        for key in hypothesis.keys:
            width = len(self.component(key).law.start)
            out[key] = hypothesis.at.psi[begin : begin + width]
            begin += width
        return out

    def _repeat_log_odds(self, members: Names) -> float:
        """Log prior odds of further steps of one kind: what was put on is often taken off."""
        rows = [
            row.identifier
            for key in members
            if (row := self.component(key).row) is not None and row.recurs
        ]
        repeats = len(rows) - len(set(rows))
        return repeats * float(np.log(priors.AGAIN / priors.EFFECT))

    def _least_value_log_odds(self, keys: Sequence[str], at: ModelFit) -> float:
        """Log prior odds of least values: below its least value a coefficient has no density.

        The posterior probability that each coefficient is above, over the prior one.
        """
        nats, values = 0.0, coefficients_by_key(self.made, keys, at)
        deviations, begin = coefficients_by_key(self.made, keys, replace(at, mean=at.deviation)), 0
        for key in keys:
            component = self.component(key)
            psi = at.psi[begin : begin + len(component.law.start)]
            begin += len(psi)
            if component.row is None or key == LAG:
                continue
            least = np.array([parameter.least for parameter in component.row.parameters])
            prior_deviation = np.exp(0.5 * component.law.log_variance(psi))
            above = log_ndtr((values[key] - least) / deviations[key]) - log_ndtr(
                -least / prior_deviation
            )
            nats += float(np.sum(above))
        return nats

    def _class_log_prior(self, members: Names) -> float:
        """Log prior of the class of a set: with the ordinary remainder or without."""
        real = self.is_real(members)
        return float(np.log(priors.REAL if real else 1.0 - priors.REAL))


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """What a search may add to a set: candidates by effect, free processes in time (`courses`).

    refine_setting: components of neighbouring settings, in a round
    refine_memory: components of neighbouring values of the memory from before the recording
    form_of: the form component of a component
    steps_at: steps of all kinds at a time, s
    components_between: vectors that begin with one step and end with another
    sources: keys of switching sources.  A set has one at most, and none with the ordinary
             remainder: how large they are in rooms was not measured
    """

    effects: dict[str, list[str]]
    courses: Sequence[str]
    refine_setting: Callable[[Component, int], list[Component]]
    refine_memory: Callable[[CandidateScan, Component, int], list[Component]]
    form_of: Callable[[Component], Component | None]
    steps_at: Callable[[float], list[Component]]
    components_between: Callable[[Component, Component], list[Component]]
    sources: list[str] = field(default_factory=list)


def beam_search(all_sets: Hypotheses, space: Space, starts: Iterable[Names]) -> list[Hypothesis]:
    """The most probable sets, best first.

    Sets with the ordinary remainder and sets without it are expanded in turn, each class with a
    beam of its own.  If a simulation lacks two effects, the remainder alone is more probable than
    either of them alone.
    """
    first = [all_sets.judge(one) for one in starts]
    beams = {real: _best_sets(all_sets, first, real=real) for real in (False, True)}
    expanded: set[Names] = set()
    for k in range(2 * MOST_MOVES):
        beam = beams[bool(k % 2)]
        waiting = [one for one in beam if one.names not in expanded]
        if not waiting or waiting[0].score < beam[0].score - 10 * priors.MOVE:
            continue
        current = waiting[0]
        expanded.add(current.names)
        for members in neighbouring_sets(all_sets, space, current):
            real = all_sets.is_real(members)
            required = beams[real][-1].score if len(beams[real]) == BEAM_WIDTH else -np.inf
            found = all_sets.judge_above(members, current, required)
            if found is not None:
                beams[real] = _best_sets(all_sets, [*beams[real], found], real=real)
    ranked = sorted((*beams[False], *beams[True]), key=lambda one: -one.score)
    best = exchange_effects(all_sets, space, ranked[0])
    return [refine_settings(all_sets, space, best), *ranked[1:]]


def exchange_effects(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """Exchange one effect of a set for another as long as that raises the score.

    An effect is added while the noise still absorbs the others; which effect it is, is decided at
    the set's own noise.  With the ordinary remainder nothing is exchanged: there a set may score
    higher for what its laws lack, as when a magnet in a hand was fitted by a step of the iron and
    one of the field.
    """
    if all_sets.is_real(best.names):
        return best
    for _ in range(MOST_MOVES):
        effects = [key for key in sorted(best.names) if all_sets.component(key).row is not None]
        bases = [best.names - {key} for key in effects if key != LAG]
        exchanged = [
            all_sets.with_member(base, key)
            for base in bases
            for key in rank_candidates(all_sets, space, base, best)
        ]
        improved = all_sets.most_probable(best, exchanged)
        if improved is best:
            break
        best = improved
    return best


def step_alternatives(all_sets: Hypotheses, space: Space, key: str) -> list[str]:
    """Steps of other kinds at the same times as a step with a form, each with its own form.

    A scan has no forms: it may put two kinds hundreds of nats apart whose sets differ by one.
    """
    step = all_sets.component(key)
    if key not in all_sets.forms or not step.jumps or not step.moments_s:
        return []
    if len(step.moments_s) == 1:
        _add_candidates(all_sets, space, space.steps_at(step.moments_s[0]))
    candidates = [all_sets.component(k) for keys in space.effects.values() for k in keys]
    others = [one for one in candidates if one.jumps and one.effect != step.effect]
    others = [one for one in others if len(one.moments_s) == len(step.moments_s)]
    return [
        register_candidate(all_sets, space, one.key)
        for one in others
        if np.allclose(one.moments_s, step.moments_s, rtol=0.0, atol=priors.SAME_MOMENT_S)
    ]


def refine_settings(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with onsets and scales of its effects refined, each where that raises the score.

    At an evidence of a thousand nats, a time constant that is off by a tenth leaves a hundred nats,
    which a free process in time explains.  So each setting is also refined without these processes,
    which may then be dropped.  An effect with a form component (a step that takes a while) has no
    sharper onset.
    """
    for key in sorted(best.names):
        if key == LAG or key in all_sets.forms or all_sets.component(key).row is None:
            continue
        refined = []
        for members in dict.fromkeys((best.names, best.names - set(space.courses))):
            reduced = all_sets.judge(members - {key}, best)
            scan = candidate_scan(all_sets.made, reduced.keys, best.fit_at_lower_noise(reduced))
            refined_key = refine_candidate(
                all_sets, space, scan, key, range(CANDIDATE_ROUNDS, MEMBER_ROUNDS)
            )
            refined.append(members - {key} | {refined_key})
        best = all_sets.most_probable(best, refined)
    return best


def _best_sets(
    all_sets: Hypotheses, hypotheses: Iterable[Hypothesis], *, real: bool
) -> list[Hypothesis]:
    """The beam of one class: the hypotheses of the highest score, each set once."""
    unique = {one.names: one for one in hypotheses if all_sets.is_real(one.names) == real}
    return sorted(unique.values(), key=lambda one: -one.score)[:BEAM_WIDTH]


def neighbouring_sets(all_sets: Hypotheses, space: Space, current: Hypothesis) -> list[Names]:
    """Sets one move away: a process or an effect more, a member less, two steps merged."""
    members = current.names
    _propose_steps(all_sets, space, current)
    removable = [key for key in sorted(members) if key not in all_sets.remainder]
    out = [all_sets.without_member(members, key) for key in removable]
    processes = [key for key in space.courses if key not in members]
    out += [members | {key} for key in processes]
    remainder, sources = frozenset(all_sets.remainder), frozenset(space.sources)
    if not all_sets.is_real(members):
        out += [members - sources | {key} for key in space.sources if key not in members]
    out.append(members - remainder if remainder <= members else (members - sources) | remainder)
    out += sets_with_merged_steps(all_sets, space, members)
    without_processes = members - set(space.courses)
    for base in dict.fromkeys((members, without_processes)):
        ranked = rank_candidates(all_sets, space, base, current)
        out += [all_sets.with_member(base, key) for key in ranked]
    return list(dict.fromkeys(out))


def sets_with_merged_steps(all_sets: Hypotheses, space: Space, members: Names) -> list[Names]:
    """Sets with one vector over an interval in place of two steps of a sensor.

    Also without every other step near the ends of the interval: such steps may fit how the vector
    came and went.
    """
    steps = [key for key in members if _step_sensor(all_sets, key)]
    steps = [key for key in steps if len(all_sets.component(key).moments_s) == 1]
    steps.sort(key=lambda key: (all_sets.component(key).moments_s, key))
    out = []
    for first, last in itertools.combinations(steps, 2):
        begins, ends = all_sets.component(first), all_sets.component(last)
        apart_s = ends.moments_s[0] - begins.moments_s[0]
        if (
            _step_sensor(all_sets, first) != _step_sensor(all_sets, last)
            or apart_s < priors.TRANSITION_S
        ):
            continue
        merged = space.components_between(begins, ends)
        all_sets.made.add(merged)
        at_s = (*begins.moments_s, *ends.moments_s)
        nearby = {key for key in steps if _begins_near(all_sets.component(key), at_s)}
        for removed in dict.fromkeys((frozenset({first, last}), frozenset(nearby))):
            out += [
                members - removed | {register_candidate(all_sets, space, one.key)} for one in merged
            ]
    return out


def _begins_near(component: Component, moments_s: Sequence[float]) -> bool:
    """Whether a component begins within `APPROACH_S` of one of these times."""
    return any(
        abs(component.moments_s[0] - moment_s) <= priors.APPROACH_S for moment_s in moments_s
    )


def _propose_steps(all_sets: Hypotheses, space: Space, current: Hypothesis) -> None:
    """Add steps to the candidates, at the largest residuals of a set."""
    made = all_sets.made
    for time_s in residual_peak_times(
        made.residual(current.keys, current.at), made.context.track.time_s
    ):
        _add_candidates(all_sets, space, space.steps_at(time_s))


def _add_candidates(all_sets: Hypotheses, space: Space, components: Sequence[Component]) -> None:
    """Add components to the candidates, unless they are known."""
    new = [one for one in components if one.key not in all_sets.made.seen]
    all_sets.made.add(new)
    for one in new:
        space.effects.setdefault(one.effect or one.key, []).append(one.key)


def residual_peak_times(residual: Array, time_s: Array) -> list[float]:
    """Times of the largest squares of a white residual (N, 3), with a least separation.

    None near the beginning or the end: a step there is no more than a few outliers.
    """
    power = np.sum(residual**2, axis=1)
    power = power + np.roll(power, -1)  # the row of a jump and the next one
    times_s: list[float] = []
    separation_s = PEAK_SEPARATION * float(time_s[-1] - time_s[0])
    for row in np.argsort(-power)[: 20 * MOST_PEAKS]:
        peak_s = float(time_s[row])
        inside = min(peak_s - time_s[0], time_s[-1] - peak_s) > priors.TRANSITION_S
        if inside and all(abs(peak_s - other) > separation_s for other in times_s):
            times_s.append(peak_s)
        if len(times_s) == MOST_PEAKS:
            break
    return times_s


def rank_candidates(
    all_sets: Hypotheses, space: Space, base: Names, current: Hypothesis
) -> list[str]:
    """The effects of the highest odds given a base set, each in its best setting.

    Their evidence is taken at the noise of `current`.
    """
    model = all_sets.judge(base, current)
    at = current.fit_at_lower_noise(model)
    present = {all_sets.component(key).effect for key in base}
    repeatable = {
        row.identifier
        for key in base
        if (row := all_sets.component(key).row) is not None and row.recurs
    }
    candidates = [
        key
        for effect, keys in space.effects.items()
        if effect not in present or effect in repeatable
        for key in keys
        if key not in base
    ]
    changing_sensors = _changing_sensors(all_sets, base)
    candidates = [key for key in candidates if _step_sensor(all_sets, key) not in changing_sensors]
    candidates = [key for key in candidates if not _is_near_same_effect(all_sets, base, key)]
    candidates = [key for key in candidates if all_sets.is_compatible(base, key)]
    if not candidates:
        return []
    scan = candidate_scan(all_sets.made, model.keys, at)
    worth = scan.log_bayes_factors(candidates)
    best: dict[str, tuple[float, str]] = {}
    for key, nats in worth.items():
        component = all_sets.component(key)
        log_odds = nats + component.prior
        if log_odds > best.get(component.effect or key, (-np.inf, ""))[0]:
            best[component.effect or key] = (log_odds, key)
    ranked = sorted(best.values(), reverse=True)[:MOST_CANDIDATES]
    return [
        refine_candidate(all_sets, space, scan, key) for log_odds, key in ranked if log_odds > 0.0
    ]


def _changing_sensors(all_sets: Hypotheses, base: Names) -> set[str]:
    """Sensors with so many steps of one kind that these are one unknown source that changes.

    A further step of any kind would be a part of that source, and would bring a form of its own.
    """
    steps = [key for key in base if _step_sensor(all_sets, key)]
    kinds = [all_sets.component(key).effect for key in steps]
    return {
        _step_sensor(all_sets, key)
        for key, kind in zip(steps, kinds, strict=True)
        if kinds.count(kind) >= priors.CHANGES
    }


def _step_sensor(all_sets: Hypotheses, key: str) -> str:
    """The sensor on which a candidate is a step; empty if it is no step."""
    component = all_sets.component(key)
    if component.row is None or not component.row.recurs:
        return ""
    return "magnetometer" if component.columns.on_mag else "gyro"


def _is_near_same_effect(all_sets: Hypotheses, base: Names, key: str) -> bool:
    """Whether a set has the same effect so near in time that the two are one."""
    candidate = all_sets.component(key)
    others = [all_sets.component(other) for other in base]
    return any(
        other.effect == candidate.effect and abs(there_s - here_s) < priors.TRANSITION_S
        for other in others
        for there_s in other.moments_s
        for here_s in candidate.moments_s
    )


def refine_candidate(
    all_sets: Hypotheses,
    space: Space,
    scan: CandidateScan,
    key: str,
    rounds: Iterable[int] = range(CANDIDATE_ROUNDS),
) -> str:
    """The key of a candidate with its onset, scale and memory refined, round by round."""
    made, row = all_sets.made, all_sets.component(key).row
    remembers = row is not None and row.remembers > 0.0
    scan = scan.at_sensor_noise() if remembers else scan
    worth = scan.log_bayes_factors([key])[key] + all_sets.component(key).prior
    for round_, memory_step in itertools.product(rounds, range(1 + MEMORY_STEPS * remembers)):
        one = all_sets.component(key)
        neighbours = (
            space.refine_memory(scan, one, round_)
            if memory_step
            else space.refine_setting(one, round_)
        )
        if not neighbours:
            continue
        made.add_tentatively(neighbours)
        found = scan.log_bayes_factors([one.key for one in neighbours])
        log_odds = {one: nats + all_sets.component(one).prior for one, nats in found.items()}
        best = max(log_odds, key=lambda one: log_odds[one])
        if log_odds[best] > worth:
            key, worth = best, log_odds[best]
    made.keep([key])
    return register_candidate(all_sets, space, key)


def register_candidate(all_sets: Hypotheses, space: Space, key: str) -> str:
    """Register a candidate in its effect's list, and its form component with the sets; its key."""
    form = space.form_of(all_sets.component(key))
    if form is not None and key not in all_sets.forms:
        all_sets.made.add([form])
        all_sets.forms[key] = form.key
    listed = space.effects[all_sets.component(key).effect or ""]
    if key not in listed:
        listed.append(key)
    return key
