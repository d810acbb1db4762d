"""Asking the running daemon over its socket."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ahrsd.errors import EXIT_BUSY, DeviceError
from ahrsd.telemetry.protocol import SCHEMA, line_of

_WAIT_S = 5.0
_PIECE = 1 << 16
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
