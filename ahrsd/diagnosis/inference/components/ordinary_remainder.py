"""The ordinary remainder: what every real recording contains beyond a calibration.

Its sizes were measured on untouched recordings (`priors`).  The field in a room differs from place
to place and in time, a sensor is not quite linear, a gyro's axes are not quite straight.  All of
that depends on time, attitude, rate and force.  Without components of its own the flexible effects
of the library would be reported for it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.components.component import Component, FixedLaw, ScaledLaw
from ahrsd.diagnosis.inference.components.gaussian_process import gaussian_process
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.estimator.locked import change_columns, harmonics, on_each_axis, rate_products
from ahrsd.samples import Array

#: key of the gyro's matrix, and its coefficients that are turns: they add turn x rate to the rates
GYRO_MATRIX, TURNS = "gyro_matrix", slice(0, 3)
_GRAVITY = 9.81


def ordinary_remainder(context: Context) -> list[Component]:
    """Its components for a recording."""
    found = [
        gaussian_process(context, "world", priors.ORDINARY["world_course"]),
        gaussian_process(context, "gyro", priors.ORDINARY["gyro_course"]),
        _remainder_component(context, "by_direction", "sensor", harmonics(context.field_b)),
        field_by_change(context),
        _remainder_component(context, "field_by_rate", "sensor", context.rowwise_rate_b_rad_s),
        _remainder_component(
            context, "by_rate_squared", "gyro", rate_products(context.rowwise_rate_b_rad_s)
        ),
        gyro_matrix(context),
    ]
    if context.force_b_m_s2 is not None and np.isfinite(context.force_b_m_s2).all():
        found.append(
            _remainder_component(context, "by_force", "gyro", context.force_b_m_s2 / _GRAVITY)
        )
        found.append(mount_bending(context))
    return found


def _remainder_component(context: Context, key: str, frame: str, functions: Array) -> Component:
    """Functions (N, k), each along each axis of the sensor, all coefficients of one size."""
    law = ordinary_size_law(priors.ORDINARY[key], np.ones(3 * functions.shape[1]))
    flat = on_each_axis(functions)
    columns = Columns(gyro=flat) if frame == "gyro" else Columns(mag=flat)
    return Component(key, frame, columns, law)


def ordinary_size_law(size: priors.Size, scale: Array) -> ScaledLaw:
    """Lognormal law of an ordinary size, of coefficients in units of `scale` (q,)."""
    mean = float(np.log(size.median))
    low, high = mean - 4.0 * size.spread, float(np.log(size.most))
    return ScaledLaw(scale, np.array([low]), np.array([high]), mean, size.spread)


def still_intervals(time_s: Array, gyro_rad_s: Array) -> list[tuple[float, float]]:
    """The longest intervals in which a sensor hardly turns, from and to, s, in order of time.

    Empty if it hardly turns for most of the recording: then that is its motion.
    """
    rows = max(1, round(priors.SMOOTHED_S * len(time_s) / float(time_s[-1] - time_s[0])))
    rate = np.linalg.norm(uniform_filter1d(gyro_rad_s, rows, axis=0), axis=1)
    still = rate < min(priors.STILL_RAD_S, priors.STILL_PART * float(np.sqrt(np.mean(rate**2))))
    if np.mean(still) > priors.MOSTLY:
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    intervals = [(float(time_s[a]), float(time_s[b - 1])) for a, b in edges.reshape(-1, 2)]
    long_enough = [one for one in intervals if one[1] - one[0] >= priors.STILL_S]
    return sorted(sorted(long_enough, key=lambda one: one[0] - one[1])[: priors.MOST_SPELLS])


def field_by_change(context: Context) -> Component:
    """A matrix times the field's rate of change, less the part equal on all axes (a delay)."""
    columns = change_columns(context.field_dot_b)
    law = ordinary_size_law(priors.ORDINARY["by_change"], np.ones(columns.shape[2]))
    return Component("by_change", "sensor", Columns(mag=columns), law)


def mount_bending(context: Context) -> Component:
    """A flexible mount, turned by force and angular acceleration."""
    effect = next(one for one in EFFECTS.values() if one.ordinary_part == "bending")
    law = ordinary_size_law(
        priors.ORDINARY["bending"], np.array([one.scale for one in effect.parameters])
    )
    return Component("bending", "sensor", effect.columns(context, {}), law)


def gyro_matrix(context: Context) -> Component:
    """Errors linear in the rates: 3 turns, 3 scales, 3 shears, of known ordinary sizes."""
    w = context.rowwise_rate_b_rad_s
    columns = np.zeros((len(w), 3, 9))
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        columns[:, i, axis], columns[:, j, axis] = -w[:, j], w[:, i]
        columns[:, axis, 3 + axis] = w[:, axis]
        columns[:, i, 6 + axis], columns[:, j, 6 + axis] = w[:, j], w[:, i]
    deviation = np.repeat([priors.ORDINARY_MISALIGNMENT_RAD, priors.ORDINARY_SCALE], [3, 6])
    return Component(GYRO_MATRIX, "gyro", Columns(gyro=columns), FixedLaw(deviation**2))
