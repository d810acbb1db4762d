"""A support archive: what somebody needs who was not there, and nothing that is a secret.

Only files that this program wrote itself are put in, and of the captures only the newest bytes.
The network, environment variables and other programs' files are left alone.
"""

from __future__ import annotations

import gzip
import importlib.metadata
import io
import json
import platform
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

FORMATS = {".tar.gz": "tar.gz", ".tgz": "tar.gz", ".tar": "tar", ".zip": "zip"}
_PACKAGES = ("ahrsd", "numpy", "scipy", "gtsam", "rerun-sdk", "pyserial", "mcap")
_CAPTURE_BYTES = 64 << 20
_JOURNAL_BYTES = 4 << 20


def write_bundle(
    file: Path, state: Path, captures: Path, config: str, status: dict[str, Any] | None
) -> list[str]:
    """Write FILE, in the format of its name, and return what is in it. Raises OSError.

    status: what the running daemon says of itself; None where none runs
    """
    parts: dict[str, bytes] = {
        "versions.json": _json(versions()),
        "config.toml": config.encode(),
    }
    if status is not None:
        parts["status.json"] = _json(status)
    for journal in sorted(state.glob("journal-*.jsonl")):
        if journal.is_file():
            parts[f"journal/{journal.name}"] = _tail(journal, _JOURNAL_BYTES)
    if newest := _newest(captures.glob("*.mcap")):
        # the head, because the format is read from there; what was cut off is readable to the cut
        parts[f"captures/{newest.name}"] = _head(newest, _CAPTURE_BYTES)
    _pack(file, {f"ahrsd-bundle/{name}": body for name, body in parts.items()})
    return list(parts)


def format_of(file: Path) -> str | None:
    """The format that a file's name says; None for a name that says none of `FORMATS`."""
    return next((known for suffix, known in FORMATS.items() if file.name.endswith(suffix)), None)


def _pack(file: Path, parts: dict[str, bytes]) -> None:
    if (known := format_of(file)) == "zip":
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, body in parts.items():
                packed.writestr(name, body)
        return
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, body in parts.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mtime = len(body), int(time.time())
            archive.addfile(entry, io.BytesIO(body))
    packed_bytes = stream.getvalue()
    file.write_bytes(packed_bytes if known == "tar" else gzip.compress(packed_bytes))


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


def _newest(files: Iterable[Path]) -> Path | None:
    return max(files, key=lambda file: file.stat().st_mtime, default=None)


def _head(file: Path, size: int) -> bytes:
    with file.open("rb") as stream:
        return stream.read(size)


def _tail(file: Path, size: int) -> bytes:
    with file.open("rb") as stream:
        stream.seek(max(file.stat().st_size - size, 0))
        return stream.read()
