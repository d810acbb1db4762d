"""Samples that are missing though the time stamps do not show it.

With a lost sample its turn is lost: the field is ahead of the prediction by whole multiples of one
step's turn, v = A (h x w) dt, at one sample and, since the filter forgets slowly, at the next ones.
Noise does that as often backwards as forwards, which tells how many of the jumps are chance.

Lost turns are put right one by one (`recovered`): by how many steps more than its gyro says the
sensor turned in each step.  Jumps that stand out are put right, and what they hid
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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

#: entry of the setting: how many of these there are
LONG = "long"
#: entry of the setting where only all jumps together say that turns were lost: how many about
UNSEEN = "unseen"
_ROWS = (3, 6, 12, 24, 48)  # before and after a jump
_ROUNDS = 20
_SHARES = (0.01, 0.03, 0.1)  # of the rows, that a jump is so near that its mean is in it
_BESIDE = 0.25  # of a mean's rows: so near to its jump is the step that made it
#: below which a quarter of a normal deviate's sizes are
QUARTER = 0.3186


def lost_turns(track: Track, model: NullModel) -> list[Fact]:
    """`missing_turns` of a recording at its own rate, with the calibration that it starts from."""
    done = run_filter(track, model, with_sensitivities=False)
    return missing_turns(done, track.gyro_b_rad_s - model.gyro_bias_rad_s)


def missing_turns(done: Filtered, rate_b_rad_s: Array) -> list[Fact]:
    """Where the filter jumps by whole steps.  rate_b_rad_s (N, 3) without bias.

    Over few samples first, which tells the quick turns, then over more, which tells slower ones;
    and where all jumps together say that less than half of them stand out alone, all together.
    """
    track, none = done.track, np.zeros(len(done.track), dtype=np.int64)
    found = _standing_out(done, rate_b_rad_s)
    expected = some_lost(done, rate_b_rad_s)
    if found is not None and 2 * len(found.forward) >= expected:
        lost = none.copy()
        lost[found.forward] = np.round(found.steps[found.forward])
        setting = {LONG: found.long} if found.long else {}
        return [_fact(track, recovered(done, rate_b_rad_s, lost), setting)]
    if expected:
        turns = recovered(done, rate_b_rad_s, none, expected)
        if np.count_nonzero(turns.lost) >= priors.LOST_TURNS_FEWEST:
            return [_fact(track, turns, {UNSEEN: expected})]
    return []


def _standing_out(done: Filtered, rate_b_rad_s: Array) -> _Jumps | None:
    """Jumps by whole steps that are no noise, over few samples or more; None where none are."""
    for samples, least in priors.LOST_TURN_AVERAGED:
        if len(done.track) < 10 * samples:
            break
        found = _jumps(done, rate_b_rad_s, samples, least)
        jumps = found.forward
        fewest = priors.LOST_TURNS_FEWEST + 3 * len(found.backward) + found.others
        sure = max(priors.LOST_TURNS_NATS, priors.LOST_TURN_EACH_NATS * len(jumps))
        nats = whole_nats(found.steps[jumps], found.scatter[jumps])
        if len(jumps) >= fewest and nats > sure:
            return found
    return None


def differ(lost: Sequence[Fact], beside: Sequence[Fact]) -> bool:
    """Whether the two searches put other turns right."""
    first, then = (
        [fact.turned for fact in facts if fact.turned is not None] for facts in (lost, beside)
    )
    pairs = zip(first, then, strict=False)
    return len(first) != len(then) or not all(np.array_equal(a, b) for a, b in pairs)


def price(facts: Sequence[Fact]) -> float:
    """Nats that lost turns cost: which rows of all they are, and each further step of a gap."""
    turned = [fact.turned for fact in facts if fact.turned is not None]
    steps = np.round(np.concatenate([np.empty(0), *turned]) - 1.0)
    rows = int(np.count_nonzero(steps > 0))
    if not rows:
        return 0.0
    longer = float(np.sum(steps[steps > 0] - 1.0))
    return rows * float(np.log(len(steps) / rows)) + longer * priors.LONGER_GAP_NATS


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """steps (N,) by which the field is ahead;  rows of jumps.

    scatter (N,): deviation of `steps` that noise makes
    others: how many jumps there are that no lost turn makes
    long: how many are far beyond noise and ahead: beside lost turns, where a second or so was lost
    """

    steps: Array
    scatter: Array
    forward: NDArray[np.intp]
    backward: NDArray[np.intp]
    others: int
    long: int


def _jumps(done: Filtered, rate_b_rad_s: Array, samples: int, least: float) -> _Jumps:
    dt = np.nan_to_num(done.track.dt_s, nan=0.0)[:, None]
    v = np.cross(done.predicted_b, rate_b_rad_s * dt) @ done.model.soft_iron
    size = np.linalg.norm(v, axis=1)
    ahead = np.zeros_like(v)
    behind = np.zeros_like(v)
    stop = len(v) - samples
    total = np.concatenate([[0], np.cumsum(done.used)])
    complete = np.zeros(len(v), dtype=bool)
    complete[samples:stop] = total[2 * samples : -1] - total[: -2 * samples - 1] == 2 * samples
    for k in range(samples):
        ahead[:stop] += done.innovation[k : stop + k] / samples
        behind[samples:] += done.innovation[samples - 1 - k : len(v) - 1 - k] / samples
    jump = ahead - behind
    sigma = _scatter(done, jump[complete], samples)
    steps = np.sum(jump * v, axis=1) / np.maximum(size**2, 1e-300)
    rest = np.linalg.norm(jump - steps[:, None] * v, axis=1)
    fresh = np.sum(behind * v, axis=1) < 0.5 * size**2
    tell = (size > least * sigma) & (rest < 5 * sigma) & complete & fresh
    whole = np.abs(steps - np.round(steps)) < priors.LOST_TURN_NEAR
    forward = _peaks(tell & whole & (steps > 1 - priors.LOST_TURN_NEAR), steps, samples)
    far = np.linalg.norm(jump, axis=1)
    clear = complete & (far > priors.JUMP_CLEAR * sigma)
    for k in forward.tolist():  # before and behind a jump its mean is not along the turn
        clear[max(0, k - 2 * samples) : k + 2 * samples] = False
    sudden = clear & (np.linalg.norm(behind, axis=1) < 0.5 * far)
    long = _peaks(
        sudden & (far > priors.JUMP_LONG * sigma) & (steps > 1.0 + 2 * priors.LOST_TURN_NEAR),
        far,
        samples,
    )
    # on its way back from a long one the filter makes many that no lost turn makes
    across = (sudden if len(long) else clear) & ((rest > priors.JUMP_ACROSS * far) | (steps < 0))
    return _Jumps(
        steps,
        sigma / np.maximum(size, 1e-300),
        forward,
        _peaks(tell & whole & (steps < -1 + priors.LOST_TURN_NEAR), -steps, samples),
        len(_peaks(across, far, samples)),
        len(long),
    )


def whole_nats(steps: Array, scatter: Array) -> float:
    """Nats by which forward jumps (n,) of so much `scatter` are whole steps and no tail of noise.

    Whole steps lie about their number; of noise only the tail counts as a jump, most of it hardly.
    """
    whole = -0.5 * ((steps - np.round(steps)) / scatter) ** 2
    tail = -0.5 * (steps / scatter) ** 2 - log_ndtr(-(1 - priors.LOST_TURN_NEAR) / scatter)
    return float(np.sum(whole - tail))


def _scatter(done: Filtered, jump: Array, samples: int) -> float:
    """Deviation of a mean of so many samples: the filter's, or what the jumps show if it is more.

    Slow noise jumps by more than white noise does.  The smallest quarter of the jumps is noise.
    """
    white = float(np.sqrt(np.median(done.gains.innovation_covariance[:, 0, 0]) / samples))
    if not len(jump):
        return white
    lowest = float(np.quantile(np.abs(jump), 0.25)) / QUARTER
    return max(white, lowest / float(np.sqrt(2.0)))


def _fact(track: Track, turns: Turns, setting: Mapping[str, float]) -> Fact:
    """The lost samples; where one may have been missed the turn is put right on average."""
    rows = np.flatnonzero(turns.lost)
    per_row = float(turns.lost.sum()) / max(float(np.sum(1.0 - turns.missed)), len(rows))
    share = per_row / (per_row + 1.0)
    missed = np.where(turns.lost > 0, 0.0, per_row * turns.missed)
    turned = np.asarray(1.0 + turns.lost + missed, np.float64)
    times = tuple((float(track.time_s[k - 1]), float(track.time_s[k])) for k in rows)
    words = (
        f"at {counted(len(rows), 'sample')} the field is ahead by whole steps of the "
        "turn: samples are missing that the time stamps do not show"
    )
    if UNSEEN in setting:
        words += "; most are known by all jumps together, and not one by one"
    where = Where(times, ("x", "y", "z"), "link")
    parameters = (Value("part", share, share / float(np.sqrt(len(rows))), "1"),)
    told = {"hidden": True, **setting}
    return Fact(
        "dropped_samples",
        words,
        where,
        priors.SURE_OF_NOISE,
        parameters,
        told,
        turned=turned,
        unseen=missed,
    )


def _peaks(rows: NDArray[np.bool], size: Array, samples: int) -> NDArray[np.intp]:
    """Of rows closer than the averaging the one that is largest."""
    out: list[int] = []
    for k in np.flatnonzero(rows).tolist():
        if out and k - out[-1] < 2 * samples:
            if size[k] > size[out[-1]]:
                out[-1] = k
        else:
            out.append(k)
    return np.array(out, dtype=np.intp)


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
        seen = run_filter(track, model, with_sensitivities=False)
        likelihood = float(np.sum(seen.log_likelihood[seen.used]))
        if likelihood > most:
            found = _jumps_of_rows(seen, rate_b_rad_s, max(float(lost.sum()), expected), lost)
            best, most = Turns(lost, found.missed), likelihood
            picked = _surest_rows(found.nats, found.rows)
        else:  # some of them were none: half of them, the surer ones
            picked = picked[: len(picked) // 2]
        if found is None or not len(picked):
            break
        lost = _put_right(best.lost, found, picked)
    return best


def _put_right(
    lost: NDArray[np.int64], found: _JumpsOfRows, picked: NDArray[np.int64]
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
class _JumpsOfRows:
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
        if len(k) < priors.LOST_TURN_ROWS * length:
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
    return count if nats > priors.LOST_TURNS_TOGETHER_NATS else 0.0


def surplus(mean: Means) -> tuple[float, float]:
    """Nats of jumps by one step ahead, beyond backward ones, and how many there are about.

    No nats where jumps of another size are likelier.  The mean is over rows near a jump, and most
    have only a part of it in them.
    """
    tells = mean.size > 1.0
    scale = float(np.median(mean.z[tells] / mean.size[tells])) if tells.any() else 0.0
    like = mean.across < priors.JUMP_ACROSS_CHI2
    z, size = mean.z[like] - scale * mean.size[like], mean.size[like]

    def nats(step: float) -> tuple[float, float]:
        odds = np.exp(np.minimum(step * z - step**2 * size / 2, priors.JUMP_MOST_NATS)) - 1.0
        told = [(float(np.sum(np.log1p(share * odds))), share) for share in _SHARES]
        total, share = max(told)
        return total / mean.length, share * len(z) / mean.length

    forward, count = nats(priors.LOST_TURN_PART)
    if forward < priors.LOST_TURNS_TOGETHER_NATS or forward < max(
        nats(step)[0] for step in priors.OTHER_PARTS
    ):
        return 0.0, 0.0
    return forward - priors.LOST_TURNS_BACKWARD * max(nats(-priors.LOST_TURN_PART)[0], 0.0), count


def _jumps_of_rows(
    done: Filtered, rate_b_rad_s: Array, count: float, lost: NDArray[np.int64]
) -> _JumpsOfRows:
    """Jumps by whole steps, and by one step back near those that were put right, `lost`.

    count: how many steps are known to be lost
    """
    n = len(done.track)
    least = float(np.log(n / count)) + priors.LOST_TURN_BEYOND_SHARE_NATS
    one = np.ones(n, dtype=np.int64)
    out = _JumpsOfRows(one, np.full(n, -np.inf), one.copy(), np.ones(n))
    for mean in _means(done, rate_b_rad_s):
        z, size = mean.z, mean.size
        steps = np.maximum(np.round((z - priors.LONGER_GAP_NATS) / np.maximum(size, 1e-300)), 1.0)
        nats = steps * z - steps**2 * size / 2 - least - priors.LONGER_GAP_NATS * (steps - 1)
        about = _about(lost, 1 + int(_BESIDE * mean.length))
        back = np.where(about[mean.k], -z - size / 2 - priors.COUNTED_TWICE_NATS, -np.inf)
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


def _surest_rows(nats: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows with more than 0 nats, of those nearer than their means reach the one with most.

    The surest first.
    """
    out: list[int] = []
    candidates = np.flatnonzero(nats > 0)
    for k in candidates[np.argsort(-nats[candidates], kind="stable")].tolist():
        if all(abs(k - other) > 2 * rows[k] for other in out):
            out.append(k)
    return np.array(out, dtype=np.int64)
