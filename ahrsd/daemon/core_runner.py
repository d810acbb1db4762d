"""What surrounds the core: the record of every input, the journal, the viewer, the log, its thread.

`Shell.feed` is the only way into the core, for the daemon and for a replay. It records the input
before the core sees it, carries out what the core answers, and returns the bytes to send.

**Tasks of the estimation** (`Worker`, `core.estimation`) are done in a thread beside the daemon's
loop. Python lets one thread run at a time, and lets another one have its turn after `SWITCH_S`:
that, and no longer, is what a byte waits for a long computation.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

from ahrsd import events
from ahrsd.config.config import CONFIG_KEY, Config, core_settings, print_config
from ahrsd.core.core import Core
from ahrsd.core.settings import BESIDE_KEY
from ahrsd.daemon import host_clock
from ahrsd.daemon.host_clock import HostClock
from ahrsd.daemon.journal import Journal
from ahrsd.errors import CaptureError, JournalError
from ahrsd.events import Failure
from ahrsd.inputs import Input, Journalled, JournalOpened
from ahrsd.recording.capture import CaptureWriter, make_private_folder
from ahrsd.viewer.sink import RerunLimits, RerunSink
from ahrsd.writeback.journal_history import find_record_of_other_device

log = logging.getLogger("ahrsd")

# -- Tasks of the estimation -----------------------------------------------------------------------


SWITCH_S = 0.0005
MOST_WAITING = 40  # pieces of up to 2 s of samples each: older verdicts are of no use
_STUCK_S = 5.0  # no piece takes so long: then the service manager's watchdog gets no message
_MOST_REASONS = 16  # different failures of which the traceback is logged, once each


class Worker:
    """Does what it is given, in order. `woken` is called after each piece, from the thread.

    Giving never waits: who takes the bytes that become pieces asks `full` before, and lets the
    bytes wait instead. What breaks off is logged once, and told by `take_done`.
    """

    def __init__(self) -> None:
        self.woken: Callable[[], None] = lambda: None
        self._todo: SimpleQueue[Callable[[], Failure | None] | None] = SimpleQueue()
        self._free = threading.Event()
        self._put = self._done = self._told = 0  # each is written by one thread only
        self._broken: SimpleQueue[tuple[int, str]] = SimpleQueue()  # which piece, and how
        self._reasons: set[str] = set()
        self._ended = self._closing = False
        self._began_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="estimator", daemon=True)
        self._thread.start()

    def put(self, work: Callable[[], Failure | None]) -> None:
        """One more."""
        self._put += 1
        self._todo.put(work)

    @property
    def full(self) -> bool:
        """Whether so many wait that nothing more should be given."""
        return self._put - self._done >= MOST_WAITING and not (self._ended or self.stuck)

    def wait_for_room(self, timeout_s: float) -> None:
        """Until a piece is done."""
        self._free.clear()
        if self.full:
            self._free.wait(timeout_s)

    def take_done(self) -> list[tuple[int, str]]:
        """How many were done since this was asked last; one that broke off is the last of a pair.

        Raises RuntimeError where the thread itself ended.
        """
        if self._ended and not self._closing:
            raise RuntimeError("the estimator's thread ended, see above")
        done, batches = self._done, []
        while not self._broken.empty():
            number, reason = self._broken.get()
            batches.append((number - self._told, reason))
            self._told = number
        if done > self._told:
            batches.append((done - self._told, ""))
            self._told = done
        return batches

    @property
    def stuck(self) -> bool:
        """Whether it has been at one piece for longer than any takes."""
        began_s = self._began_s
        return began_s is not None and time.monotonic() - began_s > _STUCK_S

    def close(self, timeout_s: float) -> None:
        """Leave what waits; what is under way may end within `timeout_s`."""
        self._closing = True
        self._todo.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while (work := self._todo.get()) is not None and not self._closing:
                self._began_s = time.monotonic()
                failure = work()
                self._began_s = None
                if failure is not None:
                    self._log(failure)
                    self._broken.put((self._done + 1, failure.reason))
                self._done += 1
                self._free.set()
                self.woken()
        finally:  # also after a bug: who waits for the work must know it
            self._ended = True
            self._free.set()
            self.woken()

    def _log(self, failure: Failure) -> None:
        if failure.reason in self._reasons or len(self._reasons) >= _MOST_REASONS:
            return
        self._reasons.add(failure.reason)
        log.error("the estimator broke off: %s", failure.reason, extra={"trace": failure.trace})


# -- The core and its side taps --------------------------------------------------------------------


_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40}
_CLOSE_S = 8.0  # to close, where nobody waits for the end
_LEAST_S = 0.2
_FOLD_S = 60.0  # a text that is repeated within this time is only counted
_FOLD_TEXTS = 64  # largest number of texts that are counted at one time
DAEMON_KEEPS = 64  # decisions and gaps in memory; the capture has them all


class Viewer(Protocol):
    """Where events go to be looked at; never blocks."""

    def push(self, event: events.Event, host_s: float) -> None:
        """Take an event."""


Listener = Callable[[events.Event], None]  # somebody else who wants every event, in order


@dataclass(slots=True)
class FoldedLog:
    """The log, in which a text that comes again within a minute is only counted."""

    write: Callable[[int, str], None] = lambda level, text: log.log(level, "%s", text)
    _open: OrderedDict[tuple[int, str], tuple[float, int]] = field(default_factory=OrderedDict)

    def say(self, level: int, text: str, now_s: float) -> None:
        """Write it now, or count it."""
        self.settle(now_s)
        key = (level, text)
        if key in self._open:
            since_s, count = self._open[key]
            self._open[key] = (since_s, count + 1)
            return
        self.write(level, text)
        self._open[key] = (now_s, 0)
        if len(self._open) > _FOLD_TEXTS:
            self._end(*self._open.popitem(last=False))

    def unfold(self, level: int, text: str) -> None:
        """The text is news again: the next time it is written."""
        if (counted := self._open.pop((level, text), None)) is not None:
            self._end((level, text), counted)

    def settle(self, now_s: float) -> None:
        """Write the counts whose minute is over."""
        while self._open and now_s - next(iter(self._open.values()))[0] >= _FOLD_S:
            self._end(*self._open.popitem(last=False))

    def finish(self) -> None:
        """The end: write every count."""
        while self._open:
            self._end(*self._open.popitem(last=False))

    def _end(self, key: tuple[int, str], value: tuple[float, int]) -> None:
        if value[1]:
            again = "once more" if value[1] == 1 else f"{value[1]} more times"
            self.write(key[0], f"{key[1]} ({again})")


@dataclass(slots=True)
class JournalKeeper:
    """Opens the journal of the device that answers, appends, and says how it went."""

    open: Callable[[int], Journal]
    now_ns: Callable[[], int]
    journal: Journal | None = None

    def opened(self, serial: int) -> JournalOpened:
        """Open the journal of a device; an error is an answer, not an exception."""
        self.journal = None
        try:
            journal = self.open(serial)
        except JournalError as error:
            return JournalOpened(self.now_ns(), serial, [], str(error))
        if other := find_record_of_other_device(journal.records(), serial):
            text = f"{journal.path}: {other}; move the file away or put that device's name on it"
            return JournalOpened(self.now_ns(), serial, [], text)
        self.journal = journal
        records: list[dict[str, object]] = [
            {"kind": r.kind, "facts": dict(r.facts)} for r in journal.records()
        ]
        return JournalOpened(self.now_ns(), serial, records)

    def append(self, item: events.JournalAppend) -> Journalled:
        """Make a record durable."""
        if self.journal is None:
            return Journalled(self.now_ns(), item.kind, "no journal is open")
        try:
            self.journal.append(item.kind, **{**host_clock.stamp(), **item.facts})
        except JournalError as error:
            return Journalled(self.now_ns(), item.kind, str(error))
        return Journalled(self.now_ns(), item.kind)


@dataclass(slots=True)
class Shell:
    """A core and its side taps; each tap may be absent.

    to_client: takes what is for a program on a shared port
    """

    core: Core
    capture: CaptureWriter | None = None
    journal: JournalKeeper | None = None
    viewer: Viewer | None = None
    listeners: list[Listener] = field(default_factory=list)
    finished: bool = False
    folded: FoldedLog = field(default_factory=FoldedLog)
    worker: Worker | None = None
    to_client: Callable[[events.SendToClient], None] | None = None

    def feed(self, item: Input) -> bytes:
        """One input through the core; returns what must be written to the port."""
        waiting: list[Input] = [item]
        output = bytearray()
        while waiting:
            one = waiting.pop(0)
            if self.capture is not None:
                self.capture.write(one)
            for event in self.core.handle(one):
                output += self._carry_out(event, one.host_ns, waiting)
        return bytes(output)

    def say(self, level: int, text: str, host_ns: int) -> None:
        """A fact of the shell's own, for the log and the record."""
        self.folded.say(level, text, host_ns * 1e-9)
        if self.capture is not None:
            name = logging.getLevelName(level).lower()
            self.capture.write_event(host_ns, {"note": text, "level": name})

    @property
    def viewer_losses(self) -> tuple[int, str]:
        """How many events the viewer dropped, and its newest fault."""
        if not isinstance(self.viewer, RerunSink):
            return 0, ""
        return self.viewer.counters.dropped, self.viewer.counters.last_fault

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
            case events.SendToClient(client, data):
                if self.capture is not None:
                    fact = {"to": client, "data": data.decode("latin-1")}
                    self.capture.write_event(host_ns, fact)
                if self.to_client is not None:
                    self.to_client(event)
            case events.OpenJournal(serial) if self.journal is not None:
                waiting.append(self.journal.opened(serial))
            case events.JournalAppend() if self.journal is not None:
                waiting.append(self.journal.append(event))
            case events.Examine(work) if self.worker is not None:
                self.worker.put(work)
            case events.RegistersRead(_, values) if self.capture is not None:
                self.capture.write_registers(host_ns, {str(n): v for n, v in values.items()})
            case events.Finished():
                self.finished = True
            case _:
                self._log(event, host_ns)
        return b""

    def _log(self, event: events.Event, host_ns: int) -> None:
        line: tuple[int, str] | None = None
        match event:
            case events.Noted(at_s, _, level, text):
                line = (_LEVELS[level], text)
                fact: dict[str, object] = {"note": text, "level": level, "at_s": at_s}
            case events.StateChanged(at_s, _, old, new, reason):
                line = (logging.INFO, f"{old} -> {new}: {reason}")
                fact = {"state": new, "from": old, "reason": reason, "at_s": at_s}
            case events.RegisterWritten(at_s, _, register, old_values, new_values, outcome):
                line = (logging.INFO, f"register {register} {outcome}: {new_values}")
                values = {"old": old_values, "new": new_values}
                fact = {"register": register, **values, "outcome": outcome, "at_s": at_s}
            case events.Judged(at_s, _, gates):
                fact = {"at_s": at_s, "gates": {g.gate: [g.value, g.limit, g.ok] for g in gates}}
            case _:
                return
        if line is not None:
            self.folded.say(*line, host_ns * 1e-9)
        if self.capture is not None:
            self.capture.write_event(host_ns, fact)


def journal_in(directory: Path) -> Callable[[int], Journal]:
    """Opener of journals in a state directory, one per serial number."""
    from ahrsd.daemon.journal import journal_path

    def opener(serial: int) -> Journal:
        return Journal.open(journal_path(directory, serial))

    return opener


def open_shell(config: Config, clock: HostClock, capture: Path | None) -> Shell:
    """The core with its capture, journal and viewer, as the configuration says.

    Raises CaptureError where there can be no capture.
    """
    core = Core(replace(core_settings(config), keep=DAEMON_KEEPS, beside=True))
    writer = None if capture is None else _open_capture(config, capture)
    viewer = None
    if config.rerun.file is not None or config.rerun.serve:
        limits = RerunLimits(server_bytes=config.rerun.memory_megabytes * 1_000_000)
        viewer = RerunSink(config.rerun.file, config.rerun.serve, config.rerun.port, limits=limits)
    keeper = JournalKeeper(journal_in(config.state), clock.now_ns)
    return Shell(core, writer, keeper, viewer, worker=Worker())


def _open_capture(config: Config, path: Path) -> CaptureWriter:
    try:
        make_private_folder(path.parent)
    except OSError as error:
        raise CaptureError(
            f"{path.parent}: the folder of the captures cannot be made: {error.strerror}; set "
            "capture.directory, or capture.enabled = false"
        ) from error
    return CaptureWriter(
        path,
        {"program": "ahrsd run", CONFIG_KEY: print_config(config), BESIDE_KEY: "beside"},
        part_bytes=config.capture.part_megabytes * 1_000_000,
        keep_bytes=config.capture.keep_megabytes * 1_000_000,
    )


def close_shell(shell: Shell, until_s: float | None = None) -> None:
    """Close what `open_shell` opened, all of it by `until_s` (monotonic) or soon."""
    until_s = time.monotonic() + _CLOSE_S if until_s is None else until_s

    def left_s() -> float:
        return max(until_s - time.monotonic(), _LEAST_S)

    if shell.worker is not None:
        shell.worker.close(left_s() / 4)
    if shell.capture is not None:
        status = shell.capture.close(left_s())  # before the viewer: it can be replayed
        if not status.complete:
            log.error("capture incomplete: %d bytes lost: %s", status.lost_bytes, status.error)
    if isinstance(shell.viewer, RerunSink):
        shell.viewer.close(left_s())
        if fault := shell.viewer.counters.last_fault:
            log.warning("rerun: %s", fault)
