"""The unknown that has no course: an error of the gyro by its rates, a matrix that changes slowly.

A gyro whose scale is another to the left than to the right, or a mount that bends with the day, has
no place in time and hardly one in a regime: over a twentieth of the recording it averages out, and
what it does counts as noise.  Free forms of such errors see it (`rivals`).  They are asked where
nothing else is left, each as a random effect that pays for its coefficients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules.discrepancy import UNIT_GAUSS, UNIT_RAD_S, by_rate
from ahrsd.diagnosis.rules.random_effect import effect_nats
from ahrsd.diagnosis.rules.rivals import by_matrix
from ahrsd.diagnosis.rules.unknown import Remainder, detected
from ahrsd.diagnosis.where_and_when.locate import Frame


def with_forms(left: Remainder, price: float, limits: Limits) -> Remainder:
    """The remainder, told of a form's frame where nothing else is left and a form explains it.

    price: nats that the names may leave of their own forms
    """
    if detected(left, limits):
        return left
    basis = left.basis
    rate, matrix = basis.whitened([by_rate(basis.context), by_matrix(basis.context)])
    found: dict[Frame, float] = {
        "gyro": effect_nats(basis, rate * UNIT_RAD_S),
        "sensor": effect_nats(basis, matrix * UNIT_GAUSS),
    }
    frame = max(found, key=lambda one: found[one])
    evidence = found[frame] - float(np.log(len(found)))
    if evidence <= limits.unknown_nats + price:
        return left
    located = {**left.located, frame: replace(left.located[frame], evidence=evidence)}
    return replace(left, located=located, stood_in=frame)
