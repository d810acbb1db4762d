"""A cable on a pty in real time, served by a thread of its own; the host opens `path`."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from patience import PATIENCE_S

from scripted_vn100.cable import Cable

TURN_S = 0.004


class Served:
    """`with Served(cable) as port:` serves it; `act` does something between two turns.

    link: a symbolic link to the pty, so that the port keeps its name
    """

    def __init__(self, cable: Cable, link: Path | None = None) -> None:
        self.cable, self.link = cable, link
        self.path = ""
        self.error: Exception | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._begun_s = time.monotonic()
        self._thread = threading.Thread(target=self._work, name="scripted-vn100")

    def now_s(self) -> float:
        """The world's time."""
        return time.monotonic() - self._begun_s

    def __enter__(self) -> Served:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        if self.link is not None:
            self.link.unlink(missing_ok=True)
            self.link.symlink_to(self.path)
        self._begun_s = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)
        os.close(self._master)
        os.close(self._slave)
        if self.error is not None and error is None:
            raise self.error

    def act(self, what: Callable[[Cable, float], object]) -> object:
        """Do something to the cable, with the world's time, while nothing else happens to it."""
        with self._lock:
            return what(self.cable, self.now_s())

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except Exception as error:  # noqa: BLE001 - handed to the test
            self.error = error

    def _turn(self) -> None:
        readable, _, _ = select.select([self._master], [], [], TURN_S)
        with self._lock:
            if readable:
                try:
                    data = os.read(self._master, 4096)
                except OSError:  # nobody has the other end open
                    data = b""
                    time.sleep(TURN_S)
                self.cable.receive(data, self.now_s())
            output = self.cable.advance(self.now_s())
        if output:
            try:
                os.write(self._master, output)
            except BlockingIOError:  # nobody reads: as on a wire, it is gone
                return
