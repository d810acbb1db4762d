"""The emulated VN-100 in a process of its own, beside the program that talks to it.

    with EmulatorProcess(Setup("rov", seed=1), speed=30.0, lossless=True) as emulated:
        port = serial.Serial(emulated.path, 115200)

The process ends with `stop`, and by itself when the program that started it ends in whatever way.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from ctypes import c_double
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Self

from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
