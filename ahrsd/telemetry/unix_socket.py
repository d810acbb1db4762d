"""The daemon's Unix socket, both ends: the server in the daemon, and how a command asks it.

**The server** has a thread of its own that never keeps the serial loop waiting. The daemon's thread
calls `publish` and `status`; both put a value into a bounded queue and return. Who may connect is
decided by the permissions of the socket's file (0660).

**A command** finds the socket (`find_socket`) and asks over a `DaemonConnection`. What is said on
it is in `protocol`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import selectors
import socket
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ahrsd
from ahrsd import events
from ahrsd.errors import EXIT_BUSY, DeviceError
from ahrsd.telemetry.protocol import (
    LIMIT_BYTES,
    LONGEST_REQUEST,
    SCHEMA,
    STREAMS,
    BadRequest,
    Outbox,
    Record,
    SocketRequest,
    line_of,
    parse_request,
    record_of,
    stream_of,
)
from ahrsd.telemetry.words import explain_json

# -- The daemon's end ------------------------------------------------------------------------------


log = logging.getLogger(__name__)

MOST_CLIENTS = 16
_QUEUED = 4096  # events that wait for the thread; the oldest go first
_PIECE = 1 << 16
_CLOSE_S = 1.0


class Client:
    """One connection."""

    def __init__(self, connection: socket.socket, limit_bytes: int) -> None:
        self.connection = connection
        self.outbox = Outbox(limit_bytes)
        self.streams: frozenset[str] = frozenset()
        self.heard = bytearray()
        self.ended = False


class SocketServer:
    """Serves until `close`. Raises OSError where the socket cannot be made."""

    def __init__(self, path: Path, limit_bytes: int = LIMIT_BYTES) -> None:
        self.path, self.limit_bytes = path, limit_bytes
        self.dropped = 0  # records that slow readers did not get
        self._status: dict[str, object] | None = None
        self._queue: deque[tuple[str, Record | events.Event]] = deque()
        self._wanted: frozenset[str] = frozenset()
        self._seq = 0
        self._clients: dict[int, Client] = {}
        self._listener = _listen(path)
        self._wake, self._waker = socket.socketpair()
        for one in (self._wake, self._waker):
            one.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake, selectors.EVENT_READ)
        self._stop = False
        self._thread = threading.Thread(target=self._run, name="ahrsd-socket", daemon=True)
        self._thread.start()

    # -- the daemon's thread -----------------------------------------------------------------------

    def wants(self, stream: str) -> bool:
        """Whether anybody watches the stream."""
        return stream in self._wanted

    def publish(self, event: events.Event) -> None:
        """An event of the core; costs nothing where nobody watches its stream."""
        stream = stream_of(event)
        if stream in self._wanted:
            self._put(stream, event)

    def samples(self, record: Record) -> None:
        """Samples for who watches them."""
        self._put("samples", record)

    def status(self, status: dict[str, object]) -> None:
        """The newest status: the answer to `status`, and a record for who watches it."""
        self._status = status
        if "status" in self._wanted:
            self._put("status", {"record": "status", **status})

    def _put(self, stream: str, item: Record | events.Event) -> None:
        if len(self._queue) >= _QUEUED:
            with contextlib.suppress(IndexError):  # the thread may have emptied it just now
                self._queue.popleft()
        self._queue.append((stream, item))
        self._nudge()

    def _nudge(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # full: it is awake already
            self._waker.send(b"\0")

    def close(self) -> None:
        """Answer no more; bounded in time."""
        self._stop = True
        self._nudge()
        self._thread.join(_CLOSE_S)
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()

    # -- the socket's thread -----------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop:
            for key, mask in self._selector.select(timeout=1.0):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._wake:
                    self._drain()
                else:
                    self._serve(key.data, mask)
        for client in list(self._clients.values()):
            self._end(client)
        for one in (self._listener, self._wake, self._waker):
            one.close()
        self._selector.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            log.warning("socket: %s", error.strerror)
            return
        connection.setblocking(False)
        client = Client(connection, self.limit_bytes)
        if len(self._clients) >= MOST_CLIENTS:
            with contextlib.suppress(OSError):
                connection.send(line_of({"error": f"{MOST_CLIENTS} clients are connected already"}))
            connection.close()
            return
        self._clients[connection.fileno()] = client
        self._selector.register(connection, selectors.EVENT_READ, client)
        client.outbox.answer(line_of({"schema": SCHEMA, "version": ahrsd.__version__}))
        self._send(client)

    def _drain(self) -> None:
        """Hand what is queued to the clients that want it."""
        with contextlib.suppress(BlockingIOError):
            self._wake.recv(_PIECE)
        while self._queue:
            stream, item = self._queue.popleft()
            takers = [c for c in self._clients.values() if stream in c.streams]
            if not takers:
                continue
            self._seq += 1
            record = item if isinstance(item, dict) else record_of(item)
            line = line_of({**record, "seq": self._seq})
            for client in takers:
                before = client.outbox.dropped
                client.outbox.record(line, self._seq)
                self.dropped += client.outbox.dropped - before
        for client in list(self._clients.values()):
            self._send(client)

    def _serve(self, client: Client, mask: int) -> None:
        # Records handed out earlier in the same turn may have found the client gone.
        if mask & selectors.EVENT_READ and not client.ended:
            self._hear(client)
        if mask & selectors.EVENT_WRITE and not client.ended:
            self._send(client)

    def _hear(self, client: Client) -> None:
        try:
            data = client.connection.recv(_PIECE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end(client)
            return
        client.heard += data
        while (end := client.heard.find(b"\n")) >= 0:
            line = bytes(client.heard[:end])
            del client.heard[: end + 1]
            if line.strip():
                self._answer(client, line)
        if len(client.heard) > LONGEST_REQUEST:
            client.outbox.answer(line_of({"error": f"a line of over {LONGEST_REQUEST} bytes"}))
            client.heard.clear()
        self._send(client)

    def _answer(self, client: Client, line: bytes) -> None:
        try:
            request = parse_request(line)
        except BadRequest as error:
            client.outbox.answer(line_of({"error": str(error)}))
            return
        client.outbox.answer(line_of(self._reply(client, request)))

    def _reply(self, client: Client, request: SocketRequest) -> dict[str, object]:
        if request.ask == "watch":
            client.streams = request.streams
            self._wanted = frozenset().union(*(c.streams for c in self._clients.values()))
            return {"watching": [name for name in STREAMS if name in request.streams]}
        if self._status is None:
            return {"error": "the daemon has only just begun; ask again in a second"}
        return self._status if request.ask == "status" else explain_json(self._status)

    def _send(self, client: Client) -> None:
        """As much as the client takes; the rest waits until it reads."""
        while len(client.outbox):
            try:
                client.outbox.sent(client.connection.send(client.outbox.head(_PIECE)))
            except BlockingIOError:
                break
            except OSError:
                self._end(client)
                return
        wants = selectors.EVENT_READ | (selectors.EVENT_WRITE if len(client.outbox) else 0)
        self._selector.modify(client.connection, wants, client)

    def _end(self, client: Client) -> None:
        if client.ended:
            return
        client.ended = True
        del self._clients[client.connection.fileno()]
        self._selector.unregister(client.connection)
        client.connection.close()
        self._wanted = frozenset().union(*(c.streams for c in self._clients.values()))


def _listen(path: Path) -> socket.socket:
    """The listening socket; a file that a dead daemon left is replaced, a live one is not."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_socket():
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(path))
            except OSError:
                path.unlink(missing_ok=True)
            else:
                raise FileExistsError(f"{path}: another daemon serves here")
    listener = socket.socket(socket.AF_UNIX)
    before = os.umask(0o117)
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    listener.listen(MOST_CLIENTS)
    listener.setblocking(False)
    return listener


# -- The other end ---------------------------------------------------------------------------------


_WAIT_S = 5.0
_SYSTEM = Path("/run/ahrsd/socket")


def default_socket_path(state_directory: Path) -> Path:
    """$RUNTIME_DIRECTORY/socket as systemd sets it, else in the state directory."""
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0]) / "socket"
    return state_directory / "socket"


def find_socket(state_directory: Path) -> Path:
    """Where a client looks: this user's daemon first, then the system's service."""
    own = default_socket_path(state_directory)
    return own if own.exists() or not _SYSTEM.exists() else _SYSTEM


class DaemonConnection:
    """A connection. Raises DeviceError with one clear line where no daemon answers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(_WAIT_S)
        self._heard = bytearray()
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            where = f"{path}: no daemon answers ({error.strerror})"
            if not path.parent.exists():
                where = f"{path.parent}: no daemon answers (there is no such folder)"
            raise DeviceError(
                f"{where}; is `ahrsd run` running, under this user or as a service? --socket or "
                "--state-directory names another place",
                EXIT_BUSY,
            ) from None
        try:
            greeting = self._line()
            if greeting.get("schema") != SCHEMA:
                why = greeting.get("error", f"it speaks {greeting.get('schema')}, not {SCHEMA}")
                raise DeviceError(f"{path}: {why}", EXIT_BUSY)
        except DeviceError:
            self._socket.close()
            raise

    def __enter__(self) -> DaemonConnection:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # the daemon may be gone already
            self._socket.shutdown(socket.SHUT_RDWR)  # whoever waits in `watch` is woken
        self._socket.close()

    def ask(self, what: str) -> dict[str, Any]:
        """One answer."""
        self._say({"ask": what})
        answer = self._line()
        if "error" in answer:
            raise DeviceError(f"{self.path}: {answer['error']}", EXIT_BUSY)
        return answer

    def watch(self, streams: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        """Records until the daemon ends; a silence of some seconds is an error."""
        self._say({"ask": "watch", "of": list(streams)})
        while True:
            yield self._line()

    def _say(self, request: dict[str, object]) -> None:
        try:
            self._socket.sendall(line_of(request))
        except OSError:  # it closed the connection
            raise DeviceError(f"{self.path}: the daemon has ended", EXIT_BUSY) from None

    def _line(self) -> dict[str, Any]:
        while b"\n" not in self._heard:
            try:
                data = self._socket.recv(_PIECE)
            except TimeoutError:
                raise DeviceError(f"{self.path}: silent for {_WAIT_S:.0f} s", EXIT_BUSY) from None
            except ConnectionError:  # a reset: it closed before it had read what was asked
                data = b""
            except OSError as error:
                raise DeviceError(f"{self.path}: {error.strerror}", EXIT_BUSY) from None
            if not data:
                raise DeviceError(f"{self.path}: the daemon has ended", EXIT_BUSY)
            self._heard += data
        line, _, rest = bytes(self._heard).partition(b"\n")
        self._heard = bytearray(rest)
        answer = json.loads(line)
        return answer if isinstance(answer, dict) else {"error": "not an object"}
