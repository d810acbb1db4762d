"""The search over sets of components at one linearisation.

Every set is judged by one function of the set alone: its largest log likelihood with the priors of
its hyperparameters, plus the prior odds of its members.  So it does not matter whether a set was
reached by adding or by dropping.  A beam of a few sets moves by add, drop and swap.
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
from ahrsd.diagnosis.inference.likelihood.candidates import Beside, beside
from ahrsd.diagnosis.inference.likelihood.evidence import At, reached
from ahrsd.diagnosis.inference.likelihood.linearisation import CALIBRATION, Linearised, by_key
from ahrsd.samples import Array

BEAM_WIDTH, MOST_CANDIDATES, MOST_MOVES = 2, 4, 8
#: rounds in which settings are sought of what may be added, and on of what is there
CANDIDATE_ROUNDS, MEMBER_ROUNDS = 3, 7
#: steps in a round to what an effect has from before the recording
MEMORY_STEPS = 3
#: moments at which steps are proposed, and how far apart, of the recording's length
MOST_PEAKS, PEAK_SEPARATION = 4, 0.02

Names = frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A set of components and how likely it is.  keys: in the order of the coefficients."""

    names: Names
    keys: tuple[str, ...]
    at: At
    score: float

    def fit_at_lower_noise(self, other: Hypothesis) -> At:
        """Another hypothesis in the quieter noise of the two: what one lacks is no noise."""
        quiet = np.minimum(self.at.log_noise, other.at.log_noise)
        return replace(other.at, log_noise=quiet)


@dataclass(eq=False)
class Hypotheses:
    """Sets of components at one linearisation, each judged once.

    remainder: keys of what every real recording leaves, in or out together
    start: noise (B,) and psi by key that the richest model has
    forms: key of what a component leaves of its form, which comes and goes with it
    holding: key of what contains a delay, and of the same beside one, without it
    real: whether all sets are of a recording that leaves what real ones do, whatever is in them
    unknown_nats: evidence of a source that is no member: one that switches and was taken out, of
                  which a rest is left, or one along whose direction the noise is louder
    too_wide: sets that were not compared, having too many coefficients
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
        """By its key."""
        return self.made.seen[key].component

    def judge(self, names: Iterable[str], near: Hypothesis | None = None) -> Hypothesis:
        """The set with these members beside the calibration."""
        members = frozenset(names)
        found = self._maximise(members, self._component_keys(members), near, -np.inf)
        if found is None:
            raise ValueError("a set that is asked for has a score")
        return found

    def judge_above(
        self, names: Iterable[str], near: Hypothesis | None, asked: float
    ) -> Hypothesis | None:
        """The same; None where its score will surely not be so large, or the set is too wide."""
        members = frozenset(names)
        keys = self._component_keys(members)
        if sum(self.component(key).width for key in keys) > priors.WIDEST:
            self.too_wide += 1
            return None
        return self._maximise(members, keys, near, asked)

    def _component_keys(self, members: Names) -> tuple[str, ...]:
        """What a set is made of: the calibration, its members, what they leave of their forms."""
        ordered = sorted(members)
        return (
            CALIBRATION,
            *ordered,
            *sorted(self.forms[key] for key in ordered if key in self.forms),
        )

    def _maximise(
        self, members: Names, keys: tuple[str, ...], near: Hypothesis | None, asked: float
    ) -> Hypothesis | None:
        """A set at its likeliest; None where its score will surely not be so large.

        near: a set of the same class from whose noise and sizes the climb begins, which is short;
        else it begins where the richest model is; where either is loud, in quiet noise: from loud
        noise what a member explains is noise still.  What has only lost members begins in near's
        """
        if members not in self.judged:
            real = self.is_real(members)
            step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
            products = self.made.products(keys, step)
            laws = [self.component(key).law for key in keys]
            noise, known = self.start_noise, self.start_psi
            if near is not None and real == self.is_real(near.names):
                noise, known = near.at.log_noise, {**known, **self.psi_of(near)}
            psi = [known.get(key, law.start) for key, law in zip(keys, laws, strict=True)]
            start = np.concatenate([*psi, np.zeros(0)])
            fewer = near is not None and members < near.names
            if not fewer and np.max(noise) > noise[-1] + priors.LOUD:
                noise = np.minimum(noise, noise[-1])
            odds = sum(self.component(key).prior for key in sorted(members))
            odds += self._repeat_log_odds(members) + self._class_log_prior(members)
            forms = set(keys) - members - {CALIBRATION}
            small = [k for k, key in enumerate(keys) if key in forms and key not in known]
            at = reached(products, laws, (noise, start), asked - odds, small=small)
            if at is None:
                return None
            odds += self._least_value_log_odds(keys, at)
            self.judged[members] = Hypothesis(members, keys, at, at.nats + odds)
        return self.judged[members]

    def most_probable(
        self, best: Hypothesis, tried: Iterable[Names], near: Hypothesis | None = None
    ) -> Hypothesis:
        """The likeliest of a hypothesis and others, which are climbed to from near it, or another.

        A climb that will surely not reach the likeliest so far is given up.
        """
        near = near or best
        for names in tried:
            found = self.judge_above(names, near, best.score)
            if found is not None and found.score > best.score:
                best = found
        return best

    def without_member(self, members: Names, key: str) -> Names:
        """The set without a member: without the delay what contains one is whole."""
        whole = {other: key for key, other in self.projected.items()} if key == LAG else {}
        return frozenset(whole.get(one, one) for one in members - {key})

    def with_member(self, members: Names, key: str) -> Names:
        """The set with one more member: beside the delay what contains one is without it."""
        beside = self.projected if key == LAG else {}
        return frozenset(beside.get(one, one) for one in members | {key})

    def is_compatible(self, members: Names, key: str) -> bool:
        """Whether a candidate may be asked beside a set: whole where no delay is in it."""
        return key not in self.projected if LAG in members else not self.component(key).beside

    def is_real(self, members: Names) -> bool:
        """Whether a set leaves what real recordings do."""
        return self.real or any(key in members for key in self.remainder)

    def psi_of(self, known: Hypothesis) -> dict[str, Array]:
        """Hyperparameters of each of a set's components."""
        out, begin = {}, 0
        for key in known.keys:
            width = len(self.component(key).law.start)
            out[key] = known.at.psi[begin : begin + width]
            begin += width
        return out

    def _repeat_log_odds(self, members: Names) -> float:
        """What was put on is taken off: a further step of one kind is no rare thing."""
        rows = [
            row.identifier
            for key in members
            if (row := self.component(key).row) is not None and row.recurs
        ]
        more = len(rows) - len(set(rows))
        return more * float(np.log(priors.AGAIN / priors.EFFECT))

    def _least_value_log_odds(self, keys: Sequence[str], at: At) -> float:
        """What it costs that a name's coefficient has a least value: its law has none below.

        The probability that it is above, by the readings, over that by its law before them.
        """
        nats, values = 0.0, by_key(self.made, keys, at)
        deviations, begin = by_key(self.made, keys, replace(at, mean=at.deviation)), 0
        for key in keys:
            one = self.component(key)
            psi = at.psi[begin : begin + len(one.law.start)]
            begin += len(psi)
            if one.row is None or key == LAG:
                continue
            least = np.array([parameter.least for parameter in one.row.parameters])
            own = np.exp(0.5 * one.law.log_variance(psi))
            above = log_ndtr((values[key] - least) / deviations[key]) - log_ndtr(-least / own)
            nats += float(np.sum(above))
        return nats

    def _class_log_prior(self, members: Names) -> float:
        real = self.is_real(members)
        return float(np.log(priors.REAL if real else 1.0 - priors.REAL))


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """What a search may put into a set: candidates by effect, and free courses.

    finer: neighbours of a setting;  remembered: those in what is from before the recording
    form: what a component leaves of its form;  steps_at: of a time
    while_there: what comes with one step and goes with another
    sources: that switch, of which one at most is added, and none beside a remainder: how large
             they are in rooms is not measured
    """

    effects: dict[str, list[str]]
    courses: Sequence[str]
    refine_setting: Callable[[Component, int], list[Component]]
    refine_memory: Callable[[Beside, Component, int], list[Component]]
    form_of: Callable[[Component], Component | None]
    steps_at: Callable[[float], list[Component]]
    interval_components: Callable[[Component, Component], list[Component]]
    sources: list[str] = field(default_factory=list)


def beam_search(all_sets: Hypotheses, space: Space, starts: Iterable[Names]) -> list[Hypothesis]:
    """The likeliest sets, best first.

    Sets with the ordinary remainder and without are moved in turn, each kind with a beam of its
    own: where a simulation has two effects, the remainder is likelier than either of them alone.
    """
    first = [all_sets.judge(one) for one in starts]
    beams = {real: _best_sets(all_sets, first, real=real) for real in (False, True)}
    done: set[Names] = set()
    for k in range(2 * MOST_MOVES):
        beam = beams[bool(k % 2)]
        todo = [one for one in beam if one.names not in done]
        if not todo or todo[0].score < beam[0].score - 10 * priors.MOVE:
            continue
        here = todo[0]
        done.add(here.names)
        for names in neighbouring_sets(all_sets, space, here):
            real = all_sets.is_real(names)
            asked_for = beams[real][-1].score if len(beams[real]) == BEAM_WIDTH else -np.inf
            found = all_sets.judge_above(names, here, asked_for)
            if found is not None:
                beams[real] = _best_sets(all_sets, [*beams[real], found], real=real)
    ranked = sorted((*beams[False], *beams[True]), key=lambda one: -one.score)
    best = exchange_effects(all_sets, space, ranked[0])
    return [refine_settings(all_sets, space, best), *ranked[1:]]


def exchange_effects(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The likeliest of a set and those with another name in place of one, while one is likelier.

    A name is added beside noise that has swallowed the others; what it is, is told in its own.
    Beside an ordinary remainder nothing is exchanged: there a set is likelier for what its laws
    lack as well, and a hand's magnet was a step of the iron and one of the field.
    """
    if all_sets.is_real(best.names):
        return best
    for _ in range(MOST_MOVES):
        names = [key for key in sorted(best.names) if all_sets.component(key).row is not None]
        bases = [best.names - {key} for key in names if key != LAG]
        found = [
            all_sets.with_member(base, key)
            for base in bases
            for key in rank_candidates(all_sets, space, base, best)
        ]
        likelier = all_sets.most_probable(best, found)
        if likelier is best:
            break
        best = likelier
    return best


def step_alternatives(all_sets: Hypotheses, space: Space, key: str) -> list[str]:
    """Steps of other kinds at the very moments of one that has a form, each with its own.

    A scan asks without forms: by it the two may be hundreds of nats apart that differ by one.
    """
    own = all_sets.component(key)
    if key not in all_sets.forms or not own.jumps or not own.moments_s:
        return []
    if len(own.moments_s) == 1:
        _add_candidates(all_sets, space, space.steps_at(own.moments_s[0]))
    listed = [all_sets.component(k) for keys in space.effects.values() for k in keys]
    others = [one for one in listed if one.jumps and one.effect != own.effect]
    others = [one for one in others if len(one.moments_s) == len(own.moments_s)]
    return [
        register_candidate(all_sets, space, one.key)
        for one in others
        if np.allclose(one.moments_s, own.moments_s, rtol=0.0, atol=priors.SAME_MOMENT_S)
    ]


def refine_settings(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with onsets and scales of its names sought on where each is likelier.

    Of what has a thousand nats a time constant that is off by a tenth leaves a hundred, and a free
    course beside it explains them: it is sought without courses as well, which may then go.  What
    has a form of its own, as a step that takes a while, has no sharper onset.
    """
    for key in sorted(best.names):
        if key == LAG or key in all_sets.forms or all_sets.component(key).row is None:
            continue
        tried = []
        for rest in dict.fromkeys((best.names, best.names - set(space.courses))):
            fewer = all_sets.judge(rest - {key}, best)
            scan = beside(all_sets.made, fewer.keys, best.fit_at_lower_noise(fewer))
            new = refine_candidate(
                all_sets, space, scan, key, range(CANDIDATE_ROUNDS, MEMBER_ROUNDS)
            )
            tried.append(rest - {key} | {new})
        best = all_sets.most_probable(best, tried)
    return best


def _best_sets(
    all_sets: Hypotheses, found: Iterable[Hypothesis], *, real: bool
) -> list[Hypothesis]:
    unique = {one.names: one for one in found if all_sets.is_real(one.names) == real}
    return sorted(unique.values(), key=lambda one: -one.score)[:BEAM_WIDTH]


def neighbouring_sets(all_sets: Hypotheses, space: Space, here: Hypothesis) -> list[Names]:
    """Sets that are one step away: a course or an effect more, one less, one for another."""
    names = here.names
    _propose_steps(all_sets, space, here)
    own = [key for key in sorted(names) if key not in all_sets.remainder]
    out = [all_sets.without_member(names, key) for key in own]
    courses = [key for key in space.courses if key not in names]
    out += [names | {key} for key in courses]
    rest, sources = frozenset(all_sets.remainder), frozenset(space.sources)
    if not all_sets.is_real(names):
        out += [names - sources | {key} for key in space.sources if key not in names]
    out.append(names - rest if rest <= names else (names - sources) | rest)
    out += sets_with_merged_steps(all_sets, space, names)
    bare = names - set(space.courses)
    for base in dict.fromkeys((names, bare)):
        ranked = rank_candidates(all_sets, space, base, here)
        out += [all_sets.with_member(base, key) for key in ranked]
    return list(dict.fromkeys(out))


def sets_with_merged_steps(all_sets: Hypotheses, space: Space, names: Names) -> list[Names]:
    """Sets with one vector that comes and goes in place of two steps of a sensor.

    With it alone at its moments as well: what other steps there took is the vector's way.
    """
    steps = [key for key in names if _step_sensor(all_sets, key)]
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
        found = space.interval_components(begins, ends)
        all_sets.made.add(found)
        at_s = (*begins.moments_s, *ends.moments_s)
        near = {key for key in steps if _begins_near(all_sets.component(key), at_s)}
        for gone in dict.fromkeys((frozenset({first, last}), frozenset(near))):
            out += [names - gone | {register_candidate(all_sets, space, one.key)} for one in found]
    return out


def _begins_near(one: Component, moments_s: Sequence[float]) -> bool:
    """Whether it begins within a hand's time of one of these moments."""
    return any(abs(one.moments_s[0] - at) <= priors.APPROACH_S for at in moments_s)


def _propose_steps(all_sets: Hypotheses, space: Space, here: Hypothesis) -> None:
    """Put steps at the moments at which a set is most surprised among the candidates."""
    made = all_sets.made
    for time_s in residual_peak_times(made.left_by(here.keys, here.at), made.context.track.time_s):
        _add_candidates(all_sets, space, space.steps_at(time_s))


def _add_candidates(all_sets: Hypotheses, space: Space, found: Sequence[Component]) -> None:
    """Put components among the candidates, but for those that are known."""
    new = [one for one in found if one.key not in all_sets.made.seen]
    all_sets.made.add(new)
    for one in new:
        space.effects.setdefault(one.effect or one.key, []).append(one.key)


def residual_peak_times(residual: Array, time_s: Array) -> list[float]:
    """Moments of the largest squares of a residual (N, 3) without colour, apart from each other.

    None so near to the beginning or the end that a step there is no more than some wild readings.
    """
    power = np.sum(residual**2, axis=1)
    power = power + np.roll(power, -1)  # the row of a jump, and the next
    found: list[float] = []
    near = PEAK_SEPARATION * float(time_s[-1] - time_s[0])
    for row in np.argsort(-power)[: 20 * MOST_PEAKS]:
        at = float(time_s[row])
        inside = min(at - time_s[0], time_s[-1] - at) > priors.TRANSITION_S
        if inside and all(abs(at - other) > near for other in found):
            found.append(at)
        if len(found) == MOST_PEAKS:
            break
    return found


def rank_candidates(all_sets: Hypotheses, space: Space, base: Names, here: Hypothesis) -> list[str]:
    """The likeliest setting of each of the likeliest effects, beside a base in here's noise."""
    model = all_sets.judge(base, here)
    at = here.fit_at_lower_noise(model)
    had = {all_sets.component(key).effect for key in base}
    again = {
        row.identifier
        for key in base
        if (row := all_sets.component(key).row) is not None and row.recurs
    }
    candidates = [
        key for name, keys in space.effects.items() if name not in had or name in again
        for key in keys if key not in base
    ]  # fmt: skip
    changing = _changing_sensors(all_sets, base)
    candidates = [key for key in candidates if _step_sensor(all_sets, key) not in changing]
    candidates = [key for key in candidates if not _is_near_same_effect(all_sets, base, key)]
    candidates = [key for key in candidates if all_sets.is_compatible(base, key)]
    if not candidates:
        return []
    scan = beside(all_sets.made, model.keys, at)
    worth = scan.worth(candidates)
    best: dict[str, tuple[float, str]] = {}
    for key, nats in worth.items():
        one = all_sets.component(key)
        total = nats + one.prior
        if total > best.get(one.effect or key, (-np.inf, ""))[0]:
            best[one.effect or key] = (total, key)
    ranked = sorted(best.values(), reverse=True)[:MOST_CANDIDATES]
    return [refine_candidate(all_sets, space, scan, key) for total, key in ranked if total > 0.0]


def _changing_sensors(all_sets: Hypotheses, base: Names) -> set[str]:
    """Sensors with so many steps of one kind that they are one source that changes, unknown.

    Further steps, of whatever kind, would be parts of it, and each brings a form of its own.
    """
    steps = [key for key in base if _step_sensor(all_sets, key)]
    kinds = [all_sets.component(key).effect for key in steps]
    return {
        _step_sensor(all_sets, key)
        for key, kind in zip(steps, kinds, strict=True)
        if kinds.count(kind) >= priors.CHANGES
    }


def _step_sensor(all_sets: Hypotheses, key: str) -> str:
    """The sensor of which a candidate is a step; empty where it is none."""
    one = all_sets.component(key)
    if one.row is None or not one.row.recurs:
        return ""
    return "magnetometer" if one.columns.on_mag else "gyro"


def _is_near_same_effect(all_sets: Hypotheses, base: Names, key: str) -> bool:
    """Whether a set has the same effect so near in time that the two are one."""
    one = all_sets.component(key)
    others = [all_sets.component(other) for other in base]
    return any(
        other.effect == one.effect and abs(there_s - here_s) < priors.TRANSITION_S
        for other in others
        for there_s in other.moments_s
        for here_s in one.moments_s
    )


def refine_candidate(
    all_sets: Hypotheses,
    space: Space,
    scan: Beside,
    key: str,
    rounds: Iterable[int] = range(CANDIDATE_ROUNDS),
) -> str:
    """The candidate with onset, scale and what it remembers sought more and more finely."""
    made, row = all_sets.made, all_sets.component(key).row
    remembers = row is not None and row.remembers > 0.0
    scan = scan.in_quiet() if remembers else scan
    worth = scan.worth([key])[key] + all_sets.component(key).prior
    for round_, again in itertools.product(rounds, range(1 + MEMORY_STEPS * remembers)):
        one = all_sets.component(key)
        near = (
            space.refine_memory(scan, one, round_) if again else space.refine_setting(one, round_)
        )
        if not near:
            continue
        made.add(near)
        found = scan.worth([one.key for one in near])
        total = {one: nats + all_sets.component(one).prior for one, nats in found.items()}
        first = max(total, key=lambda one: total[one])
        if total[first] > worth:
            key, worth = first, total[first]
    return register_candidate(all_sets, space, key)


def register_candidate(all_sets: Hypotheses, space: Space, key: str) -> str:
    """A candidate, known to the sets with what it leaves of its form."""
    form = space.form_of(all_sets.component(key))
    if form is not None and key not in all_sets.forms:
        all_sets.made.add([form])
        all_sets.forms[key] = form.key
    listed = space.effects[all_sets.component(key).effect or ""]
    if key not in listed:
        listed.append(key)
    return key
