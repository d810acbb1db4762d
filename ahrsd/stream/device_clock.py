"""Device time to host time, and the spacing of samples.

Why a lower hull.  A message arrives late, never early: `host = a + r * device + delay`, delay > 0
(wire time, the 16 ms latency timer of a USB adapter, a busy host). The samples with the least
delay carry the truth, so the clock is a line *below* all points (device, host): an edge of their
lower convex hull. Until the hull is long enough to tell a drift of some ppm from a delay, r is 1.

Three things live here, all without a clock of their own:

* `DeviceClock`: the line, its drift and residuals; survives device restarts and host jumps.
* `StepClock`: a time for streams that carry none ($VNYMR): the message counts, lost ones included.
* `StreamTimeline`: device times to steps `dt_s`; never a negative step, never one over a gap.
"""

from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

Mask = NDArray[np.bool_]

HULL_POINTS: Final = 64  # a hull of years of samples has far fewer; bounds memory all the same
WINDOW_HOST_S: Final = 1800.0  # older points are dropped, so that a drifting rate is followed
DRIFT_SPAN_HOST_S: Final = 60.0  # a shorter hull cannot tell ppm from delay: the rate stays nominal
NOT_DRIFT: Final = 0.05  # |rate - 1| beyond any crystal: an accelerated run, the hull's rate counts
MATURE_HOST_S: Final = 1.0  # jumps are judged only against a line at least this long
MATURE_POINTS: Final = 20
JUMP_TOLERANCE_S: Final = 0.05  # a point this far below the line is not jitter: the line is wrong
JUMP_DRIFT: Final = 5e-4  # plus what an unmodelled drift may build up over a pause
LATE_S: Final = 0.25  # every point of LATE_SPAN_S this late: the host's clock leapt ahead
LATE_SPAN_S: Final = 2.0
RESTART_S: Final = 0.5  # device time falling by more than this is a restart, less is disorder
GAP_RATIO: Final = 1.5  # a step longer than this many periods is a gap
PERIOD_MEMORY: Final = 128  # steps whose median is the stream's period


class DeviceClock:
    """Lower convex hull of (device, host) arrivals; `to_host` is the line below them."""

    def __init__(self) -> None:
        self.restarts = self.jumps = 0
        self._begin()

    def _begin(self) -> None:
        """Forget the line; the counters stay."""
        self._hull: deque[tuple[float, float]] = deque()
        self._points = 0
        self._span_host_s = self._last_device_s = 0.0
        self._rate = 1.0  # host seconds per device second
        self._anchor = (0.0, 0.0)
        self._late_since_s: float | None = None

    @property
    def known(self) -> bool:
        """Whether there is a line at all."""
        return bool(self._hull)

    def update(self, device_s: float, host_s: float) -> bool:
        """Take one arrival; returns true where the line began anew (first, restart or jump)."""
        if not (np.isfinite(device_s) and np.isfinite(host_s)):
            return False
        fell_s = self._last_device_s - device_s
        if self.known and 0.0 <= fell_s <= RESTART_S:
            return False
        anew = not self.known
        if not anew and fell_s > RESTART_S:
            self.restarts += 1
            anew = True
        elif not anew and self._jumped(device_s, host_s):
            self.jumps += 1
            anew = True
        if anew:
            self._begin()
        if self._late_since_s is None:  # a point far above the line says nothing about the line
            self._append(device_s, host_s)
        self._last_device_s = device_s
        return anew

    def host_s(self, device_s: float) -> float:
        """Host time of one device time; nan before the first update."""
        if not self.known:
            return float("nan")
        return self._anchor[1] + self._rate * (device_s - self._anchor[0])

    def to_host(self, device_s: Array) -> Array:
        """Host times of (N,) device times; nan before the first update."""
        if not self.known:
            return np.full_like(device_s, np.nan, dtype=np.float64)
        return self._anchor[1] + self._rate * (np.asarray(device_s, float) - self._anchor[0])

    def _jumped(self, device_s: float, host_s: float) -> bool:
        """Whether the arrival contradicts a line that is old enough to be trusted."""
        if self._points < MATURE_POINTS or self._span_host_s < MATURE_HOST_S:
            return False
        late_s = host_s - self.host_s(device_s)
        pause_s = (device_s - self._last_device_s) * self._rate
        if late_s < -(JUMP_TOLERANCE_S + JUMP_DRIFT * pause_s):
            return True
        if late_s < LATE_S:
            self._late_since_s = None
            return False
        if self._late_since_s is None:
            self._late_since_s = host_s
        return host_s - self._late_since_s >= LATE_SPAN_S

    def _append(self, device_s: float, host_s: float) -> None:
        """Monotone chain: the new point is always the rightmost one of the lower hull."""
        hull = self._hull
        while len(hull) >= 2 and not _turns_up(hull[-2], hull[-1], (device_s, host_s)):
            hull.pop()
        hull.append((device_s, host_s))
        while len(hull) > HULL_POINTS or host_s - hull[0][1] > WINDOW_HOST_S:
            hull.popleft()
        self._points += 1
        self._fit()

    def _fit(self) -> None:
        """The hull edge over the middle of the window: least summed distance to all points."""
        hull = self._hull
        self._span_host_s = max(self._span_host_s, hull[-1][1] - hull[0][1])
        middle_s = 0.5 * (hull[0][0] + hull[-1][0])
        rate = 1.0
        for (d0, h0), (d1, h1) in zip(hull, list(hull)[1:], strict=False):
            if d1 >= middle_s:
                rate = (h1 - h0) / (d1 - d0)
                break
        trusted = self._span_host_s >= DRIFT_SPAN_HOST_S or abs(rate - 1.0) > NOT_DRIFT
        self._rate = rate if trusted and rate > 0.0 else 1.0
        self._anchor = min(hull, key=lambda point: point[1] - self._rate * point[0])


def _turns_up(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether a, b, c bends upwards at b, so that b belongs to the lower hull."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0


class StepClock:
    """Times for a stream that carries none: one step per message, lost messages included."""

    def __init__(self, rate_hz: float, start_s: float = 0.0) -> None:
        if not (np.isfinite(rate_hz) and rate_hz > 0.0):
            raise ValueError(f"a rate must be positive, in Hz; got {rate_hz!r}")
        self.step_s = 1.0 / rate_hz
        self._count, self._start_s = 0, start_s

    @property
    def now_s(self) -> float:
        """Time of the message that would come next, were none lost."""
        return self._start_s + self._count * self.step_s

    def times(self, lost_before: Array) -> Array:
        """(N,) times of N messages; lost_before (N,) counts the ones lost before each.

        Times are count * step, so they do not drift by summing.
        """
        counts = self._count + np.cumsum(1 + np.asarray(lost_before, dtype=np.int64))
        if len(counts):
            self._count = int(counts[-1])
        return np.asarray(self._start_s + (counts - 1) * self.step_s, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Gap:
    """No usable sample from `at_s` (the last one before) for `length_s` of device time."""

    at_s: float
    length_s: float


@dataclass(frozen=True, slots=True, eq=False)
class TimelineSteps:
    """What `StreamTimeline` says about N device times `time_s`.

    keep:     (N,) false for repeated times and for samples marked unusable
    dt_s:     (N,) step that ends at the sample; nan where nothing usable precedes it
    first:    (N,) true where a run of consecutive samples begins
    gaps, restarts: facts of this block
    """

    time_s: Array
    keep: Mask
    dt_s: Array
    first: Mask
    gaps: tuple[Gap, ...] = field(default=())
    restarts: int = 0


class StreamTimeline:
    """Device times to steps. A step is reported only between neighbours of the stream."""

    def __init__(self, period_s: float | None = None) -> None:
        self.restarts = 0
        self._nominal_s = period_s
        self._recent: deque[float] = deque(maxlen=PERIOD_MEMORY)
        self.forget()

    def forget(self) -> None:
        """What follows does not follow what came: the link was away or the stream was changed."""
        self._last_seen_s: float | None = None
        self._last_used_s: float | None = None
        self._recent.clear()
        self._period_s = float("nan") if self._nominal_s is None else self._nominal_s

    @property
    def newest_s(self) -> float | None:
        """The newest time, also of a sample that could not be used; None: none since `forget`."""
        return self._last_seen_s

    @property
    def period_s(self) -> float:
        """Median step of late; nan before two samples."""
        return self._period_s

    def copied(self) -> StreamTimeline:
        """One that goes on from here by itself; everything in it but the memory is immutable."""
        other = copy(self)
        other._recent = self._recent.copy()
        return other

    def extend(self, time_s: Array, usable: Mask | None = None) -> TimelineSteps:
        """Steps of N further samples at device times (N,).

        A repeated time is dropped; a time that falls begins a new run; a step over 1.5 periods is
        a gap, and so is what unusable samples (mask false) leave behind.
        """
        count = len(time_s)
        good = np.ones(count, bool) if usable is None else np.asarray(usable, bool)
        keep, first = np.zeros(count, bool), np.zeros(count, bool)
        dt_s = np.full(count, np.nan)
        gaps: list[Gap] = []
        before_restarts = self.restarts
        limit_s = GAP_RATIO * self._learn(time_s)
        for k, now_s in enumerate(np.asarray(time_s, float).tolist()):
            if not self._advance(now_s) or not good[k]:
                continue
            keep[k] = True
            step_s = np.nan if self._last_used_s is None else now_s - self._last_used_s
            first[k] = not step_s <= limit_s
            if first[k] and self._last_used_s is not None:
                gaps.append(Gap(self._last_used_s, step_s))
            elif not first[k]:
                dt_s[k] = step_s
            self._last_used_s = now_s
        return TimelineSteps(
            np.asarray(time_s, float),
            keep,
            dt_s,
            first,
            tuple(gaps),
            self.restarts - before_restarts,
        )

    def _advance(self, now_s: float) -> bool:
        """Whether the time is new; a fall cuts the run, a repetition is counted."""
        last_s, self._last_seen_s = self._last_seen_s, now_s
        if not np.isfinite(now_s):
            self._last_seen_s = last_s
            return False
        if last_s is not None and now_s == last_s:
            return False
        if last_s is not None and now_s < last_s:
            self.restarts += 1
            self._last_used_s = None
        return True

    def _learn(self, time_s: Array) -> float:
        """Period with this block's own steps in it, so that the first block has one as well."""
        before = [] if self._last_seen_s is None else [self._last_seen_s]
        steps_s = np.diff(np.concatenate([before, np.asarray(time_s, float)]))
        new_s = steps_s[steps_s > 0.0][-PERIOD_MEMORY:].tolist()
        self._recent.extend(new_s)
        if new_s:
            self._period_s = median(self._recent)
        return self._period_s if np.isfinite(self._period_s) else np.inf
