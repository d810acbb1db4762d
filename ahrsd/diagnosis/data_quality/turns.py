"""Lost turns one by one: by how many steps more than its gyro says the sensor turned in each step.

That turns were lost is known (`missing.py`).  Jumps that stand out are put right, and what they hid
is looked for again: the filter takes long to forget one, and the next lies on its way back.  A jump
back by one step, beside one that was put right, takes that back: it was counted twice.

A lost step ahead of row k moves the field that the filter predicts by v = h x w dt from there on.
Carried by the gyro into one frame v stands still, so the mean over `L` rows from k on, less that
over the `L` before, is m v for m lost steps, with a deviation s that the differences show:

    nats(m) = m z - m^2 I / 2 - ln(1 / share) - 3 - (m - 1) ln 4,   z = v . jump / s^2,
                                                                    I = |v|^2 / s^2

share: of the rows, that turns were lost before; one in four such gaps is longer by one more.  Quick
turns show over few rows, slow ones over many, where they are not so many that the next jump is
among them.

Where none stands out they still may be there: of all rows the share p has a jump by one step,

    nats(p) = 1/L sum log(1 - p + p exp(z - I / 2)),

and of noise or a field that changes those by minus one step have as much, or those by much more or
less than one.  A gyro that reads too little has z = e I in all rows: that is taken out before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.samples import Array

_ROWS = (3, 6, 12, 24, 48)  # before and after a jump
_ROUNDS = 20
_SURE_NATS = 3.0  # beyond the share
_ENOUGH = 10  # times as many rows as are averaged: else their spread is not known
LONGER_NATS = float(np.log(4.0))  # what each further step of a gap costs
_SHARES = (0.01, 0.03, 0.1)  # of the rows, that a jump is so near that its mean is in it
_ACROSS = 12.0  # chi square that one in 400 is beyond
_BESIDE = 0.25  # of a mean's rows: so near to its jump is the step that made it
_TWICE_NATS = 6.0  # that a step counts twice: one in twenty does, and must be surer than chance
_EACH = 6.0  # nats that one jump is worth at most: several must say it, not a field that jumps once
_PART, _OTHERS = 0.7, (0.3, 1.4)  # of a step, in the mean over the rows that have a part of it
#: nats by which that must be, less so many times those backward: 3.5 is the most of 370 recordings
#: with none lost
_MANY_NATS, _BACKWARD = 12.0, 3.0
#: below which a quarter of a normal deviate's sizes are
QUARTER = 0.3186


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """lost (N,): how many steps were lost before each row;  missed (N,): how likely one is missed.

    A step that is lost has I / 2 nats in the mean, with a deviation of sqrt(I): below the share's
    own nats it is missed.
    """

    lost: NDArray[np.int64]
    missed: Array


def recovered(
    done: Filtered, rate_b_rad_s: Array, lost: NDArray[np.int64], expected: float = 1.0
) -> Turns:
    """The lost steps put right in rounds, as long as that makes the recording likelier.

    rate_b_rad_s: (N, 3) without bias;  lost: (N,) what stood out at first
    expected: how many there are, if all together say so (`some_lost`)
    """
    model, A = done.model, done.model.soft_iron
    clean = done.predicted_b @ A.T + done.innovation + model.hard_iron_gauss
    read = np.isfinite(done.track.mag_b_gauss).all(axis=1, keepdims=True)
    mag = np.where(read, clean, np.nan)
    best, most = Turns(lost, np.where(lost > 0, 0.0, 1.0)), -np.inf
    found, picked = None, np.zeros(0, dtype=np.int64)
    for _ in range(_ROUNDS):
        gyro = model.gyro_bias_rad_s + rate_b_rad_s * (1 + lost)[:, None]
        track = replace(done.track, mag_b_gauss=mag, gyro_b_rad_s=gyro)
        seen = run_filter(track, model, sensitive=False)
        likelihood = float(np.sum(seen.log_likelihood[seen.used]))
        if likelihood > most:
            found = _jumps(seen, rate_b_rad_s, max(float(lost.sum()), expected), lost)
            best, most = Turns(lost, found.missed), likelihood
            picked = _peaks(found.nats, found.rows)
        else:  # some of them were none: half of them, the surer ones
            picked = picked[: len(picked) // 2]
        if found is None or not len(picked):
            break
        lost = _put_right(best.lost, found, picked)
    return best


def _put_right(
    lost: NDArray[np.int64], found: _Jumps, picked: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The lost steps with those of the picked rows; one back is taken from the nearest.

    Two jumps back may be near the same one: it is taken back once.
    """
    now = lost.copy()
    for row in picked.tolist():
        now[row if found.steps[row] > 0 else _nearest(lost, row)] += found.steps[row]
    return np.maximum(now, 0)


def _about(lost: NDArray[np.int64], reach: int) -> NDArray[np.bool]:
    """(N,) rows with a lost step so near."""
    ends = np.concatenate([np.zeros(reach + 1, np.int64), np.cumsum(lost > 0)])
    last = np.minimum(np.arange(len(lost)) + 2 * reach + 1, len(ends) - 1)
    return np.asarray(ends[last] > ends[: len(lost)])


def _nearest(lost: NDArray[np.int64], row: int) -> int:
    """The row with a lost step that is nearest to this one."""
    rows = np.flatnonzero(lost)
    return int(rows[np.argmin(np.abs(rows - row))])


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """Of each row, by the number of rows about it that tells most; missed: as in `Turns`."""

    steps: NDArray[np.int64]
    nats: Array
    rows: NDArray[np.int64]
    missed: Array


@dataclass(frozen=True, slots=True, eq=False)
class Means:
    """What means over `length` rows say: of rows k (n,) z (n,) and I (n,) of one step.

    across (n,): chi square, of two axes, of the jump's part that no turn makes
    """

    length: int
    k: NDArray[np.int64]
    z: Array
    size: Array
    across: Array


def _means(done: Filtered, rate_b_rad_s: Array) -> Iterator[Means]:
    if not done.used.any():  # no reading was used: then nothing jumps
        return
    dt = np.nan_to_num(done.track.dt_s, nan=0.0)[:, None]
    v = np.einsum("nij,nj->ni", done.orientation, np.cross(done.predicted_b, rate_b_rad_s * dt))
    left = done.innovation @ np.linalg.inv(done.model.soft_iron).T
    total = _summed(np.einsum("nij,nj->ni", done.orientation, left))
    usable = _summed(done.used.astype(np.float64))
    white = float(np.sqrt(np.median(done.gains.innovation_covariance[done.used, 0, 0])))
    for length in _ROWS:
        k = np.arange(length, len(v) - length)
        k = k[usable[k + length] - usable[k - length] == 2 * length]
        if len(k) < _ENOUGH * length:
            break
        jump = (total[k + length] - 2 * total[k] + total[k - length]) / length
        s = float(np.quantile(np.abs(jump), 0.25)) / QUARTER
        s = max(s, white * float(np.sqrt(2.0 / length)))
        z, size = np.sum(jump * v[k], axis=1) / s**2, np.sum(v[k] ** 2, axis=1) / s**2
        along = z**2 / np.maximum(size, 1e-300)
        yield Means(length, k, z, size, np.sum(jump**2, axis=1) / s**2 - along)


def some_lost(done: Filtered, rate_b_rad_s: Array) -> float:
    """How many turns all jumps together say are lost, though none may stand out alone; or 0."""
    told = [surplus(mean) for mean in _means(done, rate_b_rad_s)]
    nats, count = max(told, default=(0.0, 0.0))
    return count if nats > _MANY_NATS else 0.0


def surplus(mean: Means) -> tuple[float, float]:
    """Nats of jumps by one step ahead, beyond backward ones, and how many there are about.

    No nats where jumps of another size are likelier.  The mean is over rows near a jump, and most
    have only a part of it in them.
    """
    tells = mean.size > 1.0
    scale = float(np.median(mean.z[tells] / mean.size[tells])) if tells.any() else 0.0
    like = mean.across < _ACROSS
    z, size = mean.z[like] - scale * mean.size[like], mean.size[like]

    def nats(step: float) -> tuple[float, float]:
        odds = np.exp(np.minimum(step * z - step**2 * size / 2, _EACH)) - 1.0
        told = [(float(np.sum(np.log1p(share * odds))), share) for share in _SHARES]
        total, share = max(told)
        return total / mean.length, share * len(z) / mean.length

    forward, count = nats(_PART)
    if forward < _MANY_NATS or forward < max(nats(step)[0] for step in _OTHERS):
        return 0.0, 0.0
    return forward - _BACKWARD * max(nats(-_PART)[0], 0.0), count


def _jumps(done: Filtered, rate_b_rad_s: Array, count: float, lost: NDArray[np.int64]) -> _Jumps:
    """Jumps by whole steps, and by one step back near those that were put right, `lost`.

    count: how many steps are known to be lost
    """
    n = len(done.track)
    least = float(np.log(n / count)) + _SURE_NATS
    one = np.ones(n, dtype=np.int64)
    out = _Jumps(one, np.full(n, -np.inf), one.copy(), np.ones(n))
    for mean in _means(done, rate_b_rad_s):
        z, size = mean.z, mean.size
        steps = np.maximum(np.round((z - LONGER_NATS) / np.maximum(size, 1e-300)), 1.0)
        nats = steps * z - steps**2 * size / 2 - least - LONGER_NATS * (steps - 1)
        about = _about(lost, 1 + int(_BESIDE * mean.length))
        back = np.where(about[mean.k], -z - size / 2 - _TWICE_NATS, -np.inf)
        steps, nats = np.where(back > nats, -1, steps), np.maximum(nats, back)
        better = nats > out.nats[mean.k]
        at = mean.k[better]
        out.nats[at], out.steps[at], out.rows[at] = nats[better], steps[better], mean.length
        missed = ndtr((least - size / 2) / np.sqrt(np.maximum(size, 1e-12)))
        out.missed[mean.k] = np.minimum(out.missed[mean.k], missed)
    return out


def _summed(values: Array) -> Array:
    """Sums of the first 0, 1, ... N rows."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _peaks(nats: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows with more than 0 nats, of those nearer than their means reach the one with most.

    The surest first.
    """
    out: list[int] = []
    candidates = np.flatnonzero(nats > 0)
    for k in candidates[np.argsort(-nats[candidates], kind="stable")].tolist():
        if all(abs(k - other) > 2 * rows[k] for other in out):
            out.append(k)
    return np.array(out, dtype=np.int64)
