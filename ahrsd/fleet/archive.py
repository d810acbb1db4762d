"""Which recordings an archive holds: a folder on a disk, or anything that fsspec opens (s3://...).

Files are listed as they come and never all kept, so an archive of any size costs no memory. What
by its name is no recording is counted, not opened.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from ahrsd.errors import AhrsdError
from ahrsd.foreign_file import kind_of
from ahrsd.printable import line, printable

SUFFIXES = (
    ".mcap", ".vnraw", ".vnbin", ".bin", ".log", ".txt", ".csv", ".parquet", ".bag", ".db3", ".ulg",
)  # fmt: skip
_BESIDE = ("*.gps.csv", "*.gps.csv.gz")  # what `evaluate` reads beside a recording
_ROS_2 = "metadata.yaml"  # makes a folder one recording
_SCRATCH = "ahrsd-fleet-"
#: modules below fsspec and the base of what they raise beside OSError
_STORAGE_ERRORS = (
    ("aiohttp", "ClientError"),
    ("botocore.exceptions", "BotoCoreError"),
    ("botocore.exceptions", "ClientError"),
    ("google.auth.exceptions", "GoogleAuthError"),
    ("gcsfs.retry", "HttpError"),
    ("azure.core.exceptions", "AzureError"),
    ("paramiko.ssh_exception", "SSHException"),
)


@dataclass(frozen=True, slots=True)
class ArchiveEntry:
    """One recording of an archive.

    url:     path, or address with its protocol
    changed: what differs once the file was written anew: time of the change, or a tag of the store
    folders: names of the folders between archive and file
    is_folder: a recording that is a folder of files (ROS 2)
    """

    url: str
    size_bytes: int
    changed: str
    folders: tuple[str, ...] = ()
    modified_s: float | None = None
    is_folder: bool = False


@dataclass(frozen=True, slots=True)
class Archive:
    """Where to look; `patterns` of file names replace the suffixes of recordings."""

    root: str
    patterns: tuple[str, ...] = ()

    def entries(
        self,
        left_out: Callable[[str], None] = lambda _: None,
        linked: Callable[[str], None] = lambda _: None,
    ) -> Iterator[ArchiveEntry]:
        """Every recording.  AhrsdError.

        left_out: told the names of other files; linked: told the folders that are only linked to,
        which are not entered: they may lead round in a circle, or out of the archive
        """
        listed = _remote(self.root) if is_remote(self.root) else _on_disk(Path(self.root), linked)
        for entry in listed:
            name = entry.url.rpartition("/")[2]
            if entry.is_folder or self._wanted(name):
                yield entry
            else:
                left_out(name)

    def _wanted(self, name: str) -> bool:
        if self.patterns:
            return any(fnmatch(name, pattern) for pattern in self.patterns)
        plain = name.removesuffix(".gz").lower()
        return plain.endswith(SUFFIXES) and not any(fnmatch(name, one) for one in _BESIDE)


def is_remote(root: str) -> bool:
    """Whether it is fsspec's and no path."""
    return "://" in root


def _on_disk(root: Path, linked: Callable[[str], None]) -> Iterator[ArchiveEntry]:
    if not root.is_dir():
        what = "is no folder" if root.exists() else "does not exist"
        raise AhrsdError(f"{printable(root, 500)}: {what}; give the folder of the recordings")
    waiting: list[tuple[str, tuple[str, ...]]] = [(str(root), ())]
    while waiting:
        folder, names = waiting.pop()
        try:
            found = os.scandir(folder)
        except OSError as error:
            raise AhrsdError(
                f"{printable(folder, 500)}: cannot be listed: {error.strerror}; allow it, or move "
                "it out of the archive"
            ) from error
        with found:
            for one in found:
                if one.name.startswith("."):
                    continue
                if not stat.S_ISDIR(_mode(Path(one.path))):
                    yield _file(one, names)
                elif _mode(Path(one.path, _ROS_2)):
                    yield _folder(Path(one.path), names)
                elif one.is_symlink():
                    linked(one.path)
                else:
                    waiting.append((one.path, (*names, one.name)))


def _mode(path: Path) -> int:
    """What it is; 0 where that cannot be known, as of a link to nothing or to itself."""
    try:
        return path.stat().st_mode
    except OSError:
        return 0


def _file(one: os.DirEntry[str], names: tuple[str, ...]) -> ArchiveEntry:
    try:
        status = one.stat()
    except OSError:  # a link to nothing: its row says what is wrong
        return ArchiveEntry(one.path, 0, "", names)
    return ArchiveEntry(one.path, status.st_size, str(status.st_mtime_ns), names, status.st_mtime)


def _folder(path: Path, names: tuple[str, ...]) -> ArchiveEntry:
    try:
        states = [part.stat() for part in _files(path)]
    except OSError:  # as above
        return ArchiveEntry(str(path), 0, "", names, is_folder=True)
    last = max(state.st_mtime_ns for state in states)
    size = sum(state.st_size for state in states)
    return ArchiveEntry(str(path), size, str(last), names, last / 1e9, is_folder=True)


def _file_system(root: str) -> tuple[Any, str]:
    """fsspec's file system and the path in it.  AhrsdError where something is missing."""
    if importlib.util.find_spec("fsspec") is None:
        raise AhrsdError(f"{root}: fsspec opens it; install it: pip install 'ahrsd[fleet]'")
    import fsspec

    try:
        system, path = fsspec.core.url_to_fs(root, use_listings_cache=False)
    except ImportError as error:
        raise AhrsdError(f"{root}: {error}; for s3:// that is: pip install 'ahrsd[s3]'") from error
    except ValueError as error:
        raise AhrsdError(
            f"{root}: {error}; give a folder, or an address such as s3://bucket/dives"
        ) from error
    return system, str(path)


def _remote(root: str) -> Iterator[ArchiveEntry]:
    system, top = _file_system(root)
    try:
        with _as_os_error():
            if not system.isdir(top):
                raise AhrsdError(f"{root}: holds no folder of that name; check the address")
            for folder, _, files in system.walk(top, detail=True, on_error="raise"):
                below = folder[len(top) :].strip("/")
                names = tuple(below.split("/")) if below else ()
                for name, facts in files.items():
                    if not name.startswith("."):
                        yield _object(system, facts, names)
    except OSError as error:
        raise AhrsdError(
            f"{root}: cannot be listed: {line(error.strerror or str(error))}; check the address, "
            "the network and the credentials"
        ) from error


@contextmanager
def _as_os_error() -> Iterator[None]:
    """What a storage's library raises, each classes of its own, is an OSError."""
    try:
        yield
    except _storage_errors() as error:
        raise OSError(f"{type(error).__name__}: {error}") from error


def _storage_errors() -> tuple[type[Exception], ...]:
    """Of the libraries that are loaded by now."""
    loaded = ((sys.modules.get(module), name) for module, name in _STORAGE_ERRORS)
    return tuple(getattr(module, name) for module, name in loaded if module is not None)


def _object(system: Any, facts: dict[str, Any], names: tuple[str, ...]) -> ArchiveEntry:  # noqa: ANN401
    when = facts.get("LastModified") or facts.get("mtime") or facts.get("last_modified")
    stamp = when.timestamp() if isinstance(when, datetime) else when
    return ArchiveEntry(
        system.unstrip_protocol(facts["name"]),
        int(facts.get("size") or 0),
        str(facts.get("ETag") or when or ""),
        names,
        float(stamp) if isinstance(stamp, int | float) else None,
    )


@contextmanager
def local_file(entry: ArchiveEntry) -> Iterator[Path]:
    """The recording as a file of this machine; a copy of a remote one is gone afterwards.

    OSError where it cannot be had.
    """
    if not is_remote(entry.url):
        yield Path(entry.url)
        return
    system, path = _file_system(entry.url)
    folder = Path(tempfile.mkdtemp(prefix=f"{_SCRATCH}{os.getpid()}-"))
    try:
        target = folder / entry.url.rpartition("/")[2]
        with _as_os_error():
            system.get_file(path, str(target))
        yield target
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sweep() -> None:
    """Remove copies of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_SCRATCH}*"):
        owner = folder.name.removeprefix(_SCRATCH).partition("-")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)


def pieces(path: Path, size: int = 1 << 20) -> Iterator[bytes]:
    """The bytes of a recording, of a folder those of its files in order.  OSError.

    Only regular files are opened: a FIFO would be waited for without end.
    """
    is_folder = path.is_dir()
    for one in _files(path) if is_folder else (path,):
        if is_folder:
            yield os.fsencode(one.relative_to(path)) + b"\0"
        if kind := kind_of(one.stat().st_mode):
            raise OSError(errno.EINVAL, f"is {kind}, not a regular file", str(one))
        with one.open("rb") as file:
            while piece := file.read(size):
                yield piece


def _files(folder: Path) -> list[Path]:
    """The files of a recording that is a folder, those of its own folders too.  OSError."""
    return sorted(one for one in folder.rglob("*") if not one.is_dir())
