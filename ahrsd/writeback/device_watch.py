"""Whether the device is still the one that was read, and still runs: asked again, seen by itself.

**Recheck.** When a device that is written or listened to is asked again who it is and what it
holds.

At intervals, because another program may write through the device's other port and a restart in a
stream without device time shows nowhere else; soon after anything that makes it doubtful (a
silence, readings or a time that jump), because another device may have the cable.

**Restarts.** Whether the device restarted, by what it shows itself: seen in this run, or told by
its time.

A suspicion has the device read again at once. Only a proof confirms what is in flash: its time
since start-up against the journal's newest record (`restarted_since`); its time that fell in
this run, for a record of before this run; or a restart that it reported, where it tells no time.

While it is doubtful whose the stream is, nothing that it shows is a proof: in a procedure, when
nobody watches it, while the device is asked who it is, and from a doubt on until it said so.

A message may have lain in a buffer, as old as its time says, so a proof by its time takes the
earliest start-up that a second of messages shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from ahrsd.writeback.journal_history import CLOCK_RATE, LATENCY_S, Stamp, restarted_since

# -- Recheck ---------------------------------------------------------------------------------------


LEAST_S = 2.0  # between two that something waits for: a poor link must not be filled with reads


@dataclass(slots=True)
class Recheck:
    """See the module. `due_s` is None while nothing is to be asked."""

    interval_s: float
    due_s: float | None = None
    asked_s: float = float("-inf")  # the newest time
    unanswered: bool = False

    def restart(self, host_s: float) -> None:
        """Restart the interval: the device was read, or is being read."""
        self.asked_s, self.due_s = host_s, host_s + self.interval_s
        self.unanswered = False

    def stop(self) -> None:
        """Stop asking: no device is there."""
        self.due_s = None

    def schedule_soon(self, host_s: float) -> None:
        """Ask again soon: something is doubtful, or nobody answered."""
        if self.due_s is not None:
            self.due_s = min(self.due_s, max(host_s, self.asked_s + LEAST_S))

    def schedule_now(self, host_s: float) -> None:
        """Ask now: something waits for the answer."""
        if self.due_s is not None:
            self.due_s = host_s

    def is_due(self, host_s: float) -> bool:
        """Whether to ask now."""
        return self.due_s is not None and host_s >= self.due_s


# -- Restarts --------------------------------------------------------------------------------------


SETTLE_S: Final = 1.0


class RestartWatch:
    """Of the device that was bound last; host times are monotonic."""

    def __init__(self) -> None:
        self._serial: int | None = None
        self._bound = False
        self._seen: int | None = None
        self.fell_s = -math.inf  # when its time fell last since this run knows it
        self._read_from_s = math.inf
        self._doubt_s: float | None = None  # since when nobody knows whose the messages are
        self._asked_s = self._answered_s = -math.inf  # who it is, the newest time
        self._first_s: float | None = None  # when its time was heard first since it was bound
        self._newest_s = self._newest_at_s = math.nan  # its time, as last heard, and when
        self._started_s = math.inf  # when it started up, at the latest

    def on_restart(
        self, record: Stamp, now: Stamp, host_s: float, uptime_s: float | None = None
    ) -> None:
        """A restart was seen; a device that tells its time must show that it was after the record.

        So what the device only reports (VNERR) counts where its stream has no time.
        """
        if self.is_doubtful(host_s):
            self._bound = False
            return
        if uptime_s is not None:
            self._note_fall(uptime_s, host_s)
        untimed = uptime_s is None and self._first_s is None
        if untimed or self._proves_restart_since(record, now, uptime_s):
            self._seen = self._serial
        self._bound = False

    def on_restart_proven(self) -> None:
        """Its time has proven a restart: the device is read again, and that counts."""
        self._seen, self._bound = self._serial, False

    def on_link_lost(self) -> None:
        """The link went away, or nobody is there to ask."""
        self._bound = False

    def mark_doubt(self, host_s: float = -math.inf) -> None:
        """From then on the messages may be another device's, until one says who it is."""
        self._doubt_s = host_s if self._doubt_s is None else min(self._doubt_s, host_s)

    def on_confirmed(self, asked_s: float, answered_s: float) -> None:
        """It was this device that was asked; what came in between may still be another's."""
        self._asked_s, self._answered_s = asked_s, answered_s
        if self._doubt_s is not None and self._doubt_s <= asked_s:
            self._doubt_s = None

    def on_other_device(self) -> None:
        """Another device has the cable: what was seen may be of that one, until one is read."""
        self.mark_doubt()
        self._bound = False
        self._seen, self.fell_s, self._newest_s = None, -math.inf, math.nan

    def bind(self, serial: int, read_from_s: float) -> bool:
        """A device was identified and read; whether this one was seen to restart before."""
        restarted = self._seen == serial
        if serial != self._serial:
            self.fell_s, self._newest_s = -math.inf, math.nan
        self._serial, self._seen, self._bound, self._doubt_s = serial, None, True, None
        self._read_from_s = math.inf if restarted else read_from_s
        self._first_s, self._started_s = None, math.inf
        return restarted

    def on_uptime(self, uptime_s: float, host_s: float) -> str:
        """The device's time; why its registers must be read again, empty where they need not."""
        if not self._bound:
            return ""
        if first := self._first_s is None:
            self._first_s = host_s
        fell = self._has_fallen(uptime_s)
        if fell and not first:
            return "the device restarted: its time fell"
        if not self.is_doubtful(host_s):
            self._note_fall(uptime_s, host_s)
        self._newest_s, self._newest_at_s = uptime_s, host_s
        self._started_s = min(self._started_s, host_s - uptime_s)
        stale = first and uptime_s < host_s - self._read_from_s - LATENCY_S
        return "the device restarted since it was read" if stale else ""

    def proves_restart(self, record: Stamp, now: Stamp, host_s: float) -> bool:
        """Whether the device's time proves a restart since this record."""
        settled = self._first_s is not None and host_s - self._first_s >= SETTLE_S
        if not (self._bound and settled) or self.is_doubtful(host_s):
            return False
        return self._proves_restart_since(record, now, host_s - self._started_s)

    def _proves_restart_since(self, record: Stamp, now: Stamp, uptime_s: float | None) -> bool:
        """A record of another boot of the host is older than this run."""
        of_before = bool(now.boot_id) and record.boot_id != now.boot_id
        return (self.fell_s > -math.inf and of_before) or restarted_since(record, now, uptime_s)

    def is_doubtful(self, host_s: float) -> bool:
        """Whether it is, and was before now: a restart itself makes readings jump."""
        asking = self._asked_s < host_s < self._answered_s
        return asking or (self._doubt_s is not None and self._doubt_s < host_s)

    def _note_fall(self, uptime_s: float, host_s: float) -> None:
        if self._has_fallen(uptime_s) and self._may_have_restarted(uptime_s, host_s):
            self.fell_s = host_s

    def _has_fallen(self, uptime_s: float) -> bool:
        return uptime_s < self._newest_s - LATENCY_S

    def _may_have_restarted(self, uptime_s: float, host_s: float) -> bool:
        """Not where its time says that it runs for longer than since it was heard before."""
        since_s = host_s - self._newest_at_s
        return uptime_s <= since_s * (1.0 + CLOCK_RATE) + LATENCY_S
