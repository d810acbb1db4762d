"""Progress bars on a terminal, with the time that is left; nothing where stderr is no terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def count_progress(label: str) -> Iterator[Callable[[int, int], None] | None]:
    """Call what it yields with how many are done, of how many; None where nobody would see it."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn(label, markup=False), BarColumn(), MofNCompleteColumn(), Remaining())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(label, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@contextmanager
def byte_progress(path: Path) -> Iterator[Callable[[int], None] | None]:
    """Call what it yields with the bytes of the file just done; None where nobody would see it.

    A capture says nothing of how much of its file an input is: its bar only shows that it goes on.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(path.name, markup=False),
        BarColumn(),
        DownloadColumn(),
        TimeElapsedColumn(),
    )
    known = path.is_file() and path.suffix != ".mcap"
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(path.name, total=path.stat().st_size if known else None)
        yield lambda count: progress.advance(task, count)
