"""`ahrsd run`: what the daemon is made of, as the configuration says, and how it ends."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType

from ahrsd.config.core_settings import core_settings, terms_text, with_date
from ahrsd.config.loading import CONFIG_KEY, Config
from ahrsd.config.text import print_config
from ahrsd.core.core import Core
from ahrsd.core.settings import BESIDE_KEY
from ahrsd.daemon.core_runner import JournalKeeper, Shell, close_shell, journal_in
from ahrsd.daemon.daemon import Daemon
from ahrsd.daemon.estimation_worker import SWITCH_S, Worker
from ahrsd.daemon.heap import needed_bytes, take_heap
from ahrsd.daemon.host_clock import HostClock
from ahrsd.daemon.operator_inbox import OperatorBox, OperatorInbox
from ahrsd.daemon.recall import Recall
from ahrsd.daemon.reloading import Reloader
from ahrsd.daemon.serial_link import find_device
from ahrsd.daemon.vehicle_files import ColumnsFile, InterlockFile
from ahrsd.errors import EXIT_DONE, CaptureError, ConfigError
from ahrsd.recording.capture import CaptureWriter
from ahrsd.recording.retention import make_private_folder, new_capture_path
from ahrsd.report.summary import summary_lines
from ahrsd.telemetry.public import Public
from ahrsd.telemetry.sd_notify import Notifier
from ahrsd.viewer.sink import RerunLimits, RerunSink
from drivers.serial_port import BaudFound, PortError, spelled

log = logging.getLogger("ahrsd")

_EXIT_S = 2.6  # from a signal to the end of everything that is waited for
_LEAST_S = 0.2
_SEARCH_AGAIN_S = 0.5
DAEMON_KEEPS = 64  # decisions and gaps in memory; the capture has them all


class _Stopped(Exception):
    """A signal came before there was anything to put back."""


@contextlib.contextmanager
def _signals(stop: Callable[[str], None], reload: Callable[[], None]) -> Iterator[None]:
    """SIGTERM and SIGINT call `stop` with their name, SIGHUP calls `reload`.

    Where the daemon runs in a terminal, SIGHUP means that it was closed, and is a stop; where
    somebody had it ignored (nohup), it stays so.
    """

    def handler(number: int, _: FrameType | None) -> None:
        in_terminal = sys.stdin is not None and sys.stdin.isatty()
        if number == signal.SIGHUP and not in_terminal:
            reload()
        else:
            stop(signal.Signals(number).name)

    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {s: signal.signal(s, handler) for s in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _stop_searching(name: str) -> None:
    raise _Stopped(name)


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


def _open_words(config: Config) -> OperatorInbox | None:
    """Where a person may speak to the daemon; a run that sends nothing needs none."""
    if config.mode == "passive":
        return None
    box = OperatorBox(config.state)
    with contextlib.suppress(OSError):  # the inbox says why, and when it is over
        box.prepare()
    return OperatorInbox(box)


def open_public(config: Config, shell: Shell, notifier: Notifier) -> Public:
    """What tells the world how the daemon stands, as the configuration says."""
    public = Public(time.monotonic(), notifier)
    if config.socket.enabled:
        public.open_socket(config.socket.path, config.state)
    if config.metrics.enabled:
        public.open_metrics(config.metrics.port)
    shell.listeners.append(public.event)
    return public


def _search(config: Config, port: Path, notifier: Notifier, wait: bool) -> BaudFound:
    """The device's rate. Raises PortError where there is none and `wait` is false."""
    said = None if config.device.baud == "auto" else config.device.baud
    before = ""
    while True:
        try:
            return find_device(port, said, may_query=config.mode != "passive")
        except PortError as error:
            if not wait:
                raise
            if str(error) != before:
                before = str(error)
                log.warning("waiting for the device: %s", before)
            notifier.ready(f"waiting for the device: {before}")
        notifier.feed()
        time.sleep(_SEARCH_AGAIN_S)


@dataclass(slots=True)
class VehicleFiles:
    """What the vehicle tells, as far as the configuration names files for it."""

    interlock: InterlockFile | None
    columns: ColumnsFile | None

    @staticmethod
    def of(config: Config) -> VehicleFiles:
        """Begin to look at them."""
        word, terms = config.interlock, config.terms
        return VehicleFiles(
            None if word.file is None else InterlockFile(word.file, word.max_age_s),
            None if terms.file is None else ColumnsFile(terms.file, terms.max_age_s),
        )

    def complaints(self) -> list[Callable[[], str]]:
        """What is wrong with each now."""
        files = [file for file in (self.interlock, self.columns) if file is not None]
        return [partial(getattr, file, "fault") for file in files]

    def change(self, config: Config, daemon: Daemon, words: OperatorInbox | None) -> None:
        """Look at other files, where they are others."""
        now = (config.interlock.file, config.terms.file)
        if now == tuple(None if f is None else f.path for f in (self.interlock, self.columns)):
            return
        self.close()
        new = VehicleFiles.of(config)
        self.interlock, self.columns = new.interlock, new.columns
        daemon.watch_files(self.interlock, self.columns, complaints(self, words))

    def close(self) -> None:
        """Look no more."""
        for file in (self.interlock, self.columns):
            if file is not None:
                file.close()


def complaints(vehicle: VehicleFiles, words: OperatorInbox | None) -> list[Callable[[], str]]:
    """What is wrong with files of others now."""
    return [*vehicle.complaints(), *([] if words is None else [partial(getattr, words, "fault")])]


def run_daemon(
    config: Config,
    say: Callable[[str], None] = print,
    *,
    wait: bool = False,
    load: Callable[[], Config] | None = None,
) -> int:
    """`ahrsd run`: until a signal; returns the exit code. `load` gives the configuration on SIGHUP.

    A device is heard before anything else is begun, so a wrong port leaves nothing behind. Raises
    PortError (not with `wait`: then it looks again and again), ConfigError, CaptureError.
    """
    port, notifier, reloader = config.device.port, Notifier(), Reloader(load, config)
    if port is None:
        raise ConfigError(["device.port: no port is given"])
    terms = terms_text(config)
    try:
        with _signals(_stop_searching, lambda: None):
            found = _search(config, port, notifier, wait)
    except _Stopped as stopped:
        log.info("stopped (%s) before a device was found", stopped)
        return EXIT_DONE
    log.info("%s: %s", spelled(port), found.why)
    config = with_date(config)
    clock = HostClock()
    capture = new_capture_path(config.captures) if config.capture.enabled else None
    take_heap(needed_bytes(config.estimator.parameters()))
    shell = open_shell(config, clock, capture)
    words, vehicle = _open_words(config), VehicleFiles.of(config)
    public = open_public(config, shell, notifier)
    daemon = Daemon(
        config,
        shell,
        port,
        clock,
        vehicle.interlock,
        baud=found.baud,
        words=words,
        public=public,
        terms=terms,
        columns=vehicle.columns,
        complaints=complaints(vehicle, words),
        reloader=reloader,
        recall=Recall.of(config, capture),
    )
    daemon.on_change = lambda change: vehicle.change(change.config, daemon, words)
    gc.freeze()  # what is there now stays: the collector need not look through it again and again
    sys.setswitchinterval(SWITCH_S)
    try:
        with _signals(daemon.stop, reloader.ask):
            daemon.run()
    finally:
        vehicle.close()
        if words is not None:
            words.close(_LEAST_S)
        public.close()
        close_shell(shell, (daemon.stopped_s or time.monotonic()) + _EXIT_S)
    for line in summary_lines(shell.core, str(capture or port)):
        say(line)
    return EXIT_DONE
