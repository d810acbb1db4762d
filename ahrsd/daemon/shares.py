"""Every `[[share]]` of a run: ports for programs that may speak, addresses for those that read.

**Addresses**: tcp listeners and udp targets. Whoever has a message writes it: the thread that reads
the device (raw) or the daemon's (corrected, nmea); what a reader's connection does not take at once
waits for it in an `Outbox`, within bounds, and goes out in the thread of `NetworkShares`. So a
reader that is slow, or never reads, loses messages of its own and costs nobody else anything.
Nothing that a reader sends gets further than here.

**Ports**: ptys with stable names. Two threads write into a port: the one that reads the device
(measurements) and the daemon's (answers). A third one reads what the programs write, at the rate of
a real line, so nobody can flood the daemon. What a program does not read is lost for it alone.

What ptys ask for, each met with real drivers: the port is raw before anybody opens it, else its
echo would come back as commands; a program has it open when its master does not hang up; TIOCEXCL
of a program that was killed stays with the pty, so a port that was left gets a new pty under the
same name, but only after a while, for drivers close and open again at once.
"""

from __future__ import annotations

import contextlib
import errno
import grp
import logging
import os
import select
import selectors
import socket
import stat
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ahrsd.config.sections import Address, ShareSection
from ahrsd.errors import ConfigError
from ahrsd.events import SendToClient
from ahrsd.inputs import ClientLeft, ClientSent
from ahrsd.sharing.share_output import MessageSplitter, ShareFacts
from ahrsd.telemetry.protocol import Outbox

# -- Addresses: tcp listeners and udp targets ------------------------------------------------------


log = logging.getLogger("ahrsd")

MOST_READERS = 16  # connections of one share
_UNREAD_BYTES = 1 << 16  # kept for one slow reader; the kernel keeps about as many
_PIECE = 1 << 16  # bytes of one send
_HEARD_BYTES = 1 << 12  # received from a reader at a time
_AGAIN_S = 0.02  # until a reader that did not take everything is tried again
_IDLE_S = 1.0  # longest wait for a connection if no bytes are waiting
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


# -- Ports -----------------------------------------------------------------------------------------


_POLL_S = 0.02  # interval at which ports are checked for programs and for unwritten bytes
_RENEW_S = 1.0  # until a port that a program closed is replaced by a new one
_MOST_UNREAD_BYTES = 1 << 16  # kept for one slow program
_LINE_BYTES_PER_S = 11_520.0  # rate allowed to one program: a line at 115200 baud
_BURST_BYTES = 4096  # allowed to one program at once
_MODE = 0o660  # permissions of a port: owner and group
_LOCAL_FLAGS = 3  # index in the result of tcgetattr


@dataclass(slots=True)
class _Port:
    """One port. Everything but `master` and the link is used under `lock`."""

    share: ShareSection
    master: int
    target: str  # of the name: the pty's own
    lock: threading.Lock = field(default_factory=threading.Lock)
    unread: bytearray = field(default_factory=bytearray)
    open: bool = False
    used: bool = False
    streams: bool = True
    left_s: float = 0.0
    fault: str = ""
    lost_bytes: int = 0
    allowance: float = float(_BURST_BYTES)
    allowed_s: float = 0.0

    def write(self, data: bytes) -> None:
        """Now what the port takes; the rest waits, within bounds."""
        with self.lock:
            if not self.open:
                return
            if not self.unread:
                data = data[self._put(data) :]  # all of it, mostly
            if len(self.unread) + len(data) > _MOST_UNREAD_BYTES:
                self.lost_bytes += len(data)
            elif data:
                self.unread += data
                self._flush()

    def flush(self) -> None:
        """What waits, as far as the port takes it."""
        with self.lock:
            self._flush()

    def _flush(self) -> None:
        while self.unread and (taken := self._put(self.unread)):
            del self.unread[:taken]

    def _put(self, data: bytes | bytearray) -> int:
        try:
            return os.write(self.master, data)
        except OSError:  # full; or a program that is gone, which is seen later
            return 0


class SharedPorts:
    """Opens the ports; `close` takes them away again. Raises ConfigError where one cannot be.

    put: takes what programs write, from the thread of this object
    """

    def __init__(
        self,
        shares: Iterable[ShareSection],
        put: Callable[[ClientSent | ClientLeft], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._put, self._now_ns = put, now_ns
        self._ports: dict[str, _Port] = {}
        self._closing = False
        try:
            for share in shares:
                self._ports[share.name] = _Port(share, *_open_pty(share))
        except ConfigError:
            self._take_away()
            raise
        self._thread = threading.Thread(target=self._work, name="shared-ports", daemon=True)
        self._thread.start()

    def measured(self, data: bytes) -> bool:
        """Whole messages of the device that answer nobody; whether a program has them."""
        taken = False
        for port in self._ports.values():
            if port.streams and port.open:
                port.write(data)
                taken = True
        return taken

    def send(self, item: SendToClient) -> None:
        """An answer for the program on one port."""
        if (port := self._ports.get(item.client)) is not None:
            if item.stream is not None:
                port.streams = item.stream
            port.write(item.data)

    def facts(self) -> list[ShareFacts]:
        """Each port: whether a program has it open, and what it did not read."""
        return [
            ShareFacts(name, readers=int(port.open), lost_bytes=port.lost_bytes, fault=port.fault)
            for name, port in self._ports.items()
        ]

    def close(self) -> None:
        """Take the ports away; safe to call again."""
        if not self._closing:
            self._closing = True
            self._thread.join(_JOIN_S)
            self._take_away()

    def _take_away(self) -> None:
        for port in self._ports.values():
            with contextlib.suppress(OSError):  # the name may be somebody else's by now
                if str(Path(port.share.name).readlink()) == port.target:
                    Path(port.share.name).unlink()
            os.close(port.master)
        self._ports = {}

    # -- the thread that reads the programs --------------------------------------------------------

    def _work(self) -> None:
        while not self._closing:
            try:
                self._turn()
            except OSError as error:
                log.warning("shared ports: %s", error)
                time.sleep(_POLL_S)

    def _turn(self) -> None:
        now_s = time.monotonic()
        for port in self._ports.values():
            self._look(port, now_s)
        readable = {p.master: p for p in self._ports.values() if p.open and _may_say(p, now_s)}
        writable = [p.master for p in self._ports.values() if p.open and p.unread]
        if not readable and not writable:
            time.sleep(_POLL_S)
            return
        for master in select.select([*readable], writable, [], _POLL_S)[0]:
            self._read(readable[master])
        for port in self._ports.values():
            port.flush()

    def _look(self, port: _Port, now_s: float) -> None:
        """Whether a program has opened it by now; a fresh pty where one left it for good."""
        if port.open:
            return
        poll = select.poll()
        poll.register(port.master, 0)
        if not any(what & select.POLLHUP for _, what in poll.poll(0)):
            with port.lock:
                port.open = port.used = port.streams = True
        elif port.used and now_s - port.left_s > _RENEW_S:
            self._renew(port, now_s)

    def _renew(self, port: _Port, now_s: float) -> None:
        """A fresh pty; where the name is somebody else's by now it is tried again and again."""
        try:
            master, target = _open_pty(port.share, port.target)
        except ConfigError as error:
            if port.fault != (fault := error.lines[0]):
                log.warning("%s", fault)
            port.fault, port.left_s = fault, now_s
            return
        os.close(port.master)
        port.master, port.target, port.used, port.fault = master, target, False, ""

    def _read(self, port: _Port) -> None:
        try:
            data = os.read(port.master, int(port.allowance))
        except BlockingIOError:
            return
        except OSError:  # EIO: nobody has it open any more
            with port.lock:
                port.open, port.left_s = False, time.monotonic()
                port.unread.clear()
            self._put(ClientLeft(self._now_ns(), port.share.name))
            return
        port.allowance -= len(data)
        self._put(ClientSent(self._now_ns(), port.share.name, data.decode("latin-1")))


def _may_say(port: _Port, now_s: float) -> bool:
    """Whether the program on it may be read now, by the rate of a real line."""
    gained = (now_s - port.allowed_s) * _LINE_BYTES_PER_S
    port.allowance, port.allowed_s = min(port.allowance + gained, float(_BURST_BYTES)), now_s
    return port.allowance >= 1.0


def _open_pty(share: ShareSection, before: str = "") -> tuple[int, str]:
    """A raw pty under the share's name; its master and its own name. Raises ConfigError.

    before: the pty of ours that has the name until now
    """
    path = Path(share.name)
    if _is_somebodys(path, before):
        raise ConfigError(
            [f"share.pty = {path}: there is something of that name; remove it or choose another"]
        )
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        target = os.ttyname(slave)
        group = os.getegid() if share.group is None else grp.getgrnam(share.group).gr_gid
        os.chown(target, -1, group)
        Path(target).chmod(_MODE)
        scratch = path.with_name(f".{path.name}.new")
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(target)
        scratch.replace(path)
    except KeyError as error:
        os.close(master)
        raise ConfigError([f"share.group: {path}: there is no group {share.group}"]) from error
    except OSError as error:
        os.close(master)
        why = f"{error.strerror}; the folder must exist and be the daemon's to write"
        raise ConfigError([f"share.pty = {path}: {why}"]) from error
    finally:
        os.close(slave)  # held open it would keep TIOCEXCL of a program that died
    return master, target


def _is_somebodys(path: Path, ours: str) -> bool:
    """Whether the name is taken by anything but a link to a pty of ours, or of a killed run."""
    try:
        link = path.lstat()
    except OSError:
        return False  # not there, or told when the link is made
    if not stat.S_ISLNK(link.st_mode) or not (target := str(path.readlink())).startswith(
        "/dev/pts/"
    ):
        return True
    return target != ours and _is_port(target, link.st_mtime_ns)


def _is_port(pty: str, named_ns: int) -> bool:
    """Whether it is another program's port: there, raw, and there since before it was named.

    What a killed run left is gone with it. Its number may be a person's terminal by now, a shell's
    prompt (raw as well), or a port that this run has just opened for another share.
    """
    try:
        slave = os.open(pty, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        return error.errno == errno.EBUSY  # a port, and somebody has it for itself
    try:
        if os.fstat(slave).st_ctime_ns > named_ns:  # made after the link: the number came again
            return False
        return not termios.tcgetattr(slave)[_LOCAL_FLAGS] & termios.ICANON
    except termios.error:  # gone at this moment
        return False
    finally:
        os.close(slave)


# -- Every share of a run --------------------------------------------------------------------------


class Shares:
    """Opens them; `close` takes them away again. Raises ConfigError where one cannot be.

    put: takes what programs on ptys write, from another thread
    """

    def __init__(
        self,
        shares: Iterable[ShareSection],
        put: Callable[[ClientSent | ClientLeft], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._sections = tuple(shares)
        self._splitter = MessageSplitter()
        self._ports = SharedPorts([s for s in self._sections if s.pty is not None], put, now_ns)
        try:
            self._network = NetworkShares([s for s in self._sections if s.pty is None])
        except ConfigError:
            self._ports.close()
            raise

    def outlets(self) -> list[Listener | Target]:
        """Those that send more than the device's own messages: they are written from outside."""
        return [place for place in self._network.places if place.share.send != "raw"]

    def heard(self, data: bytes) -> bool:
        """Bytes of the device; none where nothing came for a while. Of the thread that reads it.

        Whether a program was handed any of it.
        """
        ahead = self._splitter.completed_message(data)
        taken = bool(ahead) and self._measured([ahead])
        messages = self._splitter.feed(data) if data else self._splitter.flush()
        return (bool(messages) and self._measured(messages)) or taken

    def _measured(self, messages: Sequence[bytes]) -> bool:
        taken = self._ports.measured(b"".join(messages))
        return self._network.raw(messages) or taken

    def send(self, item: SendToClient) -> None:
        """An answer for the program on one port."""
        self._ports.send(item)

    def announced(self) -> list[tuple[int, str]]:
        """What a person should hear at the start, with the level of the log."""
        names = ", ".join(
            share.name if share.pty is not None else f"{share.name} ({share.send})"
            for share in self._sections
        )
        open_ = [share.name for share in self._sections if share.other_hosts]
        warning = f"other machines can read the device at {', '.join(open_)} (other_hosts = true)"
        lines = [(logging.INFO, f"the device is shared on {names}")]
        return [*lines, (logging.WARNING, warning)] if open_ else lines

    def facts(self) -> tuple[ShareFacts, ...]:
        """How each stands, in the order of the configuration."""
        found = {fact.name: fact for fact in (*self._ports.facts(), *self._network.facts())}
        return tuple(found[share.name] for share in self._sections if share.name in found)

    def close(self) -> None:
        """Take them away; safe to call again."""
        self._ports.close()
        self._network.close()
