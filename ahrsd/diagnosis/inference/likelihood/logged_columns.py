"""How the logger recorded each column: held values, noise, means.

A logger holds a value until the next, adds noise of its own, and averages.  The column then differs
from, say, the current that flowed.  A held value is late; noise makes the coefficient of the column
too small; a mean lacks what is quick, which a delay or a field by the column's change would then
explain.  Each column has one logger model, for all effects that use it.  It is chosen before the
search, where it makes the sensor's readings more probable, given calibration, delay and all logged
causes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct, idct

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.columns.held_and_noisy import (
    denoise_columns,
    find_held_column,
    interpolate_held_column,
)
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.inference.components import effect_components
from ahrsd.diagnosis.inference.components.effect_components import LATE_STEP_S
from ahrsd.diagnosis.inference.likelihood.candidates import CandidateScan, candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit
from ahrsd.diagnosis.inference.likelihood.linearisation import Linearised
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: rounds of refinement of the most probable mean
_REFINEMENT_ROUNDS = 2
#: log likelihood of a problem given calibration, delay and logged causes, nats
LogLikelihood = Callable[[Problem], float]
Library = Mapping[str, Effect]


@dataclass(frozen=True, slots=True)
class LoggerModel:
    """How a column was logged: means over `mean_s`, and `late_s` late (early where negative)."""

    column: str
    mean_s: float = 0.0
    late_s: float = 0.0

    @property
    def setting(self) -> dict[str, float]:
        """The keys of a setting that describe it."""
        known = {"mean_s": self.mean_s, "late_s": self.late_s}
        return {key: value for key, value in known.items() if value}

    @property
    def words(self) -> str:
        """In words."""
        words = [f"the mean of {self.mean_s:.2g} s"] * (self.mean_s > 0.0)
        way = "late" if self.late_s > 0.0 else "early"
        return ", ".join([*words, *[f"logged {abs(self.late_s):.2g} s {way}"] * bool(self.late_s)])

    def before_logging(self, track: Track) -> Track:
        """A track with the column as it was before it was logged."""
        values, time_s = track.covariates[self.column], track.time_s
        if self.mean_s > 0.0:
            values = deconvolve_mean(time_s, values, self.mean_s)
        values = np.interp(time_s + self.late_s, time_s, values)
        return track.with_columns({**track.covariates, self.column: values})

    def neighbours(self, round_: int) -> list[LoggerModel]:
        """Logger models a little earlier and later, and with shorter and longer means."""
        step_s, factor = LATE_STEP_S / 2 ** (1 + round_), 2.0 ** (0.5 ** (1 + round_))
        around = [replace(self, late_s=round(self.late_s + way * step_s, 4)) for way in (-1, 1)]
        return around + [
            replace(self, mean_s=self.mean_s * scale) for scale in (1 / factor, factor)
        ]


def clean_columns(
    problem: Problem, log_likelihood: LogLikelihood, in_model: Collection[str]
) -> Problem:
    """The problem without the logger's artefacts in its columns, where that is more probable.

    Its notes say so.
    in_model: the columns on which the likelihood depends
    """
    best = None
    for clean in (_interpolate_held, _remove_noise):
        for name in sorted(in_model):
            changed = clean(problem, name)
            if changed is None:
                continue
            best = log_likelihood(problem) if best is None else best
            likelihood = log_likelihood(changed)
            if likelihood > best + priors.ODDS_REAL:
                problem, best = changed, likelihood
    return problem


def _interpolate_held(problem: Problem, name: str) -> Problem | None:
    """With a column interpolated linearly between its values, if these are rare; else None."""
    held = find_held_column(problem.recorded, name)
    if held is None:
        return None
    note = f"column {label(name)} has a new value {held.interval_words}: interpolated linearly"
    return _replace_recorded(problem, interpolate_held_column(problem.recorded, held), note)


def _remove_noise(problem: Problem, name: str) -> Problem | None:
    """With a column without its logger's noise; None if that is not separable from the signal."""
    clean = denoise_columns(problem.recorded, (name,))
    note = f"column {label(name)} is noisy: effects of it are judged with its noise removed"
    return None if clean is None else _replace_recorded(problem, clean, note)


def find_mean_columns(
    made: Linearised, keys: Sequence[str], at: ModelFit, library: Library
) -> Iterator[LoggerModel]:
    """Columns that are more probably means, by the Bayes factor of one effect of each column.

    made, keys, at: a model with calibration, delay and all causes as they are logged.
    A mean over the time before is late by half of it; a mean centred on its time is not.  A mean
    has to be more probable than any shift of the column in time, which is a setting of the effect.
    Only one effect at a time is tested: a late field and one by the current's change together
    imitate a mean.
    """
    for name, effects in sorted(_effects_by_column(made.context, library).items()):
        scan = _scan_without_column(made.copy(), keys, at, name)  # what it adds goes with it
        unaveraged = [LoggerModel(name, 0.0, late_s) for late_s in (0.0, *priors.LOGGED_LATE_S)]
        required = (
            max(_best_log_bayes_factors(scan, effects, unaveraged).values()) + priors.ODDS_REAL
        )
        best, nats = unaveraged[0], required
        loggers = [
            LoggerModel(name, mean_s, late_s)
            for mean_s in priors.LOGGED_MEANS_S
            for late_s in (mean_s / 2, 0.0)
        ]
        for round_ in range(1 + _REFINEMENT_ROUNDS):
            for one, log_bayes_factor in _best_log_bayes_factors(scan, effects, loggers).items():
                if log_bayes_factor > nats:
                    best, nats = one, log_bayes_factor
            if best.mean_s == 0.0:
                break
            loggers = best.neighbours(round_)
        if best.mean_s > 0.0:
            yield best


def _effects_by_column(
    context: Context, library: Library
) -> dict[str, list[tuple[Effect, Setting]]]:
    """Effects of each column in their first setting, where a shift in time or a mean changes them.

    Columns without such an effect are left out.
    """
    found: dict[str, list[tuple[Effect, Setting]]] = {}
    for effect in library.values():
        if effect.delay or effect.quick or not effect.needs:
            continue
        first: dict[str, Setting] = {}
        for one in effect.settings(context):
            if (name := one.get("covariate")) in context.track.covariates:
                first.setdefault(str(name), one)
        for name, setting in first.items():
            if len(effect_components.logged_time_settings(context, effect, setting)) > 1:
                found.setdefault(name, []).append((effect, setting))
    return found


def _scan_without_column(
    made: Linearised, keys: Sequence[str], at: ModelFit, name: str
) -> CandidateScan:
    """The model without the effects of a column, in the noise that it has with them."""
    psi, kept, begin = [], [], 0
    for key in keys:
        one = made.seen[key].component
        width = len(one.law.start)
        if one.setting.get("covariate") != name:
            kept.append(key)
            psi.append(at.psi[begin : begin + width])
        begin += width
    return candidate_scan(made, kept, replace(at, psi=np.concatenate([*psi, np.zeros(0)])))


def _best_log_bayes_factors(
    scan: CandidateScan, effects: Sequence[tuple[Effect, Setting]], loggers: Sequence[LoggerModel]
) -> dict[LoggerModel, float]:
    """Largest log Bayes factor of the effects for each logger model."""
    made, logger_of = scan.made, dict[str, LoggerModel]()
    for one in loggers:
        context = replace(made.context, track=one.before_logging(made.context.track))
        for effect, setting in effects:
            new = effect_components.effect_component(context, effect, setting, 1)
            new = replace(new, key=f"{new.key} {one}")
            made.add([new])
            logger_of[new.key] = one
    found = scan.log_bayes_factors(list(logger_of))
    return {
        one: max(found[key] for key, other in logger_of.items() if other == one) for one in loggers
    }


def apply_logger_model(problem: Problem, logger: LoggerModel) -> Problem:
    """The problem with a column corrected for its logger."""
    note = f"column {label(logger.column)} is taken as {logger.words}"
    logged = {**problem.logged, logger.column: logger.setting}
    return replace(
        _replace_recorded(problem, logger.before_logging(problem.recorded), note), logged=logged
    )


def recorded_setting(setting: Setting, problem: Problem) -> Setting:
    """A setting by a column as recorded, from one by the column as corrected for its logger."""
    logger = problem.logged.get(str(setting.get("covariate")), {})
    return {
        **setting,
        **{key: round(setting.get(key, 0.0) + shift, 4) for key, shift in logger.items()},
    }


def _replace_recorded(problem: Problem, recorded: Track, note: str) -> Problem:
    return replace(problem, recorded=recorded, notes=(*problem.notes, note))


def deconvolve_mean(time_s: Array, values: Array, mean_s: float) -> Array:
    """(N,) values before averaging, from means over mean_s about these times.

    Each frequency is divided by the mean's transfer function with a Wiener filter: where that is
    close to zero, the frequency remains suppressed.
    """
    count, lost = len(values), priors.LOGGED_LOST
    even_s = np.linspace(time_s[0], time_s[-1], count)
    hertz = np.arange(count) / (2.0 * count * (even_s[1] - even_s[0]))
    transfer = np.sinc(hertz * mean_s)
    cosines = dct(np.interp(even_s, time_s, values), norm="ortho")
    restored = idct(cosines * transfer * (1.0 + lost) / (transfer**2 + lost), norm="ortho")
    return np.asarray(np.interp(time_s, even_s, restored))
