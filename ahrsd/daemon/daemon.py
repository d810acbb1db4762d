"""The daemon: a port, a clock and the shell around the core.

One loop: wait for bytes, a deadline, the vehicle's word or a signal; hand each to the core as an
input; write what it answers. Losing the port is normal: the loop waits for it to come back and the
core identifies the device again. At the end (SIGTERM, SIGINT) the core first puts back what it
changed for the session.

**Samples of an earlier run** (`Recall`): the newest captures are read for a warm start, beside the
run that begins. The thread ends by itself, within `LONGEST_S`; whatever goes wrong in it is a
reason for a run that begins with nothing, never an end of the run.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

from ahrsd import inputs
from ahrsd.config.config import Change, Config, Reloader
from ahrsd.core.core import Core
from ahrsd.core.estimation import run_supervised
from ahrsd.daemon import host_clock
from ahrsd.daemon.core_runner import Shell
from ahrsd.daemon.health_log import Watch
from ahrsd.daemon.serial_link import Bytes, Item, Lost, SerialLink
from ahrsd.daemon.vehicle_files import VehicleFiles
from ahrsd.recording.earlier_run import earlier_inputs
from ahrsd.telemetry.feeds import Outlet
from ahrsd.telemetry.status import LinkFacts
from ahrsd.writeback.journal_history import Stamp
from drivers.serial_port import PortError, PortLost, find_device, latency_timer_ms, spelled

log = logging.getLogger("ahrsd")

# -- Samples of an earlier run ---------------------------------------------------------------------


LONGEST_S = 120.0


class Recall:
    """Reads; `take` gives one input at a time, once all of them are there."""

    def __init__(
        self, read: Callable[[Callable[[], bool]], list[inputs.EarlierSamples | inputs.EarlierRun]]
    ) -> None:
        self._read = read
        self._found: deque[inputs.EarlierSamples | inputs.EarlierRun] = deque()
        self._until_s = time.monotonic() + LONGEST_S
        self._thread = threading.Thread(target=self._run, name="earlier runs", daemon=True)
        self._thread.start()

    @staticmethod
    def of(config: Config, own: Path | None) -> Recall | None:
        """As the configuration says; None where no earlier run is of use."""
        limit_s = config.estimator.warm_start_s
        if limit_s <= 0.0 or config.mode == "passive":
            return None
        now = Stamp(time.time(), host_clock.boot_id(), host_clock.boot_s())
        folder, rate_hz = config.captures, config.estimator.step_rate_hz
        return Recall(lambda go_on: earlier_inputs(folder, own, now, limit_s, rate_hz, go_on))

    def _run(self) -> None:
        found, failure = run_supervised(lambda: self._read(self._go_on))
        if failure is not None:
            log.error("no warm start: %s", failure.reason, extra={"trace": failure.trace})
            found = [inputs.EarlierRun(0, why=failure.reason)]
        self._found.extend(found or ())

    def _go_on(self) -> bool:
        return time.monotonic() < self._until_s

    def take(self, host_ns: int) -> inputs.EarlierSamples | inputs.EarlierRun | None:
        """The next input, as of now; None while there is none."""
        if self._thread.is_alive() or not self._found:
            return None
        return replace(self._found.popleft(), host_ns=host_ns)


# -- The loop --------------------------------------------------------------------------------------


_REOPEN_S = (0.05, 0.5)  # first wait for a port to come back, longest wait
_LONGEST_WAIT_S = 0.2  # longest wait for bytes in one turn of the loop
_BEHIND_S = 0.05  # longest wait for an estimator that is behind
_SHORTEST_WAIT_S = 0.002  # so that the reader has its turn after long work
_STOP_S = 1.6  # to put the device's settings back; a service manager waits only so long
_CLEANUP_S = 2.0  # to put the device's output back after a bug
_WATCH_S = 1.0  # interval of the health log
_WALL_STEP_S = 1.0  # step of the wall clock that is passed to the core
_SUSPENDED_S = 0.5  # a longer suspension of the host restarts the link


def _asleep_s() -> float:
    """How long the host has been suspended since it booted."""
    while True:  # until nothing came between the clocks
        before_s = time.clock_gettime(time.CLOCK_MONOTONIC)
        boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        if time.clock_gettime(time.CLOCK_MONOTONIC) - before_s < _SUSPENDED_S / 10:
            return boot_s - before_s


class Telemetry(Protocol):
    """Who tells the world how the daemon stands."""

    def feed(self, outlets: Iterable[Outlet]) -> None:
        """Send what these shares are for."""

    def turn(self, core: Core, now_s: float, *, well: bool) -> None:
        """The loop turned once; all is `well`, or the watchdog must know."""

    def look(self, core: Core, link: LinkFacts, now_s: float) -> None:
        """About once a second: the newest status."""

    def stopping(self) -> None:
        """The daemon ends."""


class Daemon:
    """Runs one device until `stop` is called. `listeners` on the shell see every event.

    baud: of the port where it was found already, else as the configuration says
    files: what the vehicle and a person say; terms: text of a repaired model
    recall: reads what earlier runs left
    """

    def __init__(
        self,
        config: Config,
        shell: Shell,
        port_path: Path,
        clock: host_clock.HostClock,
        files: VehicleFiles | None = None,
        *,
        baud: int | None = None,
        telemetry: Telemetry | None = None,
        terms: str = "",
        reloader: Reloader | None = None,
        recall: Recall | None = None,
    ) -> None:
        self.config, self.shell, self.clock = config, shell, clock
        self._may_query = config.mode != "passive"
        said = None if config.device.baud == "auto" else config.device.baud
        known = baud or said or find_device(port_path, None, may_query=self._may_query).baud
        self._link = SerialLink(port_path, known, clock.now_ns, clock.patient_bytes)
        self._inbox = self._link.inbox
        if shell.worker is not None:
            shell.worker.woken = self._inbox.wake
        self._files = VehicleFiles() if files is None else files
        self._telemetry, self._terms = telemetry, terms
        if self._files.words is not None:
            self._files.words.woken = self._inbox.wake
            shell.listeners.append(self._files.answer)
        self._reloader, self._recall = reloader, recall
        self._latency_timer_ms: int | None = None
        self._stop_reason = ""
        self.stopped_s: float | None = None  # when `stop` was called, monotonic
        self._operator: SimpleQueue[inputs.Operator] = SimpleQueue()
        self._offsets_s = [float("inf")] * 2  # of wall clock and boottime, as last told
        self._asleep_s = _asleep_s()
        self._watch = Watch(time.monotonic())
        self._next_watch_s = self._retry_s = 0.0
        self._messages_before = 0
        self._wait_s = _REOPEN_S[0]
        self._waiting = False  # whether it was said what is waited for since the link was lost

    # -- from outside ------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """End the run; safe from a signal handler and from another thread."""
        if not self._stop_reason:
            self._stop_reason, self.stopped_s = reason, time.monotonic()
        self._inbox.wake()

    def operate(self, verb: str, argument: str = "", word: str = "") -> None:
        """A person's command; safe from another thread."""
        self._operator.put(inputs.Operator(self.clock.now_ns(), verb, argument, word))
        self._inbox.wake()

    # -- the run -----------------------------------------------------------------------------------

    def run(self) -> None:
        """Until stopped. Raises PortError only where the port cannot be opened the first time."""
        with ExitStack() as leaving:
            leaving.callback(self.shell.folded.finish)
            leaving.callback(self._link.unshare)  # behind the next: its thread writes there
            leaving.callback(self._link.close)
            if self.config.share:
                self._share()
            leaving.push(self._after_a_bug)
            self._tell_wall()
            if self._terms:
                self._feed(inputs.TermsKnown(self.clock.now_ns(), self._terms))
            self._open()
            while not self._stop_reason:
                self._turn(_LONGEST_WAIT_S)
            self._finish()

    def _share(self) -> None:
        """Other programs find the device at places of their own."""
        shares = self._link.share(self.config.share)
        self.shell.to_client = shares.send
        if self._telemetry is not None:
            self._telemetry.feed(shares.outlets())
        for level, text in shares.announced():
            self.shell.say(level, text, self.clock.now_ns())

    def _after_a_bug(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """On the way out: whatever it was, the device is put back; what was raised goes on."""
        if isinstance(error, Exception) and not isinstance(error, PortError):
            self._clean_up(error)

    def _turn(self, longest_s: float) -> None:
        """One wait and what it brought."""
        if not self._link.is_open:
            self._reopen()
        item = self._wait(self._patience_s(longest_s))
        if self._slept():
            return
        self._around()
        if isinstance(item, Bytes):
            self._feed(inputs.Received(item.host_ns, item.data))
        elif isinstance(item, Lost):
            self._lost(item.host_ns, item.reason)
        elif item is not None:
            self._feed(item)
        # What is waited for may lie in the inbox or in the port already: a reply is late only
        # against what was taken, and a silence is one only where nothing waits to be read.
        now_ns = self.clock.now_ns() if item is None else item.host_ns
        if item is not None or (self._inbox.empty and not self._link.has_more()):
            self._tick(now_ns)
        self._take_findings(now_ns)
        if self._recall is not None and (earlier := self._recall.take(now_ns)) is not None:
            self._feed(earlier)
        self._look()
        if self._telemetry is not None:
            well = self.shell.worker is None or not self.shell.worker.stuck
            self._telemetry.turn(self.shell.core, time.monotonic(), well=well)

    def _wait(self, longest_s: float) -> Item | None:
        """The next bytes; while the estimator is behind they wait, and the rest goes on."""
        worker = self.shell.worker
        if worker is not None and worker.full and not self._stop_reason:
            worker.wait_for_room(min(longest_s, _BEHIND_S))
            return None
        return self._inbox.get(longest_s)

    def _take_findings(self, now_ns: int) -> None:
        """What was done beside the core, told at the time of what was taken last."""
        worker = self.shell.worker
        for pieces, failure in () if worker is None else worker.take_done():
            self._feed(inputs.Examined(now_ns, pieces, failure))

    def _slept(self) -> bool:
        """Whether the host was suspended; then the link begins anew, with the device's registers.

        Its clock stood still and the device's did not: nothing that is at hand may be joined over
        that, nor is it known whether the device kept its power.
        """
        asleep_s = _asleep_s()
        slept_s, self._asleep_s = asleep_s - self._asleep_s, asleep_s
        if slept_s < _SUSPENDED_S or not self._link.is_open:
            return False
        reason = f"the host was suspended for {slept_s:.1f} s"
        self._lost(self.clock.now_ns(), reason, heard=False)
        return True

    def _tick(self, now_ns: int) -> None:
        deadline = self.shell.core.deadline_ns
        if deadline is not None and now_ns >= deadline:
            self._feed(inputs.Tick(now_ns))

    def _around(self) -> None:
        """Vehicle, operators and the wall clock: before bytes are judged by what they say."""
        now = self.clock.now_ns()
        for item in self._files.heard(now):
            self._feed(item)
        for word in self._files.commands():
            self.operate(word.verb, word.argument, word.name)
        while not self._operator.empty():
            self._feed(self._operator.get())
        self._tell_wall()

    def _patience_s(self, longest_s: float) -> float:
        """How long to wait for bytes: until somebody wants to be woken."""
        if not self._link.is_open:
            longest_s = min(longest_s, self._retry_s - time.monotonic())
        deadline = self.shell.core.deadline_ns
        if deadline is not None:
            left_s = (deadline - self.clock.now_ns()) * 1e-9 / self.clock.speed
            longest_s = min(longest_s, left_s)
        return max(longest_s, _SHORTEST_WAIT_S)

    def _tell_wall(self) -> None:
        """The host's other clocks, at the start and when one was set or the host was suspended."""
        now_ns = self.clock.now_ns()
        wall_s, (boot_id, boot_s) = time.time(), self.clock.boot()
        offsets_s = [wall_s - now_ns * 1e-9 / self.clock.speed, boot_s - now_ns * 1e-9]
        steps_s = [abs(a - b) for a, b in zip(offsets_s, self._offsets_s, strict=True)]
        if not max(steps_s) < _WALL_STEP_S:
            self._offsets_s = offsets_s
            self._feed(inputs.WallClock(now_ns, wall_s, boot_id, boot_s))

    def _feed(self, item: inputs.Input) -> None:
        output = self.shell.feed(item)
        if output:
            try:
                self._link.write(output)
            except PortLost as error:
                self._lost(self.clock.now_ns(), str(error))

    def _look(self) -> None:
        """Once a second: what a person should hear."""
        now_s = time.monotonic()
        if now_s < self._next_watch_s:
            return
        self._next_watch_s = now_s + _WATCH_S
        capture, now_ns = self.shell.capture, self.clock.now_ns()
        error = "" if capture is None else capture.status.error
        for remark in self._watch.look(self.shell.core, now_s, error, self._link.is_open):
            self.shell.say(remark.level, remark.text, now_ns)
        for text in self._files.news_of_faults():
            self.shell.say(logging.WARNING, text, now_ns)
        for well, text in () if self._reloader is None else self._reloader.take(self._change):
            self.shell.say(logging.INFO if well else logging.WARNING, text, now_ns)
        self.shell.folded.settle(now_ns * 1e-9)
        if self._telemetry is not None:
            self._telemetry.look(self.shell.core, self._link_facts(error), now_s)
        device = self.config.device
        if self._watch.garbage and device.baud == "auto":
            self._link.doubt()
            self._lost(now_ns, "no message in what arrives: looking for the rate")
        elif self._watch.silent and device.configure_stream and self._may_query:
            self._lost(now_ns, "silence: asking the device again for its output")

    def _change(self, change: Change) -> None:
        """What a person changed in the configuration takes effect."""
        before, self.config = self.config, change.config
        self._files.change(change.config)
        capture, gates = change.config.capture, change.config.gates
        if self.shell.capture is not None:
            sizes = capture.part_megabytes * 1_000_000, capture.keep_megabytes * 1_000_000
            self.shell.capture.resize(*sizes)
        if gates != before.gates:
            self._feed(inputs.LimitsChanged(self.clock.now_ns(), asdict(gates.limits())))

    def _link_facts(self, capture_error: str) -> LinkFacts:
        capture, (dropped, viewer_fault) = self.shell.capture, self.shell.viewer_losses
        return LinkFacts(
            port=spelled(self._link.path),
            baud=self._link.baud,
            is_open=self._link.is_open,
            latency_timer_ms=self._latency_timer_ms,
            capture="" if capture is None else str(capture.path),
            capture_error=capture_error,
            viewer_dropped=dropped,
            viewer_fault=viewer_fault,
            interlock=self._files.word,
            complaints=self._files.faults,
            shares=() if self._link.shared is None else self._link.shared.facts(),
            estimator_stuck=self.shell.worker is not None and self.shell.worker.stuck,
        )

    # -- the port ----------------------------------------------------------------------------------

    def _open(self) -> None:
        self._link.open(may_query=self._may_query)
        if self._waiting:  # it is back: what it says now is news, however short ago it said it
            self.shell.folded.finish()
        self._messages_before = self._messages
        self._watch.link_opened(time.monotonic())
        path, now = self._link.path, self.clock.now_ns()
        self._latency_timer_ms = latency_timer_ms(path)
        self._feed(inputs.LinkOpened(now, spelled(path), self._link.baud, self._latency_timer_ms))

    @property
    def _messages(self) -> int:
        return self.shell.core.device_session.session.deframer.counters.valid

    def _lost(self, host_ns: int, reason: str, *, heard: bool = True) -> None:
        for item in self._link.close():
            if not isinstance(item, Bytes):
                self._feed(item)
            elif heard:  # before the link went
                self._feed(inputs.Received(item.host_ns, item.data))
        if self._stop_reason:  # the mark that `stop` left went with them
            self._inbox.wake()
        if self._messages > self._messages_before:  # it was a device: it may be back at once
            self._wait_s = _REOPEN_S[0]
        self._retry_s, self._waiting = time.monotonic() + self._wait_s, False
        self._feed(inputs.LinkLost(host_ns, reason))

    def _reopen(self) -> None:
        """Try again and again, quickly first."""
        if time.monotonic() < self._retry_s:
            return
        self._wait_s = min(self._wait_s * 1.5, _REOPEN_S[1])
        self._retry_s = time.monotonic() + self._wait_s
        try:
            self._open()
        except PortError as error:
            text = f"waiting for the device: {error}"
            if not self._waiting:  # after each loss at once, however short ago the last one was
                self.shell.folded.unfold(logging.WARNING, text)
            self._waiting = True
            self.shell.say(logging.WARNING, text, self.clock.now_ns())

    # -- the end -----------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Let the core put back what it changed; bounded in time."""
        until = (self.stopped_s or time.monotonic()) + _STOP_S
        if self._telemetry is not None:
            self._telemetry.stopping()
        self._feed(inputs.Stop(self.clock.now_ns(), self._stop_reason))
        while not self.shell.finished and time.monotonic() < until:
            self._turn(0.05)
        if not self.shell.finished:
            text = f"stopped ({self._stop_reason}) without having put everything back"
            self.shell.say(logging.ERROR, text, self.clock.now_ns())

    def _clean_up(self, bug: Exception) -> None:
        """After a bug of ours: the device streams again as before, whatever the core believes."""
        log.error("internal error; putting the device's output back", exc_info=bug)
        talk = self.shell.core.device_session
        if text := self._link.put_back(talk.cleanup(), talk.allows_cleanup, _CLEANUP_S):
            log.error("the device's output is not as it was: %s", text)
