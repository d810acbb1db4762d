"""Files that other programs write: regular files only, bounded, and never waited for by the daemon.

    contents = read_regular(path, 4096)          # ForeignFileError says what is wrong, in words
    text = text_within(path, 1 << 20)            # the same for a start: gives up after PATIENCE_S
    watch = FileWatch(path, 64, every_s=0.05)    # a thread of its own looks, `watch.sight` is told

What such a file says is new where it was *seen to change*, on a clock that only runs forward. Time
stamps of the file system are compared for equality and never with a clock, so that a clock that is
set, or a stamp of tomorrow, makes no word new. What is seen first says nothing about when it was
written, and neither does what is seen first after the file could not be read.
"""

from __future__ import annotations

import os
import stat
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

PATIENCE_S = 5.0  # a file that answers so late is on a disk that hangs
_KINDS = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISLNK, "a symbolic link"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

Mark = tuple[int, int, int, int]  # file system, inode, time of the last change in ns, size


class ForeignFileError(ValueError):
    """Why a file cannot be used, in words that follow its name."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a file held; two readings with equal `mark` and `data` are of the same writing."""

    data: bytes
    mark: Mark


def boot_s() -> float:
    """Seconds since the host booted, suspensions included; it is never set."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def read_regular(
    path: Path | str, most_bytes: int, *, follow: bool = True, folder: int | None = None
) -> Contents:
    """A regular file as a whole. Raises ForeignFileError.

    It is looked at before it is opened, because opening some devices does something already.
    follow: whether a symbolic link is followed; folder: descriptor that `path` is relative to
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    try:
        _regular(os.stat(path, dir_fd=folder, follow_symlinks=follow).st_mode)
        descriptor = os.open(path, flags | (0 if follow else os.O_NOFOLLOW), dir_fd=folder)
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            _regular(status.st_mode)
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise ForeignFileError(f"cannot be read: {error.strerror}") from error
    if len(data) > most_bytes:
        raise ForeignFileError(f"is larger than {most_bytes} bytes")
    return Contents(data, (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size))


def kind_of(mode: int) -> str:
    """What is not a regular file, in words; empty for one."""
    return next((name for is_kind, name in _KINDS if is_kind(mode)), "")


def _regular(mode: int) -> None:
    if kind := kind_of(mode):
        raise ForeignFileError(f"is {kind}, not a regular file")


def text_within(path: Path, most_bytes: int, wait_s: float = PATIENCE_S) -> str:
    """A file of text, for a start: where it does not answer in time, that is said, not waited for.

    Raises ForeignFileError.
    """
    answers: list[bytes | ForeignFileError] = []

    def read() -> None:
        try:
            answers.append(read_regular(path, most_bytes).data)
        except ForeignFileError as error:
            answers.append(error)

    thread = threading.Thread(target=read, name=f"read {path.name}", daemon=True)
    thread.start()
    thread.join(wait_s)
    if not answers:
        raise ForeignFileError(f"did not answer within {wait_s:.0f} s: its disk hangs")
    if isinstance(answers[0], ForeignFileError):
        raise answers[0]
    try:
        return answers[0].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ForeignFileError(f"is not UTF-8 text (byte {error.start})") from error


@dataclass(frozen=True, slots=True)
class FileState:
    """What was seen of a file.

    data:     what it holds; None where it cannot be read, `fault` then says why
    writings: how often it was seen to change
    since_s:  when the newest change was made at the earliest (`boot_s`): the look before the one
              that found it began then; -inf while none was seen
    """

    data: bytes | None = None
    writings: int = 0
    since_s: float = float("-inf")
    fault: str = ""


class Changes:
    """Looks at one file, in order, and what follows from each. Reads no clock and no file."""

    def __init__(self) -> None:
        self.sight = FileState()
        self._before: Contents | None = None
        self._before_s = float("-inf")

    def seen(self, contents: Contents, began_s: float) -> FileState:
        """The file as a look found it that began at `began_s`."""
        sight = self.sight
        changed = self._before is not None and contents != self._before
        since_s = self._before_s if changed else sight.since_s
        self.sight = FileState(contents.data, sight.writings + changed, since_s)
        self._before, self._before_s = contents, began_s
        return self.sight

    def unreadable(self, fault: str) -> FileState:
        """A look that failed: what is seen next is seen for the first time."""
        self._before = None
        self.sight = FileState(None, self.sight.writings, float("-inf"), fault)
        return self.sight


class FileWatch:
    """Looks at a file again and again, in a thread of its own; only that thread waits for it."""

    def __init__(
        self,
        path: Path,
        most_bytes: int,
        every_s: float,
        *,
        read: Callable[[Path, int], Contents] = read_regular,
        now_s: Callable[[], float] = boot_s,
    ) -> None:
        self.path = path
        self._most_bytes, self._every_s, self._read, self.now_s = most_bytes, every_s, read, now_s
        self._changes = Changes()
        self._began_s: float | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"watch {path.name}", daemon=True)
        self._thread.start()

    @property
    def sight(self) -> FileState:
        """The newest one; never waits."""
        return self._changes.sight

    @property
    def fault(self) -> str:
        """One line about what is wrong with the file; empty where nothing is."""
        began_s = self._began_s
        if began_s is not None and self.now_s() - began_s > PATIENCE_S:
            return f"{self.path}: does not answer: its disk hangs"
        return f"{self.path}: {text}" if (text := self.sight.fault) else ""

    def close(self) -> None:
        """Look no more; a look that hangs is left to itself."""
        self._closing.set()

    def _work(self) -> None:
        while not self._closing.is_set():
            began_s = self._began_s = self.now_s()
            try:
                self._changes.seen(self._read(self.path, self._most_bytes), began_s)
            except ForeignFileError as error:
                self._changes.unreadable(str(error))
            self._began_s = None
            self._closing.wait(self._every_s)
