"""The richest model: calibration, delay, ordinary remainder and free courses in every frame.

It is where everything is linearised.  In the null, what is missing counts as noise: beside a magnet
of 0.14 G its sigma was ten times too large, the calibration was bent to it, and the step never got
its evidence.  Here courses hold what is missing, whatever it is; the noise is what they leave, the
calibration is the one beside them, and a name has to do better than they do.
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
    anew,
    causes,
    delay,
    delay_form,
    plain_delay,
)
from ahrsd.diagnosis.inference.components.gaussian_process import course
from ahrsd.diagnosis.inference.components.ordinary_remainder import ordinary_remainder
from ahrsd.diagnosis.inference.likelihood.evidence import At, maximised
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    CALIBRATION,
    Linearised,
    Point,
    as_columns_say,
    first_point,
    linearised,
    moved,
    regained,
    relevelled,
    step_of,
)
from ahrsd.diagnosis.inference.likelihood.logged_columns import as_logged, of_means, read_as
from ahrsd.diagnosis.innovation_filter.innovation import Filtered
from ahrsd.diagnosis.where_and_when.locate import FRAMES

#: linearisations in one noise, noises, and nats that a further one must gain
ROUNDS, NOISES, SETTLED = 6, 3, 5.0
#: parts of a step that are tried, with the delay's or without
STEPS: tuple[tuple[float, bool], ...] = ((1.0, True), (1.0, False), (0.3, False))
#: deviations of an innovation beyond which a step has left every calibration that can be
_RUN_AWAY = 1e6
#: the sensor's course stands for all three where the remainder, with the other two, is in
RICH_COURSES = ("free sensor",)
#: of the ordinary remainder, by frame
COURSES = {frame: f"{frame}_course" for frame in FRAMES}


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """A linearisation with everything but candidates.

    remainder: keys of what real recordings leave;  whole: keys of the richest model, or of that of
    the first steps: calibration, delay, logged causes
    """

    made: Linearised
    remainder: tuple[str, ...]
    whole: tuple[str, ...]


def base_of(
    point: Point, library: Mapping[str, Effect], named: Sequence[Component], *, whole: bool = True
) -> Base:
    """The base at a point.

    named: components known by name, made anew of this context;  whole: with remainder and courses
    """
    context = point.context
    rest = ordinary_remainder(context) if whole else []
    lag = delay(context, library)
    lags = [] if lag is None else [lag]
    if point.problem.lag_s != 0.0:
        lags.append(delay_form(context, point.problem.lag_s))
    known = [anew(one, context, library) for one in named]
    had = {one.effect for one in known}
    driven = [one for one in causes(context, library) if one.effect not in had]
    bound = {one.key: one for one in rest if one.key in COURSES.values()}
    free = [course(context, frame, like=bound.get(COURSES[frame])) for frame in FRAMES if whole]
    parts = [*rest, *lags, *known, *driven, *free]
    made = linearised(as_columns_say(point, parts), context)
    made.add(parts)
    made.put_back(made.point.values)
    remainder = tuple(one.key for one in rest)
    few = (CALIBRATION, *(one.key for one in (*lags, *known, *driven)), *remainder)
    return Base(made, remainder, (*few, *RICH_COURSES) if whole else few)


def fitted(made: Linearised, keys: Sequence[str], step: float, near: At | None = None) -> At:
    """The likeliest hyperparameters of a model, from the highest band's power on.

    That is the sensor's own: from there an effect is not noise before it was asked for.
    near: of the same components at a point nearby, from where the climb is short
    """
    products = made.products(keys, step)
    laws = [made.seen[key].component.law for key in keys]
    if near is not None:
        return maximised(products, laws, (near.log_noise, near.psi))
    psi = np.concatenate([law.start for law in laws])
    top = float(np.log(products.square[-1] / products.rows[-1]))
    return maximised(products, laws, (np.full(len(products.rows), top), psi))


def psi_by_key(made: Linearised, keys: Sequence[str], at: At) -> dict[str, np.ndarray]:
    """Hyperparameters of each component."""
    out, begin = {}, 0
    for key in keys:
        width = len(made.seen[key].component.law.start)
        out[key] = at.psi[begin : begin + width]
        begin += width
    return out


def richest(problem: Problem, filtered: Filtered, library: Mapping[str, Effect]) -> Judged:
    """The likeliest point of some at the richest model, nothing named, from a null's filter.

    First the delay and the logged causes alone, beside noise of any spectrum: a delay of a tenth of
    a second, or a motor's current, bend everything else that is fitted beside them.
    """
    problem = _as_logged(problem, filtered, library)
    small = _settled(_likeliest_delay(problem, filtered, library), library, (), whole=False)
    instants = replace(problem, instants=True)
    for lag_s in _delays_of_instants(small.base.made.point.problem):
        early = _delayed(instants, filtered, library, lag_s)
        if _is_smoother_alone(early, instants, filtered, library):
            continue
        early = _settled(early, library, (), whole=False)
        small = early if early.nats > small.nats + priors.ODDS_REAL else small
    return settled(small.base.made.point, library, ())


def _delays_of_instants(problem: Problem) -> tuple[float, ...]:
    """Delays that a gyro may have whose values are rates at instants: it is early by half a step.

    That half alone, and where there is more, all of it, which is the magnetometer's as well.
    """
    step_s = regular_step(problem.recorded.dt_s)
    if problem.lag_s <= 0.0 or step_s is None:
        return ()
    more = is_magnetometer_lag(problem.recorded, problem.lag_s)
    return (step_s / 2, problem.lag_s) if more else (step_s / 2,)


def _as_logged(problem: Problem, filtered: Filtered, library: Mapping[str, Effect]) -> Problem:
    """The problem with each column read as its logger wrote it, where that is likelier."""

    def likely(one: Problem) -> float:
        return _delayed(one, filtered, library, 0.0).nats

    problem = as_logged(problem, likely).with_lag(problem.lag_s)
    if not problem.recorded.covariates:
        return problem
    here = _delayed(problem, filtered, library, 0.0)
    for reading in of_means(here.base.made, here.base.whole, here.at, library):
        other = read_as(problem, reading).with_lag(problem.lag_s)
        found = _delayed(other, filtered, library, 0.0)
        if found.nats > here.nats + priors.ODDS_REAL:
            problem, here = other, found
    return problem


def _delayed(
    problem: Problem, filtered: Filtered, library: Mapping[str, Effect], lag_s: float
) -> Judged:
    """The small model at a delay."""
    start = first_point(problem.with_lag(lag_s), filtered, (LAG,))
    values = {} if lag_s == 0.0 else {LAG: np.array([lag_s])}
    return judged(replace(start, values=values), library, (), whole=False)


def _likeliest_delay(problem: Problem, filtered: Filtered, library: Mapping[str, Effect]) -> Judged:
    """The small model at the likeliest of some delays, sought up and down from none.

    Beside a calibration that a long delay has bent, what is linear in it may point the other way.
    A library without a late magnetometer has no delay.
    """
    if plain_delay(library, 1.0) is None:
        return judged(first_point(problem, filtered, ()), library, (), whole=False)
    best = none = _delayed(problem, filtered, library, 0.0)
    for way in (priors.ORDINARY_LAG_S, -priors.ORDINARY_LAG_S):
        while True:
            lag_s = best.base.made.point.problem.lag_s + way
            found = _delayed(problem, filtered, library, lag_s)
            if found.nats < best.nats + priors.ODDS_REAL:  # between samples is smoother
                break
            if _points_back(found):
                break
            best = found
    if best is not none and _is_smoother_alone(best, problem, filtered, library):
        return none
    return best


def _is_smoother_alone(
    here: Judged, problem: Problem, filtered: Filtered, library: Mapping[str, Effect]
) -> bool:
    """Whether a gyro that is late by as much as it is early here makes readings about as likely.

    Moved in time its noise is averaged, either way.  Of nats that go by the square of what a delay
    is off by, one that is there has a quarter of the difference of the two.
    """
    late = _delayed(problem, filtered, library, -here.base.made.point.problem.lag_s)
    return here.nats - late.nats < 4.0 * priors.ODDS_REAL


def _points_back(here: Judged) -> bool:
    """Whether readings say at a delay that it is nearer to none.

    Moved in time a gyro's noise is another one, and in some the readings are likelier, whatever the
    delay is; a delay that is there stays where it is.
    """
    lag_s = here.base.made.point.problem.lag_s
    off, deviation = step_of(here.base.made, here.base.whole, here.at)  # of the delay the last
    return bool(-off[-1] * np.sign(lag_s) > priors.POINTS_BACK * deviation[-1])


def settled(point: Point, library: Mapping[str, Effect], named: Sequence[Component]) -> Judged:
    """The point moved to where the richest model with these names is likeliest."""
    return _settled(judged(point, library, named), library, named, whole=True)


def _settled(
    here: Judged, library: Mapping[str, Effect], named: Sequence[Component], *, whole: bool
) -> Judged:
    """Moved while that makes the model likelier, and with gains of the noise that is left there.

    A step that makes it less likely, linear as it is, is taken in part or not at all; none is taken
    that is less than the calibration and the delay are known to.  Coefficients move in held noise,
    and the noise is estimated anew where they rest: what was not taken out yet is no noise.
    """

    def judge(make: Callable[[], Point], near: Judged) -> Judged | None:
        try:
            point = make()
        except np.linalg.LinAlgError:  # a step too far
            return None
        seen = np.all(np.abs(point.filtered.whitened) < _RUN_AWAY)  # false of what is not finite
        return judged(point, library, named, whole=whole, near=near) if seen else None

    here = _moved_to_rest(here, judge)
    for _ in range(NOISES):
        for quieter in (_relevelled, _regained):
            found = judge(partial(quieter, here), here)
            if found is not None and found.nats > here.nats + SETTLED:
                here = _moved_to_rest(found, judge)
                break
        else:
            break
    return here


def _relevelled(here: Judged) -> Point:
    return relevelled(here.base.made, here.base.whole, here.at)


def _regained(here: Judged) -> Point:
    return regained(here.base.made.point)


def _moved_to_rest(
    here: Judged, judge: Callable[[Callable[[], Point], Judged], Judged | None]
) -> Judged:
    """Moved while that makes the model likelier, gains held."""
    ways = STEPS
    for _ in range(ROUNDS):
        if _is_there(here):
            break
        for k, (share, delayed) in enumerate(ways):
            at = here.base.made, here.base.whole, here.at
            found = judge(partial(moved, *at, share, delayed=delayed), here)
            if found is not None and found.nats > here.nats:
                ways = ways[k:]
                break
        else:
            break
        gained, here = found.nats - here.nats, found
        if gained < SETTLED:
            break
    return here


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The richest model at a point; nats: by readings and not by rows, so that points compare."""

    base: Base
    at: At
    nats: float


def judged(
    point: Point,
    library: Mapping[str, Effect],
    named: Sequence[Component],
    *,
    whole: bool = True,
    near: Judged | None = None,
) -> Judged:
    """The likeliest hyperparameters of the richest model at a point.

    near: the same at a point nearby
    """
    base = base_of(point, library, named, whole=whole)
    step = priors.NOISE_STEP_REAL if whole else priors.NOISE_STEP_FREE
    like = near is not None and near.base.whole == base.whole
    at = fitted(base.made, base.whole, step, near.at if near is not None and like else None)
    return Judged(base, at, at.nats + base.made.log_whitening)


def _is_there(here: Judged) -> bool:
    """Whether calibration and delay are where the model wants them."""
    off, deviation = step_of(here.base.made, here.base.whole, here.at)
    return not np.any(np.abs(off) > priors.NEAR * deviation)
