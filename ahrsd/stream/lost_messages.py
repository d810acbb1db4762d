"""Lost messages of a stream that carries no time, by when the others arrived.

A message arrives late, never early: behind its instant by a delay that a USB adapter, a busy host
or a wire makes. Counted by the steps of its rate, a stream without losses keeps the least of its
delays for ever. Where a message is lost, every later one arrives a step later than the count says,
so the least delay rises by a step and stays there.

Messages come in bunches (all that an adapter gathered in 16 ms). The last one of a bunch waited
least, so only the ends of bunches are compared: the least delay of `_ENDS` ends before a place with
that of `_ENDS` ends from there on. Where in a bunch a message is lost cannot be known: of such a
bunch only the last message is used, whose time the messages behind it tell.

The same decides the rate (`step_of`). Losses make the mean rate too low; counted by the true step
and its losses, the delays lie closer together than by any other step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

_ENDS = 8  # of bunches, whose least delay is compared
_BUNCH = 0.3  # of a step; a message that follows sooner is of the same bunch
_RISE = 0.6  # of a step, by which the least delay rises where a message is lost
_BEFORE = 0.9  # of a step; a delay below it is of a message before the loss
_BUNCHED = 1.3  # messages to a bunch, beyond which the end of a bunch may be the lost one
_FASTER = (1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.35)  # than the mean rate, where some are lost
FASTEST = 1.4  # than the mean rate, which losses may explain
_SLOWEST = 1.02
_FITS = 3  # a line through the arrivals, counted with what is lost by the line before
_STEADY = 0.15  # of a step (rms): the least delay stays
_CLOSER, _AS_CLOSE = 0.5, 1.2  # than another fit
_NO_LATTICE = 0.45  # of a step (rms); a spread beyond is of arrivals that no step explains


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """What the arrivals of messages tell.

    settled: how many of the messages can be judged; the rest waits for those behind it
    lost:    (settled,) messages that are missing before each, those of `used` false included
    used:    (settled,) false where the time of a message is not known
    delay_s: (settled,) of each behind its counted time, up to a constant
    """

    settled: int
    lost: NDArray[np.int64]
    used: NDArray[np.bool_]
    delay_s: Array


class LostMessages:
    """Sees where messages are missing; see the module. What it says does not depend on chunks."""

    def __init__(self) -> None:
        self.places = 0
        self.missing = 0
        self.forget()

    def forget(self) -> None:
        """What follows does not follow on."""
        self._ends: deque[float] = deque(maxlen=_ENDS)  # delays of the newest ends, in steps
        self._count = 0  # steps from the origin to the newest message
        self._origin_s: float | None = None

    def look(
        self, arrivals_s: Sequence[float], known: Sequence[int], step_s: float, ends: bool = False
    ) -> Arrived:
        """The messages from the first one that was not settled; known (N,): lost before each.

        ends: whether nothing follows, so that all of them are settled by what is there
        """
        arrived, lost = np.asarray(arrivals_s), np.array(known, dtype=np.int64)
        if self._origin_s is None:
            self._origin_s, self._count = float(arrived[0]), -1 - int(lost[0])
        counted = self._count + np.cumsum(1 + lost)
        delay = (arrived - self._origin_s) / step_s - counted
        last = np.flatnonzero(np.append(np.diff(arrived) >= _BUNCH * step_s, True))
        used = np.ones(len(lost), dtype=bool)
        settled = self._judge(delay, last, lost, used, ends)
        self._count += int(np.sum(1 + lost[:settled]))
        left = delay[:settled] - np.cumsum(lost[:settled] - np.asarray(known[:settled]))
        return Arrived(settled, lost[:settled], used[:settled], left * step_s)

    def _judge(
        self,
        delay: Array,
        last: NDArray[np.intp],
        lost: NDArray[np.int64],
        used: NDArray[np.bool_],
        whole: bool,
    ) -> int:
        """Fill `lost` and `used`; how many messages are settled. Delays are in steps."""
        ends, bunched = delay[last], int(len(delay) > _BUNCHED * len(last))
        at, shift = 0, 0
        if not self._ends:
            self._ends.append(float(ends[0]))
            at = 1
        if ends[at:].size and float(np.max(ends[at:]) - min(*self._ends, *ends)) <= _RISE:
            self._ends.extend(ends[at:].tolist())
            return len(delay)
        while at < len(ends):
            window = ends[at : at + _ENDS] - shift
            least = min(self._ends)
            if float(window.min()) - least <= _RISE:
                self._ends.append(float(window[0]))
                at += 1
                continue
            first = int(last[at - 1]) + 1 if at else 0
            if len(window) < _ENDS and not whole:
                return first
            before = np.flatnonzero(window < least + _BEFORE)
            behind = at + (int(before[-1]) + 1 if len(before) else 0) + bunched
            behind = min(behind, len(ends) - 1)
            rest = ends[behind : behind + _ENDS] - shift
            missing = max(1, round(float(rest.min()) - least))
            end = int(last[behind])
            used[first:end] = False
            lost[end] += missing
            shift += missing
            self.places += 1
            self.missing += missing
            self._ends.append(float(ends[behind]) - shift)
            at = behind + 1
        return len(delay)


def step_of(
    arrivals_s: Sequence[float], known: Sequence[int], offered_s: Sequence[float] = ()
) -> tuple[float, bool]:
    """The step in s between messages, and whether the arrivals lie on steps of it; 0 for none.

    The mean step where no loss shows. Else the one of `offered_s`, which the device has, by which
    the delays lie closest together; any other only where it is much closer and has fewer losses.
    """
    arrived = np.asarray(arrivals_s) - arrivals_s[0]
    lost = np.asarray(known, dtype=np.int64)
    mean_s = _slope(arrived, lost)
    if not mean_s > 0.0:
        return 0.0, False
    if _Fit.of(arrived, lost, mean_s).steady:
        return mean_s, True
    near = [step for step in offered_s if mean_s / FASTEST < step < mean_s * _SLOWEST]
    chosen = _closest([_Fit.counted(arrived, lost, step) for step in near])
    for faster in _FASTER:
        fit = _Fit.refined(arrived, lost, mean_s / faster)
        if not fit.steady:
            continue
        better = chosen is None or (
            fit.spread_s < _CLOSER * chosen.spread_s and fit.missing < chosen.missing
        )
        chosen = fit if better else chosen
    if chosen is None:
        return mean_s, False
    return chosen.step_s, chosen.spread_s < _NO_LATTICE * chosen.step_s


@dataclass(frozen=True, slots=True)
class _Fit:
    """Arrivals counted by a step: the losses among them, and how far the delays lie apart (rms).

    steady: whether the least delay stays where it is
    """

    step_s: float
    missing: int
    spread_s: float
    steady: bool

    @classmethod
    def of(cls, arrived: Array, lost: NDArray[np.int64], step_s: float) -> _Fit:
        """With just these losses."""
        delay = arrived - step_s * np.cumsum(1 + lost)
        ends = delay[np.append(np.diff(arrived) >= _BUNCH * step_s, True)]
        if len(ends) < 2 * _ENDS:
            return cls(step_s, int(lost.sum()), float(np.std(ends)), False)
        least = np.lib.stride_tricks.sliding_window_view(ends, _ENDS).min(axis=1)
        steady = float(np.std(least)) < _STEADY * step_s
        return cls(step_s, int(lost.sum()), float(np.std(ends)), steady)

    @classmethod
    def counted(cls, arrived: Array, known: NDArray[np.int64], step_s: float) -> _Fit:
        """With what is lost by this step."""
        lost = LostMessages().look(arrived.tolist(), known.tolist(), step_s, ends=True).lost
        return cls.of(arrived, lost, step_s)

    @classmethod
    def refined(cls, arrived: Array, known: NDArray[np.int64], step_s: float) -> _Fit:
        """With a step near this one, by a line through the arrivals so counted."""
        for _ in range(_FITS):
            seen = LostMessages().look(arrived.tolist(), known.tolist(), step_s, ends=True)
            step_s = _slope(arrived, seen.lost)
            if not step_s > 0.0:
                return cls(0.0, 0, float("inf"), False)
        return cls.counted(arrived, known, step_s)


def _closest(fits: list[_Fit]) -> _Fit | None:
    """Of those that are steady the closest; of about as close ones that with the fewest losses."""
    steady = [fit for fit in fits if fit.steady]
    if not steady:
        return None
    least = min(fit.spread_s for fit in steady)
    near = [fit for fit in steady if fit.spread_s <= _AS_CLOSE * least]
    return min(near, key=lambda fit: fit.missing)


def _slope(arrived: Array, lost: NDArray[np.int64]) -> float:
    """Seconds per message by a line through the arrivals."""
    number = np.cumsum(1.0 + lost)
    number -= number.mean()
    return float(number @ arrived / (number @ number))
