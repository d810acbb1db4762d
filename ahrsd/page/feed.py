"""The newest status of the daemon, from one connection however many browsers look at the page."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ahrsd.errors import DeviceError
from ahrsd.telemetry.client import DaemonConnection
from ahrsd.telemetry.protocol import STATUS_SCHEMA

_AGAIN_S = 1.0
_STALE_S = 3.5  # a status comes every second


@dataclass(frozen=True, slots=True)
class Heard:
    """The newest status and when it came (monotonic); `fault`: why none comes, empty if one may."""

    status: dict[str, Any] | None = None
    at_s: float = 0.0
    fault: str = ""

    def away(self, now_s: float) -> str:
        """Why the status says nothing of now; empty where it does."""
        if self.fault:
            return self.fault
        if self.status is None:
            return "the daemon has not told its status yet"
        if now_s - self.at_s > _STALE_S:
            return "the daemon is silent"
        return ""


class DaemonFeed:
    """Watches the daemon in a thread of its own; connects again by itself."""

    def __init__(self, connect: Callable[[], DaemonConnection]) -> None:
        self._connect = connect
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self.heard = Heard(at_s=time.monotonic())

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End with the next status; the thread does not keep the process."""
        self._stopped.set()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                with self._connect() as daemon:
                    self._watch(daemon)
            except (DeviceError, OSError, ValueError) as error:
                self.heard = Heard(self.heard.status, self.heard.at_s, str(error))
            self._stopped.wait(_AGAIN_S)

    def _watch(self, daemon: DaemonConnection) -> None:
        """The newest status at once, then each one as it comes."""
        self._take(daemon.ask("status"))
        for record in daemon.watch(("status",)):
            if self._stopped.is_set():
                return
            if record.get("record") == "status":
                self._take(record)
            elif "error" in record:
                raise ValueError(str(record["error"]))

    def _take(self, status: dict[str, Any]) -> None:
        if status.get("schema") != STATUS_SCHEMA:
            raise ValueError(f"the daemon tells {status.get('schema')}, not {STATUS_SCHEMA}")
        self.heard = Heard(status, time.monotonic())
