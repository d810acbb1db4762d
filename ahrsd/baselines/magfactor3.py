"""MagFactor3: GTSAM's magnetometer factor, m = alpha R_bw M + b, attitude R_bw and field M known.

One uniform scale alpha and b; soft iron proper is not in the model. One vectorised factor

    r_k = alpha R_bw M + b - m_k,   dr/dalpha = R_bw M,   dr/db = I
"""

from __future__ import annotations

import gtsam
import numpy as np

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.graphs import custom_factor, values_of, vector_of
from ahrsd.samples import Array

NODES = (1, 3)
_SIGMA_GAUSS = 1e-3
_MAX_ITERATIONS = 100


def residual(x: Array, body: Array, raw: Array) -> tuple[Array, Array]:
    """r (3N,) and its derivative (3N, 4) by [alpha, b]; body (N, 3) is R_bw M."""
    r = x[0] * body + x[1:] - raw
    J = np.empty((len(raw), 3, 4))
    J[:, :, 0] = body
    J[:, :, 1:] = np.eye(3)
    return r.ravel(), J.reshape(-1, 4)


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A = alpha I and b.  MethodError where attitude or field are missing, or alpha <= 0."""
    del settings
    if data.R_nb is None or data.field_n_gauss is None:
        raise MethodError("needs the attitude of every sample and the local field")
    body = np.einsum("nji,j->ni", data.R_nb, data.field_n_gauss)
    if body.shape != data.raw_b_gauss.shape or not np.isfinite(body).all():
        raise MethodError("attitude or field are not finite, or not one per sample")
    graph = gtsam.NonlinearFactorGraph()
    rows = body.size
    graph.add(
        custom_factor(lambda x: residual(x, body, data.raw_b_gauss), rows, NODES, _SIGMA_GAUSS)
    )
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAX_ITERATIONS)
    start = values_of(np.array([1.0, 0.0, 0.0, 0.0]), NODES)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    x = vector_of(optimizer.optimize(), len(NODES))
    if not x[0] > 0:
        raise MethodError(f"the scale that fits best is {x[0]:.3g}: attitude or field are wrong")
    return MethodFit(float(x[0]) * np.eye(3), x[1:], None, int(optimizer.iterations()))
