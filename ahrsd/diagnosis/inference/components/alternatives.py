"""What is asked beside names: sources of other laws than slow ones in time, and a name's own form.

A source that no name has is slow in time, or quick, or follows how the sensor turns.  Names that
are flexible explain a part of it, and nothing else being there, take its evidence.  And what stands
in for it has no constant coefficient: with one that is free in time it explains far more, while a
name that is there explains no more than by chance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component, Law, Sized
from ahrsd.diagnosis.inference.components.gaussian_process import CourseLaw, course
from ahrsd.diagnosis.model import Columns, Context, unit_vectors
from ahrsd.diagnosis.where_and_when.regime import heading_columns
from ahrsd.estimator.locked import harmonics, on_each_axis
from ahrsd.samples import Array

BY_RATE, BY_TILT = "free by_rate", "free by_tilt"
BY_HEADING, QUICK = "free by_heading", "free quick"
#: half waves of a coefficient that is free in time
_WAVES = 16


def other_courses(context: Context) -> list[Component]:
    """Fields on the sensor that no name has: by its rate of turn, by its tilt, quick in time.

    What hangs, slides or levels itself goes by the tilt, where an accelerometer tells that.
    """
    rate = context.rowwise_rate_b_rad_s
    rate = rate / max(float(np.sqrt(np.mean(np.sum(rate**2, axis=1)))), 1e-12)
    size = np.linalg.norm(rate, axis=1)
    laws = {BY_RATE: np.column_stack([rate, size, size**2])}
    if context.world_levelled:
        down = context.R_nb[:, 2]
        laws[BY_TILT] = np.column_stack([down, harmonics(down)[:, :5]])
    found = [_by_law(key, functions) for key, functions in laws.items()]
    return [*found, course(context, "sensor", quick=QUICK)]


def _by_law(key: str, functions: Array) -> Component:
    """A field of any size on each axis of the sensor by functions (N, k) of its motion."""
    flat = on_each_axis(functions)
    unit = priors.COURSE_UNIT["sensor"]
    low, high = (np.array([np.log(unit * one)]) for one in priors.COURSE_SIZES)
    law = Sized(np.ones(flat.shape[2]), low, high, mean=float(np.log(unit)))
    return Component(key, "sensor", Columns(mag=flat), law, float(np.log(priors.COURSE)))


def by_heading(context: Context) -> Component:
    """A field on the sensor in waves of the heading, as a turret's or a crane's that turns back.

    Of a few seconds each time and of many directions it is noise of a colour in time.
    """
    columns, unit = heading_columns(context), priors.COURSE_UNIT["sensor"]
    low, high = (np.array([np.log(unit * one)]) for one in priors.COURSE_SIZES)
    law = Sized(np.ones(columns.width), low, high, mean=float(np.log(unit)))
    return Component(BY_HEADING, "sensor", columns, law, float(np.log(priors.COURSE)))


def lone_parts(all_parts: Iterable[Component]) -> list[Component]:
    """Parts of what every recording leaves, each of any size and beside none of the others.

    Where one is there and not the others it is no ordinary remainder: a source that no name has.
    """
    found = []
    for one in all_parts:
        if isinstance(one.law, Sized):
            law, odds = replace(one.law, spread=0.0), float(np.log(priors.COURSE))
            found.append(replace(one, key=f"free {one.key}", law=law, prior=odds))
    return found


def varying(known: Component, added: Array, context: Context) -> list[Component]:
    """What a name adds (N, 3), by a factor that is free in time, and by one free in attitude.

    Both are relative to its coefficient, and 0 in the mean: where an attitude hardly changes, a
    factor that is free in it were else the name again, of one coefficient in place of many.
    """
    weight = np.sum(added**2, axis=1)
    weight = weight / max(float(np.sum(weight)), 1e-300)
    time_s = context.track.time_s
    order = np.arange(1, _WAVES + 1)
    phase = np.pi * (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    in_time = CourseLaw(order.astype(float), 1.0, most=priors.VARIES_MOST)
    unit = unit_vectors(context.field_b)
    degree_1_and_2 = np.column_stack([np.sqrt(3.0) * unit, harmonics(context.field_b)[:, :5]])
    low, high = (np.array([np.log(one)]) for one in (priors.COURSE_SIZES[0], priors.VARIES_MOST))
    in_attitude = Sized(np.ones(degree_1_and_2.shape[1]), low, high)
    factors: list[tuple[Array, Law]] = [
        (np.cos(phase[:, None] * order), in_time),
        (degree_1_and_2, in_attitude),
    ]
    found = []
    for key, (factor, law) in zip(form_keys(known.key), factors, strict=True):
        flat = added[:, :, None] * (factor - weight @ factor)[:, None, :]
        columns = Columns(mag=flat) if known.columns.on_mag else Columns(gyro=flat)
        found.append(Component(key, known.frame, columns, law, float(np.log(priors.COURSE))))
    return found


def form_keys(key: str) -> tuple[str, str]:
    """Keys of the free factors of a name."""
    return f"{key}, free in time", f"{key}, free in attitude"
