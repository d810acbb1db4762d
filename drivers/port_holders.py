"""Who else has a terminal device open, from /proc (Linux).

Locks are advice: a program that opened a port without any is only visible here. Descriptors are
compared by device number, because /dev/serial/by-id and udev names are links. A pty's other end is
not a competitor: the process that has the master side open is left out; nor is a pty of another
container, which may have the same number.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_PTMX = os.makedev(5, 2)
_PTY_SLAVE_MAJORS = range(136, 144)  # Linux, Documentation/admin-guide/devices.txt
_SHOWN = 80


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
