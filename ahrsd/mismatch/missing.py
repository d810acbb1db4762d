"""Samples that are missing though the time stamps do not show it.

With a lost sample its turn is lost: the field is ahead of the prediction by whole multiples of one
step's turn, v = A (h x w) dt, at one sample and, since the filter forgets slowly, at the next ones.
Noise does that as often backwards as forwards, which tells how many of the jumps are chance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch.diagnosis import Value, Where
from ahrsd.mismatch.facts import Fact
from ahrsd.mismatch.innovation import Filtered, run_filter
from ahrsd.mismatch.problem import Problem
from ahrsd.samples import Array

_MEAN = 3  # samples after the jump that are averaged
_SEEN = 5.0  # deviations of a step's turn that can be told
_NEAR = 0.3  # of a whole number
_FEWEST = 5


def lost_turns(problem: Problem) -> list[Fact]:
    """`missing_turns` of a recording at its own rate, with the calibration that it starts from."""
    done = run_filter(problem.recorded, problem.cold, sensitive=False)
    return missing_turns(done, problem.recorded.gyro_b_rad_s - problem.cold.gyro_bias_rad_s)


def missing_turns(done: Filtered, rate_b_rad_s: Array) -> list[Fact]:
    """Where the filter jumps by whole steps.  rate_b_rad_s (N, 3) without bias."""
    track, A = done.track, done.model.soft_iron
    if len(track) < 10 * _MEAN:
        return []
    dt = np.nan_to_num(track.dt_s, nan=0.0)[:, None]
    v = np.cross(done.predicted_b, rate_b_rad_s * dt) @ A
    size = np.linalg.norm(v, axis=1)
    sigma = float(np.sqrt(np.median(done.gains.innovation_covariance[:, 0, 0]) / _MEAN))
    ahead = np.zeros_like(v)
    behind = np.zeros_like(v)
    stop = len(v) - _MEAN
    for k in range(_MEAN):
        ahead[:stop] += done.innovation[k : stop + k] / _MEAN
        behind[_MEAN:] += done.innovation[_MEAN - 1 - k : len(v) - 1 - k] / _MEAN
    jump = ahead - behind
    steps = np.sum(jump * v, axis=1) / np.maximum(size**2, 1e-300)
    rest = np.linalg.norm(jump - steps[:, None] * v, axis=1)
    fresh = np.sum(behind * v, axis=1) < 0.5 * size**2
    tell = (size > _SEEN * sigma) & (rest < 5 * sigma) & done.used & fresh
    whole = np.abs(steps - np.round(steps)) < _NEAR
    forward = _peaks(tell & whole & (steps > 1 - _NEAR), steps)
    backward = _peaks(tell & whole & (steps < -1 + _NEAR), -steps)
    if len(forward) < _FEWEST + 3 * len(backward):
        return []
    lost = float(np.sum(np.round(steps[forward]))) * len(v) / max(int(np.count_nonzero(tell)), 1)
    share = lost / (lost + len(v))
    deviation = share / float(np.sqrt(len(forward)))
    times = tuple((float(track.time_s[k - 1]), float(track.time_s[k])) for k in forward)
    words = (
        f"at {len(forward)} samples the field is ahead by whole steps of the turn: samples are "
        "missing that the time stamps do not show"
    )
    where = Where(times, ("x", "y", "z"), "link")
    parameters = (Value("part", share, deviation, "1"),)
    rows, turns = forward.tolist(), np.round(steps[forward]).tolist()
    setting = {"hidden": True, "rows": rows, "turns": turns}
    return [Fact("dropped_samples", words, where, 0.9, parameters, setting)]


def _peaks(rows: NDArray[np.bool], size: Array) -> NDArray[np.intp]:
    """Of rows closer than the averaging the one that is largest."""
    out: list[int] = []
    for k in np.flatnonzero(rows).tolist():
        if out and k - out[-1] < 2 * _MEAN:
            if size[k] > size[out[-1]]:
                out[-1] = k
        else:
            out.append(k)
    return np.array(out, dtype=np.intp)
