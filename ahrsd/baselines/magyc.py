"""MAGYC's two methods ([M]): MAGICAL's residual with C = L L^T of unit volume by construction."""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.graphs import batch, incremental
from ahrsd.baselines.kinematic import Model, windowed
from ahrsd.baselines.soft_iron import cholesky

# -- MAGYC-BFG -------------------------------------------------------------------------------------
#
# MAGYC-BFG: batch factor graph with C = L L^T of unit volume by construction ([M]).
#
# Three nodes: the five numbers of L (e^p0, p1, e^p2, p3, p4 and e^-(p0 + p2) last), b' and w_b. Per
# window one residual factor [w - w_b]x (C m - b') + C m'; no norm factor. Dogleg, tolerance 1e-7.


def cholesky_model() -> Model:
    """L's numbers, b' and w_b as three nodes; start C = I."""
    return Model(cholesky, np.zeros(11), (5, 3, 3), norm=False)


def estimate_bfg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.batch`."""
    return batch(cholesky_model(), windowed(data, settings))


# -- MAGYC-IFG -------------------------------------------------------------------------------------
#
# MAGYC-IFG: MAGYC-BFG's factors as they arrive ([M]).
#
# A factor per window of theta samples, iSAM2 with dogleg every Gamma factors, the answer the mean
# of the last 20 % of the estimates. iSAM2 keeps GTSAM's threshold of 0.1 for linearising again, as
# the seed does: a gyro bias in rad/s never crosses it, and moves in the linear part only.


GTSAM_THRESHOLD = 0.1


def estimate_ifg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.incremental`."""
    threshold = GTSAM_THRESHOLD if settings.relinearize is None else settings.relinearize
    return incremental(cholesky_model(), windowed(data, settings), settings, threshold)
