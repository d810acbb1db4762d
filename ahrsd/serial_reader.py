"""The device's port: found, opened, read in a thread, lost, opened again.

The thread does nothing but wait, read and stamp: the solver may be busy for some milliseconds
without a byte waiting longer for its time stamp. Losing the link is a value like any other.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from drivers.serial_port import (
    LISTEN_S,
    SCANNED_BAUD,
    BaudFound,
    LinkLost,
    SerialPort,
    detect_baud,
)

_POLL_S = 0.2
_JOIN_S = 2.0
_PATIENT_S = 1.1  # where nothing may be asked: a stream of 1 Hz must be heard


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


Queue = SimpleQueue[Bytes | Lost | None]


class SerialReader:
    """Reads an open port into a queue until it is lost or `stop` is called."""

    def __init__(self, port: SerialPort, queue: Queue, now_ns: Callable[[], int]) -> None:
        self._port, self._queue, self._now_ns = port, queue, now_ns
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="serial-reader", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        reason = "the reading thread broke down, see above"
        try:
            while not self._stopping:
                if not self._port.wait_readable(_POLL_S):
                    continue
                data = self._port.read()
                if data:
                    self._queue.put(Bytes(self._now_ns(), data))
        except LinkLost as error:
            reason = str(error)
        finally:  # also after a bug: a daemon that hears nothing must know it
            if not self._stopping:
                self._queue.put(Lost(self._now_ns(), reason))

    def stop(self) -> bool:
        """End the thread; whether it ended. Only then may the port be closed."""
        self._stopping = True
        self._thread.join(_JOIN_S)
        return not self._thread.is_alive()


def find_device(path: Path, baud: int | None, *, may_query: bool) -> BaudFound:
    """The rate at which a device is heard on the port: `baud`, or where that is None, any.

    Raises PortError and BaudNotFound: there is nobody to talk to.
    """
    listen_s = LISTEN_S if may_query else _PATIENT_S
    rates = SCANNED_BAUD if baud is None else ()
    return detect_baud(path, None, baud, listen_s, may_query=may_query, rates=rates)


class SerialLink:
    """One port, opened as often as it takes. Everything that it hears comes out of `queue`."""

    def __init__(self, path: Path, baud: int, now_ns: Callable[[], int]) -> None:
        self.path, self.baud = path, baud
        self.queue: Queue = SimpleQueue()
        self._now_ns = now_ns
        self._port: SerialPort | None = None
        self._reader: SerialReader | None = None
        self._doubtful: itertools.cycle[int] | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is ours now."""
        return self._port is not None

    def doubt(self) -> None:
        """Only garbage comes: the next openings try one rate each until a device is heard."""
        self._doubtful = itertools.cycle(SCANNED_BAUD)

    def open(self, *, may_query: bool) -> None:
        """Open and begin to read. Raises PortError; then nothing is open."""
        if self._doubtful is not None:
            self.baud = find_device(self.path, next(self._doubtful), may_query=may_query).baud
            self._doubtful = None
        self._port = SerialPort(self.path, self.baud)
        self._reader = SerialReader(self._port, self.queue, self._now_ns)

    def write(self, data: bytes) -> None:
        """Send; nothing where the port is closed. Raises LinkLost."""
        if self._port is not None:
            self._port.write(data)

    def take_port(self) -> SerialPort | None:
        """The open port itself, no longer read by the thread; the caller closes it."""
        port, reader = self._port, self._reader
        self._port = self._reader = None
        ended = reader is None or reader.stop()
        while True:  # what the reader still put there belongs to a link that is gone
            try:
                self.queue.get_nowait()
            except queue.Empty:
                break
        return port if ended else None  # a descriptor in use must not be closed, and so used again

    def close(self) -> None:
        """Give the port back; safe to call again."""
        port = self.take_port()
        if port is not None:
            port.close()
