"""What any sensor has of itself: a mount and scales of a degree or a hundredth.

Too small to be said beside what no name explains, they are there, and in the turns of a person's
hand a mount of a degree looks in part like a delay of some milliseconds.  So beside a remainder a
delay is told with the gyro's whole matrix free, as far as sensors differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.rules.regression import Base, based
from ahrsd.diagnosis.values import Columns, Context

ITSELF = "of itself"
#: deviation of an element of the matrix: 1.7 degrees, three hundredths
USUAL = 0.03
#: names that are a part of the matrix
PARTS = ("mag_gyro_misalignment", "gyro_scale", "gyro_nonorthogonality", "clock_rate")


def beside_itself(basis: Base, names: Sequence[str]) -> Base:
    """The basis with the matrix known too, unless a part of it is named; for its coefficients only.

    Three rows more than there are samples say that each element is 0 with the deviation `USUAL`.
    """
    if any(name in PARTS for name in names):
        return basis
    wider = basis.beside(ITSELF, basis.whitened([gyro_matrix(basis.context)])[0])
    prior = np.zeros((3, 3, wider.known.shape[2]))
    prior.reshape(9, -1)[:, wider.groups[ITSELF]] = np.sqrt(basis.colour) / USUAL * np.eye(9)
    known = np.concatenate([wider.known, prior])
    innovation = np.concatenate([wider.innovation, np.zeros((3, 3))])
    return replace(based(wider, wider.groups, known, innovation), colour=basis.colour)


def gyro_matrix(context: Context) -> Columns:
    """Columns (N, 3, 9) of an error of the gyro by a matrix on its rate, row by row."""
    rate = context.rowwise_rate_b_rad_s
    return Columns(gyro=np.einsum("nj,ik->nikj", rate, np.eye(3)).reshape(len(rate), 3, -1))
