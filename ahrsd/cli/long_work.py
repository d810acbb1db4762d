"""Commands that take long: progress bars with the time left; limits of time and memory a task.

Progress is shown on a terminal and nothing where stderr is none. `--limit` and `--memory` belong to
commands that do many things, each in a process of its own.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from ahrsd.errors import AhrsdError

# -- Progress --------------------------------------------------------------------------------------


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
    from ahrsd.fleet.questions import duration

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


# -- Limits of each of many tasks ------------------------------------------------------------------


_SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
_BYTES = {"K": 2.0**10, "M": 2.0**20, "G": 2.0**30}

_Command = Callable[..., Any]


def limit_options(
    what: str, *, limit: str | None = None, memory: str | None = None
) -> Callable[[_Command], _Command]:
    """Both for each of `what`, as `limit_s` and `memory_bytes`; 0 where there is no limit."""
    limited = click.option(
        "--limit", "limit_s", default=limit, show_default=limit or "none", callback=_seconds,
        help=f"Longest time for {what}: s, min, h.",
    )  # fmt: skip
    bounded = click.option(
        "--memory", "memory_bytes", default=memory, show_default=memory or "none", callback=_bytes,
        help=f"Most memory for {what}: M, G.",
    )  # fmt: skip
    return lambda command: limited(bounded(command))


def _seconds(_context: click.Context, _option: click.Parameter, text: str | None) -> float:
    return _amount("--limit", text, _SECONDS)


def _bytes(_context: click.Context, _option: click.Parameter, text: str | None) -> int:
    return round(_amount("--memory", text, _BYTES))


def _amount(option: str, text: str | None, units: dict[str, float]) -> float:
    if text is None:
        return 0.0
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)", text.strip())
    factor = None if found is None else units.get(found[2].removesuffix("iB").removesuffix("B"))
    if found is None or factor is None or float(found[1]) <= 0.0:
        raise AhrsdError(f"{option} {text}: a number with one of {', '.join(filter(None, units))}")
    return float(found[1]) * factor
