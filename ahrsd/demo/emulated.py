"""The world of the demo: an emulated device beside it, that device's time, and its vehicle."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ahrsd.daemon.host_clock import HostClock
from ahrsd.errors import EXIT_BUSY, DeviceError
from drivers.serial_port import PortError, SerialPort
from drivers.vn100.commands import read_registers
from drivers.vn100.device import Device
from drivers.vn100.emulator.pty import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup
from drivers.vn100.errors import DriverError

BAUD = 115200
UNREAD_BYTES = 512  # then the world waits: some messages
_WATCH_S = 0.5
_STUCK_S = 120.0  # real time in which the emulated world goes on by nothing


@dataclass(frozen=True, slots=True)
class WorldClock(HostClock):
    """The emulated world's time: a busy machine slows the world, and the daemon's clock with it."""

    world_s: Callable[[], float] = float

    def now_ns(self) -> int:
        """Nanoseconds, never falling."""
        return self.start_ns + int(self.world_s() * 1e9)

    def boot(self) -> tuple[str, float]:
        """The world's time, whose boot was its beginning."""
        return self._own_boot()


class Watched(Protocol):
    """The daemon, as far as it is watched here."""

    def run(self) -> None:
        """Until it is stopped."""

    def stop(self, reason: str) -> None:
        """From another thread."""


class AlwaysSafe:
    """A vehicle that never objects."""

    def safe(self) -> bool:
        """The vehicle's word."""
        return True


@contextlib.contextmanager
def emulated_device(setup: Setup, link: Path, speed: float) -> Iterator[EmulatorProcess]:
    """The emulated device; whatever its port says becomes one line."""
    try:
        with EmulatorProcess(setup, link=link, speed=speed, lossless=True) as emulated:
            yield emulated
    except (PortError, DriverError) as error:
        raise DeviceError(f"the emulated device: {error}", EXIT_BUSY) from error
    except OSError as error:
        if error.filename not in (None, str(link)):
            raise
        raise DeviceError(f"no emulated device: {error}", EXIT_BUSY) from error


def run_watched(daemon: Watched, emulated: EmulatorProcess, longest_s: float) -> None:
    """The daemon until somebody ends it, or the emulated device is gone or stands still.

    longest_s: of device time, in case no samples come that could end the scene
    Raises DeviceError where it was the device.
    """
    over = threading.Event()
    trouble: list[str] = []

    def watch() -> None:
        world_s, moved = emulated.device_s(), time.monotonic()
        while not over.wait(_WATCH_S):
            now_s = emulated.device_s()
            if now_s != world_s:
                world_s, moved = now_s, time.monotonic()
            if not emulated.alive:
                trouble.append("the emulated device died")
            elif time.monotonic() - moved > _STUCK_S:
                trouble.append(f"the emulated device stood still for {_STUCK_S:.0f} s")
            elif world_s > longest_s:
                trouble.append(f"no end after {longest_s:.0f} s of device time")
            if trouble:
                daemon.stop(trouble[0])
                return

    watcher = threading.Thread(target=watch, name="demo-watch", daemon=True)
    watcher.start()
    try:
        daemon.run()
    finally:
        over.set()
        watcher.join()
    if trouble:
        raise DeviceError(f"the demo ended early: {trouble[0]}", EXIT_BUSY)


def read_back(link: Path, registers: Iterable[int]) -> dict[int, tuple[float, ...]]:
    """What the device holds in registers now, by a connection of its own."""
    with SerialPort(link, BAUD) as port, Device(port) as device:
        values = device.run(read_registers(registers), 10.0)
    return {number: tuple(map(float, v)) for number, v in values.items()}
