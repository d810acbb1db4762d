"""Samples that are missing though the time stamps do not show it.

With a lost sample its turn is lost: the field is ahead of the prediction by whole multiples of one
step's turn, v = A (h x w) dt, at one sample and, since the filter forgets slowly, at the next ones.
Noise does that as often backwards as forwards, which tells how many of the jumps are chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.data_quality.turns import LONGER_NATS, QUARTER, Turns, recovered, some_lost
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

#: samples before and after a jump, and how many deviations of a mean a step's turn must have: over
#: more samples there are fewer jumps by chance
_AVERAGED = ((3, 7.0), (12, 5.0))
_NEAR = 0.3  # of a whole number
_FEWEST = 5
_SURE_NATS = 12.0  # by which they must be whole steps rather than noise: others have 160 and more
#: and that each must be in the mean: a gyro that reads 3 % too little is ahead all the time, and on
#: a path through a room 13 jumps had 2.4 each; lost turns have 3.8 and more
_EACH_NATS = 3.0
#: deviations of a mean that no noise jumps by, and the part of such a jump that is across the turn,
#: more than a lost one has
_CLEAR, _ACROSS = 8.0, 0.5
#: and those of a jump that many turns in a row were lost at, which nobody can count
_LONG = 30.0
#: entry of the setting: how many of these there are
LONG = "long"
#: entry of the setting where only all jumps together say that turns were lost: how many about
UNSEEN = "unseen"


def lost_turns(track: Track, model: NullModel) -> list[Fact]:
    """`missing_turns` of a recording at its own rate, with the calibration that it starts from."""
    done = run_filter(track, model, sensitive=False)
    return missing_turns(done, track.gyro_b_rad_s - model.gyro_bias_rad_s)


def missing_turns(done: Filtered, rate_b_rad_s: Array) -> list[Fact]:
    """Where the filter jumps by whole steps.  rate_b_rad_s (N, 3) without bias.

    Over few samples first, which tells the quick turns, then over more, which tells slower ones;
    and where too few stand out alone, all together.
    """
    track = done.track
    for samples, least in _AVERAGED:
        if len(track) < 10 * samples:
            break
        found = _jumps(done, rate_b_rad_s, samples, least)
        enough = len(found.forward) >= _FEWEST + 3 * len(found.backward) + found.others
        jumps = found.forward
        sure = max(_SURE_NATS, _EACH_NATS * len(jumps))
        if enough and whole_nats(found.steps[jumps], found.scatter[jumps]) > sure:
            lost = np.zeros(len(track), dtype=np.int64)
            lost[jumps] = np.round(found.steps[jumps])
            setting = {LONG: found.long} if found.long else {}
            return [_fact(track, recovered(done, rate_b_rad_s, lost), setting)]
    if expected := some_lost(done, rate_b_rad_s):
        turns = recovered(done, rate_b_rad_s, np.zeros(len(track), dtype=np.int64), expected)
        if np.count_nonzero(turns.lost) >= _FEWEST:
            return [_fact(track, turns, {UNSEEN: expected})]
    return []


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
    return rows * float(np.log(len(steps) / rows)) + longer * LONGER_NATS


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
    whole = np.abs(steps - np.round(steps)) < _NEAR
    forward = _peaks(tell & whole & (steps > 1 - _NEAR), steps, samples)
    far = np.linalg.norm(jump, axis=1)
    clear = complete & (far > _CLEAR * sigma)
    for k in forward.tolist():  # before and behind a jump its mean is not along the turn
        clear[max(0, k - 2 * samples) : k + 2 * samples] = False
    sudden = clear & (np.linalg.norm(behind, axis=1) < 0.5 * far)
    long = _peaks(sudden & (far > _LONG * sigma) & (steps > 1.0 + 2 * _NEAR), far, samples)
    # on its way back from a long one the filter makes many that no lost turn makes
    across = (sudden if len(long) else clear) & ((rest > _ACROSS * far) | (steps < 0))
    return _Jumps(
        steps,
        sigma / np.maximum(size, 1e-300),
        forward,
        _peaks(tell & whole & (steps < -1 + _NEAR), -steps, samples),
        len(_peaks(across, far, samples)),
        len(long),
    )


def whole_nats(steps: Array, scatter: Array) -> float:
    """Nats by which forward jumps (n,) of so much `scatter` are whole steps and no tail of noise.

    Whole steps lie about their number; of noise only the tail counts as a jump, most of it hardly.
    """
    whole = -0.5 * ((steps - np.round(steps)) / scatter) ** 2
    tail = -0.5 * (steps / scatter) ** 2 - log_ndtr(-(1 - _NEAR) / scatter)
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
        "dropped_samples", words, where, 0.98, parameters, told, turned=turned, unseen=missed
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
