"""A regular clock behind the stamps that a host gave to a stream's samples.

A sensor samples regularly; its samples reach the host in bunches (a USB adapter hands over what
came in 16 ms), get equal stamps, or stamps in whole seconds.  Each stamp is then the sample's
instant and a delay that stays within a bound however long the stream is, whereas an irregular clock
wanders off any straight line.  Where that holds the samples belong on the line.

A sample that was lost moves all later ones by one step.  That shows as a step of the smallest delay
(the lower envelope of the stamps), which otherwise stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

_SHORT, _SHORT_SHARE = 0.3, 0.02  # of the mean step; share of such steps that tells bunches
_FEWEST = 40  # samples of a stretch that is fitted
_BOUND_STEPS, _BOUND_S = 8.0, 0.1  # delays stay within so many steps, or so many seconds, or
_BOUND_STAMPS = 1.3  # so many times the usual step between different stamps
_APART_S = 1.1  # between bunches at most; what is further apart are bursts of a sleeping logger
_LOST = 0.6  # of a step, by which the lower envelope moves where a sample is lost
_GAP = 1.6  # usual steps, beyond which a step is a gap
#: seconds after which clocks begin again: 12 hours are a time of day without am and pm
_PERIODS = (
    (86400.0, "a day"), (43200.0, "half a day"), (604800.0, "a week (GPS time)"),
    (2**16 * 1e-3, "16 bits of ms"), (2**32 * 1e-3, "32 bits of ms"),
    (2**32 * 1e-6, "32 bits of us"), (2**32 * 1e-9, "32 bits of ns"),
)  # fmt: skip
_FEWEST_BUNCHES = 6
_WIDTHS = 3.0  # bunches to a window of the envelope


@dataclass(frozen=True, slots=True, eq=False)
class RegularClock:
    """time_s (N,): the samples' instants; scatter_s: rms of the stamps about them.

    starts: first row of each stretch that a pause or a loss begins, the first one included
    """

    time_s: Array
    step_s: float
    scatter_s: float
    starts: tuple[int, ...]


def is_bunched(stamps_s: Array) -> bool:
    """Whether many stamps follow the one before at once: a host's, not the sensor's."""
    steps = np.diff(stamps_s)
    if len(steps) < _FEWEST:
        return bool(np.any(steps == 0.0))
    usual = float(np.mean(np.minimum(steps, 5.0 * _stamp_step(steps))))
    return bool(np.mean(steps < _SHORT * usual) > _SHORT_SHARE)


def _stamp_step(steps: Array) -> float:
    """The usual step between different stamps that is not within a bunch.

    However many rows a bunch has, its own steps are far below the mean one (pauses not counted).
    """
    near = steps[steps <= _APART_S]
    mean_s = float(np.mean(near)) if len(near) else 0.0
    moved = steps[steps > _SHORT * mean_s]
    return float(np.percentile(moved, 95.0)) if len(moved) else 0.0


def regular_clock(stamps_s: Array) -> RegularClock | None:
    """The clock behind stamps (N,) that never go back; None where no regular clock fits them."""
    steps = np.diff(stamps_s)
    apart = _stamp_step(steps)
    if len(stamps_s) < _FEWEST or not 0.0 < apart <= _APART_S:
        return None
    pauses = np.flatnonzero(steps > _GAP * apart) + 1
    begins = [0, *pauses.tolist()]
    ends = [*begins[1:], len(stamps_s)]
    longest = max(zip(begins, ends, strict=True), key=lambda pair: pair[1] - pair[0])
    if longest[1] - longest[0] < _FEWEST:
        return None
    # what looks like lost samples may be the pattern of a rounding: then there are none
    fits = (_fit(stamps_s, begins, ends, longest, apart, lossy) for lossy in (True, False))
    return next((fit for fit in fits if fit is not None), None)


def _fit(
    stamps_s: Array,
    begins: list[int],
    ends: list[int],
    longest: tuple[int, int],
    apart: float,
    lossy: bool,
) -> RegularClock | None:
    """The clock behind stretches of stamps, with or without lost samples among them."""
    step_s, width = _step_of(stamps_s[slice(*longest)], apart, lossy)
    if not step_s > 0.0:
        return None
    time_s, starts = np.empty_like(stamps_s), []
    for begin, end in zip(begins, ends, strict=True):
        fitted = _stretch(stamps_s[begin:end], step_s, width, lossy)
        time_s[begin:end] = fitted[0]
        starts += [begin + at for at in fitted[1]]
    delay = stamps_s - time_s
    bound = max(_BOUND_STEPS * step_s, _BOUND_S, _BOUND_STAMPS * apart)
    if float(np.ptp(np.quantile(delay, [0.002, 0.998]))) > bound:
        return None
    time_s = _forward(time_s, starts, step_s)
    scatter = float(np.std(stamps_s - time_s))
    return RegularClock(time_s, step_s, scatter, tuple(starts))


def _step_of(stamps_s: Array, apart: float, lossy: bool) -> tuple[float, int]:
    """The step of a stretch, and the samples of a window that has some bunches in it."""
    rows = np.arange(len(stamps_s), dtype=np.float64)
    rough = (stamps_s[-1] - stamps_s[0]) / max(len(stamps_s) - 1, 1)
    if not rough > 0.0:
        return 0.0, 1
    width = int(np.clip(np.ceil(_WIDTHS * apart / rough), 8, max(len(stamps_s) // 4, 8)))
    # the first sample of each bunch: their delays differ by less than a step
    firsts = np.flatnonzero(np.diff(stamps_s) > 0.5 * apart) + 1
    firsts = firsts if len(firsts) >= _FEWEST_BUNCHES else np.arange(len(stamps_s))
    since_s = stamps_s[firsts] - stamps_s[0]
    slope = float(np.polyfit(rows[firsts], since_s, 1)[0])
    for _ in range(3 if lossy else 0):
        lost = np.zeros(len(stamps_s))
        for at in _losses(stamps_s - slope * rows, slope, width):
            lost[at[0] :] += at[1]
        slope = float(np.polyfit((rows + lost)[firsts], since_s, 1)[0])
        if not slope > 0.0:
            return 0.0, width
    return max(slope, 0.0), width


def _losses(delay: Array, step_s: float, width: int) -> list[tuple[int, int]]:
    """(row, samples lost before it) where the envelope of the delays steps up."""
    n = len(delay)
    if n < 4 * width:
        return []
    windows = np.lib.stride_tricks.sliding_window_view(delay, width)
    low = windows.min(axis=1)  # of the samples k .. k + width - 1
    before, behind = low[: n - 2 * width + 1], low[width:]
    rise = behind - before  # at the row k + width
    rise = rise - np.median(rise)  # which a step that is not quite right makes everywhere
    steady = 2.0 * float(np.median(np.abs(rise)))
    limit = max(_LOST * step_s, 3.0 * steady)
    found = []
    over = rise > limit
    edges = np.flatnonzero(np.diff(np.concatenate([[False], over, [False]]).astype(np.int8)))
    for first, last in edges.reshape(-1, 2):
        at = first + int(np.argmax(rise[first:last]))
        count = round(float(rise[at]) / step_s)
        if count >= 1:
            found.append((int(at + width), count))
    return found


def _stretch(stamps_s: Array, step_s: float, width: int, lossy: bool) -> tuple[Array, list[int]]:
    """Instants of a stretch without a pause, and where its parts begin."""
    n = len(stamps_s)
    rows = np.arange(n, dtype=np.float64)
    starts = [0]
    for at, lost in _losses(stamps_s - step_s * rows, step_s, width) if lossy else ():
        rows[at:] += lost
        starts.append(at)
    delay = stamps_s - step_s * rows
    return step_s * rows + float(np.mean(delay)), starts


def _forward(time_s: Array, starts: list[int], step_s: float) -> Array:
    """Stretches that were put too early begin a step behind the one before."""
    out = time_s.copy()
    ends = [*starts[1:], len(out)]
    for begin, end in zip(starts[1:], ends[1:], strict=True):
        behind = out[begin - 1] + step_s - out[begin]
        if behind > 0.0:
            out[begin:end] += behind
    return out


def ties_spread(stamps_s: Array) -> Array | None:
    """Stamps (N,) whose few equal ones are spread up to the next one; None where they are many."""
    tied = np.diff(stamps_s) == 0.0
    if np.mean(tied) > _SHORT_SHARE or np.any(np.diff(stamps_s) < 0.0):
        return None
    first = np.flatnonzero(np.concatenate([[True], ~tied]))
    length = np.diff(np.append(first, len(stamps_s)))
    after = np.append(stamps_s[first[1:]], 2.0 * stamps_s[-1] - stamps_s[first[-1] - 1])
    place = np.arange(len(stamps_s)) - np.repeat(first, length)
    step = np.repeat((after - stamps_s[first]) / length, length)
    return np.asarray(stamps_s + place * step)


def unwrapped(time_s: Array) -> tuple[Array, NDArray[np.intp], str]:
    """Times (N,) that count on where a counter or a time of day began again at its end.

    Then a step back is the whole period but for a usual step. The rows where it began again, and
    what it was of.
    """
    steps = np.diff(time_s)
    forward = steps[steps > 0.0]
    back = np.flatnonzero(steps < 0.0)
    if not len(forward) or not len(back):
        return time_s, np.zeros(0, np.intp), ""
    usual = _GAP * float(np.percentile(forward, 95.0))
    for period_s, what in _PERIODS:
        rest = steps[back] + period_s
        if np.all((rest >= 0.0) & (rest <= usual)):
            shift = np.zeros(len(time_s))
            shift[back + 1] = period_s
            return time_s + np.cumsum(shift), np.asarray(back, dtype=np.intp) + 1, what
    return time_s, np.zeros(0, np.intp), ""


def clock_jumps(time_s: Array, longest_s: float) -> tuple[Array, NDArray[np.intp]]:
    """Times (N,) without the jumps of the host's clock, and the rows at which it jumped.

    A step back, and a step beyond `longest_s`, that regular rows follow is a clock that was set:
    how much time passed is not known, and the later rows are moved to `longest_s` behind. Where
    rows are out of order instead, they stay, and time goes back there.
    """
    steps = np.diff(time_s)
    forward = steps[steps > 0.0]
    if not len(forward):
        return time_s, np.zeros(0, np.intp)
    usual = _GAP * float(np.percentile(forward, 95.0))
    regular = np.append((steps >= 0.0) & (steps <= usual), False)
    strange = np.flatnonzero((steps < 0.0) | (steps > longest_s))
    settled = [k for k in strange if k + 3 < len(regular) and regular[k + 1 : k + 3].all()]
    if not settled or len(settled) < len(strange):
        return time_s, np.zeros(0, np.intp)
    shift = np.zeros(len(time_s))
    for k in settled:
        length_s = max(1.0, 4.0 * usual) if steps[k] < 0.0 else longest_s
        shift[k + 1] = min(length_s, longest_s) - steps[k]
    return time_s + np.cumsum(shift), np.asarray(settled, dtype=np.intp) + 1
