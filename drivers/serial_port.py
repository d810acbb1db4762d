"""A serial port that is ours alone, and the search for its rate. The only importer of pyserial.

Also one of a device server on the network: `socket://HOST:PORT` (bytes as they are; the server has
the rate) and `rfc2217://HOST:PORT` (the rate is set from here), both through pyserial. Nobody can
see who else uses such a port. A network that goes away without a word is noticed within some 15 s.

pyserial opens and configures; bytes go through os.read and os.write on its descriptor, which is
several times cheaper than pyserial's own. Exclusive means all three: flock (programs that ask),
TIOCEXCL (the kernel refuses other openings, root's excepted) and nobody else in /proc (programs
that do neither).

Errors::

    PortError                    report it
    +-- PortAbsent               wait for the device, or the path is wrong
    +-- PortBusy                 somebody has it: `holders` says who
    +-- PortForbidden            no permission: the text names the group to join
    +-- PortUnusable             it cannot be configured, a rate it cannot do
    |   +-- NoPort               what has this name is no port: no waiting helps
    +-- PortLost                 it was open and is gone: close, open again

Who else has a terminal device open is read from /proc (Linux): locks are advice, and a program that
opened a port without any is only visible there. Descriptors are compared by device number, because
/dev/serial/by-id and udev names are links. A pty's other end is not a competitor: the process that
has the master side open is left out; nor is a pty of another container, which may have the same
number.

A USB serial adapter (FTDI) holds bytes back for its latency timer. The default of 16 ms bunches the
samples of a 200 Hz stream by three; 1 ms does not. sysfs shows it as
``/sys/class/tty/NAME/device/latency_timer`` (a udev rule sets it).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import pwd
import re
import select
import socket
import stat
import struct
import termios
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import serial

from drivers.vn100.decode import decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.errors import NO_CHECKSUM, DriverError
from drivers.vn100.messages import Reply, encode

# -- Who else has it open --------------------------------------------------------------------------


_PTMX = os.makedev(5, 2)
_PTY_SLAVE_MAJORS = range(136, 144)  # Linux, Documentation/admin-guide/devices.txt
_SHOWN = 80
_NAMED = 3  # processes that a message names


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has the port open; `command` as its command line begins."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command})"


def holders(path: str | Path, proc: Path = Path("/proc")) -> tuple[Holder, ...]:
    """The other processes that have the device at `path` open.

    Processes of other users cannot be seen without privileges, so an empty answer is no proof.
    """
    try:
        device = Path(path).stat()
    except OSError:
        return ()
    if not stat.S_ISCHR(device.st_mode):
        return ()
    found = []
    for entry in proc.iterdir():
        if not entry.name.isdecimal() or int(entry.name) == os.getpid():
            continue
        open_devices = {
            number: status.st_rdev
            for number, status in _open_devices(entry)
            if not _of_other_ptys(status, device)
        }
        if device.st_rdev in open_devices.values() and not _serves(
            entry, open_devices, device.st_rdev
        ):
            found.append(Holder(int(entry.name), _command(entry)))
    return tuple(sorted(found, key=lambda holder: holder.pid))


def is_pty(path: str | Path) -> bool:
    """Whether `path` is the terminal side of a pty."""
    return os.major(Path(path).stat().st_rdev) in _PTY_SLAVE_MAJORS


def _of_other_ptys(status: os.stat_result, device: os.stat_result) -> bool:
    """Whether it is a pty that only has the device's number: a container counts its own.

    Ports of hardware have one number everywhere; a pty is one of its file system.
    """
    same_number = status.st_rdev == device.st_rdev
    is_slave = os.major(status.st_rdev) in _PTY_SLAVE_MAJORS
    return same_number and is_slave and status.st_dev != device.st_dev


def _open_devices(process: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Descriptor number and state of every character device that a process has open."""
    try:
        descriptors = list((process / "fd").iterdir())
    except OSError:  # ended meanwhile, or another user's
        return
    for descriptor in descriptors:
        try:
            status = descriptor.stat()
        except OSError:
            continue
        if stat.S_ISCHR(status.st_mode):
            yield descriptor.name, status


def _serves(process: Path, open_devices: dict[str, int], device: int) -> bool:
    """Whether the process has the master side of this pty open."""
    if os.major(device) not in _PTY_SLAVE_MAJORS:
        return False
    index = (os.major(device) - _PTY_SLAVE_MAJORS[0]) * 256 + os.minor(device)
    masters = [number for number, rdev in open_devices.items() if rdev == _PTMX]
    for number in masters:
        try:
            text = (process / "fdinfo" / number).read_text()
        except OSError:
            continue
        if f"tty-index:\t{index}\n" in text:
            return True
    return False


def _command(process: Path) -> str:
    try:
        words = (process / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return "?"
    text = " ".join(b" ".join(words).decode(errors="replace").split())  # one line
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


# -- Latency timer of a USB adapter ----------------------------------------------------------------


SYSFS = Path("/sys")


def latency_timer_ms(path: str | Path, sysfs: Path = SYSFS) -> int | None:
    """The adapter's latency timer, None where the port has none (or it cannot be read)."""
    try:
        text = _file(path, sysfs).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return None
    return int(text) if text.isascii() and text.isdecimal() else None


def _file(path: str | Path, sysfs: Path) -> Path:
    return sysfs / "class" / "tty" / Path(path).resolve().name / "device" / "latency_timer"


# -- The port --------------------------------------------------------------------------------------


READ_BYTES = 65536
WRITE_TIMEOUT_S = 2.0
LISTEN_S = 0.3
_PATIENT_S = 1.1  # where nothing may be asked: a stream of 1 Hz must be heard
SCANNED_BAUD = (115200, 921600, 460800, 230400, 128000, 57600, 38400, 19200, 9600)
_URL = re.compile(r"^(socket|rfc2217):/+")  # a Path has only one slash left
_ON_NETWORK = re.compile(r"^([A-Za-z][\w+.-]*:/+|[^/]+:\d+$)")  # what only looks like one of these
_WHOLE_URL = re.compile(r"^(socket|rfc2217)://(\[[^\]]+\]|[^:/\[\]]+):\d+/?(\?.*)?$")
_KEEP_ALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 3, "TCP_KEEPCNT": 3}  # seconds, seconds, times
_TELNET_POLL_S = 0.005
_TIOCGEXCL = 0x80045440  # Linux asm-generic/ioctls.h; termios does not have it
_ENOUGH = 2  # messages at a rate, to believe it
_GARBAGE_TOLERATED = 0.5  # part of the bytes at a right rate that may lie outside of messages


class PortError(DriverError):
    """A serial port cannot be used; the text is one line for a person."""


class PortAbsent(PortError):
    """There is no such device (now)."""


class PortBusy(PortError):
    """Somebody else has the port; `holders` are those that can be seen."""

    def __init__(self, path: str, others: tuple[Holder, ...]) -> None:
        who = ", ".join(map(str, others[:_NAMED])) or "a process that cannot be seen from here"
        if more := len(others[_NAMED:]):
            who += f" and {more} more"
        super().__init__(f"{path} is in use by {who}: stop it first")
        self.holders = others


class PortForbidden(PortError):
    """The user may not open it."""


class PortUnusable(PortError):
    """The device is there and cannot be opened or configured."""


class NoPort(PortUnusable):
    """The name is that of a file or folder, or of no port of a device server."""


class PortLost(PortError):
    """An open port went away: unplugged, hung up, or it takes no more bytes."""


class SerialPort:
    """An open port, 8N1, no flow control, non-blocking. A context manager.

    Raises PortAbsent, PortBusy or PortUnusable. Nothing of the port is touched before it is sure
    that nobody else has it.
    """

    def __init__(self, path: str | Path, baud: int) -> None:
        self.path = spelled(path)
        if is_url(path):
            self._serial = _open_url(self.path, baud)
        else:
            _refuse_if_held(self.path)
            self._serial = _open(self.path, baud)
            with contextlib.suppress(OSError):  # a port without it has the other two
                fcntl.ioctl(self._serial.fileno(), termios.TIOCEXCL)
        telnet = self.path.startswith("rfc2217:")
        self._wire = _Telnet(self._serial) if telnet else _Descriptor(self._serial.fileno())

    @property
    def baud(self) -> int:
        """Rate that the host side uses."""
        return int(self._serial.baudrate)

    def read(self, wait_s: float = 0.0) -> bytes:
        """What has arrived, or arrives within `wait_s`; b"" if nothing. Raises PortLost."""
        try:
            if not self._wire.readable(wait_s):
                return b""
            data = self._wire.read()
        except BlockingIOError:
            return b""
        except (OSError, serial.SerialException) as error:
            raise PortLost(f"{self.path} is gone: {error}") from error
        if not data:  # readable without a byte: the other end hung up
            raise PortLost(f"{self.path} is gone: hung up")
        return data

    def write(self, data: bytes, timeout_s: float = WRITE_TIMEOUT_S) -> None:
        """Write all of `data`, waiting where the port is full. Raises PortLost."""
        view, end_s = memoryview(data), time.monotonic() + timeout_s
        while view:
            try:
                view = view[self._wire.write(view) :]
            except BlockingIOError:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    raise PortLost(
                        f"{self.path} took only {len(data) - len(view)} of {len(data)} bytes in "
                        f"{timeout_s:g} s"
                    ) from None
                self._wire.wait_writable(left_s)
            except (OSError, serial.SerialException) as error:
                raise PortLost(f"{self.path} is gone: {error}") from error

    def set_baud(self, baud: int) -> None:
        """Change the host's rate and drop what was received at the old one."""
        try:
            self._serial.baudrate = baud
            self._serial.reset_input_buffer()
        except (ValueError, OSError, termios.error) as error:
            raise PortUnusable(f"{self.path} cannot do {baud} baud: {error}") from error

    def wait_readable(self, timeout_s: float) -> bool:
        """Whether bytes (or a hang-up) came within `timeout_s`."""
        return self._wire.readable(timeout_s)

    def has_bytes(self) -> bool:
        """Whether bytes wait now; also while another thread is in `wait_readable`."""
        return self._wire.has_bytes()

    def close(self) -> None:
        """Close; safe to call again and after the device is gone."""
        if self._serial.is_open:
            with contextlib.suppress(OSError):  # a pty that the other end keeps open remembers it
                fcntl.ioctl(self._serial.fileno(), termios.TIOCNXCL)
            self._serial.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Descriptor:
    """Bytes straight through a descriptor: a terminal's or a socket's."""

    def __init__(self, fileno: int) -> None:
        self._fileno = fileno
        self._poll = select.poll()
        self._poll.register(fileno, select.POLLIN)

    def readable(self, timeout_s: float) -> bool:
        return bool(self._poll.poll(max(0.0, timeout_s) * 1000))

    def has_bytes(self) -> bool:
        poll = select.poll()  # one of its own: a thread may wait on the other
        poll.register(self._fileno, select.POLLIN)
        return bool(poll.poll(0))

    def read(self) -> bytes:
        return os.read(self._fileno, READ_BYTES)

    def write(self, data: memoryview) -> int:
        return os.write(self._fileno, data)

    def wait_writable(self, timeout_s: float) -> None:
        select.select([], [self._fileno], [], timeout_s)


class _Telnet:
    """Bytes that pyserial's thread takes out of the telnet protocol of RFC 2217."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port

    def readable(self, timeout_s: float) -> bool:
        end_s = time.monotonic() + timeout_s
        while not self.has_bytes():
            if time.monotonic() >= end_s:
                return False
            time.sleep(_TELNET_POLL_S)
        return True

    def has_bytes(self) -> bool:
        return bool(self._port.in_waiting)

    def read(self) -> bytes:
        return bytes(self._port.read(min(self._port.in_waiting, READ_BYTES)))

    def write(self, data: memoryview) -> int:
        self._port.write(bytes(data))
        return len(data)

    def wait_writable(self, timeout_s: float) -> None:
        """Never asked: `write` takes all."""


@dataclass(frozen=True, slots=True)
class RateHeard:
    """What listening at one rate gave."""

    baud: int
    received: int
    messages: int
    unchecked: int = 0  # lines without a checksum
    answered: bool = False

    def __str__(self) -> str:
        what = f"{self.received} bytes, no message" if self.received else "silence"
        return f"{self.baud}: {f'messages: {self.messages}' if self.messages else what}"


@dataclass(frozen=True, slots=True)
class BaudFound:
    """The rate at which valid messages arrive, and why this one was believed."""

    baud: int
    why: str
    tried: tuple[RateHeard, ...]


class BaudNotFound(PortError):
    """At no rate was there a valid message; `silent` tells silence from garbage."""

    def __init__(self, path: str, tried: tuple[RateHeard, ...], asked: bool) -> None:
        self.tried = tried
        self.silent = not any(heard.received for heard in tried)
        if self.silent:
            advice = (
                "the device does not answer: check power, cable and which of its ports this is"
                if asked
                else "the device may be silent: allow ahrsd to ask it, or give the rate"
            )
        elif any(heard.unchecked for heard in tried):
            advice = NO_CHECKSUM
        else:
            advice = "bytes arrive but no message: not a VN-100, or a rate that was not tried"
        super().__init__(f"{path}: {'; '.join(map(str, tried))}. {advice}")


def detect_baud(
    path: str | Path,
    last_good: int | None = None,
    configured: int | None = None,
    listen_s: float = LISTEN_S,
    *,
    may_query: bool = False,
    rates: Iterable[int] = SCANNED_BAUD,
) -> BaudFound:
    """The rate that the device talks at. Listens first and never changes the device's rate.

    With `may_query` each rate is then tried with a read of register 1; without, no byte is sent.
    Order: last good, configured, then 115200 and the others. Raises PortError and BaudNotFound.
    """
    preferred = {last_good: "the last good rate", configured: "the configured rate"}
    order = list(dict.fromkeys(rate for rate in (last_good, configured, *rates) if rate))
    if spelled(path).startswith("socket:"):
        del order[1:]  # the device server has the rate
    tried: list[RateHeard] = []
    with SerialPort(path, order[0]) as port:
        for attempt in (_listen, _query) if may_query else (_listen,):
            for baud in order:
                try:
                    heard = attempt(port, baud, listen_s)
                except PortUnusable:  # not every adapter can do every rate
                    continue
                tried.append(heard)
                if heard.messages:
                    how = "an answer came" if heard.answered else "heard"
                    reason = preferred.get(baud, "found by trying")
                    if port.path.startswith("socket:"):
                        return BaudFound(baud, f"{how} through a device server", tuple(tried))
                    return BaudFound(baud, f"{how} at {baud} baud, {reason}", tuple(tried))
    raise BaudNotFound(str(path), tuple(tried), may_query)


def find_device(path: Path, baud: int | None, *, may_query: bool) -> BaudFound:
    """The rate at which a device is heard on the port: `baud`, or where that is None, any.

    Raises PortError and BaudNotFound: there is nobody to talk to.
    """
    listen_s = LISTEN_S if may_query else _PATIENT_S
    rates = SCANNED_BAUD if baud is None else ()
    return detect_baud(path, None, baud, listen_s, may_query=may_query, rates=rates)


def _listen(port: SerialPort, baud: int, listen_s: float) -> RateHeard:
    """Listen at one rate; messages count only where most bytes belong to them."""
    port.set_baud(baud)
    deframer = Deframer()
    messages = 0

    def enough(chunk: bytes) -> bool:
        nonlocal messages
        messages += len(deframer.feed(chunk))
        return messages >= _ENOUGH

    received = _collect(port, listen_s, enough)
    counters = deframer.counters
    believable = messages and counters.skipped_bytes <= _GARBAGE_TOLERATED * received
    return RateHeard(baud, received, messages if believable else 0, counters.unchecked)


def _query(port: SerialPort, baud: int, listen_s: float) -> RateHeard:
    """Ask for the model. The line end first clears what the device has.

    A reply counts, and so do messages of which there was none while only listened to.
    """
    port.set_baud(baud)
    port.write(b"\r\n" + encode("VNRRG,01"))
    deframer = Deframer()
    answers = 0

    def enough(chunk: bytes) -> bool:
        nonlocal answers
        replies = [decode(frame) for frame in deframer.feed(chunk)]
        # a line that echoes sends the question back, which has no values
        answers += sum(
            isinstance(reply, Reply) and reply.register == 1 and bool(reply.tokens)
            for reply in replies
        )
        return answers > 0

    received = _collect(port, listen_s, enough)
    counters = deframer.counters
    others = counters.valid if counters.skipped_bytes <= _GARBAGE_TOLERATED * received else 0
    messages = answers or (others if others >= _ENOUGH else 0)
    return RateHeard(baud, received, messages, counters.unchecked, bool(answers))


def _collect(port: SerialPort, listen_s: float, enough: Callable[[bytes], bool]) -> int:
    """Read until `enough` says so or the time is over; returns the number of bytes."""
    end_s = time.monotonic() + listen_s
    received = 0
    while (left_s := end_s - time.monotonic()) > 0:
        if port.wait_readable(left_s):
            chunk = port.read()
            received += len(chunk)
            if enough(chunk):
                break
    return received


def is_url(path: str | Path) -> bool:
    """Whether it is a port of a device server."""
    return bool(_URL.match(str(path)))


def spelled(path: str | Path) -> str:
    """The port as people write it: a URL that went through a Path has its slashes back."""
    return _URL.sub(r"\1://", str(path))


def _open_url(url: str, baud: int) -> serial.Serial:
    if not _WHOLE_URL.match(url):
        scheme = url.partition(":")[0]
        raise NoPort(f"{url} names no port of a device server: expected {scheme}://HOST:PORT")
    try:
        port = serial.serial_for_url(url, baud, timeout=0)
    except (OSError, ValueError) as error:  # serial.SerialException is an OSError
        text = " ".join(str(error).split())
        raise PortAbsent(
            f"{url} does not answer: is the device server on, is it on this network? ({text})"
        ) from error
    connection = getattr(port, "_socket", None)
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for name, value in _KEEP_ALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    return port


def _refuse_if_held(path: str) -> None:
    """PortAbsent or PortBusy before anything of the port is changed."""
    try:
        pty = is_pty(path)
        others = holders(path)
        if others:
            raise PortBusy(path, others)
        if pty:  # there the flag outlives its owner, as long as the other end is open
            return
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise _why(path, error) from error
    try:
        flag = fcntl.ioctl(descriptor, _TIOCGEXCL, struct.pack("i", 0))
        if struct.unpack("i", flag)[0]:  # root is not stopped by it, so it must be asked for
            raise PortBusy(path, ())
    except OSError:  # an old kernel, or no terminal: the opening will tell
        return
    finally:
        os.close(descriptor)


def _open(path: str, baud: int) -> serial.Serial:
    try:
        return serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        raise _why(path, error) from error


def _why(path: str, error: Exception) -> PortError:
    """What an opening that failed means."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EBUSY, errno.EAGAIN):
        return PortBusy(path, holders(path))
    if number == errno.ENOENT and _ON_NETWORK.match(path):
        return NoPort(
            f"{path} is no port: one of a device server is socket://HOST:PORT or "
            "rfc2217://HOST:PORT"
        )
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return PortAbsent(f"{path} does not exist: is the device plugged in, is the name right?")
    if number in (errno.EACCES, errno.EPERM):
        return PortForbidden(f"{path}: no permission; {_who_may(path)}")
    kind = PortUnusable if _is_device(path) else NoPort
    return kind(f"{path} cannot be opened as a serial port: {error}")


def _is_device(path: str) -> bool:
    try:
        return stat.S_ISCHR(Path(path).stat().st_mode)
    except OSError:  # gone meanwhile: it may come again
        return True


def _who_may(path: str) -> str:
    """What a person can do who may not open the port."""
    try:
        status = Path(path).stat()
        group = grp.getgrgid(status.st_gid)
    except (OSError, KeyError):
        return "is the user in the group of the device?"
    both = stat.S_IRGRP | stat.S_IWGRP
    if not status.st_gid or status.st_mode & both != both:
        return "no group may open it: give it to one by a udev rule"
    if status.st_gid in os.getgroups():
        return f"although this process is in its group {group.gr_name}: is it in a container?"
    if _user() in group.gr_mem:
        return f"you are in its group {group.gr_name} since you logged in: log in again"
    return f"join its group: sudo usermod -aG {group.gr_name} {_user()}, then log in again"


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return "$USER"
