"""How each logged column is read: as its logger wrote it.

A logger holds a value until the next, adds noise of its own, and takes means.  What a column is
then is no longer what flowed: held it is late, noise makes what follows it too small, and a mean
lacks what is quick, which a delay or a field by the column's change explains as well.  Each column
has one reading, for all names by it, and it is chosen before anything is searched: where the
readings of the sensor are likelier so, beside calibration, delay and all causes that are logged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct, idct

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.columns.held_and_noisy import (
    denoise_columns,
    find_held_columns,
    interpolate_held_columns,
)
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.inference.components import effect_components
from ahrsd.diagnosis.inference.components.effect_components import LATE_STEP_S
from ahrsd.diagnosis.inference.likelihood.candidates import Beside, beside
from ahrsd.diagnosis.inference.likelihood.evidence import At
from ahrsd.diagnosis.inference.likelihood.linearisation import Linearised
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: rounds in which the likeliest mean is sought more finely
_FINER = 2
#: nats of a problem beside calibration, delay and logged causes
Likely = Callable[[Problem], float]
Library = Mapping[str, Effect]


@dataclass(frozen=True, slots=True)
class Reading:
    """How a column was logged: means over `mean_s`, and `late_s` late (early where negative)."""

    column: str
    mean_s: float = 0.0
    late_s: float = 0.0

    @property
    def setting(self) -> dict[str, float]:
        """What a setting by the column says of it."""
        known = {"mean_s": self.mean_s, "late_s": self.late_s}
        return {key: value for key, value in known.items() if value}

    @property
    def words(self) -> str:
        """In words."""
        how = [f"the mean of {self.mean_s:.2g} s"] * (self.mean_s > 0.0)
        way = "late" if self.late_s > 0.0 else "early"
        return ", ".join([*how, *[f"logged {abs(self.late_s):.2g} s {way}"] * bool(self.late_s)])

    def of(self, track: Track) -> Track:
        """A track with the column as it was before it was logged."""
        values, time_s = track.covariates[self.column], track.time_s
        if self.mean_s > 0.0:
            values = before_the_mean(time_s, values, self.mean_s)
        values = np.interp(time_s + self.late_s, time_s, values)
        return track.with_columns({**track.covariates, self.column: values})

    def neighbours(self, round_: int) -> list[Reading]:
        """Readings that are a little earlier and later, and of means of less and more."""
        step_s, factor = LATE_STEP_S / 2 ** (1 + round_), 2.0 ** (0.5 ** (1 + round_))
        around = [replace(self, late_s=round(self.late_s + way * step_s, 4)) for way in (-1, 1)]
        return around + [replace(self, mean_s=self.mean_s * by) for by in (1 / factor, factor)]


def as_logged(problem: Problem, likely: Likely) -> Problem:
    """The problem with each column without what its logger put there, where that is likelier.

    What is said of that is in its notes.
    """
    best = None
    for read in (_drawn, _without_noise):
        for name in sorted(problem.recorded.covariates):
            other = read(problem, name)
            if other is None:
                continue
            best = likely(problem) if best is None else best
            found = likely(other)
            if found > best + priors.ODDS_REAL:
                problem, best = other, found
    return problem


def _drawn(problem: Problem, name: str) -> Problem | None:
    """With a column drawn straight between its values, where these come seldom."""
    seldom = tuple(one for one in find_held_columns(problem.recorded) if one.name == name)
    if not seldom:
        return None
    said = (
        f"column {label(name)} comes {seldom[0].interval_words}: drawn straight between its values"
    )
    return _with(problem, interpolate_held_columns(problem.recorded, seldom), said)


def _without_noise(problem: Problem, name: str) -> Problem | None:
    """With a column without its logger's noise, where that can be told from its course."""
    clean = denoise_columns(problem.recorded, (name,))
    said = f"column {label(name)} has noise of its own: what follows it is judged without it"
    return None if clean is None else _with(problem, clean, said)


def of_means(made: Linearised, keys: Sequence[str], at: At, library: Library) -> Iterator[Reading]:
    """Columns that are likelier means, by what one effect by each is then worth.

    made, keys, at: a model with calibration, delay and all causes as they are logged.  A mean over
    the time before comes late by half of it; one about the moment does not.  It has to be likelier
    than any other time of the column: when a name is late, is a setting of its own.
    One effect alone: a late field and one by the current's change together are a mean as well.
    """
    made = made.copied()
    for name in sorted(made.context.track.covariates):
        asked = _effects_by(made.context, library, name)
        if not asked:
            continue
        scan = _without(made, keys, at, name)
        late = [Reading(name, 0.0, late_s) for late_s in (0.0, *priors.LOGGED_LATE_S)]
        least = max(_worth(scan, asked, late).values()) + priors.ODDS_REAL
        best, nats = late[0], least
        readings = [
            Reading(name, mean_s, late_s)
            for mean_s in priors.LOGGED_MEANS_S
            for late_s in (mean_s / 2, 0.0)
        ]
        for round_ in range(1 + _FINER):
            for one, worth in _worth(scan, asked, readings).items():
                if worth > nats:
                    best, nats = one, worth
            if best.mean_s == 0.0:
                break
            readings = best.neighbours(round_)
        if best.mean_s > 0.0:
            yield best


def _effects_by(context: Context, library: Library, name: str) -> list[tuple[Effect, Setting]]:
    """Effects by a column in their first setting, where another time or mean changes them."""
    found = []
    for effect in library.values():
        if effect.delay or effect.quick or not effect.needs:
            continue
        by_it = [one for one in effect.settings(context) if one.get("covariate") == name]
        if by_it and len(effect_components.in_time(context, effect, by_it[0])) > 1:
            found.append((effect, by_it[0]))
    return found


def _without(made: Linearised, keys: Sequence[str], at: At, name: str) -> Beside:
    """The model without what a column causes, in the noise that it leaves with it."""
    psi, kept, begin = [], [], 0
    for key in keys:
        one = made.seen[key].component
        width = len(one.law.start)
        if one.setting.get("covariate") != name:
            kept.append(key)
            psi.append(at.psi[begin : begin + width])
        begin += width
    return beside(made, kept, replace(at, psi=np.concatenate([*psi, np.zeros(0)])))


def _worth(
    scan: Beside, asked: Sequence[tuple[Effect, Setting]], readings: Sequence[Reading]
) -> dict[Reading, float]:
    """Nats of the likeliest of the effects by each reading."""
    made, of = scan.made, dict[str, Reading]()
    for one in readings:
        context = replace(made.context, track=one.of(made.context.track))
        for effect, setting in asked:
            new = effect_components.component(context, effect, setting, 1)
            new = replace(new, key=f"{new.key} {one}")
            made.add([new])
            of[new.key] = one
    found = scan.worth(list(of))
    return {one: max(found[key] for key, other in of.items() if other == one) for one in readings}


def read_as(problem: Problem, reading: Reading) -> Problem:
    """The problem with a column read so."""
    said = f"column {label(reading.column)} is read as {reading.words}"
    logged = {**problem.logged, reading.column: reading.setting}
    return replace(_with(problem, reading.of(problem.recorded), said), logged=logged)


def as_recorded(setting: Setting, problem: Problem) -> Setting:
    """A setting by a column as it was recorded, of one by the column as it is read."""
    how = problem.logged.get(str(setting.get("covariate")), {})
    return {**setting, **{key: round(setting.get(key, 0.0) + by, 4) for key, by in how.items()}}


def _with(problem: Problem, recorded: Track, said: str) -> Problem:
    return replace(problem, recorded=recorded, notes=(*problem.notes, said))


def before_the_mean(time_s: Array, values: Array, mean_s: float) -> Array:
    """(N,) values at times that are means over mean_s about these, as they were before.

    Each frequency is put back by what a mean leaves of it, as Wiener has it: where that is next to
    nothing, it stays away.
    """
    count, lost = len(values), priors.LOGGED_LOST
    even_s = np.linspace(time_s[0], time_s[-1], count)
    hertz = np.arange(count) / (2.0 * count * (even_s[1] - even_s[0]))
    left = np.sinc(hertz * mean_s)
    cosines = dct(np.interp(even_s, time_s, values), norm="ortho")
    before = idct(cosines * left * (1.0 + lost) / (left**2 + lost), norm="ortho")
    return np.asarray(np.interp(time_s, even_s, before))
