"""The richest model: calibration, delay, ordinary remainder and free courses in every frame.

It is where everything is linearised.  In the null, what is missing counts as noise: beside a magnet
of 0.14 G its sigma was ten times too large, the calibration was bent to it, and the step never got
its evidence.  Here courses hold what is missing, whatever it is; the noise is what they leave, the
calibration is the one beside them, and a name has to do better than they do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.innovation import Filtered
from ahrsd.diagnosis.locate import FRAMES
from ahrsd.diagnosis.one_model.component import Component
from ahrsd.diagnosis.one_model.effect_components import LAG, LAG_FORM, delay, delay_form
from ahrsd.diagnosis.one_model.evidence import At, maximised
from ahrsd.diagnosis.one_model.gaussian_process import course
from ahrsd.diagnosis.one_model.linearised import (
    CALIBRATION,
    Linearised,
    Point,
    first_point,
    linearised,
    moved,
)
from ahrsd.diagnosis.one_model.remainder import ordinary_remainder
from ahrsd.diagnosis.problem import Problem

ROUNDS = 4
#: the sensor's course stands for all three where the remainder, with the other two, is in
RICH_COURSES = ("free sensor",)


def base_of(
    point: Point, library: Mapping[str, Effect], named: Sequence[Component]
) -> tuple[Linearised, tuple[str, ...], tuple[str, ...]]:
    """A linearisation with everything but candidates; keys of the remainder and of the richest.

    named: components that are known by name, whose columns are made anew here
    """
    made = linearised(point)
    context = made.context
    rest = ordinary_remainder(context)
    courses = [course(context, frame) for frame in FRAMES]
    lags = [delay(context, library)]
    if point.problem.lag_s != 0.0:
        lags.append(delay_form(context, point.problem.lag_s))
    parts = [*rest, *lags, *courses, *named]
    made.exact = (LAG,)
    made.add(parts)
    made.put_back({key: value for key, value in point.values.items() if key in made.seen})
    made.gram_of([CALIBRATION, *(one.key for one in parts)])
    remainder = tuple(one.key for one in rest)
    whole = (CALIBRATION, *remainder, *(one.key for one in lags), *RICH_COURSES,
             *(one.key for one in named))  # fmt: skip
    return made, remainder, whole


def fitted(
    made: Linearised, keys: Sequence[str], start: tuple[np.ndarray, Mapping[str, np.ndarray]] | None
) -> At:
    """The likeliest hyperparameters of a model, from the highest band's power, or from a start."""
    products = made.products(keys)
    laws = [made.seen[key].component.law for key in keys]
    psi = np.concatenate([law.start for law in laws])
    top = float(np.log(products.square[-1] / products.rows[-1]))
    starts = [(np.full(len(products.rows), top), psi)]
    if start is not None:
        noise, known = start
        warm = [known.get(key, law.start) for key, law in zip(keys, laws, strict=True)]
        starts = [(noise, np.concatenate(warm))]
    return maximised(products, laws, starts)


def psi_by_key(made: Linearised, keys: Sequence[str], at: At) -> dict[str, np.ndarray]:
    """Hyperparameters of each component."""
    out, begin = {}, 0
    for key in keys:
        width = len(made.seen[key].component.law.start)
        out[key] = at.psi[begin : begin + width]
        begin += width
    return out


def richest(
    problem: Problem, filtered: Filtered, library: Mapping[str, Effect], rounds: int = ROUNDS
) -> Point:
    """The point at the richest model, nothing named, from a null's filter."""
    point = first_point(problem, filtered)
    for _ in range(rounds):
        made, _, keys = base_of(point, library, ())
        point = moved(made, keys, fitted(made, keys, None))
    return point
