"""A train of short pulses whose times nobody logged: its period, its phase, how long a pulse is.

Pulses of w seconds every P seconds are lines at all multiples of 1/P up to about 1/w, each of them
too weak to be seen alone.  Their sum over the multiples shows the period; folding the residual
at that period shows when in it, and for how long, something is there.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.effects.base import Setting
from ahrsd.samples import Array

_PERIODS_S = (0.4, 6.0)
_HIGHEST_HZ = 12.0  # pulses of 40 ms and longer
_LONGEST_S = 0.25
_PADDING = 4
_PERIODS = 4  # of the best by their lines that are folded
_CLOSER = 6  # steps to either side in which a period is refined
_BINS, _FINE_BINS = 2, 16  # to a sample, when trains are folded, and when the best is refined
_FEWEST = 20  # periods in a recording


def trains(residual: Array, time_s: Array, step_s: float) -> tuple[Setting, ...]:
    """The likeliest train of pulses in (N, 3), empty where the recording is too short for one."""
    start_s, span_s = float(time_s[0]), float(time_s[-1] - time_s[0])
    longest_s = min(_PERIODS_S[1], span_s / _FEWEST)
    if longest_s < 2 * _PERIODS_S[0] or len(time_s) < 256:
        return ()
    time_s = time_s - start_s
    quick = _quick(residual, round(0.5 / step_s))
    periods, tried = _periods(quick, step_s, span_s, longest_s)
    best = max(
        (_folded(quick, time_s, period_s, step_s, _BINS) for period_s in periods),
        key=lambda found: found[0],
    )
    for reach in (1.0, 1.0 / _CLOSER):
        shift = reach * best[1] ** 2 / (_PADDING * span_s * _HIGHEST_HZ) / _CLOSER
        near = best[1] + shift * np.arange(-_CLOSER, _CLOSER + 1)
        folded = (_folded(quick, time_s, float(p), step_s, _FINE_BINS) for p in near)
        best = max(folded, key=lambda found: found[0])
    _, period_s, phase_s, width_s = best
    return (
        {
            "start_s": start_s,
            "period_s": round(period_s, 7),
            "phase_s": round(phase_s, 5),
            "width_s": round(width_s, 5),
            "searched": tried * round(_FINE_BINS * period_s / step_s),
        },
    )


def train(time_s: Array, setting: Setting) -> Array:
    """1 in the samples that a pulse hits, else 0, (N,)."""
    since = (time_s - setting["start_s"] - setting["phase_s"]) % setting["period_s"]
    return np.where(since < setting["width_s"], 1.0, 0.0)


def _quick(residual: Array, width: int) -> Array:
    """What is left of (N, 3) when its mean over `width` samples is taken off."""
    total = np.vstack([np.zeros(3), np.cumsum(residual - residual.mean(axis=0), axis=0)])
    rows = np.arange(len(residual))
    first, last = np.maximum(rows - width // 2, 0), np.minimum(rows + width // 2 + 1, len(rows))
    return np.asarray(
        residual - residual.mean(axis=0) - (total[last] - total[first]) / (last - first)[:, None]
    )


def _periods(quick: Array, step_s: float, span_s: float, longest_s: float) -> tuple[Array, int]:
    """The periods whose multiples hold most power, and how many were looked at."""
    count = len(quick)
    power = np.sum(np.abs(np.fft.rfft(quick, _PADDING * count, axis=0)) ** 2, axis=1)
    spacing_hz = 1.0 / (_PADDING * count * step_s)
    top_hz = min(_HIGHEST_HZ, 0.45 / step_s)
    pieces = np.array_split(power, max(len(power) // 512, 1))
    usual = np.repeat([max(float(np.median(part)), 1e-300) for part in pieces], [*map(len, pieces)])
    power = np.minimum(power / usual, 50.0)  # one line is no train, however strong
    base_hz = np.arange(1.0 / longest_s, 1.0 / _PERIODS_S[0], 1.0 / (_PADDING * span_s * top_hz))
    score, lines = np.zeros(len(base_hz)), np.floor(top_hz / base_hz)
    for multiple in range(1, int(lines.max()) + 1):
        at = np.rint(multiple * base_hz / spacing_hz).astype(np.intp)
        inside = multiple <= lines
        score[inside] += power[at[inside]]
    score = (score - lines * power.mean()) / np.sqrt(np.maximum(lines, 1.0))
    found = []
    for _ in range(_PERIODS):
        best = int(np.argmax(score))
        found.append(1.0 / base_hz[best])
        score[np.abs(base_hz - base_hz[best]) < 2.0 / span_s] = -np.inf
    return np.array(found), len(base_hz)


def _folded(
    quick: Array, time_s: Array, period_s: float, step_s: float, fine: int
) -> tuple[float, float, float, float]:
    """Power of the best window of the folded residual: (power, period, its phase, its width).

    fine: bins to a sample; a pulse is a sample at least, or it would hit a few outliers only
    """
    bins = max(8, round(fine * period_s / step_s))
    at = np.minimum((time_s % period_s / period_s * bins).astype(np.intp), bins - 1)
    count = np.bincount(at, minlength=bins).astype(float)
    sums = np.stack([np.bincount(at, weights=axis, minlength=bins) for axis in quick.T])
    # twice around, so that a window may reach over the period's end
    many = np.concatenate([[0.0], np.cumsum(np.tile(count, 2))])
    much = np.concatenate([np.zeros((3, 1)), np.cumsum(np.tile(sums, 2), axis=1)], axis=1)
    best = (-1.0, period_s, 0.0, 0.0)
    for width in range(fine, max(fine + 1, round(_LONGEST_S * bins / period_s)) + 1):
        ends = slice(width, width + bins)
        hit = np.maximum(many[ends] - many[:bins], 1.0)
        squares = much[:, ends] - much[:, :bins]
        squares *= squares  # in place: of all that a survey does at the recorded rate, this is most
        power = (squares[0] + squares[1] + squares[2]) / hit
        k = int(np.argmax(power))
        if power[k] > best[0]:
            wide = period_s / bins
            best = (float(power[k]), period_s, float(k * wide), float(width * wide))
    return best
