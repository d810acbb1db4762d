"""MAGYC-IFG: MAGYC-BFG's factors as they arrive ([M]).

A factor per window of theta samples, iSAM2 with dogleg every Gamma factors, the answer the mean of
the last 20 % of the estimates. iSAM2 keeps GTSAM's threshold of 0.1 for linearising again, as the
seed does: a gyro bias in rad/s never crosses it, and moves in the linear part only.
"""

from __future__ import annotations

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.graphs import incremental
from ahrsd.baselines.magyc_bfg import model
from ahrsd.baselines.windows import windowed

GTSAM_THRESHOLD = 0.1


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.incremental`."""
    threshold = GTSAM_THRESHOLD if settings.relinearize is None else settings.relinearize
    return incremental(model(), windowed(data, settings), settings, threshold)
