"""MAGYC-BFG: batch factor graph with C = L L^T of unit volume by construction ([M]).

Three nodes: the five numbers of L (e^p0, p1, e^p2, p3, p4 and e^-(p0 + p2) last), b' and w_b. Per
window one residual factor [w - w_b]x (C m - b') + C m'; no norm factor. Dogleg, tolerance 1e-7.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.graphs import batch
from ahrsd.baselines.kinematic import Model
from ahrsd.baselines.soft_iron import cholesky
from ahrsd.baselines.windows import windowed


def model() -> Model:
    """L's numbers, b' and w_b as three nodes; start C = I."""
    return Model(cholesky, np.zeros(11), (5, 3, 3), norm=False)


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.batch`."""
    return batch(model(), windowed(data, settings))
