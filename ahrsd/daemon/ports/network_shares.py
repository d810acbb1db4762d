"""Addresses at which other programs read what the device measures: tcp listeners and udp targets.

Whoever has a message writes it: the thread that reads the device (raw) or the daemon's (corrected,
nmea); what a reader's connection does not take at once waits for it in an `Outbox`, within bounds,
and goes out in the thread of this object. So a reader that is slow, or never reads, loses messages
of its own and costs nobody else anything. Nothing that a reader sends gets further than here.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import selectors
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from ahrsd.config.sections import Address, ShareSection
from ahrsd.errors import ConfigError
from ahrsd.sharing.share_output import ShareFacts
from ahrsd.telemetry.protocol import Outbox

log = logging.getLogger("ahrsd")

MOST_READERS = 16  # of one share
_UNREAD_BYTES = 1 << 16  # that wait for one reader here, and about as many in the kernel
_PIECE = 1 << 16
_HEARD_BYTES = 1 << 12  # of a reader that talks, at a time
_AGAIN_S = 0.02  # how often a reader that did not take all is tried again
_IDLE_S = 1.0
_JOIN_S = 2.0
_KEEPALIVE: Final = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}  # s, s, probes
_WHY: Final = {
    errno.EADDRINUSE: "another program listens there; stop it or choose another port",
    errno.EADDRNOTAVAIL: "no interface of this machine has that address",
    errno.EACCES: "no permission; ports below 1024 are the system's, choose a higher one",
    errno.EPERM: "no permission; under systemd allow the address (docs/guide/sharing.md)",
    errno.EAFNOSUPPORT: "this process may have no such socket; under systemd give the service a "
    "network (docs/guide/sharing.md)",
}


@dataclass(eq=False, slots=True)
class _Reader:
    """One connection."""

    connection: socket.socket
    outbox: Outbox = field(default_factory=lambda: Outbox(_UNREAD_BYTES))
    gone: bool = False

    def flush(self) -> None:
        """What waits, as far as the connection takes it."""
        try:
            while len(self.outbox):
                self.outbox.sent(self.connection.send(self.outbox.head(_PIECE)))
        except BlockingIOError:
            pass
        except OSError:  # it is closed where its end is heard
            self.gone = True


class Listener:
    """A tcp share. `lock` is for the readers and the counts."""

    def __init__(self, share: ShareSection, poke: _Poke) -> None:
        self.share, self._poke = share, poke
        self.lock = threading.Lock()
        self.readers: list[_Reader] = []
        self._lost_before = self._turned_away = self._ignored_bytes = 0
        self._newest, self._fault = b"", ""  # the first line of who comes later
        try:
            self.socket = _listen(share.address)
        except OSError as error:
            raise _refused(share, error) from error

    @property
    def wanted(self) -> bool:
        """Whether anybody reads."""
        return bool(self.readers)

    def write(self, messages: Sequence[bytes], seq: int, newest: bytes) -> None:
        """To every reader.

        seq: number of the first message; a reader that loses some is told which. 0: none has one
        newest: what a reader that connects later is told first, from now on; empty: as before
        """
        with self.lock:
            self._newest = newest or self._newest
            waits = False
            for reader in self.readers:
                self._put(reader, messages, seq)
                reader.flush()
                waits |= len(reader.outbox) > 0 or reader.gone
        if waits:
            self._poke()

    def _put(self, reader: _Reader, messages: Sequence[bytes], seq: int) -> None:
        for number, message in enumerate(messages):
            if seq:
                reader.outbox.record(message, seq + number)
            else:
                reader.outbox.offer(message)

    def accept(self) -> _Reader | None:
        """Somebody connects; None where there is no room, or nobody is there any more."""
        try:
            connection, peer = self.socket.accept()
        except OSError as error:  # such as no descriptor left: who connects waits meanwhile
            if self._fault != (fault := _why(error)):
                log.warning("%s: nobody can connect: %s", self.share.name, fault)
            self._fault = fault
            time.sleep(_AGAIN_S)
            return None
        self._fault = ""
        with self.lock:
            if len(self.readers) >= MOST_READERS:
                connection.close()
                self._turned_away += 1
                if self._turned_away == 1:
                    log.warning(
                        "%s: %d programs read already, %s is turned away",
                        self.share.name,
                        MOST_READERS,
                        peer[0],
                    )
                return None
            _prepare(connection)
            reader = _Reader(connection)
            if self._newest:
                reader.outbox.offer(self._newest)
                reader.flush()
            self.readers.append(reader)
        return reader

    def hear(self, reader: _Reader) -> bool:
        """What a reader says is thrown away; whether it is still there."""
        try:
            size = len(reader.connection.recv(_HEARD_BYTES))
        except BlockingIOError:
            return True
        except OSError:
            return False
        if size and not self._ignored_bytes:
            log.warning(
                "%s: a program sends; whoever reads here cannot command the device, and what it "
                "sends is thrown away",
                self.share.name,
            )
        self._ignored_bytes += size
        return size > 0

    def ended(self, reader: _Reader) -> None:
        """The connection is over."""
        with self.lock:
            self.readers.remove(reader)
            self._lost_before += reader.outbox.lost_bytes
            reader.connection.close()

    def again(self) -> bool:
        """Try those again that did not take all; whether any waits still."""
        with self.lock:
            for reader in self.readers:
                reader.flush()
            return any(len(reader.outbox) for reader in self.readers)

    def facts(self) -> ShareFacts:
        """How it stands."""
        with self.lock:
            lost = self._lost_before + sum(reader.outbox.lost_bytes for reader in self.readers)
            return ShareFacts(
                self.share.name,
                self.share.send,
                len(self.readers),
                lost,
                self._turned_away,
                self._ignored_bytes,
                self._fault,
            )

    def close(self) -> None:
        """Listen no more, and end every connection."""
        self.socket.close()
        for reader in self.readers:
            reader.connection.close()


class Target:
    """A udp share: a datagram for each message."""

    wanted = True

    def __init__(self, share: ShareSection) -> None:
        self.share = share
        self._place = share.address.place
        self._lost_bytes, self._fault = 0, ""
        try:
            self.socket = socket.socket(share.address.family, socket.SOCK_DGRAM)
            self.socket.setblocking(False)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except OSError as error:
            raise _refused(share, error) from error

    def write(self, messages: Sequence[bytes], seq: int, newest: bytes) -> None:
        """Each message at once; what the network does not take now is lost."""
        del seq, newest
        for message in messages:
            try:
                self.socket.sendto(message, self._place)
                fault = ""
            except OSError as error:
                self._lost_bytes += len(message)
                fault = _why(error)
            if fault != self._fault:
                log.warning("%s: %s", self.share.name, fault or f"over: {self._fault}")
                self._fault = fault

    def facts(self) -> ShareFacts:
        """How it stands."""
        lost, fault = self._lost_bytes, self._fault
        return ShareFacts(self.share.name, self.share.send, None, lost, fault=fault)

    def close(self) -> None:
        """Send no more."""
        self.socket.close()


class _Poke:
    """Wakes the thread that waits for sockets."""

    def __init__(self) -> None:
        self.heard, self._teller = socket.socketpair()
        for one in (self.heard, self._teller):
            one.setblocking(False)

    def __call__(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # full: it is awake already
            self._teller.send(b"\0")

    def take(self) -> None:
        """It woke up."""
        with contextlib.suppress(BlockingIOError):
            self.heard.recv(_PIECE)

    def close(self) -> None:
        """No more."""
        self.heard.close()
        self._teller.close()


class NetworkShares:
    """Opens the shares; `close` takes them away. Raises ConfigError where one cannot be."""

    def __init__(self, shares: Iterable[ShareSection]) -> None:
        self._places: dict[str, Listener | Target] = {}
        self._poke = _Poke()
        self._closing = False
        try:
            for share in shares:
                is_tcp = share.tcp is not None
                self._places[share.name] = Listener(share, self._poke) if is_tcp else Target(share)
        except ConfigError:
            self._take_away()
            raise
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._poke.heard, selectors.EVENT_READ)
        for listener in self._listeners:
            self._selector.register(listener.socket, selectors.EVENT_READ, (listener, None))
        self._thread = threading.Thread(target=self._work, name="network-shares", daemon=True)
        self._thread.start()

    @property
    def places(self) -> list[Listener | Target]:
        """Each share; all that is not `raw` is written from outside."""
        return list(self._places.values())

    def raw(self, messages: Sequence[bytes]) -> bool:
        """The device's own messages, for those that want these; whether anybody does."""
        wanted = False
        for place in self._places.values():
            if place.share.send == "raw":
                place.write(messages, 0, b"")
                wanted |= place.wanted
        return wanted

    def facts(self) -> list[ShareFacts]:
        """How each stands."""
        return [place.facts() for place in self._places.values()]

    def close(self) -> None:
        """End every connection; safe to call again."""
        if not self._closing:
            self._closing = True
            self._poke()
            self._thread.join(_JOIN_S)
            self._selector.close()
            self._take_away()

    def _take_away(self) -> None:
        for place in self._places.values():
            place.close()
        self._poke.close()

    @property
    def _listeners(self) -> list[Listener]:
        return [place for place in self._places.values() if isinstance(place, Listener)]

    # -- the thread of the connections -------------------------------------------------------------

    def _work(self) -> None:
        waits = False
        while not self._closing:
            heard = False
            for key, _ in self._selector.select(_AGAIN_S if waits else _IDLE_S):
                if key.data is None:
                    self._poke.take()
                else:
                    heard |= self._turn(*key.data)
            waits = sum(listener.again() for listener in self._listeners) > 0
            if heard:  # who floods is read slowly, and its own connection holds it up
                time.sleep(_AGAIN_S)

    def _turn(self, listener: Listener, reader: _Reader | None) -> bool:
        """Whether a reader said something."""
        if reader is None:
            if (new := listener.accept()) is not None:
                data = (listener, new)
                self._selector.register(new.connection, selectors.EVENT_READ, data)
            return False
        if listener.hear(reader):
            return True
        self._selector.unregister(reader.connection)
        listener.ended(reader)
        return False


def _listen(address: Address) -> socket.socket:
    listener = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if address.family is socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.setblocking(False)
        listener.bind(address.place)
        listener.listen(MOST_READERS)
    except OSError:
        listener.close()
        raise
    return listener


def _prepare(connection: socket.socket) -> None:
    """Nothing waits for company, little lies in the kernel, and who is gone is noticed."""
    connection.setblocking(False)
    with contextlib.suppress(OSError):  # it may be gone already, which is heard later
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNREAD_BYTES // 2)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _refused(share: ShareSection, error: OSError) -> ConfigError:
    return ConfigError([f"share.{share.kind} = {share.address.text}: {_why(error)}"])


def _why(error: OSError) -> str:
    """What is wrong, and what to do where that is known."""
    code = error.errno or 0
    return _WHY.get(code) or error.strerror or os.strerror(code)
