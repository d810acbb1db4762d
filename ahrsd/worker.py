"""The thread that does the slow part of the core beside it (`examination`).

Python lets one thread run at a time, and lets another one have its turn after `SWITCH_S`: that, and
no longer, is what a byte waits for a long computation.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import SimpleQueue

SWITCH_S = 0.0005
MOST_WAITING = 40  # pieces, of a quarter of a second each: older verdicts are of no use
_ASK_S = 0.1
_STUCK_S = 5.0  # no piece takes so long; the service manager's watchdog then goes hungry


class Worker:
    """Does what it is given, in order. `woken` is called after each piece, from the thread."""

    def __init__(self) -> None:
        self.woken: Callable[[], None] = lambda: None
        self._todo: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._free = threading.Event()
        self._put = self._done = self._told = 0  # each is written by one thread only
        self._ended = self._closing = False
        self._began_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="estimator", daemon=True)
        self._thread.start()

    def put(self, work: Callable[[], None]) -> None:
        """One more. Waits while too many wait already, unless there is no hope."""
        while self._put - self._done >= MOST_WAITING and not (self._ended or self.stuck):
            self._free.clear()
            self._free.wait(_ASK_S)
        self._put += 1
        self._todo.put(work)

    def take_done(self) -> int:
        """How many were done since this was asked last. Raises RuntimeError where one broke off."""
        if self._ended and not self._closing:
            raise RuntimeError("the estimate broke off, see above")
        done = self._done
        new, self._told = done - self._told, done
        return new

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
                work()
                self._began_s = None
                self._done += 1
                self._free.set()
                self.woken()
        finally:  # also after a bug: who waits for the work must know it
            self._ended = True
            self.woken()
