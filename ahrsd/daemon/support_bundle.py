"""A support archive: what somebody needs who was not there, and nothing that is a secret.

Only files that this program wrote itself are put in: regular ones, in its own folders, found there
without following a link; a link, a FIFO or a device is left out by name and never opened. Of each
file at most a stated number of bytes goes in. The network, environment variables and other
programs' files are left alone.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import os
import platform
import sys
import tarfile
import time
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, BinaryIO, Literal

from ahrsd.errors import AhrsdError
from ahrsd.foreign_file import kind_of

_PACKAGES = ("ahrsd", "numpy", "scipy", "gtsam", "rerun-sdk", "pyserial", "mcap")
_CAPTURE_BYTES = 64 << 20
_JOURNAL_BYTES = 4 << 20
_MOST_JOURNALS = 16
FORMATS = (".tar.gz", ".tgz", ".tar", ".zip")


@dataclass(slots=True)
class Bundle:
    """What goes into the archive, by name, and what was left out of it, a sentence each."""

    parts: dict[str, bytes] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def collect(state: Path, captures: Path, config: str, status: Mapping[str, Any] | None) -> Bundle:
    """What is there. Raises nothing: what cannot be read is left out.

    status: what the running daemon says of itself; None where none runs
    """
    bundle = Bundle({"versions.json": _json(versions()), "config.toml": config.encode()})
    if status is not None:
        bundle.parts["status.json"] = _json(dict(status))
    journals = _found(state, "journal-*.jsonl", bundle)
    for journal in journals[:_MOST_JOURNALS]:
        _add(bundle, f"journal/{journal.name}", journal, _JOURNAL_BYTES, newest=True)
    if more := journals[_MOST_JOURNALS:]:
        bundle.left_out.append(f"{len(more)} older journals")
    found = _found(captures, "*.mcap", bundle)
    if found:
        # the head, because the format is read from there; what was cut off is readable to the cut
        _add(bundle, f"captures/{found[0].name}", found[0], _CAPTURE_BYTES, newest=False)
    if found[1:]:
        bundle.left_out.append(f"{len(found) - 1} older captures in {captures}")
    if bundle.left_out:
        bundle.parts["left-out.txt"] = "".join(f"{text}\n" for text in bundle.left_out).encode()
    return bundle


def format_of(file: Path) -> str:
    """The ending of FILE's name that says its format. Raises AhrsdError where none does."""
    ending = next((ending for ending in FORMATS if file.name.endswith(ending)), None)
    if ending is None:
        raise AhrsdError(f"{file}: the archive's name must end in {', '.join(FORMATS)}")
    return ending


def write_bundle(file: Path, bundle: Bundle) -> None:
    """Write FILE, in the format of its name and for its owner alone. Raises OSError, AhrsdError."""
    ending = format_of(file)
    draft = file.with_name(f".{file.name}.{os.getpid()}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            _pack(stream, ending, bundle.parts)
        draft.replace(file)  # a link of that name is replaced, not followed
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def _pack(stream: BinaryIO, ending: str, parts: Mapping[str, bytes]) -> None:
    if ending == ".zip":
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, body in parts.items():
                archive.writestr(f"ahrsd-bundle/{name}", body)
        return
    mode: Literal["w:", "w:gz"] = "w:" if ending == ".tar" else "w:gz"
    with tarfile.open(fileobj=stream, mode=mode) as packed:
        for name, body in parts.items():
            entry = tarfile.TarInfo(f"ahrsd-bundle/{name}")
            entry.size, entry.mtime, entry.mode = len(body), int(time.time()), 0o600
            packed.addfile(entry, io.BytesIO(body))


def versions() -> dict[str, str]:
    """Of this program, its libraries, Python and the kernel."""
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    found = {"python": sys.version.split()[0], "system": system}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def _json(value: object) -> bytes:
    return json.dumps(value, indent=2).encode() + b"\n"


def _found(folder: Path, pattern: str, bundle: Bundle) -> list[Path]:
    """Regular files of this name, newest first; what else has such a name is left out by name."""
    files: list[tuple[int, Path]] = []
    try:
        names = sorted(name for name in os.listdir(folder) if fnmatch(name, pattern))  # noqa: PTH208
    except FileNotFoundError:
        return []
    except OSError as error:
        bundle.left_out.append(f"{folder}: cannot be read: {error.strerror}")
        return []
    for name in names:
        path = folder / name
        try:
            status = path.lstat()
        except OSError as error:
            bundle.left_out.append(f"{path}: {error.strerror}")
            continue
        if kind := kind_of(status.st_mode):
            bundle.left_out.append(f"{path}: is {kind}")
        else:
            files.append((status.st_mtime_ns, path))
    return [path for _, path in sorted(files, reverse=True)]


def _add(bundle: Bundle, name: str, path: Path, most_bytes: int, *, newest: bool) -> None:
    """The newest or the first bytes of a file. It is not followed if it became a link meanwhile."""
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_NOCTTY | os.O_CLOEXEC
    try:
        with os.fdopen(os.open(path, flags), "rb") as stream:
            status = os.fstat(stream.fileno())
            if kind := kind_of(status.st_mode):
                bundle.left_out.append(f"{path}: is {kind}")
                return
            if newest:
                stream.seek(max(status.st_size - most_bytes, 0))
            bundle.parts[name] = stream.read(most_bytes)
    except OSError as error:
        bundle.left_out.append(f"{path}: cannot be read: {error.strerror}")
        return
    if status.st_size > most_bytes:
        which = "first" if newest else "last"
        bundle.left_out.append(f"{path}: its {which} {status.st_size - most_bytes} bytes")
