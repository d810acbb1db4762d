"""A magnetometer that is late against the gyro: a reading at t is of the direction at t - tau.

Filters, buses and interrupts make it so in every real system, and a lag of tau at a rate w looks
like a field that is turned by w tau. It is taken out where the field is seen: the row measured
M Exp(w tau) u + b. The gyro's readings stay as they are, so nothing is smoothed and no noise is
mixed. For tau of a few steps at most: w is the mean rate of the row's steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.samples import Array


def rates(data: chain.EpochData) -> Array:
    """Rate (n, 3) in rad/s at each row: mean of the steps to it and from it, as far as linked."""
    if data.averaging is not None:
        return data.averaging.rate_b_rad_s
    linked = np.ones(len(data)) if data.linked is None else data.linked.copy()
    linked[0] = 0.0
    rate = data.angle_b_rad / data.dt_s[:, None] * linked[:, None]
    both = rate.copy()
    both[:-1] += rate[1:]
    sides = linked.copy()
    sides[:-1] += linked[1:]
    return np.asarray(both / np.maximum(sides, 1.0)[:, None])


def delayed(data: chain.EpochData, lag_s: float) -> chain.EpochData:
    """The same epoch with its fields taken to be `lag_s` later than before."""
    rate = rates(data)
    turn = so3.exp(lag_s * rate)
    averaging = data.averaging
    if averaging is None:
        averaging = chain.Averaging(np.ones(len(data)), turn, data.dt_s, rate)
    else:
        averaging = replace(averaging, turn=turn @ averaging.turn)
    return replace(data, averaging=averaging)
