"""What any sensor has of itself: a mount and scales of a degree or a hundredth.

Too small to be said beside what no name explains, they are there, and in the turns of a person's
hand a mount of a degree looks in part like a delay of some milliseconds.  So what is told beside a
remainder is told with the gyro's whole matrix free.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.mismatch.regression import Base
from ahrsd.mismatch.spectrum import against, spectrum_of
from ahrsd.mismatch.values import Columns, Context

ITSELF = "of itself"
#: names that are a part of the matrix
PARTS = ("mag_gyro_misalignment", "gyro_scale", "gyro_nonorthogonality", "clock_rate")


def beside_itself(basis: Base, names: Sequence[str]) -> Base:
    """The basis against the spectrum of what is left, the matrix known unless a part is named."""
    if not any(name in PARTS for name in names):
        basis = basis.beside(ITSELF, basis.whitened([gyro_matrix(basis.context)])[0])
    return against(basis, spectrum_of(basis))


def gyro_matrix(context: Context) -> Columns:
    """Columns (N, 3, 9) of an error of the gyro by a matrix on its rate, row by row."""
    rate = context.rate_b_rad_s
    return Columns(gyro=np.einsum("nj,ik->nikj", rate, np.eye(3)).reshape(len(rate), 3, -1))
