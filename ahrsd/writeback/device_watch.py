"""Whether the device is still the one that was read, and whether it restarted.

**Recheck.** When the identity and registers of the device are read again.

At intervals, because another program may write through the device's other port, and because nothing
else shows a restart in a stream without device time. Soon after a doubt (a silence, readings or a
time that jump), because another device may be on the cable.

**Restarts.** Whether the device restarted: detected in this run, or by its time since start-up.

A suspicion has the device read again at once. Only a proof confirms what is in flash: its time
since start-up compared with the journal's newest record (`restarted_since`); its time that fell in
this run, for a record from before this run; or a restart that it reported, if it sends no time.

Nothing in the stream is a proof while its source is in doubt: during a procedure, when the stream
is not watched; while the device is being identified; and from a doubt until it is confirmed.

A message may have been delayed in a buffer, so a proof by device time uses the earliest start-up
that one second of messages shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from ahrsd.writeback.journal_history import CLOCK_RATE, LATENCY_S, Stamp, restarted_since

# -- Recheck ---------------------------------------------------------------------------------------


LEAST_S = 2.0  # shortest time between two reads: they must not fill a poor link


@dataclass(slots=True)
class Recheck:
    """See the module. `due_s` is None while no device is there."""

    interval_s: float
    due_s: float | None = None
    asked_s: float = float("-inf")  # the newest time
    unanswered: bool = False

    def restart(self, host_s: float) -> None:
        """Restart the interval: the device was read, or is being read."""
        self.asked_s, self.due_s = host_s, host_s + self.interval_s
        self.unanswered = False

    def stop(self) -> None:
        """Stop: no device is there."""
        self.due_s = None

    def schedule_soon(self, host_s: float) -> None:
        """Read again soon: there is a doubt, or nobody answered."""
        if self.due_s is not None:
            self.due_s = min(self.due_s, max(host_s, self.asked_s + LEAST_S))

    def schedule_now(self, host_s: float) -> None:
        """Read again now: something waits for the answer."""
        if self.due_s is not None:
            self.due_s = host_s

    def is_due(self, host_s: float) -> bool:
        """Whether to read again now."""
        return self.due_s is not None and host_s >= self.due_s


# -- Restarts --------------------------------------------------------------------------------------


SETTLE_S: Final = 1.0  # after its first time since it was bound, before its time proves a restart


class RestartWatch:
    """Detects restarts of the device that was bound last; host times are monotonic."""

    def __init__(self) -> None:
        self._serial: int | None = None
        self._bound = False
        self._seen: int | None = None
        self.fell_s = -math.inf  # when its time fell last in this run
        self._read_from_s = math.inf
        self._doubt_s: float | None = None  # since when the source of the messages is in doubt
        self._asked_s = self._answered_s = -math.inf  # of the newest identification
        self._first_s: float | None = None  # when its time came first since it was bound
        self._newest_s = self._newest_at_s = math.nan  # its newest time, and when it came
        self._started_s = math.inf  # its start-up, at the latest

    def on_restart(
        self, record: Stamp, now: Stamp, host_s: float, uptime_s: float | None = None
    ) -> None:
        """A restart was detected; if the device sends its time, that must be after the record.

        A restart that the device only reports (VNERR) counts only if its stream has no time.
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
        """The device's time proved a restart: the next reading of the device counts as after it."""
        self._seen, self._bound = self._serial, False

    def on_link_lost(self) -> None:
        """The link was lost, or there is no device."""
        self._bound = False

    def mark_doubt(self, host_s: float = -math.inf) -> None:
        """From then on messages may be of another device, until one is identified."""
        self._doubt_s = host_s if self._doubt_s is None else min(self._doubt_s, host_s)

    def on_confirmed(self, asked_s: float, answered_s: float) -> None:
        """This device answered; messages between request and answer may still be another's."""
        self._asked_s, self._answered_s = asked_s, answered_s
        if self._doubt_s is not None and self._doubt_s <= asked_s:
            self._doubt_s = None

    def on_other_device(self) -> None:
        """Another device is on the cable: forget what was detected, until a device is read."""
        self.mark_doubt()
        self._bound = False
        self._seen, self.fell_s, self._newest_s = None, -math.inf, math.nan

    def bind(self, serial: int, read_from_s: float) -> bool:
        """A device was identified and read; returns whether a restart of it was detected before."""
        restarted = self._seen == serial
        if serial != self._serial:
            self.fell_s, self._newest_s = -math.inf, math.nan
        self._serial, self._seen, self._bound, self._doubt_s = serial, None, True, None
        self._read_from_s = math.inf if restarted else read_from_s
        self._first_s, self._started_s = None, math.inf
        return restarted

    def on_uptime(self, uptime_s: float, host_s: float) -> str:
        """Take the device's time; returns why to read its registers again, empty if not needed."""
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
        """Whether this time proves it; a record of another boot is older than this run."""
        of_before = bool(now.boot_id) and record.boot_id != now.boot_id
        return (self.fell_s > -math.inf and of_before) or restarted_since(record, now, uptime_s)

    def is_doubtful(self, host_s: float) -> bool:
        """Whether the source was in doubt before now: a restart itself makes readings jump."""
        asking = self._asked_s < host_s < self._answered_s
        return asking or (self._doubt_s is not None and self._doubt_s < host_s)

    def _note_fall(self, uptime_s: float, host_s: float) -> None:
        if self._has_fallen(uptime_s) and self._may_have_restarted(uptime_s, host_s):
            self.fell_s = host_s

    def _has_fallen(self, uptime_s: float) -> bool:
        return uptime_s < self._newest_s - LATENCY_S

    def _may_have_restarted(self, uptime_s: float, host_s: float) -> bool:
        """False if its time is longer than the time since its last message."""
        since_s = host_s - self._newest_at_s
        return uptime_s <= since_s * (1.0 + CLOCK_RATE) + LATENCY_S
