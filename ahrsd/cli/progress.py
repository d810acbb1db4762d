"""Progress bars on a terminal, with the time that is left; nothing where stderr is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click


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


@contextmanager
def fleet_progress(every_s: float = 60.0) -> Iterator[Callable[[int, int, int, float], None]]:
    """Call what it yields with how many are done, of how many, how many failed, and the rate.

    done, total, failed, and how many a minute. Where stderr is no terminal, a line a minute.
    """
    if not sys.stderr.isatty():
        yield _lines(every_s)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    said = TextColumn("{task.description}", markup=False)
    columns = (said, BarColumn(), MofNCompleteColumn(), Remaining())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("recordings", total=None)

        def show(done: int, total: int, failed: int, per_minute: float) -> None:
            words = f"recordings, {failed} failed, {per_minute:.3g} a minute"
            progress.update(task, completed=done, total=total, description=words)

        yield show


def _lines(every_s: float) -> Callable[[int, int, int, float], None]:
    from ahrsd.fleet.told import duration

    said_s = time.monotonic()

    def show(done: int, total: int, failed: int, per_minute: float) -> None:
        nonlocal said_s
        if time.monotonic() - said_s < every_s or not done:
            return
        said_s = time.monotonic()
        left = duration(60.0 * (total - done) / per_minute)
        click.echo(
            f"{done:,} of {total:,} recordings, {failed:,} failed, {per_minute:.3g} a minute, "
            f"{left} left",
            err=True,
        )

    return show
