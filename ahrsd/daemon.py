"""The daemon: a port, a clock and the shell around the core.

One loop: wait for bytes, a deadline, the vehicle's word or a signal; hand each to the core as an
input; write what it answers. Losing the port is normal: the loop waits for it to come back and the
core identifies the device again. At the end (SIGTERM, SIGINT) the core first puts back what it
changed for the session.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Protocol

from ahrsd import inputs
from ahrsd.config import CONFIG_KEY, Config
from ahrsd.config_text import print_config
from ahrsd.core import Core
from ahrsd.errors import EXIT_DONE, ConfigError
from ahrsd.interlock import InterlockFile
from ahrsd.operator_box import OperatorBox
from ahrsd.recording.capture import CaptureWriter
from ahrsd.recording.retention import new_capture_path
from ahrsd.rerun_sink import RerunLimits, RerunSink
from ahrsd.serial_reader import Bytes, Lost, SerialReader
from ahrsd.settings import core_settings, with_date
from ahrsd.shell import JournalKeeper, Shell, journal_in
from ahrsd.summary import summary_lines
from drivers.serial_port import LinkLost, PortError, SerialPort, detect_baud
from drivers.usb import latency_timer_ms

log = logging.getLogger("ahrsd")

_REOPEN_S = (0.05, 2.0)  # first wait for a port to come back, longest wait
_LONGEST_WAIT_S = 0.2
_STOP_S = 2.5  # for putting things back; a service manager's patience is limited
_INTERLOCK_S = 0.2
_OPERATOR_S = 0.5
_WALL_STEP_S = 1.0
_VIEWER_S = 3.0


class Vehicle(Protocol):
    """Who says whether a write is safe now."""

    def safe(self) -> bool:
        """The word; anything that goes wrong is no."""


Queue = SimpleQueue[Bytes | Lost | None]


@dataclass(frozen=True, slots=True)
class HostClock:
    """Monotonic host time in ns, `speed` times as fast as real time (1 but for demonstrations)."""

    speed: float = 1.0
    start_ns: int = field(default_factory=time.monotonic_ns)

    def now_ns(self) -> int:
        """Nanoseconds, never falling."""
        return self.start_ns + int((time.monotonic_ns() - self.start_ns) * self.speed)


class Daemon:
    """Runs one device until `stop` is called. `listeners` on the shell see every event."""

    def __init__(
        self,
        config: Config,
        shell: Shell,
        port_path: Path,
        clock: HostClock,
        interlock: Vehicle | None = None,
        box: OperatorBox | None = None,
    ) -> None:
        self.config, self.shell, self.clock = config, shell, clock
        self._path, self._interlock, self._box = port_path, interlock, box
        self._queue: Queue = SimpleQueue()
        self._port: SerialPort | None = None
        self._reader: SerialReader | None = None
        self._baud: int | None = None
        self._stop_reason = ""
        self._operator: SimpleQueue[inputs.Operator] = SimpleQueue()
        self._next_interlock_ns = self._next_box_ns = 0
        self._wall_offset_s = float("nan")
        self.opened = 0

    # -- from outside ------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """End the run; safe from a signal handler and from another thread."""
        self._stop_reason = self._stop_reason or reason
        self._queue.put(None)

    def operate(self, verb: str, argument: str = "") -> None:
        """A person's command; safe from another thread."""
        self._operator.put(inputs.Operator(self.clock.now_ns(), verb, argument))
        self._queue.put(None)

    # -- the run -----------------------------------------------------------------------------------

    def run(self) -> None:
        """Until stopped. Raises PortError only where the port cannot be opened the first time."""
        self._tell_wall()
        self._open()
        try:
            while not self._stop_reason:
                if self._port is None:
                    self._wait_for_port()
                    continue
                self._turn(_LONGEST_WAIT_S)
            self._finish()
        finally:
            self._close()

    def _turn(self, longest_s: float) -> None:
        """One wait and what it brought."""
        try:
            item = self._queue.get(timeout=self._wait_s(longest_s))
        except queue.Empty:
            item = None
        self._around()
        if isinstance(item, Bytes):
            self._feed(inputs.Received(item.host_ns, item.data))
        elif isinstance(item, Lost):
            self._lost(item.host_ns, item.reason)
        if self._queue.empty():  # else what is waited for may lie in the queue already
            now, deadline = self.clock.now_ns(), self.shell.core.deadline_ns
            if deadline is not None and now >= deadline:
                self._feed(inputs.Tick(now))

    def _around(self) -> None:
        """The vehicle's word, operators and the wall clock: before bytes are judged by them."""
        now = self.clock.now_ns()
        if self._interlock is not None and now >= self._next_interlock_ns:
            self._next_interlock_ns = now + int(_INTERLOCK_S * 1e9)
            self._feed(inputs.Interlock(now, self._interlock.safe()))
        if self._box is not None and now >= self._next_box_ns:
            self._next_box_ns = now + int(_OPERATOR_S * 1e9)
            for verb, argument in self._box.take():
                self._operator.put(inputs.Operator(now, verb, argument))
        while True:
            with contextlib.suppress(queue.Empty):
                self._feed(self._operator.get_nowait())
                continue
            break
        self._tell_wall()

    def _wait_s(self, longest_s: float) -> float:
        deadline = self.shell.core.deadline_ns
        if deadline is None:
            return longest_s
        left_s = (deadline - self.clock.now_ns()) * 1e-9 / self.clock.speed
        return min(max(left_s, 0.0), longest_s)

    def _tell_wall(self) -> None:
        """The wall clock, at the start and when it was set: budgets count days by it."""
        now_ns = self.clock.now_ns()
        offset_s = time.time() - now_ns * 1e-9 / self.clock.speed
        if not abs(offset_s - self._wall_offset_s) < _WALL_STEP_S:
            self._wall_offset_s = offset_s
            self._feed(inputs.WallClock(now_ns, time.time()))

    def _feed(self, item: inputs.Input) -> None:
        output = self.shell.feed(item)
        if output and self._port is not None:
            try:
                self._port.write(output)
            except LinkLost as error:
                self._lost(self.clock.now_ns(), str(error))

    # -- the port ----------------------------------------------------------------------------------

    def _open(self) -> None:
        self._baud = self._find_baud()
        port = SerialPort(self._path, self._baud)
        self._port = port
        self._reader = SerialReader(port, self._queue, self.clock.now_ns)
        self.opened += 1
        latency = latency_timer_ms(self._path)
        now = self.clock.now_ns()
        self._feed(inputs.LinkOpened(now, str(self._path), self._baud, latency))

    def _find_baud(self) -> int:
        said = self.config.device.baud
        if said != "auto":
            return said
        if self._baud is not None:
            return self._baud
        found = detect_baud(self._path, may_query=self.config.mode != "passive")
        log.info("%s", found)
        return found.baud

    def _lost(self, host_ns: int, reason: str) -> None:
        self._close()
        self._feed(inputs.LinkLost(host_ns, reason))

    def _wait_for_port(self) -> None:
        """Try again and again, quickly first; one line in the log, not one per try."""
        wait_s, said = _REOPEN_S[0], ""
        while not self._stop_reason:
            try:
                self._open()
            except PortError as error:
                if str(error) != said:
                    said = str(error)
                    log.warning("waiting for the device: %s", said)
            else:
                return
            with contextlib.suppress(queue.Empty):
                self._queue.get(timeout=wait_s)
            self._around()
            wait_s = min(wait_s * 1.5, _REOPEN_S[1])

    def _close(self) -> None:
        reader, port = self._reader, self._port
        self._reader = self._port = None
        if reader is not None:
            reader.stop()
        if port is not None:
            port.close()
        while True:  # what the reader still put there belongs to a link that is gone
            try:
                self._queue.get_nowait()
            except queue.Empty:
                break
        if self._stop_reason:
            self._queue.put(None)

    def _finish(self) -> None:
        """Let the core put back what it changed; bounded in time."""
        self._feed(inputs.Stop(self.clock.now_ns(), self._stop_reason))
        until = time.monotonic() + _STOP_S
        while not self.shell.finished and time.monotonic() < until and self._port is not None:
            self._turn(0.05)
        if not self.shell.finished:
            log.error("stopped without having put everything back: %s", self._stop_reason)


@contextlib.contextmanager
def _signals(daemon: Daemon) -> Iterator[None]:
    """SIGTERM and SIGINT end the run in an orderly way."""

    def handler(number: int, _: FrameType | None) -> None:
        daemon.stop(signal.Signals(number).name)

    before = {s: signal.signal(s, handler) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def open_shell(config: Config, clock: HostClock, capture: Path | None) -> Shell:
    """The core with its capture, journal and viewer, as the configuration says."""
    writer = None
    if capture is not None:
        capture.parent.mkdir(parents=True, exist_ok=True)
        writer = CaptureWriter(
            capture,
            {"program": "ahrsd run", CONFIG_KEY: print_config(config)},
            part_bytes=config.capture.part_megabytes * 1_000_000,
            keep_bytes=config.capture.keep_megabytes * 1_000_000,
        )
    viewer = None
    if config.rerun.file is not None or config.rerun.serve:
        limits = RerunLimits(server_bytes=config.rerun.memory_megabytes * 1_000_000)
        viewer = RerunSink(config.rerun.file, config.rerun.serve, config.rerun.port, limits=limits)
    keeper = JournalKeeper(journal_in(config.state), clock.now_ns)
    return Shell(Core(core_settings(config)), writer, keeper, viewer)


def close_shell(shell: Shell) -> None:
    """Close what `open_shell` opened, each bounded in time."""
    if isinstance(shell.viewer, RerunSink):
        shell.viewer.close(_VIEWER_S)
        if fault := shell.viewer.counters.last_fault:
            log.warning("rerun: %s", fault)
    if shell.capture is not None:
        status = shell.capture.close()
        if not status.complete:
            log.error("capture incomplete: %d bytes lost: %s", status.lost_bytes, status.error)


def run_daemon(config: Config, say: Callable[[str], None] = print) -> int:
    """`ahrsd run`: until a signal; returns the exit code."""
    port = config.device.port
    if port is None:
        raise ConfigError(["device.port: no port is given"])
    config = with_date(config)
    box = OperatorBox(config.state)
    try:
        box.prepare()
    except OSError as error:
        raise ConfigError([f"state_directory: {box.folder}: {error.strerror}"]) from None
    clock = HostClock()
    capture = new_capture_path(config.captures) if config.capture.enabled else None
    shell = open_shell(config, clock, capture)
    interlock = None
    if config.interlock.file is not None:
        interlock = InterlockFile(config.interlock.file, config.interlock.max_age_s)
    daemon = Daemon(config, shell, port, clock, interlock, box)
    try:
        with _signals(daemon):
            daemon.run()
    finally:
        close_shell(shell)
    for line in summary_lines(shell.core, str(capture or port)):
        say(line)
    return EXIT_DONE
