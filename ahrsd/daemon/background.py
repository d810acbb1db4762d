"""Threads beside the daemon's loop: the estimation's tasks, and samples of an earlier run.

**Tasks of the estimation** (`Worker`, `core.estimation`). Python lets one thread run at a time, and
lets another one have its turn after `SWITCH_S`: that, and no longer, is what a byte waits for a
long computation.

**Samples of an earlier run** (`Recall`): the newest captures are read for a warm start, beside the
run that begins. The thread ends by itself, within `LONGEST_S`; whatever goes wrong in it is a
reason for a run that begins with nothing, never an end of the run.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

from ahrsd.config.config import Config
from ahrsd.core.estimation import supervised
from ahrsd.daemon import host_clock
from ahrsd.events import Failure
from ahrsd.inputs import EarlierRun, EarlierSamples
from ahrsd.recording.earlier_run import earlier_inputs
from ahrsd.writeback.journal_history import Stamp

# -- Tasks of the estimation -----------------------------------------------------------------------


SWITCH_S = 0.0005
MOST_WAITING = 40  # pieces, of up to two seconds of samples each: older verdicts are of no use
_STUCK_S = 5.0  # no piece takes so long; the service manager's watchdog then goes hungry
_MOST_REASONS = 16  # whose traceback is logged, once each

log = logging.getLogger("ahrsd")


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


# -- Samples of an earlier run ---------------------------------------------------------------------


LONGEST_S = 120.0


class Recall:
    """Reads; `take` gives one input at a time, once all of them are there."""

    def __init__(
        self, read: Callable[[Callable[[], bool]], list[EarlierSamples | EarlierRun]]
    ) -> None:
        self._read = read
        self._found: deque[EarlierSamples | EarlierRun] = deque()
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
        found, failure = supervised(lambda: self._read(self._go_on))
        if failure is not None:
            log.error("no warm start: %s", failure.reason, extra={"trace": failure.trace})
            found = [EarlierRun(0, why=failure.reason)]
        self._found.extend(found or ())

    def _go_on(self) -> bool:
        return time.monotonic() < self._until_s

    def take(self, host_ns: int) -> EarlierSamples | EarlierRun | None:
        """The next input, as of now; None while there is none."""
        if self._thread.is_alive() or not self._found:
            return None
        return replace(self._found.popleft(), host_ns=host_ns)
