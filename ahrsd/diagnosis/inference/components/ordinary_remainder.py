"""What every real recording leaves, with sizes measured on untouched ones (`priors`).

A room differs from place to place and its field from time to time, a sensor is not quite linear, a
gyro not quite straight.  All of that is locked to time, attitude, rate and force, and without
components of its own the library's flexible names would be told for it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.components.component import Component, Fixed, Sized
from ahrsd.diagnosis.inference.components.gaussian_process import course
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.estimator.locked import change_columns, harmonics, on_each_axis, rate_products
from ahrsd.samples import Array

#: a gyro's matrix, and of its coefficients the turns: rates have turn x rate more
GYRO_MATRIX, TURNS = "gyro_matrix", slice(0, 3)
_GRAVITY = 9.81


def ordinary_remainder(context: Context) -> list[Component]:
    """Its components along a recording."""
    found = [
        course(context, "world", priors.ORDINARY["world_course"]),
        course(context, "gyro", priors.ORDINARY["gyro_course"]),
        _sized(context, "by_direction", "sensor", harmonics(context.field_b)),
        by_change(context),
        _sized(context, "field_by_rate", "sensor", context.rowwise_rate_b_rad_s),
        _sized(context, "by_rate_squared", "gyro", rate_products(context.rowwise_rate_b_rad_s)),
        gyro_matrix(context),
    ]
    if context.force_b_m_s2 is not None and np.isfinite(context.force_b_m_s2).all():
        found.append(_sized(context, "by_force", "gyro", context.force_b_m_s2 / _GRAVITY))
        found.append(bending(context))
    return found


def _sized(context: Context, key: str, frame: str, functions: Array) -> Component:
    """Each function (N, k) along each axis of the sensor, all coefficients of one size."""
    law = ordinary(priors.ORDINARY[key], np.ones(3 * functions.shape[1]))
    flat = on_each_axis(functions)
    columns = Columns(gyro=flat) if frame == "gyro" else Columns(mag=flat)
    return Component(key, frame, columns, law)


def ordinary(size: priors.Size, scale: Array) -> Sized:
    """The law of an ordinary size, of coefficients in units of `scale` (q,)."""
    mean = float(np.log(size.median))
    low, high = mean - 4.0 * size.spread, float(np.log(size.most))
    return Sized(scale, np.array([low]), np.array([high]), mean, size.spread)


def still_spells(time_s: Array, gyro_rad_s: Array) -> list[tuple[float, float]]:
    """The longest spells in which a sensor hardly turns, from and to, s, in their order.

    None where it hardly turns in most of its time: then that is its motion.
    """
    rows = max(1, round(priors.SMOOTHED_S * len(time_s) / float(time_s[-1] - time_s[0])))
    rate = np.linalg.norm(uniform_filter1d(gyro_rad_s, rows, axis=0), axis=1)
    still = rate < min(priors.STILL_RAD_S, priors.STILL_PART * float(np.sqrt(np.mean(rate**2))))
    if np.mean(still) > priors.MOSTLY:
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    spells = [(float(time_s[a]), float(time_s[b - 1])) for a, b in edges.reshape(-1, 2)]
    long = [one for one in spells if one[1] - one[0] >= priors.STILL_S]
    return sorted(sorted(long, key=lambda one: one[0] - one[1])[: priors.MOST_SPELLS])


def by_change(context: Context) -> Component:
    """A matrix on the field's change, without what is alike on all axes: that is the delay."""
    columns = change_columns(context.field_dot_b)
    law = ordinary(priors.ORDINARY["by_change"], np.ones(columns.shape[2]))
    return Component("by_change", "sensor", Columns(mag=columns), law)


def bending(context: Context) -> Component:
    """A mount that gives: turned by what force and angular acceleration do to it."""
    found = next(one for one in EFFECTS.values() if one.ordinary_part == "bending")
    law = ordinary(priors.ORDINARY["bending"], np.array([one.scale for one in found.parameters]))
    return Component("bending", "sensor", found.columns(context, {}), law)


def gyro_matrix(context: Context) -> Component:
    """Of the rates: three turns, three scales, three shears, of known ordinary sizes."""
    w = context.rowwise_rate_b_rad_s
    columns = np.zeros((len(w), 3, 9))
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        columns[:, i, axis], columns[:, j, axis] = -w[:, j], w[:, i]
        columns[:, axis, 3 + axis] = w[:, axis]
        columns[:, i, 6 + axis], columns[:, j, 6 + axis] = w[:, j], w[:, i]
    deviation = np.repeat([priors.ORDINARY_MISALIGNMENT_RAD, priors.ORDINARY_SCALE], [3, 6])
    return Component(GYRO_MATRIX, "gyro", Columns(gyro=columns), Fixed(deviation**2))
