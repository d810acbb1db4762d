"""A support archive: what somebody needs who was not there, and nothing that is a secret.

Only files that this program wrote itself are put in, and of the captures only the newest bytes.
The network, environment variables and other programs' files are left alone.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import platform
import sys
import tarfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_PACKAGES = ("ahrsd", "numpy", "scipy", "gtsam", "rerun-sdk", "pyserial", "mcap")
_CAPTURE_BYTES = 64 << 20
_JOURNAL_BYTES = 4 << 20


def write_bundle(
    file: Path, state: Path, captures: Path, config: str, status: dict[str, Any] | None
) -> list[str]:
    """Write FILE (tar, gzip) and return what is in it. Raises OSError.

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
    with tarfile.open(file, "w:gz") as archive:
        for name, body in parts.items():
            entry = tarfile.TarInfo(f"ahrsd-bundle/{name}")
            entry.size, entry.mtime = len(body), int(time.time())
            archive.addfile(entry, io.BytesIO(body))
    return list(parts)


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
