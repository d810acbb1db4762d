"""Whether what no name explains is a field, whatever a course of the gyro explains of it.

An error of the gyro turns the field and does not change its size: along the field the magnetometer
leaves its noise.  A field that differs from place to place changes both alike.  Across the field a
free course of the gyro's rate follows it as well as any other, on a path that nobody logged often
better; so what is left along the field decides, once the calibration that a large error of the gyro
bends is put right by its course.  An error of the gyro leaves nothing there that lasts for seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.discrepancy import UNIT_RAD_S, by_rate
from ahrsd.diagnosis.rules.one_source import with_one_source
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.rivals import of_the_rate
from ahrsd.diagnosis.rules.together import left_beside, projected_with, together
from ahrsd.diagnosis.rules.unknown import FINE, Remainder
from ahrsd.diagnosis.where_and_when import locate

APART_S = 1.0
#: correlation along the field, that far apart, of what is no noise of the magnetometer:
#: five trials in rooms have 0.45 to 0.74, errors of the gyro 0.03; red noise mostly 0.3 at most,
#: but one null has 0.44, so where only noise is the rival more is asked
#: (`refined.STEADY`)
MOSTLY_SLOW = 0.4


def framed(basis: Base, left: Remainder, limits: Limits) -> Remainder:
    """The remainder in the frame of a quick source, of an error by the rates, or of a field.

    basis: the model's, from which the remainder was taken
    """
    seen = with_one_source(left)
    if unknown.detected(seen, limits):
        seen = of_the_rate(seen)
    if seen.strongest.frame != "gyro" or slowness(basis) < MOSTLY_SLOW:
        return seen
    return with_one_source(_of_a_field(left))


def in_a_field(basis: Base, left: Remainder) -> Remainder:
    """The remainder, told of the likelier field where the gyro's course leads and is not all."""
    if left.strongest.frame != "gyro" or slowness(basis) < MOSTLY_SLOW:
        return left
    return _of_a_field(left)


def _of_a_field(left: Remainder) -> Remainder:
    """The remainder with the evidence of the likelier field and of the gyro exchanged."""
    gyro, sensor, world = (left.located[frame] for frame in ("gyro", "sensor", "world"))
    field = world if world.evidence > sensor.evidence else sensor
    if field.evidence >= gyro.evidence:
        return left
    sure = replace(field, evidence=gyro.evidence, p_value=min(field.p_value, gyro.p_value))
    less = replace(gyro, evidence=field.evidence)
    return replace(left, located={**left.located, field.frame: sure, "gyro": less})


def slowness(basis: Base) -> float:
    """Correlation of what is left along the field with itself `APART_S` later.

    Beside a free course of the gyro's error and one by its rates.
    """
    cut = locate.segments(basis.context.track.time_s, FINE)
    free = together(basis, [("gyro", UNIT_RAD_S)], cut, [(by_rate(basis.context), UNIT_RAD_S)])
    G, s = projected_with(basis, free, free.products())
    field = basis.context.field_b @ basis.context.model.soft_iron
    unit = field / np.linalg.norm(field, axis=1, keepdims=True)
    gone = left_beside(basis, free, G, s)
    along = np.sum(gone * unit, axis=1)
    along = along - along.mean()
    apart = max(1, round(APART_S * basis.rate_hz))
    return float(along[apart:] @ along[:-apart] / max(float(along @ along), 1e-300))
