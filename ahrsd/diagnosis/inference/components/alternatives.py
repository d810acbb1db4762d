"""Alternatives to the effects of the library: unexplained sources, and coefficients that vary.

A source that is not in the library is slow in time, or quick, or depends on how the sensor turns.
Flexible effects explain a part of it and, without an alternative, take its evidence.  An effect
that stands in for such a source has no constant coefficient: with a coefficient that varies in time
it explains far more, while a true effect explains no more than by chance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component, Law, ScaledLaw
from ahrsd.diagnosis.inference.components.gaussian_process import (
    GaussianProcessLaw,
    gaussian_process,
)
from ahrsd.diagnosis.model import Columns, Context, unit_vectors
from ahrsd.diagnosis.where_and_when.regime import heading_columns
from ahrsd.estimator.locked import harmonics, on_each_axis
from ahrsd.samples import Array

BY_RATE, BY_TILT = "free by_rate", "free by_tilt"
BY_HEADING, QUICK = "free by_heading", "free quick"
#: number of half waves of a coefficient that varies in time
_FACTOR_MODES = 16


def alternative_sources(context: Context) -> list[Component]:
    """Unexplained fields on the sensor: by its rate of turn, by its tilt, and quick in time.

    What hangs, slides or levels itself depends on the tilt; an accelerometer is needed to know
    that.
    """
    rate = context.rowwise_rate_b_rad_s
    rate = rate / max(float(np.sqrt(np.mean(np.sum(rate**2, axis=1)))), 1e-12)
    size = np.linalg.norm(rate, axis=1)
    functions_by_key = {BY_RATE: np.column_stack([rate, size, size**2])}
    if context.world_levelled:
        down_b = context.R_nb[:, 2]
        functions_by_key[BY_TILT] = np.column_stack([down_b, harmonics(down_b)[:, :5]])
    found = [
        _unexplained_field(key, Columns(mag=on_each_axis(functions)))
        for key, functions in functions_by_key.items()
    ]
    return [*found, gaussian_process(context, "sensor", quick=QUICK)]


def field_by_heading(context: Context) -> Component:
    """A field on the sensor in harmonics of the heading: a turret, or a crane that turns back.

    If each turn takes a few seconds and goes to many directions, it is coloured noise in time.
    """
    return _unexplained_field(BY_HEADING, heading_columns(context))


def _unexplained_field(key: str, columns: Columns) -> Component:
    """A field on the sensor of any size, all coefficients of one size."""
    unit = priors.COURSE_UNIT["sensor"]
    low, high = (np.array([np.log(unit * one)]) for one in priors.COURSE_SIZES)
    law = ScaledLaw(np.ones(columns.width), low, high, mean=float(np.log(unit)))
    return Component(key, "sensor", columns, law, float(np.log(priors.COURSE)))


def single_remainder_parts(all_parts: Iterable[Component]) -> list[Component]:
    """Parts of the ordinary remainder, each of any size and tested without the other parts.

    If only one part is supported by the data it is no ordinary remainder but an unexplained source.
    """
    found = []
    for part in all_parts:
        if isinstance(part.law, ScaledLaw):
            law, log_odds = replace(part.law, spread=0.0), float(np.log(priors.COURSE))
            found.append(replace(part, key=f"free {part.key}", law=law, prior=log_odds))
    return found


def coefficient_factors(
    effect: Component, contribution: Array, context: Context
) -> list[Component]:
    """An effect's contribution (N, 3) times a factor varying in time, and times one in attitude.

    Both factors are relative to the effect's coefficient and have mean 0, weighted by the square of
    the contribution.  Otherwise, where the attitude hardly changes, the factor would be the effect
    itself with one coefficient in place of many.
    """
    weight = np.sum(contribution**2, axis=1)
    weight = weight / max(float(np.sum(weight)), 1e-300)
    time_s = context.track.time_s
    order = np.arange(1, _FACTOR_MODES + 1)
    phase = np.pi * (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    law_in_time = GaussianProcessLaw(order.astype(float), 1.0, most=priors.VARIES_MOST)
    unit = unit_vectors(context.field_b)
    degree_1_and_2 = np.column_stack([np.sqrt(3.0) * unit, harmonics(context.field_b)[:, :5]])
    low, high = (np.array([np.log(one)]) for one in (priors.COURSE_SIZES[0], priors.VARIES_MOST))
    law_in_attitude = ScaledLaw(np.ones(degree_1_and_2.shape[1]), low, high)
    factors: list[tuple[Array, Law]] = [
        (np.cos(phase[:, None] * order), law_in_time),
        (degree_1_and_2, law_in_attitude),
    ]
    found = []
    for key, (factor, law) in zip(factor_keys(effect.key), factors, strict=True):
        flat = contribution[:, :, None] * (factor - weight @ factor)[:, None, :]
        columns = Columns(mag=flat) if effect.columns.on_mag else Columns(gyro=flat)
        found.append(Component(key, effect.frame, columns, law, float(np.log(priors.COURSE))))
    return found


def factor_keys(key: str) -> tuple[str, str]:
    """Keys of the two varying factors of an effect."""
    return f"{key}, free in time", f"{key}, free in attitude"
