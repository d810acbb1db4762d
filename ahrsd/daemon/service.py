"""`ahrsd run`: what the daemon is made of, as the configuration says, and how it ends."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from ahrsd.config.config import Config, Reloader, terms_text, with_date
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import SWITCH_S, Shell, close_shell, open_shell
from ahrsd.daemon.daemon import Daemon, Recall
from ahrsd.daemon.heap import needed_bytes, take_heap
from ahrsd.daemon.host_clock import HostClock
from ahrsd.daemon.vehicle_files import VehicleFiles
from ahrsd.errors import EXIT_DONE, ConfigError
from ahrsd.recording.capture import new_capture_path
from ahrsd.telemetry.public import Public
from ahrsd.telemetry.sd_notify import Notifier
from drivers.serial_port import BaudFound, NoPort, PortError, find_device, spelled

log = logging.getLogger("ahrsd")

_EXIT_S = 2.6  # from a signal to the end of all waiting
_LEAST_S = 0.2
_SEARCH_AGAIN_S = 0.5  # wait before the next search for a device


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
    """The device's rate. Raises PortError where there is none and `wait` is false, and where what
    has the name can never be a port."""
    said = None if config.device.baud == "auto" else config.device.baud
    before = ""
    while True:
        try:
            return find_device(port, said, may_query=config.mode != "passive")
        except PortError as error:
            if not wait or isinstance(error, NoPort):
                raise
            if str(error) != before:
                before = str(error)
                log.warning("waiting for the device: %s", before)
            notifier.ready(f"waiting for the device: {before}")
        notifier.feed()
        time.sleep(_SEARCH_AGAIN_S)


def run_daemon(
    config: Config,
    close: Callable[[Core, str], None],
    *,
    wait: bool = False,
    load: Callable[[], Config] | None = None,
) -> int:
    """`ahrsd run`: until a signal; returns the exit code. `load` gives the configuration on SIGHUP.

    `close` is told how the run ended: the core, and the name of the capture or the port.

    A device is heard before anything else is begun, so a wrong port leaves nothing behind. Raises
    PortError (with `wait` only NoPort: otherwise it looks again and again), ConfigError,
    CaptureError.
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
    vehicle = VehicleFiles.of(config)
    public = open_public(config, shell, notifier)
    daemon = Daemon(
        config,
        shell,
        port,
        clock,
        vehicle,
        baud=found.baud,
        telemetry=public,
        terms=terms,
        reloader=reloader,
        recall=Recall.of(config, capture),
    )
    gc.freeze()  # what is there now stays: the collector need not look through it again and again
    sys.setswitchinterval(SWITCH_S)
    try:
        with _signals(daemon.stop, reloader.ask):
            daemon.run()
    finally:
        vehicle.close(_LEAST_S)
        public.close()
        close_shell(shell, (daemon.stopped_s or time.monotonic()) + _EXIT_S)
    close(shell.core, str(capture or port))
    return EXIT_DONE
