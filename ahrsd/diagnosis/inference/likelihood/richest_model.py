"""The richest model: calibration, delay, ordinary remainder, and a free Gaussian process.

Everything is linearised there.  In the null model what is missing counts as noise: with a magnet of
0.14 G its sigma was ten times too large, the calibration was biased by it, and the step never got
its evidence.  In the richest model Gaussian processes absorb whatever is missing.  The noise is
their residual, the calibration is the one fitted with them, and an effect has to explain the data
better than they do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.delay import is_magnetometer_lag, regular_step
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.effect_components import (
    LAG,
    delay_component,
    delay_form,
    logged_cause_components,
    plain_delay,
    rebuild_component,
)
from ahrsd.diagnosis.inference.components.gaussian_process import gaussian_process
from ahrsd.diagnosis.inference.components.ordinary_remainder import ordinary_remainder
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit, maximise
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    CALIBRATION,
    Linearised,
    Point,
    initial_point,
    linearise,
    refilter_with_columns,
    refit_filter_noise,
    refit_noise_level,
    remaining_step,
    step_to_maximum,
)
from ahrsd.diagnosis.inference.likelihood.logged_columns import (
    apply_logger_model,
    clean_columns,
    find_mean_columns,
)
from ahrsd.diagnosis.innovation_filter.innovation import Filtered
from ahrsd.diagnosis.where_and_when.locate import FRAMES

#: most linearisations in one noise, most noise estimates, and nats that a further one must gain
_STEP_ROUNDS, _NOISE_ROUNDS, _CONVERGED_NATS = 6, 3, 5.0
#: shares of a step that are tried in turn, and whether the delay moves with it
_STEP_KINDS: tuple[tuple[float, bool], ...] = ((1.0, True), (1.0, False), (0.3, False))
#: standard deviations of an innovation beyond which a step has left all possible calibrations
_DIVERGED = 1e6
#: key of the free process on the sensor; the remainder contains those of the world and the gyro
FREE_PROCESSES = ("free sensor",)
#: keys of the ordinary remainder's Gaussian processes, by frame
REMAINDER_PROCESSES = {frame: f"{frame}_course" for frame in FRAMES}


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """A linearisation with everything but candidates.

    remainder: keys of the ordinary remainder
    whole: keys of the richest model, or of the small model of the first steps: calibration, delay,
           logged causes
    """

    made: Linearised
    remainder: tuple[str, ...]
    whole: tuple[str, ...]


def build_base(
    point: Point, library: Mapping[str, Effect], effects: Sequence[Component], *, whole: bool = True
) -> Base:
    """The base at a point.

    effects: components of known effects, rebuilt from this context
    whole: with remainder and Gaussian processes
    """
    context = point.context
    remainder_parts = ordinary_remainder(context) if whole else []
    lag = delay_component(context, library)
    delay_parts = [] if lag is None else [lag]
    if point.problem.lag_s != 0.0:
        delay_parts.append(delay_form(context, point.problem.lag_s))
    effect_parts = [rebuild_component(one, context, library) for one in effects]
    fitted_effects = {one.effect for one in effect_parts}
    cause_parts = [
        one for one in logged_cause_components(context, library) if one.effect not in fitted_effects
    ]
    processes = {one.key: one for one in remainder_parts if one.key in REMAINDER_PROCESSES.values()}
    free_parts = [
        gaussian_process(context, frame, like=processes.get(REMAINDER_PROCESSES[frame]))
        for frame in FRAMES
        if whole
    ]
    parts = [*remainder_parts, *delay_parts, *effect_parts, *cause_parts, *free_parts]
    made = linearise(refilter_with_columns(point, parts), context)
    made.add(parts)
    made.add_back(made.point.values)
    remainder = tuple(one.key for one in remainder_parts)
    always = (
        CALIBRATION,
        *(one.key for one in (*delay_parts, *effect_parts, *cause_parts)),
        *remainder,
    )
    return Base(made, remainder, (*always, *FREE_PROCESSES) if whole else always)


def fit_hyperparameters(
    made: Linearised, keys: Sequence[str], step: float, near: ModelFit | None = None
) -> ModelFit:
    """The most probable hyperparameters of a model, starting at the power of the highest band.

    That is the sensor's own noise: so an effect does not count as noise before it is tested.
    near: fit of the same components at a point nearby, from which fewer steps are needed
    """
    products = made.products(keys, step)
    laws = [made.seen[key].component.law for key in keys]
    if near is not None:
        return maximise(products, laws, (near.log_noise, near.psi))
    psi = np.concatenate([law.start for law in laws])
    top = float(np.log(products.square[-1] / products.rows[-1]))
    return maximise(products, laws, (np.full(len(products.rows), top), psi))


def psi_by_key(made: Linearised, keys: Sequence[str], at: ModelFit) -> dict[str, np.ndarray]:
    """Hyperparameters of each component."""
    out, begin = {}, 0
    for key in keys:
        width = len(made.seen[key].component.law.start)
        out[key] = at.psi[begin : begin + width]
        begin += width
    return out


def fit_richest_model(
    problem: Problem, filtered: Filtered, library: Mapping[str, Effect]
) -> FittedPoint:
    """The most probable point of linearisation with the richest model, without effects.

    It starts from a null model's filter.  First delay and logged causes alone are fitted, in noise
    of any spectrum: a delay of a tenth of a second, or a motor's current, biases all else that is
    fitted together with it.
    """
    problem = _correct_columns(problem, filtered, library)
    small = _converge(_find_delay(problem, filtered, library), library, (), whole=False)
    instants = replace(problem, instants=True)
    for lag_s in _instant_rate_delays(small.base.made.point.problem):
        shifted = _fit_at_delay(instants, filtered, library, lag_s)
        if _is_only_averaging(shifted, instants, filtered, library):
            continue
        shifted = _converge(shifted, library, (), whole=False)
        small = shifted if shifted.nats > small.nats + priors.ODDS_REAL else small
    return converge(small.base.made.point, library, ())


def _instant_rate_delays(problem: Problem) -> tuple[float, ...]:
    """Delays to test if the gyro's values are rates at instants, and so early by half a step.

    Half a step alone and, if the delay is more than that, all of it, as then the magnetometer is
    late too.
    """
    step_s = regular_step(problem.recorded.dt_s)
    if problem.lag_s <= 0.0 or step_s is None:
        return ()
    exceeds_half_step = is_magnetometer_lag(problem.recorded, problem.lag_s)
    return (step_s / 2, problem.lag_s) if exceeds_half_step else (step_s / 2,)


def _correct_columns(
    problem: Problem, filtered: Filtered, library: Mapping[str, Effect]
) -> Problem:
    """The problem with each column corrected for its logger, where that is more probable."""

    def log_likelihood(one: Problem) -> float:
        return _fit_at_delay(one, filtered, library, 0.0).nats

    if not problem.recorded.covariates:
        return problem
    here = _fit_at_delay(problem, filtered, library, 0.0)
    seen = here.base.made.seen
    in_model = {str(seen[key].component.setting.get("covariate")) for key in here.base.whole}
    logged = in_model.intersection(problem.recorded.covariates)
    clean = clean_columns(problem, log_likelihood, logged)
    if clean is not problem:
        problem = clean.with_lag(problem.lag_s)
        here = _fit_at_delay(problem, filtered, library, 0.0)
    for logger in find_mean_columns(here.base.made, here.base.whole, here.at, library):
        corrected = apply_logger_model(problem, logger).with_lag(problem.lag_s)
        found = _fit_at_delay(corrected, filtered, library, 0.0)
        if found.nats > here.nats + priors.ODDS_REAL:
            problem, here = corrected, found
    return problem


def _fit_at_delay(
    problem: Problem, filtered: Filtered, library: Mapping[str, Effect], lag_s: float
) -> FittedPoint:
    """The small model at a delay."""
    point = initial_point(problem.with_lag(lag_s), filtered, (LAG,))
    values = {} if lag_s == 0.0 else {LAG: np.array([lag_s])}
    return fit_at_point(replace(point, values=values), library, (), whole=False)


def _find_delay(problem: Problem, filtered: Filtered, library: Mapping[str, Effect]) -> FittedPoint:
    """The small model at the most probable delay, sought in steps up and down from zero.

    A search is needed: in a calibration that a long delay has biased, the linear estimate may have
    the wrong sign.  A library without a magnetometer delay has no delay.
    """
    if plain_delay(library, 1.0) is None:
        return fit_at_point(initial_point(problem, filtered, ()), library, (), whole=False)
    best = without = _fit_at_delay(problem, filtered, library, 0.0)
    for step_s in (priors.ORDINARY_LAG_S, -priors.ORDINARY_LAG_S):
        while True:
            lag_s = best.base.made.point.problem.lag_s + step_s
            found = _fit_at_delay(problem, filtered, library, lag_s)
            if found.nats < best.nats + priors.ODDS_REAL:  # between samples is smoother
                break
            if _points_to_smaller_delay(found):
                break
            best = found
    if best is not without and _is_only_averaging(best, problem, filtered, library):
        return without
    return best


def _is_only_averaging(
    here: FittedPoint, problem: Problem, filtered: Filtered, library: Mapping[str, Effect]
) -> bool:
    """True if the opposite delay makes the readings about as probable.

    Shifted in time the gyro's noise is averaged, in either direction.  The log likelihood falls
    with the square of the delay's error: a true delay gains over none a quarter of what it gains
    over its opposite.
    """
    opposite = _fit_at_delay(problem, filtered, library, -here.base.made.point.problem.lag_s)
    return here.nats - opposite.nats < 4.0 * priors.ODDS_REAL


def _points_to_smaller_delay(here: FittedPoint) -> bool:
    """True if at this delay the linear estimate of it is significantly closer to zero.

    Shifted in time the gyro's noise differs, and the readings may be more probable by that alone.
    At a true delay the estimate stays where it is.
    """
    lag_s = here.base.made.point.problem.lag_s
    # the last entry is the delay's
    steps, deviation = remaining_step(here.base.made, here.base.whole, here.at)
    return bool(-steps[-1] * np.sign(lag_s) > priors.POINTS_BACK * deviation[-1])


def converge(
    point: Point, library: Mapping[str, Effect], effects: Sequence[Component]
) -> FittedPoint:
    """The point at which the richest model with these effects is most probable."""
    return _converge(fit_at_point(point, library, effects), library, effects, whole=True)


def _converge(
    here: FittedPoint, library: Mapping[str, Effect], effects: Sequence[Component], *, whole: bool
) -> FittedPoint:
    """Step while the model becomes more probable, and estimate the noise again at the end.

    If a full step makes the model less probable, as the model is not linear, a part of it is taken
    or none.  No step is taken that is below the uncertainty of calibration and delay.  Coefficients
    move in fixed noise; the noise is estimated where they have converged, since before that the
    residual contains what is not subtracted yet.
    """

    def judge(make: Callable[[], Point], near: FittedPoint) -> FittedPoint | None:
        try:
            point = make()
        except np.linalg.LinAlgError:  # a step too far
            return None
        bounded = np.all(np.abs(point.filtered.whitened) < _DIVERGED)  # false of what is not finite
        return fit_at_point(point, library, effects, whole=whole, near=near) if bounded else None

    here = _take_steps(here, judge)
    for _ in range(_NOISE_ROUNDS):
        for refit in (_refit_noise_level, _refit_filter_noise):
            found = judge(partial(refit, here), here)
            if found is not None and found.nats > here.nats + _CONVERGED_NATS:
                here = _take_steps(found, judge)
                break
        else:
            break
    return here


def _refit_noise_level(here: FittedPoint) -> Point:
    return refit_noise_level(here.base.made, here.base.whole, here.at)


def _refit_filter_noise(here: FittedPoint) -> Point:
    return refit_filter_noise(here.base.made.point)


def _take_steps(
    here: FittedPoint, judge: Callable[[Callable[[], Point], FittedPoint], FittedPoint | None]
) -> FittedPoint:
    """Step while the model becomes more probable, with fixed gains."""
    step_kinds = _STEP_KINDS
    for _ in range(_STEP_ROUNDS):
        if _has_converged(here):
            break
        for k, (share, delayed) in enumerate(step_kinds):
            at = here.base.made, here.base.whole, here.at
            found = judge(partial(step_to_maximum, *at, share, delayed=delayed), here)
            if found is not None and found.nats > here.nats:
                step_kinds = step_kinds[k:]
                break
        else:
            break
        gain, here = found.nats - here.nats, found
        if gain < _CONVERGED_NATS:
            break
    return here


@dataclass(frozen=True, slots=True, eq=False)
class FittedPoint:
    """The richest model at a point.

    nats: log density of the readings and not of the rows, so that points can be compared
    """

    base: Base
    at: ModelFit
    nats: float


def fit_at_point(
    point: Point,
    library: Mapping[str, Effect],
    effects: Sequence[Component],
    *,
    whole: bool = True,
    near: FittedPoint | None = None,
) -> FittedPoint:
    """The most probable hyperparameters of the richest model at a point.

    near: fit at a point nearby
    """
    base = build_base(point, library, effects, whole=whole)
    step = priors.NOISE_STEP_REAL if whole else priors.NOISE_STEP_FREE
    same_components = near is not None and near.base.whole == base.whole
    at = fit_hyperparameters(
        base.made, base.whole, step, near.at if near is not None and same_components else None
    )
    return FittedPoint(base, at, at.nats + base.made.log_whitening)


def _has_converged(here: FittedPoint) -> bool:
    """True if calibration and delay are at the model's maximum, within their uncertainty."""
    steps, deviation = remaining_step(here.base.made, here.base.whole, here.at)
    return not np.any(np.abs(steps) > priors.NEAR * deviation)
