"""The device's port: found, opened, read in a thread, lost, opened again.

The thread does nothing but wait, read and stamp: the solver may be busy for some milliseconds
without a byte waiting longer for its time stamp. Losing the link is a value like any other.

What waits for the core is bounded. Were the core to fall behind by `BACKLOG_BYTES`, the thread
would give the link up: what it read is all taken, in order, and then the link counts as lost, with
this reason. To drop bytes in between would be to bridge a gap that nobody knows of.
"""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from ahrsd.config.sections import ShareSection
from ahrsd.daemon.shares import Shares
from ahrsd.inputs import ClientLeft, ClientSent
from drivers.serial_port import (
    SCANNED_BAUD,
    PortLost,
    SerialPort,
    find_device,
)
from drivers.vn100.commands import Command, Procedure
from drivers.vn100.device import Device
from drivers.vn100.errors import DriverError

BACKLOG_BYTES = 4 << 20  # largest backlog in memory: minutes at 200 Hz
_READ_BYTES = 128  # memory of one read in addition to its data
_POLL_S = 0.2  # longest wait of one read
_PATIENT_POLL_S = 0.001  # wait for the core where reading waits for it
# To other programs: the system hands their bytes over in a thread of its own, and what the core
# does with the same bytes takes longer than that, on a machine that may have two cores
_GIVE_WAY_S = 0.00015
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


Item = Bytes | Lost | ClientSent | ClientLeft


class Inbox:
    """What was heard and not taken yet. One thread puts bytes, one takes; anybody may wake it.

    Inputs of other threads (`add`) come out between the bytes, in the order in which they came.

    patient_bytes: the reader waits while more than this is not taken yet, for a device whose time
                   waits for its reader; None: it never waits, and a backlog beyond `limit_bytes` is
                   a lost link
    """

    def __init__(self, limit_bytes: int = BACKLOG_BYTES, patient_bytes: int | None = None) -> None:
        self.limit_bytes, self.patient_bytes = limit_bytes, patient_bytes
        self._queue: SimpleQueue[Item | None] = SimpleQueue()
        self._put_bytes = self._taken_bytes = 0  # each is written by one thread only

    @property
    def backlog_bytes(self) -> int:
        """Memory that what waits takes."""
        return self._put_bytes - self._taken_bytes

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return self._queue.empty()

    def put(self, item: Bytes | Lost) -> None:
        """From the reader."""
        if isinstance(item, Bytes):
            self._put_bytes += len(item.data) + _READ_BYTES
        self._queue.put(item)

    def add(self, item: ClientSent | ClientLeft) -> None:
        """From the thread of the shared ports, which bounds what it adds."""
        self._queue.put(item)

    def wake(self) -> None:
        """End a `get` that waits; safe in a signal handler."""
        self._queue.put(None)

    def get(self, timeout_s: float) -> Item | None:
        """The next one; None where nothing came in time, and after a `wake`."""
        try:
            item = self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Bytes):
            self._taken_bytes += len(item.data) + _READ_BYTES
        return item

    def rest(self) -> list[Bytes | ClientSent | ClientLeft]:
        """All that waits but the loss of the link; then it is empty."""
        found = []
        while not self.empty:
            if isinstance(item := self.get(0.0), Bytes | ClientSent | ClientLeft):
                found.append(item)
        return found


class SerialReader:
    """Reads an open port into an inbox until it is lost or `stop` is called.

    share: is given all that is read at once, and nothing (b"") where nothing came for a while;
           whether somebody else was handed any of it, and so goes first
    """

    def __init__(
        self,
        port: SerialPort,
        inbox: Inbox,
        now_ns: Callable[[], int],
        share: Callable[[bytes], bool] | None = None,
    ) -> None:
        self._port, self._inbox, self._now_ns, self._share = port, inbox, now_ns, share
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="serial-reader", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        reason = "the reading thread broke down, see above"
        try:
            while not self._stopping:
                if (waiting := self._inbox.backlog_bytes) > self._inbox.limit_bytes:
                    reason = f"{waiting} bytes wait to be worked on: reading was given up"
                    break
                if self._inbox.patient_bytes is not None and waiting > self._inbox.patient_bytes:
                    time.sleep(_PATIENT_POLL_S)
                    continue
                data = self._port.read(_POLL_S)
                item = Bytes(self._now_ns(), data)
                if self._share is not None and self._share(data):
                    time.sleep(_GIVE_WAY_S)
                if data:
                    self._inbox.put(item)
        except PortLost as error:
            reason = str(error)
        finally:  # also after a bug: a daemon that hears nothing must know it
            if not self._stopping:
                self._inbox.put(Lost(self._now_ns(), reason))

    def stop(self) -> bool:
        """End the thread; whether it ended. Only then may the port be closed."""
        self._stopping = True
        self._thread.join(_JOIN_S)
        return not self._thread.is_alive()


class SerialLink:
    """One port, opened as often as it takes. Everything that it hears comes out of `inbox`."""

    def __init__(
        self,
        path: Path,
        baud: int,
        now_ns: Callable[[], int],
        patient_bytes: int | None = None,
    ) -> None:
        self.path, self.baud = path, baud
        self.inbox = Inbox(patient_bytes=patient_bytes)
        self._now_ns = now_ns
        self.shared: Shares | None = None
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
        share = None if self.shared is None else self.shared.heard
        self._reader = SerialReader(self._port, self.inbox, self._now_ns, share)

    def share(self, shares: Iterable[ShareSection]) -> Shares:
        """Other programs find the device at places of their own, until `unshare`.

        Raises ConfigError where one cannot be.
        """
        self.shared = Shares(shares, self.inbox.add, self._now_ns)
        return self.shared

    def unshare(self) -> None:
        """Take the places away, once the port is closed; safe to call again."""
        if self.shared is not None:
            self.shared.close()

    def has_more(self) -> bool:
        """Whether bytes lie in the port that the thread has not come to read."""
        return self._port is not None and self._port.has_bytes()

    def write(self, data: bytes) -> None:
        """Send; nothing where the port is closed. Raises PortLost."""
        if self._port is not None:
            self._port.write(data)

    def take_port(self) -> SerialPort | None:
        """The open port itself, no longer read by the thread; the caller closes it."""
        port, reader = self._port, self._reader
        self._port = self._reader = None
        ended = reader is None or reader.stop()
        return port if ended else None  # a descriptor in use must not be closed, and so used again

    def put_back(
        self,
        procedure: Procedure[object] | None,
        allow: Callable[[Command], bool],
        longest_s: float,
    ) -> str:
        """Give the port back behind one last procedure; returns why that failed, else nothing."""
        port = self.take_port()
        if port is None:
            return ""
        try:
            with Device(port, allow) as device:
                if procedure is not None:
                    device.run(procedure, longest_s)
        except DriverError as error:
            return str(error)
        return ""

    def close(self) -> list[Bytes | ClientSent | ClientLeft]:
        """Give the port back, and what was read and not taken yet; safe to call again."""
        port = self.take_port()
        if port is not None:
            port.close()
        return self.inbox.rest()
