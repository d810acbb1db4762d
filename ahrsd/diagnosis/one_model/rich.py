"""The richest model: calibration, delay, ordinary remainder and free courses in every frame.

It is where everything is linearised.  In the null, what is missing counts as noise: beside a magnet
of 0.14 G its sigma was ten times too large, the calibration was bent to it, and the step never got
its evidence.  Here courses hold what is missing, whatever it is; the noise is what they leave, the
calibration is the one beside them, and a name has to do better than they do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.innovation import Filtered
from ahrsd.diagnosis.locate import FRAMES
from ahrsd.diagnosis.one_model import noise_model, priors
from ahrsd.diagnosis.one_model.component import Component
from ahrsd.diagnosis.one_model.effect_components import LAG, anew, causes, delay, delay_form
from ahrsd.diagnosis.one_model.evidence import At, maximised
from ahrsd.diagnosis.one_model.gaussian_process import course
from ahrsd.diagnosis.one_model.linearised import (
    CALIBRATION,
    Linearised,
    Point,
    first_point,
    linearised,
    moved,
    step_of,
)
from ahrsd.diagnosis.one_model.remainder import ordinary_remainder
from ahrsd.diagnosis.problem import Problem

#: linearisations, and nats that a further one must gain
ROUNDS, SETTLED = 6, 2.0
#: a step is none where it is this part of what it is known to, and levels are alike to this part
NEAR, SAME_LEVEL = 0.7, 0.1
#: parts of a step that are tried
SHARES = (1.0, 0.3)
#: the sensor's course stands for all three where the remainder, with the other two, is in
RICH_COURSES = ("free sensor",)


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
    made = linearised(point)
    context = made.context
    rest = ordinary_remainder(context) if whole else []
    courses = [course(context, frame) for frame in FRAMES] if whole else []
    lags = [delay(context, library)]
    if point.problem.lag_s != 0.0:
        lags.append(delay_form(context, point.problem.lag_s))
    known = [anew(one, context, library) for one in named]
    had = {one.effect for one in known}
    driven = [one for one in causes(context, library) if one.effect not in had]
    parts = [*rest, *lags, *courses, *known, *driven]
    made.exact = (LAG,)
    made.add(parts)
    made.put_back({key: value for key, value in point.values.items() if key in made.seen})
    remainder = tuple(one.key for one in rest)
    few = (CALIBRATION, *(one.key for one in (*lags, *known, *driven)), *remainder)
    return Base(made, remainder, (*few, *RICH_COURSES) if whole else few)


def fitted(made: Linearised, keys: Sequence[str], step: float = priors.NOISE_STEP_REAL) -> At:
    """The likeliest hyperparameters of a model, from the highest band's power on.

    That is the sensor's own: from there an effect is not noise before it was asked for.
    """
    products = made.products(keys, step)
    laws = [made.seen[key].component.law for key in keys]
    psi = np.concatenate([law.start for law in laws])
    top = float(np.log(products.square[-1] / products.rows[-1]))
    starts = [(np.full(len(products.rows), top), psi)]
    return maximised(products, laws, starts)


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
    small = _settled(_likeliest_delay(problem, filtered, library), library, (), whole=False)
    return settled(small.base.made.point, library, ())


def _likeliest_delay(problem: Problem, filtered: Filtered, library: Mapping[str, Effect]) -> Judged:
    """The small model at the likeliest of some delays, sought up and down from none.

    Beside a calibration that a long delay has bent, what is linear in it may point the other way.
    """

    def at(lag_s: float) -> Judged:
        if lag_s == 0.0:
            return judged(first_point(problem, filtered), library, (), whole=False)
        start = first_point(problem.lagging(lag_s), filtered)
        start = replace(start, values={LAG: np.array([lag_s])})
        return judged(start, library, (), whole=False)

    best = at(0.0)
    for way in (priors.ORDINARY_LAG_S, -priors.ORDINARY_LAG_S):
        while True:
            found = at(best.base.made.point.problem.lag_s + way)
            if found.nats < best.nats + priors.ODDS_REAL:  # readings between samples are smoother
                break
            best = found
    return best


def settled(point: Point, library: Mapping[str, Effect], named: Sequence[Component]) -> Judged:
    """The point moved to where the richest model with these names is likeliest."""
    return _settled(judged(point, library, named), library, named, whole=True)


def _settled(
    here: Judged, library: Mapping[str, Effect], named: Sequence[Component], *, whole: bool
) -> Judged:
    """Moved while that makes the model likelier.

    A step that makes it less likely, linear as it is, is taken in part or not at all; none is taken
    that is less than the calibration and the delay are known to.
    """
    for _ in range(ROUNDS):
        if _is_there(here):
            return here
        for share in SHARES:
            new = moved(here.base.made, here.base.whole, here.at, share)
            if not np.isfinite(new.filtered.whitened).all():
                continue
            found = judged(new, library, named, whole=whole)
            if found.nats > here.nats:
                break
        else:
            return here
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
    point: Point, library: Mapping[str, Effect], named: Sequence[Component], *, whole: bool = True
) -> Judged:
    """The likeliest hyperparameters of the richest model at a point."""
    base = base_of(point, library, named, whole=whole)
    step = priors.NOISE_STEP_REAL if whole else priors.NOISE_STEP_FREE
    at = fitted(base.made, base.whole, step)
    return Judged(base, at, at.nats + base.made.log_whitening)


def _is_there(here: Judged) -> bool:
    """Whether calibration, delay and the noise's level are where the model wants them."""
    made, keys = here.base.made, here.base.whole
    off, deviation = step_of(made, keys, here.at)
    if np.any(np.abs(off) > NEAR * deviation):
        return False
    level = made.left_by(keys, here.at)
    again = noise_model.amplitude(level, made.point.filtered.used, made.point.problem.rate_hz)
    change = np.log(again / made.point.amplitude)
    return float(np.sqrt(np.mean(np.square(change)))) < SAME_LEVEL
