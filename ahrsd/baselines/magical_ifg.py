"""MAGICAL-IFG: incremental factor graph ([R]).

MAGICAL-BFG's factors as they arrive, averaged over a window of theta samples, optimised every Gamma
factors (iSAM2 with dogleg); the answer is the mean of the last 20 % of the estimates.

The seed's figures come out only where iSAM2 never linearises again, which is the default here: the
derivative by the gyro bias, [C m - b']x, then stays that of C = I while the norm factor takes |C|_F
from sqrt 3 to 1, and the gyro bias comes out at about half of the truth, as in [R] Table 5.1.
`MethodSettings.relinearize` mends it.
"""

from __future__ import annotations

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.graphs import incremental
from ahrsd.baselines.magical_bfg import model
from ahrsd.baselines.windows import windowed

NEVER = 0.0


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.incremental`."""
    threshold = NEVER if settings.relinearize is None else settings.relinearize
    return incremental(model(), windowed(data, settings), settings, threshold)
