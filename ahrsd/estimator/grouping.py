"""Several steps in one state of the chain: the same information at a fraction of the cost.

Where the gyro carries the direction over a few steps much better than the magnetometer sees it,
the steps of a group need no states of their own: their fields, turned by the gyro into the group's
middle, are averaged. The mean of M u_j + b over the group is M P u + b exactly, with P the mean of
the rotations from the middle to each step, so a turning sensor loses nothing either. Groups never
span a gap; the first and the last row of an epoch stay by themselves, because its neighbours share
them.

What is lost is the gyro's noise inside a group (its variance adds _LOST of the field's) and the
field's differences inside it, which matter only if the sensor turned much (_TURN_RAD).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.lag import rates
from ahrsd.estimator.noise import Typical
from ahrsd.samples import Array

Index = NDArray[np.intp]
_LARGEST = 7
_TURN_RAD = 0.3  # of rotation in a group; 1 step in 20 may turn faster
_LOST = 0.03


def group_size(
    data: chain.Data,
    noise: chain.Noise,
    size_gauss: float,
    *,
    lost: float = _LOST,
    largest: int = _LARGEST,
) -> int:
    """How many rows may share a state: odd, 1 where the gyro is poor or the turn fast.

    noise: a guess, per step; size_gauss: of the field; lost: of the field's variance, that the
    gyro's noise may add. The mean of k fields has the variance s_m^2 / k, and the gyro's noise adds
    k / 12 (size s_g dt)^2.
    """
    typical = Typical.of(data)
    gyro = size_gauss * noise.gyro_rad_s * typical.spread_s
    ratio = noise.mag_gauss / np.sqrt(typical.count) / gyro
    turn = float(np.percentile(np.linalg.norm(data.angle_b_rad[1:], axis=1), 95))
    most = min(ratio * np.sqrt(12 * lost), _TURN_RAD / max(turn, 1e-9), largest)
    return max(1, int(most) - 1 + int(most) % 2)


def grouped(data: chain.Data, size: int) -> chain.Data:
    """An epoch with `size` of its rows, an odd number, in a state."""
    n = len(data)
    if size == 1 or n < 4:
        return data
    linked = np.ones(n) if data.linked is None else data.linked
    start, length = _groups(linked, size)
    rows = np.r_[0, start + length // 2, n - 1]
    inner = (linked > 0) & (np.arange(n) > 0)
    turn = so3.exp(np.where(inner[:, None], data.angle_b_rad, 0.0))
    own = data.averaging or chain.Averaging(
        np.ones(n), np.broadcast_to(np.eye(3), (n, 3, 3)), data.dt_s, rates(data)
    )
    angle, dt, spread, joins = _between(data, turn, linked, rows, own.spread_s)
    steps = np.add.reduceat(own.count[: n - 1], start)
    field, rate = data.field_b_gauss.copy()[rows], own.rate_b_rad_s[rows]
    for mean, values in ((field, data.field_b_gauss), (rate, own.rate_b_rad_s)):
        total = np.add.reduceat((values * own.count[:, None])[: n - 1], start)
        mean[1:-1] = total / steps[:, None]
    P = own.turn[rows]
    P[1:-1] = _sums(turn, own, rows[1:-1], start, start + length) / steps[:, None, None]
    return chain.Data(
        field,
        angle,
        dt,
        data.down_b[rows],
        data.time_s[rows],
        data.measures_first,
        linked=None if joins.all() else joins.astype(np.float64),
        averaging=chain.Averaging(np.r_[own.count[0], steps, own.count[-1]], P, spread, rate),
    )


def _groups(linked: Array, size: int) -> tuple[Index, Index]:
    """First row and length of the groups that make up the rows 1 to n - 2."""
    n = len(linked)
    edges = [1, *(2 + np.flatnonzero(linked[2 : n - 1] == 0)), n - 1]
    start = np.concatenate([np.arange(a, b, size) for a, b in pairwise(edges)])
    return start, np.diff(np.r_[start, n - 1])


def _between(
    data: chain.Data, turn: Array, linked: Array, rows: Index, spread_s: Array
) -> tuple[Array, Array, Array, Array]:
    """From one state to the next: rotation vector, time, root of the sum of dt^2, if linked."""
    total = np.broadcast_to(np.eye(3), (len(rows) - 1, 3, 3))
    for j in range(int(np.diff(rows).max())):
        k = rows[:-1] + 1 + j
        inside = k <= rows[1:]
        total = total @ np.where(inside[:, None, None], turn[np.minimum(k, rows[-1])], np.eye(3))
    first = rows[:-1] + 1
    joins = np.minimum.reduceat(linked, first) > 0
    dt = np.add.reduceat(data.dt_s, first)
    spread = np.sqrt(np.add.reduceat(spread_s**2, first))
    return (
        np.vstack([np.zeros((1, 3)), so3.log(total)]),
        np.r_[dt[0], dt],
        np.r_[spread[0], spread],
        np.r_[True, joins],
    )


def _sums(turn: Array, own: chain.Averaging, middle: Index, start: Index, end: Index) -> Array:
    """Sum over the steps of each group of the rotations from its middle's frame to theirs."""
    P = own.turn * own.count[:, None, None]
    total = P[middle]
    ahead = behind = np.broadcast_to(np.eye(3), (len(middle), 3, 3))
    for j in range(1, int((end - start).max()) // 2 + 1):
        up, down = middle + j < end, middle - j >= start
        k, m = np.minimum(middle + j, len(turn) - 1), np.maximum(middle - j, 0)
        ahead = np.swapaxes(turn[k], 1, 2) @ ahead
        behind = turn[m + 1] @ behind
        total += np.where(up[:, None, None], P[k] @ ahead, 0.0)
        total += np.where(down[:, None, None], P[m] @ behind, 0.0)
    return total
