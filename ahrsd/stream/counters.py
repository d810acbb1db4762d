"""What is counted of a stream: samples, losses, gaps."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from ahrsd.stream.device_clock import Gap


@dataclass(slots=True)
class StreamFacts:
    """Counters of a stream.

    unusable: samples that were saturated or not finite
    damaged:  messages that were recognised and refused
    expected: samples that would be there had none been lost
    duration_s: steps and gaps together; time of which nobody knows the length is not in it
    """

    samples: int = 0
    unusable: int = 0
    damaged: int = 0
    expected: float = 0.0
    duration_s: float = 0.0
    layout: str = ""
    rate_hz: float = float("nan")
    rate_source: str = ""


class Gaps:
    """Gaps in order. keep: how many of the first and how many of the newest stay; None: all.

    count, length_s: of every gap, also of those that were let go
    """

    def __init__(self, keep: int | None = None) -> None:
        self.keep = keep
        self.count = 0
        self.length_s = 0.0
        self._first: list[Gap] = []
        self._newest: deque[Gap] = deque(maxlen=keep)

    def add(self, gap: Gap) -> None:
        """One more."""
        self.count += 1
        self.length_s += gap.length_s
        first = self.keep is None or len(self._first) < self.keep
        (self._first if first else self._newest).append(gap)

    @property
    def kept(self) -> list[Gap]:
        """Those that stay, oldest first."""
        return [*self._first, *self._newest]
