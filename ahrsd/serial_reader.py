"""Bytes off the port in a thread of their own, stamped as they come.

The thread does nothing but wait, read and stamp: the solver may be busy for some milliseconds
without a byte waiting longer for its time stamp. Losing the link is a value like any other.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue

from drivers.serial_port import LinkLost, SerialPort

_POLL_S = 0.2
_JOIN_S = 2.0


@dataclass(frozen=True, slots=True)
class Bytes:
    """One read."""

    host_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Lost:
    """The port is gone; nothing follows from this reader."""

    host_ns: int
    reason: str


class SerialReader:
    """Reads an open port into a queue until it is lost or `stop` is called."""

    def __init__(
        self, port: SerialPort, queue: SimpleQueue[Bytes | Lost | None], now_ns: Callable[[], int]
    ) -> None:
        self._port, self._queue, self._now_ns = port, queue, now_ns
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="serial-reader", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        try:
            while not self._stopping:
                if not self._port.wait_readable(_POLL_S):
                    continue
                data = self._port.read()
                if data:
                    self._queue.put(Bytes(self._now_ns(), data))
        except LinkLost as error:
            if not self._stopping:
                self._queue.put(Lost(self._now_ns(), str(error)))

    def stop(self) -> None:
        """End the thread; the port may be closed afterwards."""
        self._stopping = True
        self._thread.join(_JOIN_S)
