"""What surrounds the core: the record of every input, the journal, the viewer, the summary.

`Shell.feed` is the only way into the core, for the daemon and for a replay. It records the input
before the core sees it, carries out what the core answers, and returns the bytes to send.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ahrsd import events
from ahrsd.core import Core
from ahrsd.errors import JournalError
from ahrsd.inputs import Input, Journalled, JournalOpened
from ahrsd.journal import Journal
from ahrsd.recording.capture import CaptureWriter

log = logging.getLogger("ahrsd")

_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40}


class Viewer(Protocol):
    """Where events go to be looked at; never blocks."""

    def push(self, event: events.Event, host_s: float) -> None:
        """Take an event."""


Listener = Callable[[events.Event], None]  # somebody else who wants every event, in order


@dataclass(slots=True)
class JournalKeeper:
    """Opens the journal of the device that answers, appends, and says how it went."""

    open: Callable[[int], Journal]
    now_ns: Callable[[], int]
    journal: Journal | None = None

    def opened(self, serial: int) -> JournalOpened:
        """Open the journal of a device; an error is an answer, not an exception."""
        try:
            self.journal = self.open(serial)
        except JournalError as error:
            self.journal = None
            return JournalOpened(self.now_ns(), serial, [], str(error))
        records: list[dict[str, object]] = [
            {"kind": r.kind, "facts": dict(r.facts)} for r in self.journal.records()
        ]
        return JournalOpened(self.now_ns(), serial, records)

    def append(self, item: events.JournalAppend) -> Journalled:
        """Make a record durable."""
        if self.journal is None:
            return Journalled(self.now_ns(), item.kind, "no journal is open")
        try:
            self.journal.append(item.kind, **item.facts)
        except JournalError as error:
            return Journalled(self.now_ns(), item.kind, str(error))
        return Journalled(self.now_ns(), item.kind)


@dataclass(slots=True)
class Shell:
    """A core and its side taps; each tap may be absent."""

    core: Core
    capture: CaptureWriter | None = None
    journal: JournalKeeper | None = None
    viewer: Viewer | None = None
    listeners: list[Listener] = field(default_factory=list)
    finished: bool = False
    core_s: float = 0.0

    def feed(self, item: Input) -> bytes:
        """One input through the core; returns what must be written to the port."""
        waiting: list[Input] = [item]
        output = bytearray()
        while waiting:
            one = waiting.pop(0)
            if self.capture is not None:
                self.capture.write(one)
            started = time.process_time()
            answers = self.core.handle(one)
            self.core_s += time.process_time() - started
            for event in answers:
                output += self._carry_out(event, one.host_ns, waiting)
        return bytes(output)

    def _carry_out(self, event: events.Event, host_ns: int, waiting: list[Input]) -> bytes:
        if self.viewer is not None:
            self.viewer.push(event, host_ns * 1e-9)
        for listener in self.listeners:
            listener(event)
        match event:
            case events.Send(data):
                if self.capture is not None:
                    self.capture.write_sent(host_ns, data)
                return data
            case events.OpenJournal(serial) if self.journal is not None:
                waiting.append(self.journal.opened(serial))
            case events.JournalAppend() if self.journal is not None:
                waiting.append(self.journal.append(event))
            case events.RegistersRead(_, values) if self.capture is not None:
                self.capture.write_registers(host_ns, {str(n): v for n, v in values.items()})
            case events.Finished():
                self.finished = True
            case _:
                self._log(event, host_ns)
        return b""

    def _log(self, event: events.Event, host_ns: int) -> None:
        fact: dict[str, object] | None = None
        match event:
            case events.Noted(at_s, _, level, text):
                log.log(_LEVELS[level], "%s", text, extra={"device_s": round(at_s, 3)})
                fact = {"note": text, "level": level, "at_s": at_s}
            case events.StateChanged(at_s, _, old, new, reason):
                log.info("%s -> %s: %s", old, new, reason, extra={"device_s": round(at_s, 3)})
                fact = {"state": new, "from": old, "reason": reason, "at_s": at_s}
            case events.RegisterWritten(at_s, _, register, old_values, new_values, outcome):
                log.info("register %d %s: %s", register, outcome, new_values)
                fact = {
                    "register": register,
                    "old": old_values,
                    "new": new_values,
                    "outcome": outcome,
                    "at_s": at_s,
                }
            case events.Judged(at_s, _, gates):
                fact = {"at_s": at_s, "gates": {g.gate: [g.value, g.limit, g.ok] for g in gates}}
            case _:
                return
        if self.capture is not None and fact is not None:
            self.capture.write_event(host_ns, fact)


def journal_in(directory: Path) -> Callable[[int], Journal]:
    """Opener of journals in a state directory, one per serial number."""
    from ahrsd.journal import journal_path

    def opener(serial: int) -> Journal:
        directory.mkdir(parents=True, exist_ok=True)
        return Journal.open(journal_path(directory, serial))

    return opener
