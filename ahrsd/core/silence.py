"""When a device that ought to talk is asked to talk again: forever, and never more than 5 s apart.

Two things call for it: nothing was measured for a while (an output that was paused for a command
and not resumed, because the reply or the command got lost), or something is owed to the device: the
user's outputs could not be put back, or the session's not be set up. That waits for no silence
and, where the device talks by itself, may wait longer.
"""

from __future__ import annotations

from dataclasses import dataclass

FIRST_S, LONGEST_S = 2.0, 5.0  # outputs have 1 Hz at least, so 2 s without one is a silence


@dataclass(slots=True)
class Silence:
    """See the module."""

    scale: float = 1.0  # of all waits
    asked: int = 0  # times in this silence
    _quiet_until_s: float | None = None
    _owed_at_s: float | None = None
    _owed_wait_s: float = 0.0

    @property
    def due_s(self) -> float | None:
        """When to ask; None where nothing is waited for."""
        due = [time_s for time_s in (self._quiet_until_s, self._owed_at_s) if time_s is not None]
        return min(due, default=None)

    @property
    def owed(self) -> bool:
        """Whether something was owed the last time that it was tried."""
        return self._owed_wait_s > 0.0

    def begin(self, now_s: float) -> None:
        """From now on the device ought to talk."""
        wait_s = min(FIRST_S * 2 ** max(0, self.asked - 1), LONGEST_S)
        self._quiet_until_s = now_s + self.scale * wait_s

    def heard(self, now_s: float) -> None:
        """It did."""
        self.asked = 0
        self.begin(now_s)

    def owe(self, now_s: float, first_s: float, longest_s: float) -> None:
        """Ask whatever the device says until then: after `first_s`, and each time twice as long."""
        self._owed_wait_s = min(max(2.0 * self._owed_wait_s, first_s), longest_s)
        self._owed_at_s = now_s + self.scale * self._owed_wait_s

    def settle(self) -> None:
        """Nothing is owed any more."""
        self._owed_at_s, self._owed_wait_s = None, 0.0

    def pays(self, now_s: float) -> bool:
        """Whether it is time to try again what is owed; `owe` or `settle` says how that went."""
        due = self._owed_at_s is not None and now_s >= self._owed_at_s
        if due:
            self._owed_at_s = None
        return due

    def breaks(self, now_s: float) -> bool:
        """Whether the device has said nothing for too long; then the next wait is longer."""
        if self._quiet_until_s is None or now_s < self._quiet_until_s:
            return False
        self.asked += 1
        self.begin(now_s)
        return True
