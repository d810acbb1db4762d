"""The thread that reads the newest captures for a warm start, beside the run that begins.

It ends by itself, within `LONGEST_S`; whatever goes wrong in it is a reason for a run that begins
with nothing, never an end of the run.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ahrsd.config.loading import Config
from ahrsd.core.estimation import supervised
from ahrsd.daemon import host_clock
from ahrsd.inputs import EarlierRun, EarlierSamples
from ahrsd.recording.earlier_run import earlier_inputs
from ahrsd.writeback.journal_history import Stamp

LONGEST_S = 120.0

log = logging.getLogger("ahrsd")


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
