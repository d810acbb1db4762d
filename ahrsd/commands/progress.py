"""A progress bar on a terminal; nothing where stderr is a file or a pipe."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_PACKED = (".gz", ".mcap", ".csv", ".parquet")  # the bytes that go through are not those on disk


@contextmanager
def byte_progress(path: Path) -> Iterator[Callable[[int], None] | None]:
    """Call what it yields with the number of bytes just done; None where nobody would see it."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn(path.name), BarColumn(), DownloadColumn(), TimeElapsedColumn())
    known = path.is_file() and path.suffix not in _PACKED
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(path.name, total=path.stat().st_size if known else None)
        yield lambda count: progress.advance(task, count)
