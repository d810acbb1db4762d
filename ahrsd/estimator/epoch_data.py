"""What is done with an epoch's data before they are linearised.

Did it turn the sensor? Its fields are shifted by the magnetometer's lag, its steps grouped where
several may share a state; for a search it is thinned, and joined to others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.chain import Index
from ahrsd.samples import Array

# -- Whether an epoch turned the sensor ------------------------------------------------------------
#
# Whether an epoch turned the sensor: one that did not says nothing about the iron.
#
# A field that changes while the sensor rests (a lift, a magnet, drift) would be taken for a strange
# calibration. So both sensors must have seen a rotation. How much of a steady rate is the gyro's
# bias is not known well: where the field swept far, any turn that the gyro saw will do.

_SWEPT = 0.10  # spread of the field over its size: a turn, if the gyro saw any
_SEEN = 0.3  # spread of the integrated rate, less the bias as known, over that: it saw any
_STIRRED = 0.004  # the same, if the gyro saw the turn
_TURNED_RAD = 0.002  # spread of the integrated rate less its mean
_SMOOTHED = 16  # steps


def spread(field: Array) -> float:
    """Standard deviation of (N, 3) along the direction in which it varied most."""
    away = field - field.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(away.T @ away)[-1] / (len(field) - 1)))


def turned(data: chain.EpochData, bias_rad_s: Array) -> bool:
    """True where the epoch is worth a factor on the calibration; bias (3,) of the gyro as known."""
    count = len(data) // _SMOOTHED
    field = data.field_b_gauss[: count * _SMOOTHED].reshape(count, _SMOOTHED, 3).mean(axis=1)
    relative = spread(field) / float(np.median(np.linalg.norm(data.field_b_gauss, axis=1)))
    angle = data.angle_b_rad[1:]
    path = np.cumsum(angle - bias_rad_s * data.dt_s[1:, None], axis=0)
    if relative > _SWEPT and spread(path) > _SEEN * relative:
        return True
    unsteady = np.cumsum(angle - angle.mean(axis=0), axis=0)
    return relative > _STIRRED and spread(unsteady) > _TURNED_RAD


# -- A lag of the magnetometer ---------------------------------------------------------------------
#
# A magnetometer that is late against the gyro: a reading at t is of the direction at t - tau.
#
# Filters, buses and interrupts make it so in every real system, and a lag of tau at a rate w looks
# like a field that is turned by w tau. It is taken out where the field is seen: the row measured
# M Exp(w tau) u + b. The gyro's readings stay as they are, so nothing is smoothed and no noise is
# mixed. For tau of a few steps at most: w is the mean rate of the row's steps.


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


# -- Steps in groups -------------------------------------------------------------------------------
#
# Several steps in one state of the chain: the same information at a fraction of the cost.
#
# Where the gyro carries the direction over a few steps much better than the magnetometer sees it,
# the steps of a group need no states of their own: their fields, turned by the gyro into the
# group's middle, are averaged. The mean of M u_j + b over the group is M P u + b exactly, with P
# the mean of the rotations from the middle to each step, so a turning sensor loses nothing either.
# Groups never span a gap; the first and the last row of an epoch stay by themselves, because its
# neighbours share them.
#
# What is lost is the gyro's noise inside a group (its variance adds _LOST of the field's) and the
# field's differences inside it, which matter only if the sensor turned much (_TURN_RAD).

_LARGEST = 7
_TURN_RAD, _OFTEN = 0.3, 0.95  # of rotation in a group; share of the steps that may not turn faster
_LOST = 0.03
_FEWEST = 3  # rows that are never grouped


def group_size(data: chain.EpochData, noise: chain.Noise, size_gauss: float) -> int:
    """How many steps may share a state: odd, 1 where the gyro is poor or the turn fast.

    noise: a guess, per step; size_gauss: of the field. The mean of k fields has the variance
    s_m^2 / k, and the gyro's noise adds k / 12 (size s_g dt)^2.
    """
    dt = float(np.median(data.dt_s[1:]))
    ratio = noise.mag_gauss / (size_gauss * noise.gyro_rad_s * dt)
    turns = np.sqrt(np.sum(data.angle_b_rad[1:] ** 2, axis=1))
    fast = int(np.ceil(_OFTEN * (len(turns) - 1)))
    turn = float(np.partition(turns, fast)[fast])
    most = min(ratio * np.sqrt(12 * _LOST), _TURN_RAD / max(turn, 1e-9), _LARGEST)
    return max(1, int(most) - 1 + int(most) % 2)


def grouped(epochs: Sequence[chain.EpochData], sizes: Sequence[int]) -> list[chain.EpochData]:
    """Epochs of single steps with as many of them in a state, odd numbers; all at once."""
    out = list(epochs)
    which = [k for k, size in enumerate(sizes) if size > 1 and len(epochs[k]) > _FEWEST]
    if which:
        few = _grouped([epochs[k] for k in which], [sizes[k] for k in which])
        for k, data in zip(which, few, strict=True):
            out[k] = data
    return out


def _grouped(epochs: Sequence[chain.EpochData], sizes: Sequence[int]) -> list[chain.EpochData]:
    lengths = np.array([len(d) for d in epochs])
    first = np.cumsum(lengths) - lengths
    linked = [np.ones(len(d)) if d.linked is None else d.linked for d in epochs]
    edges = [_edges(own, size) for own, size in zip(linked, sizes, strict=True)]
    ends = np.cumsum([len(e) for e in edges])
    links = np.concatenate(linked)
    links[first] = 0.0
    edge = np.concatenate([e + at for e, at in zip(edges, first, strict=True)])
    count = np.diff(np.r_[edge, len(links)])
    rows = edge + count // 2
    turn = so3.exp(
        np.where(links[:, None] > 0, np.concatenate([d.angle_b_rad for d in epochs]), 0.0)
    )
    step = np.concatenate([d.dt_s for d in epochs])
    angle, dt, spread, joins = _between(step, turn, links, rows)
    field, rate, P = (
        np.add.reduceat(np.concatenate([d.field_b_gauss for d in epochs]), edge) / count[:, None],
        np.add.reduceat(np.concatenate([rates(d) for d in epochs]), edge) / count[:, None],
        _means(turn, rows, edge, count),
    )
    out = []
    for data, own, end, at in zip(epochs, edges, ends, first, strict=True):
        piece, own_rows = slice(end - len(own), end), rows[end - len(own) : end] - at
        own_dt, own_spread, own_joins = dt[piece].copy(), spread[piece].copy(), joins[piece].copy()
        own_dt[0], own_spread[0], own_joins[0] = own_dt[1], own_spread[1], 1.0
        averaging = chain.Averaging(
            count[piece].astype(float), P[piece].copy(), own_spread, rate[piece].copy()
        )
        out.append(
            chain.EpochData(
                field[piece].copy(),
                angle[piece].copy(),
                own_dt,
                data.down_b[own_rows],
                data.time_s[own_rows],
                data.measures_first,
                linked=None if own_joins.all() else own_joins,
                averaging=averaging,
            )
        )
    return out


def _edges(linked: Array, size: int) -> Index:
    """First row of each group of an epoch; its first and last row are groups by themselves."""
    n = len(linked)
    cuts = [1, *(2 + np.flatnonzero(linked[2 : n - 1] == 0)), n - 1]
    return np.concatenate([[0], *(np.arange(a, b, size) for a, b in pairwise(cuts)), [n - 1]])


def _between(
    step_s: Array, turn: Array, linked: Array, rows: Index
) -> tuple[Array, Array, Array, Array]:
    """To each state from the one before: rotation vector, time, root of the sum of squared steps
    of time, 1 if linked else 0; of the first state only the shapes.
    """
    before = np.r_[rows[0], rows[:-1]]
    total = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    for j in range(1, int((rows - before).max()) + 1):
        k = before + j
        total = total @ np.where((k <= rows)[:, None, None], turn[np.minimum(k, rows)], np.eye(3))
    first = np.r_[rows[0], rows[:-1] + 1]
    return (
        so3.log(total),
        np.asarray(np.add.reduceat(step_s, first)),
        np.sqrt(np.add.reduceat(step_s**2, first)),
        np.minimum.reduceat(linked, first),
    )


def _means(turn: Array, rows: Index, start: Index, length: Index) -> Array:
    """Mean over each group of the rotations from its middle's sensor frame to its steps'."""
    P = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    end = start + length
    ahead = behind = np.broadcast_to(np.eye(3), P.shape)
    for j in range(1, int(length.max()) // 2 + 1):
        up, down = rows + j < end, rows - j >= start
        ahead = np.swapaxes(turn[np.minimum(rows + j, len(turn) - 1)], 1, 2) @ ahead
        behind = turn[np.maximum(rows - j + 1, 0)] @ behind
        P += np.where(up[:, None, None], ahead, 0.0) + np.where(down[:, None, None], behind, 0.0)
    P /= length[:, None, None]
    return P


# -- Parts of a window for a search ----------------------------------------------------------------


def thinned(data: chain.EpochData, k: int) -> chain.EpochData:
    """Every k-th row of an epoch, by itself."""
    if k == 1:
        return data
    count = (len(data) - 1) // k
    rows = np.arange(count + 1) * k
    linked = None
    if data.linked is not None:
        linked = np.r_[1.0, data.linked[1 : count * k + 1].reshape(count, k).min(axis=1)]
    angle = np.zeros((count + 1, 3))
    angle[1:] = so3.compose(data.angle_b_rad[1 : count * k + 1].reshape(count, k, 3))
    dt = np.r_[data.dt_s[1], data.dt_s[1 : count * k + 1].reshape(count, k).sum(axis=1)]
    averaging = data.averaging
    if averaging is not None:
        averaging = chain.Averaging(
            averaging.count[rows], averaging.turn[rows], dt, averaging.rate_b_rad_s[rows]
        )
    return chain.EpochData(
        data.field_b_gauss[rows],
        angle,
        dt,
        data.down_b[rows],
        data.time_s[rows],
        measures_first=True,
        linked=linked,
        averaging=averaging,
    )


def joined(parts: Sequence[chain.EpochData]) -> chain.EpochData:
    """Epochs as one chain that is cut between them; each measures its first field."""
    ones = [np.ones(len(p)) for p in parts]
    linked = [
        np.r_[0.0, (o if p.linked is None else p.linked)[1:]]
        for p, o in zip(parts, ones, strict=True)
    ]
    averaging = None
    if any(p.averaging is not None for p in parts):
        all_ = [
            p.averaging or chain.Averaging(o, np.tile(np.eye(3), (len(p), 1, 1)), p.dt_s, rates(p))
            for p, o in zip(parts, ones, strict=True)
        ]
        averaging = chain.Averaging(
            np.concatenate([a.count for a in all_]),
            np.concatenate([a.turn for a in all_]),
            np.concatenate([a.spread_s for a in all_]),
            np.concatenate([a.rate_b_rad_s for a in all_]),
        )
    return chain.EpochData(
        np.vstack([p.field_b_gauss for p in parts]),
        np.vstack([p.angle_b_rad for p in parts]),
        np.concatenate([p.dt_s for p in parts]),
        np.vstack([p.down_b for p in parts]),
        np.concatenate([p.time_s for p in parts]),
        measures_first=True,
        linked=np.concatenate(linked),
        averaging=averaging,
    )
