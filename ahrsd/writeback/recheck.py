"""When a device that is written or listened to is asked again who it is and what it holds.

At intervals, because another program may write through the device's other port and a restart in a
stream without device time shows nowhere else; soon after anything that makes it doubtful (a
silence, readings or a time that jump), because another device may have the cable.
"""

from __future__ import annotations

from dataclasses import dataclass

LEAST_S = 2.0  # between two that something waits for: a poor link must not be filled with reads


@dataclass(slots=True)
class Recheck:
    """See the module. `due_s` is None while nothing is to be asked."""

    interval_s: float
    due_s: float | None = None
    asked_s: float = float("-inf")  # the newest time
    unanswered: bool = False

    def begin(self, host_s: float) -> None:
        """Restart the interval: the device was read, or is being read."""
        self.asked_s, self.due_s = host_s, host_s + self.interval_s
        self.unanswered = False

    def off(self) -> None:
        """Stop asking: no device is there."""
        self.due_s = None

    def soon(self, host_s: float) -> None:
        """Ask again soon: something is doubtful, or nobody answered."""
        if self.due_s is not None:
            self.due_s = min(self.due_s, max(host_s, self.asked_s + LEAST_S))

    def now(self, host_s: float) -> None:
        """Ask now: something waits for the answer."""
        if self.due_s is not None:
            self.due_s = host_s

    def is_due(self, host_s: float) -> bool:
        """Whether to ask now."""
        return self.due_s is not None and host_s >= self.due_s
