"""Instruments that are not the model's: imperfections drawn from the estimator's table, put into
the readings of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pieces

from ahrsd import so3
from ahrsd.calibration import Estimate
from ahrsd.estimator.parameters import Imperfections
from ahrsd.montecarlo.nuisances import SHAPES
from ahrsd.samples import Array


def imperfect(
    made: pieces.Drive, kind: Imperfections, rng: np.random.Generator, hold: int = 1
) -> pieces.Drive:
    """The same drive as an instrument of this kind reads it; its truth is that of `pieces`.

    The iron of the truth is that of the mean over time, the bias that of the end.
    """
    turn, scale, shape = rng.normal(size=3), rng.normal(), rng.normal(size=5)
    lag_s, drift, iron = rng.normal() * kind.lag_s, rng.normal(size=3), rng.normal(size=3)
    rate, field = made.rate_b_rad_s, made.field_b_gauss
    E = so3.exp(kind.turn_rad * turn[None])[0] + kind.scale * scale * np.eye(3)
    E = E + kind.shape * np.tensordot(shape, SHAPES, 1)
    share = (made.block.time_s - made.block.time_s[0]) / np.ptp(made.block.time_s)
    gyro = made.block.gyro_b_rad_s + rate @ (E - np.eye(3)).T
    gyro = gyro + kind.bias_rad_s * (share - 1.0)[:, None] * drift
    late = np.einsum("nij,nj->ni", so3.exp(rate * lag_s), field)
    moved = kind.iron_gauss * (share - 0.5)[:, None] * iron
    put_on = (late - field) @ pieces.SOFT_IRON.T + moved
    kept = np.arange(len(put_on)) // hold * hold
    block = replace(
        made.block,
        raw_b_gauss=made.block.raw_b_gauss + put_on[kept],
        gyro_b_rad_s=gyro,
    )
    return replace(made, block=block)


def sigmas_off(made: pieces.Drive, found: Estimate) -> Array:
    """Errors over what was announced (12,)."""
    return made.errors(found) / np.sqrt(np.diag(found.covariance))
