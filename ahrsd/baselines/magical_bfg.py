"""MAGICAL-BFG: batch factor graph ([R]).

One node x = (C's upper triangle, b', w_b). Per averaged window of theta samples one residual factor

    [w - w_b]x (C m - b') + C m'

and one norm factor |C|_F - 1 that keeps C from vanishing; relative and absolute tolerance 1e-7.
A = C^-1 is rescaled to unit volume and b = A b' at the end.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.graphs import batch
from ahrsd.baselines.kinematic import Model
from ahrsd.baselines.soft_iron import triangle
from ahrsd.baselines.windows import windowed
from ahrsd.estimator.chain import upper_triangle


def model() -> Model:
    """C's triangle, b' and w_b in one node, with the norm factor; start C = I."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(triangle, start, (12,), norm=True)


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.batch`."""
    return batch(model(), windowed(data, settings))
