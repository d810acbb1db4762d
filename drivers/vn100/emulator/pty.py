"""Serves an emulated VN-100 on a pseudo terminal: the only part of the emulator that does I/O.

Two manners:

* as a port is: time passes whoever listens; bytes that nobody has opened the port for vanish, and
  of a host that reads too slowly `OVERRUN_BYTES` wait, the rest is lost and counted;
* `lossless`, for runs faster than real time: when the host has not read what was sent, the device's
  time stands still, so that host and device stay in step and nothing is lost. Time then begins
  to run when the host begins to read.

A pty has no bit rate of its own. When the rate that the host has set differs from register 5, the
bytes of both directions are garbled, as they would be on a wire (`check_baud`).

`EmulatorProcess` serves it in a process of its own, beside the program that talks to it:

    with EmulatorProcess(Setup("rov", seed=1), speed=30.0, lossless=True) as emulated:
        port = serial.Serial(emulated.path, 115200)

The process ends with `stop`, and by itself when the program that started it ends in whatever way.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import multiprocessing
import os
import pty
import select
import signal
import struct
import termios
import threading
import time
import tty
from collections.abc import Callable
from ctypes import c_double
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Self

import numpy as np

from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.faults import garble
from drivers.vn100.emulator.scenarios import Setup, build

TURN_S = 1e-3  # real time between two looks at the line
CATCH_UP_S = 0.02  # lossless: a stall of the process is not made up for beyond this
OVERRUN_BYTES = 65536
TALK_SPEED = 2.0  # lossless: at most, while the host has paused the output to change something
UNREAD_BYTES = 512  # lossless: time stands still while the host has left more than this unread
DESERTED_S = 1.0  # lossless: nobody has read for so long; the port may be opened again

_TCGETS2 = 0x802C542A  # asm-generic: struct termios2, whose speeds are plain numbers
_TERMIOS2 = struct.Struct("4I20B2I")


class Line:
    """One pty: it comes into being when the device is plugged in and goes when it is unplugged.

    hold: keep the host's end open too. The kernel then tells how much the host has not read yet,
    but not whether there is a host.
    """

    def __init__(self, link: Path | None, hold: bool, baud: int) -> None:
        if link is not None and link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link} exists and is no symbolic link; choose another --link")
        self.link = link
        self._master, self._slave = pty.openpty()
        self.device = os.ttyname(self._slave)
        self._hold = hold
        _configure(self._slave, baud)
        os.set_blocking(self._master, False)
        if not hold:
            os.close(self._slave)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        if link is not None:
            self._point(link)

    def _point(self, link: Path) -> None:
        fresh = link.with_name(f".{link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.device)
        fresh.replace(link)

    def close(self) -> None:
        """Unplug: the host's next read fails."""
        os.close(self._master)
        if self._hold:
            os.close(self._slave)
        link = self.link
        if link is not None and link.is_symlink() and str(link.readlink()) == self.device:
            link.unlink()

    def wait(self, seconds: float) -> bool:
        """Wait until bytes come, at most so long. False when no host has the port open."""
        events = self._poll.poll(seconds * 1000)
        if any(event & select.POLLHUP for _, event in events):
            time.sleep(seconds)
            return False
        return True

    def read(self) -> bytes:
        """The host's bytes, if any."""
        try:
            return os.read(self._master, 4096)
        except (BlockingIOError, OSError):  # nothing there, or the host just went away
            return b""

    def write(self, data: bytes) -> int:
        """Pass on as much as the line takes; how much that was."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def host_baud(self) -> int:
        """The bit rate that the host has set; 0 where the system does not tell."""
        try:
            settings = fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size))
        except OSError:  # no termios2 on this system
            return 0
        return int(_TERMIOS2.unpack(settings)[-1])

    def free(self) -> bool:
        """Whether a host could open the port; false where one was killed in exclusive use."""
        try:
            os.close(os.open(self.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
        except OSError as error:
            return error.errno != errno.EBUSY
        return True

    def unread(self) -> int:
        """Bytes that the host could read now; only where `hold`."""
        raw = fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4))
        return int(struct.unpack("i", raw)[0])

    def release(self) -> None:
        """Undo the exclusive use that a host left behind; only where `hold`."""
        fcntl.ioctl(self._slave, termios.TIOCNXCL)


def _configure(terminal: int, baud: int) -> None:
    """Raw, at the device's rate: also hosts that set nothing (`cat`) see its bytes."""
    tty.setraw(terminal)
    speed = getattr(termios, f"B{baud}", None)
    if speed is not None:
        settings = termios.tcgetattr(terminal)
        settings[4] = settings[5] = speed
        termios.tcsetattr(terminal, termios.TCSANOW, settings)


class PtyEmulator:
    """Runs an `Emulator` against the clock on a pty, in this thread (`serve`) or in its own.

    link:       symbolic link that always points to the present pty
    speed:      device seconds per real second, positive
    lossless:   see above
    check_baud: garble what passes while the host's bit rate is not the device's
    report:     called with one line whenever something happens (plugged, reset, faults)
    on_time:    called with the device's time whenever it was moved on
    overrun_bytes counts what was lost because the host read too slowly.
    """

    def __init__(
        self,
        emulator: Emulator,
        *,
        link: Path | None = None,
        speed: float = 1.0,
        lossless: bool = False,
        check_baud: bool = True,
        report: Callable[[str], None] | None = None,
        on_time: Callable[[float], None] | None = None,
    ) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be positive, not {speed:g}")
        self.emulator = emulator
        self.overrun_bytes = 0
        self.device_s = 0.0
        self._link = link
        self._speed = speed
        self._lossless = lossless
        self._check_baud = check_baud
        self._report = report or (lambda _: None)
        self._on_time = on_time or (lambda _: None)
        self._draw = np.random.default_rng(0)
        self._backlog = bytearray()
        self._line: Line | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._present = False
        self._read_at = 0.0
        self._plug()

    @property
    def path(self) -> str:
        """What a host opens: the link if there is one, else the pty ("" while unplugged)."""
        if self._link is not None:
            return str(self._link)
        return "" if self._line is None else self._line.device

    def start(self) -> None:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.serve, name="vn100-emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End `serve`, wait for its thread and close the pty. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._unplug()

    def request_stop(self) -> None:
        """End `serve` soon; for signal handlers."""
        self._stop.set()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def serve(self) -> None:
        """Run until `stop`."""
        last = time.monotonic()
        while not self._stop.is_set():
            heard = self._listen()
            now = time.monotonic()
            self._pass_time(now - last, now)
            self._on_time(self.device_s)
            last = now
            if heard:
                self.emulator.receive(heard, self.device_s)
            self._send(self.emulator.deliver(self.device_s))
            for line in self.emulator.take_log():
                self._report(f"{self.device_s:9.3f} s  {line}")
            self._follow_plug()

    def _plug(self) -> None:
        self._line = Line(self._link, self._lossless, self.emulator.baud)
        self._present = False
        self._read_at = time.monotonic()

    def _unplug(self) -> None:
        self._backlog.clear()
        if self._line is not None:
            self._line.close()
            self._line = None

    def _follow_plug(self) -> None:
        if self.emulator.plugged == (self._line is not None):
            return
        self._unplug()
        if self.emulator.plugged:
            self._plug()
            self._report(f"{self.device_s:9.3f} s  port {self.path}")

    def _listen(self) -> bytes:
        """Wait a turn; the host's bytes as the device hears them."""
        if self._line is None:
            time.sleep(TURN_S)
            return b""
        was_present, self._present = self._present, self._line.wait(TURN_S)
        if self._present:
            heard = self._line.read()
            return self._garbled(heard, self.emulator.baud, self._line.host_baud())
        self._backlog.clear()
        if was_present and not self._line.free() and not self._line.wait(0):
            self._unplug()  # nobody but root could open this one again
            self._plug()
            self._report(f"{self.device_s:9.3f} s  port {self.path}")
        return b""

    def _garbled(self, data: bytes, device_baud: int, host_baud: int) -> bytes:
        if not self._check_baud or host_baud in (0, device_baud):
            return data
        return garble(data, self._draw)

    def _pass_time(self, elapsed_s: float, now: float) -> None:
        if not self._lossless:
            self.device_s += elapsed_s * self._speed
            return
        if self._line is not None and (self._backlog or self._line.unread() > UNREAD_BYTES):
            if now - self._read_at > DESERTED_S:
                self._line.release()
                self._read_at = now
            return
        self._read_at = now
        speed = self._speed if self.emulator.streaming else min(self._speed, TALK_SPEED)
        self.device_s += min(elapsed_s, CATCH_UP_S) * speed

    def _send(self, messages: list[tuple[int, bytes]]) -> None:
        line = self._line
        if line is None or not self._present:
            return
        waiting = self._backlog
        if messages:
            host_baud = line.host_baud()
            heard = (self._garbled(message, baud, host_baud) for baud, message in messages)
            waiting = bytearray().join([waiting, *heard])
        if waiting:
            del waiting[: line.write(bytes(waiting))]
        excess = len(waiting) - OVERRUN_BYTES
        if excess > 0 and not self._lossless:
            del waiting[OVERRUN_BYTES:]
            self.overrun_bytes += excess
        self._backlog = waiting  # no reader sees it longer than it may be


# -- In a process of its own -----------------------------------------------------------------------


START_S = 30.0
OFF_S = 1.0  # device time without power in a `power_cycle`


class EmulatorProcess:
    """Starts when it is made; the arguments are those of `Setup` and `PtyEmulator`.

    path: what the host opens. Raises ValueError for a setup that cannot be, OSError where there is
    no pty or the link cannot be made.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        link: Path | None = None,
        speed: float = 1.0,
        lossless: bool = False,
        check_baud: bool = True,
    ) -> None:
        build(setup)  # refuse here what cannot be
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._device_s = context.RawValue("d", 0.0)
        self._process = context.Process(
            target=_serve,
            args=(setup, theirs, self._device_s),
            kwargs={"link": link, "speed": speed, "lossless": lossless, "check_baud": check_baud},
            name="vn100-emulator",
            daemon=True,
        )
        self._process.start()
        theirs.close()
        self.path = self._first_word()

    def _first_word(self) -> str:
        """The path that the process reports; raises what it reports instead."""
        try:
            answer = (
                self._pipe.recv()
                if self._pipe.poll(START_S)
                else OSError(f"the emulator process did not start within {START_S:g} s")
            )
        except EOFError:
            answer = OSError("the emulator process ended before it had started")
        if isinstance(answer, Exception):
            self.stop()
            raise answer
        return str(answer)

    def device_s(self) -> float:
        """True time of the emulated world in seconds; goes on through restarts of the device."""
        return float(self._device_s.value)

    @property
    def alive(self) -> bool:
        """Whether the process still serves."""
        return self._process.is_alive()

    def power_cycle(self) -> None:
        """Switch the device off and on: its RAM is what its flash holds. Nothing where it died."""
        with contextlib.suppress(OSError):
            self._pipe.send("power cycle")

    def stop(self) -> None:
        """Close the pty and end the process. May be called twice."""
        self._pipe.close()
        self._process.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def _serve(
    setup: Setup,
    pipe: Connection,
    shown_s: c_double,
    *,
    link: Path | None,
    speed: float,
    lossless: bool,
    check_baud: bool,
) -> None:
    """The other process: serve until the pipe closes."""

    def show(device_s: float) -> None:
        shown_s.value = device_s

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both; the pipe decides
    try:
        served = PtyEmulator(
            build(setup),
            link=link,
            speed=speed,
            lossless=lossless,
            check_baud=check_baud,
            on_time=show,
        )
    except (ValueError, OSError) as error:
        pipe.send(error)
        return
    with served:
        pipe.send(served.path)
        with contextlib.suppress(EOFError):
            while pipe.recv():
                emulator, now_s = served.emulator, served.device_s
                emulator.at(now_s, emulator.lose_power)
                emulator.at(now_s + OFF_S, emulator.restart, any_life=True)
