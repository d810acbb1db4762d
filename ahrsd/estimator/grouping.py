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
from ahrsd.samples import Array

Index = NDArray[np.intp]
_LARGEST = 7
_TURN_RAD = 0.3  # of rotation in a group; 1 step in 20 may turn faster
_LOST = 0.03


def group_size(data: chain.Data, noise: chain.Noise, size_gauss: float) -> int:
    """How many steps may share a state: odd, 1 where the gyro is poor or the turn fast.

    noise: a guess, per step; size_gauss: of the field. The mean of k fields has the variance
    s_m^2 / k, and the gyro's noise adds k / 12 (size s_g dt)^2.
    """
    dt = float(np.median(data.dt_s[1:]))
    ratio = noise.mag_gauss / (size_gauss * noise.gyro_rad_s * dt)
    turn = float(np.percentile(np.linalg.norm(data.angle_b_rad[1:], axis=1), 95))
    most = min(ratio * np.sqrt(12 * _LOST), _TURN_RAD / max(turn, 1e-9), _LARGEST)
    return max(1, int(most) - 1 + int(most) % 2)


def grouped(data: chain.Data, size: int) -> chain.Data:
    """An epoch of single steps with `size` of them, an odd number, in a state."""
    n = len(data)
    if size == 1 or n < 4:
        return data
    linked = np.ones(n) if data.linked is None else data.linked
    start, length = _groups(linked, size)
    rows = np.r_[0, start + length // 2, n - 1]
    inner = (linked > 0) & (np.arange(n) > 0)
    turn = so3.exp(np.where(inner[:, None], data.angle_b_rad, 0.0))
    angle, dt, spread, joins = _between(data, turn, linked, rows)
    field = data.field_b_gauss.copy()[rows]
    field[1:-1] = np.add.reduceat(data.field_b_gauss[: n - 1], start) / length[:, None]
    rate = rates(data)
    mean_rate = rate[rows]
    mean_rate[1:-1] = np.add.reduceat(rate[: n - 1], start) / length[:, None]
    return chain.Data(
        field,
        angle,
        dt,
        data.down_b[rows],
        data.time_s[rows],
        data.measures_first,
        linked=None if joins.all() else joins.astype(np.float64),
        averaging=chain.Averaging(
            np.r_[1, length, 1].astype(float), _means(turn, rows, start, length), spread, mean_rate
        ),
    )


def _groups(linked: Array, size: int) -> tuple[Index, Index]:
    """First row and length of the groups that make up the rows 1 to n - 2."""
    n = len(linked)
    edges = [1, *(2 + np.flatnonzero(linked[2 : n - 1] == 0)), n - 1]
    start = np.concatenate([np.arange(a, b, size) for a, b in pairwise(edges)])
    return start, np.diff(np.r_[start, n - 1])


def _between(
    data: chain.Data, turn: Array, linked: Array, rows: Index
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
    spread = np.sqrt(np.add.reduceat(data.dt_s**2, first))
    return (
        np.vstack([np.zeros((1, 3)), so3.log(total)]),
        np.r_[dt[0], dt],
        np.r_[spread[0], spread],
        np.r_[True, joins],
    )


def _means(turn: Array, rows: Index, start: Index, length: Index) -> Array:
    """Mean over each group of the rotations from its middle's sensor frame to its steps'."""
    P = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    middle, end = rows[1:-1], start + length
    ahead = behind = np.broadcast_to(np.eye(3), (len(middle), 3, 3))
    for j in range(1, int(length.max()) // 2 + 1):
        up, down = middle + j < end, middle - j >= start
        ahead = np.swapaxes(turn[np.minimum(middle + j, len(turn) - 1)], 1, 2) @ ahead
        behind = turn[np.maximum(middle - j + 1, 0)] @ behind
        P[1:-1] += np.where(up[:, None, None], ahead, 0.0) + np.where(
            down[:, None, None], behind, 0.0
        )
    P[1:-1] /= length[:, None, None]
    return P
