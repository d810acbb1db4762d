"""How the daemon names its captures, and how many it keeps.

Only files that carry the daemon's own name pattern are ever removed.
"""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime
from pathlib import Path

_PATTERN = "ahrsd-*.mcap"


def new_capture_path(directory: Path, now: datetime | None = None) -> Path:
    """A name that sorts by time: `ahrsd-20261103T120000Z.mcap`, with a number where it is taken."""
    stamp = (now or datetime.now(UTC)).strftime("%Y%m%dT%H%M%SZ")
    path = directory / f"ahrsd-{stamp}.mcap"
    number = 2
    while path.exists():
        path = directory / f"ahrsd-{stamp}-{number}.mcap"
        number += 1
    return path


def make_private_folder(folder: Path) -> None:
    """The folder and what is missing above it, for their owner alone. Raises OSError.

    One that exists stays as it is.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    for one in reversed(missing):
        with contextlib.suppress(FileExistsError):
            one.mkdir(mode=0o700)
            one.chmod(0o700)  # whatever the umask


def prune(directory: Path, keep_bytes: int, keep: Path) -> list[Path]:
    """Remove the oldest captures until all fit into `keep_bytes`; `keep` always stays.

    Returns what was removed. A file that cannot be removed is no reason to stop recording.
    """
    files = []
    for path in directory.glob(_PATTERN):
        with contextlib.suppress(OSError):
            status = path.stat()
            files.append((status.st_mtime_ns, path, status.st_size))
    total = sum(size for _, _, size in files)
    removed = []
    for _, path, size in sorted(files):
        if total <= keep_bytes:
            break
        if path != keep:
            with contextlib.suppress(OSError):
                path.unlink()
                removed.append(path)
                total -= size
    return removed
