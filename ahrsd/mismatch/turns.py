"""Lost turns one by one: by how many steps more than its gyro says the sensor turned in each step.

That turns were lost is known (`missing.py`).  Jumps that stand out are put right, and what they hid
is looked for again: the filter takes long to forget one, and the next lies on its way back.

A lost step ahead of row k moves the field that the filter predicts by v = h x w dt from there on.
Carried by the gyro into one frame v stands still, so the mean over `L` rows from k on, less that
over the `L` before, is m v for m lost steps, with a deviation s that the differences show:

    nats(m) = m z - m^2 I / 2 - ln(1 / share) - 3,   z = v . jump / s^2,   I = |v|^2 / s^2

share: of the rows, that turns were lost before.  Quick turns show over few rows, slow ones over
many, where they are not so many that the next jump is among them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch.innovation import Filtered, run_filter
from ahrsd.samples import Array

_ROWS = (3, 6, 12, 24, 48)  # before and after a jump
_ROUNDS = 8
_SURE_NATS = 3.0  # beyond the share
_ENOUGH = 10  # times as many rows as are averaged: else their spread is not known
#: below which a quarter of a normal deviate's sizes are
QUARTER = 0.3186


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """lost (N,): how many steps were lost before each row;  shows (N,): where one would show."""

    lost: NDArray[np.int64]
    shows: NDArray[np.bool]


def recovered(done: Filtered, rate_b_rad_s: Array, lost: NDArray[np.int64]) -> Turns:
    """The lost steps put right in rounds, as long as that makes the recording likelier.

    rate_b_rad_s: (N, 3) without bias;  lost: (N,) what stood out at first
    """
    model, A = done.model, done.model.soft_iron
    clean = done.predicted_b @ A.T + done.innovation + model.hard_iron_gauss
    read = np.isfinite(done.track.mag_b_gauss).all(axis=1, keepdims=True)
    mag = np.where(read, clean, np.nan)
    best, most = Turns(lost, lost > 0), -np.inf
    for _ in range(_ROUNDS):
        gyro = model.gyro_bias_rad_s + rate_b_rad_s * (1 + lost)[:, None]
        track = replace(done.track, mag_b_gauss=mag, gyro_b_rad_s=gyro)
        seen = run_filter(track, model, sensitive=False)
        likelihood = float(np.sum(seen.log_likelihood[seen.used]))
        if likelihood < most:
            break
        found = _jumps(seen, rate_b_rad_s, max(int(lost.sum()), 1))
        best, most = Turns(lost, found.shows), likelihood
        picked = _peaks(found.nats, found.rows)
        if not len(picked):
            break
        lost = lost.copy()
        lost[picked] += found.steps[picked]
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """Of each row, by the number of rows about it that tells most; shows: one step would."""

    steps: NDArray[np.int64]
    nats: Array
    rows: NDArray[np.int64]
    shows: NDArray[np.bool]


def _jumps(done: Filtered, rate_b_rad_s: Array, count: int) -> _Jumps:
    """Jumps by whole steps.  count: how many steps are known to be lost."""
    dt = np.nan_to_num(done.track.dt_s, nan=0.0)[:, None]
    v = np.einsum("nij,nj->ni", done.orientation, np.cross(done.predicted_b, rate_b_rad_s * dt))
    left = done.innovation @ np.linalg.inv(done.model.soft_iron).T
    total = _summed(np.einsum("nij,nj->ni", done.orientation, left))
    usable = _summed(done.used.astype(np.float64))
    white = float(np.sqrt(np.median(done.gains.innovation_covariance[done.used, 0, 0])))
    n, least = len(v), float(np.log(len(v) / count)) + _SURE_NATS
    one = np.ones(n, dtype=np.int64)
    out = _Jumps(one, np.full(n, -np.inf), one.copy(), np.zeros(n, dtype=np.bool))
    for length in _ROWS:
        k = np.arange(length, n - length)
        k = k[usable[k + length] - usable[k - length] == 2 * length]
        if len(k) < _ENOUGH * length:
            break
        jump = (total[k + length] - 2 * total[k] + total[k - length]) / length
        s = float(np.quantile(np.abs(jump), 0.25)) / QUARTER
        s = max(s, white * float(np.sqrt(2.0 / length)))
        z, size = np.sum(jump * v[k], axis=1) / s**2, np.sum(v[k] ** 2, axis=1) / s**2
        steps = np.maximum(np.round(z / np.maximum(size, 1e-300)), 1.0)
        nats = steps * z - steps**2 * size / 2 - least
        better = nats > out.nats[k]
        at = k[better]
        out.nats[at], out.steps[at], out.rows[at] = nats[better], steps[better], length
        out.shows[k] |= size / 2 > least
    return out


def _summed(values: Array) -> Array:
    """Sums of the first 0, 1, ... N rows."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _peaks(nats: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows with more than 0 nats, of those nearer than their means reach the one with most."""
    out: list[int] = []
    candidates = np.flatnonzero(nats > 0)
    for k in candidates[np.argsort(-nats[candidates], kind="stable")].tolist():
        if all(abs(k - other) > 2 * rows[k] for other in out):
            out.append(k)
    return np.array(sorted(out), dtype=np.int64)
