"""A device server on the loopback: one TCP client at a time to a pty, raw or by RFC 2217."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from types import TracebackType
from typing import Self

import serial
import serial.rfc2217
from patience import PATIENCE_S


class DeviceServer:
    """`url` is what to open. `drop()` ends the present connection, `silent` forwards nothing."""

    def __init__(self, path: str, *, telnet: bool = False) -> None:
        self._path, self._telnet = path, telnet
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._stopping = False
        self.silent = False
        self.baud = 0  # that the client asked for
        self._thread = threading.Thread(target=self._serve, name="device-server")

    @property
    def url(self) -> str:
        scheme = "rfc2217" if self._telnet else "socket"
        return f"{scheme}://127.0.0.1:{self._listener.getsockname()[1]}"

    def drop(self) -> None:
        """The connection ends."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stopping = True
        self.drop()
        self._thread.join(PATIENCE_S)
        self._listener.close()

    def _serve(self) -> None:
        while not self._stopping:
            if not select.select([self._listener], [], [], 0.1)[0]:
                continue
            self._client, _ = self._listener.accept()
            with self._client, _Pty(self._path, 115200, timeout=0) as port:
                self._forward(self._client, port)
            self._client = None

    def _forward(self, client: socket.socket, port: serial.Serial) -> None:
        manager = serial.rfc2217.PortManager(port, _Writer(client)) if self._telnet else None
        while not self._stopping:
            ready = select.select([client, port], [], [], 0.1)[0]
            if client in ready:
                try:
                    data = client.recv(4096)
                except OSError:
                    return
                if not data:
                    return
                port.write(b"".join(manager.filter(data)) if manager else data)
                self.baud = port.baudrate
            if port in ready and not self.silent:
                data = port.read(port.in_waiting or 1)
                with contextlib.suppress(OSError):
                    client.sendall(b"".join(manager.escape(data)) if manager else data)


class _Pty(serial.Serial):
    """A pseudo-terminal has no control lines."""

    cts = dsr = ri = cd = False

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass


class _Writer:
    """As the port manager wants its connection."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client

    def write(self, data: bytes) -> None:
        self._client.sendall(data)
