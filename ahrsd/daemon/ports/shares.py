"""Every `[[share]]` of a run: ports for programs that may speak, addresses for those that read.

The addresses are in `network_shares`; here are the ports: ptys with stable names. Two threads write
into a port: the one that reads the device (measurements) and the daemon's (answers). A third one
reads what the programs write, at the rate of a real line, so nobody can flood the daemon. What a
program does not read is lost for it alone.

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
import stat
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ahrsd.config.sections import ShareSection
from ahrsd.daemon.ports.network_shares import Listener, NetworkShares, Target
from ahrsd.errors import ConfigError
from ahrsd.events import SendToClient
from ahrsd.inputs import ClientLeft, ClientSent
from ahrsd.sharing.share_output import MessageSplitter, ShareFacts

# -- Ports -----------------------------------------------------------------------------------------


log = logging.getLogger("ahrsd")

_POLL_S = 0.02  # how often it is looked who has opened a port, and what could not be written
_RENEW_S = 1.0  # after a program closed its port
_MOST_UNREAD_BYTES = 1 << 16
_LINE_BYTES_PER_S = 11_520.0  # of a line at 115200 baud
_BURST_BYTES = 4096
_MODE = 0o660
_LOCAL_FLAGS = 3  # of what tcgetattr returns
_JOIN_S = 2.0


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
        kind = path.lstat().st_mode
    except OSError:
        return False  # not there, or told when the link is made
    if not stat.S_ISLNK(kind) or not (target := str(path.readlink())).startswith("/dev/pts/"):
        return True
    return target != ours and _is_port(target)


def _is_port(pty: str) -> bool:
    """Whether it is another program's port: there, and raw.

    What a killed run left is gone with it; its number may be a person's terminal by now.
    """
    try:
        slave = os.open(pty, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        return error.errno == errno.EBUSY  # a port, and somebody has it for itself
    try:
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
        ahead = self._splitter.ahead(data)
        taken = bool(ahead) and self._measured([ahead])
        messages = self._splitter.feed(data) if data else self._splitter.silence()
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
