"""A run: what of the archive has no row yet, through a bounded window, here or on a cluster.

The driver keeps nothing of what is done: rows are on the disk before it hears of them. It may be
killed at any moment; started again it looks which stamps have rows and goes on with the others.
"""

from __future__ import annotations

import collections
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from ahrsd.errors import AhrsdError
from ahrsd.fleet.archive import Archive, ArchiveEntry, sweep
from ahrsd.fleet.processes import Limits, Place, crew
from ahrsd.fleet.row import ANSWERED
from ahrsd.fleet.store import Known, Store
from ahrsd.fleet.work import THERE, Answer, Orders, keep_loss, stamp

_COMPACTED = 4096  # rows in the spool after which they are moved
_TOLD_S = 2.0


class Task(Protocol):
    """One recording, one row: `work.Examiner`."""

    def __call__(self, entry: ArchiveEntry, orders: Orders) -> Answer: ...  # noqa: D102


@dataclass(slots=True)
class Progress:
    """How far a run is.

    left_out: files that by their name are no recordings, by suffix; before: recordings with a row
    """

    total: int = 0
    before: int = 0
    left_out: collections.Counter[str] = field(default_factory=collections.Counter)
    outcomes: collections.Counter[str] = field(default_factory=collections.Counter)
    begun_s: float = field(default_factory=time.monotonic)

    @property
    def done(self) -> int:
        """Recordings of this run."""
        return sum(self.outcomes.values())

    @property
    def failed(self) -> int:
        """Those of them that gave no answer."""
        return self.done - sum(self.outcomes[name] for name in (*ANSWERED, THERE))

    @property
    def per_minute(self) -> float:
        """Recordings a minute since the start."""
        return 60.0 * self.done / max(time.monotonic() - self.begun_s, 1e-9)

    def json(self) -> dict[str, object]:
        """For `status`."""
        return {
            "total": self.total,
            "before": self.before,
            "done": self.done,
            "failed": self.failed,
            "per_minute": round(self.per_minute, 3),
            "process": os.getpid(),
        }


def run(
    archive: Archive, orders: Orders, task: Task, place: Place, tell: Callable[[Progress], None]
) -> Progress:
    """Give every recording of the archive its row; what happened.  AhrsdError.

    tell: called after each recording; where a run is interrupted, all rows so far are kept
    """
    store = Store(Path(orders.out))
    store.create()
    with store.alone():
        sweep()
        store.compact()
        known = store.known("stamp", failures=not orders.again)
        progress = _planned(archive, orders, known)
        tell(progress)
        missing = (one for one in archive.entries() if not known.holds(stamp(one, orders)))
        try:
            if progress.total:
                _through(missing, orders, task, place, store, progress, tell)
            store.compact()
            store.tell(progress.json())
        except OSError as error:
            raise AhrsdError(
                f"{orders.out}: a row cannot be written: {error.strerror or error}; all rows so "
                "far are kept: make room, then the same command"
            ) from error
    return progress


def _through(
    missing: Iterable[ArchiveEntry],
    orders: Orders,
    task: Task,
    place: Place,
    store: Store,
    progress: Progress,
    tell: Callable[[Progress], None],
) -> None:
    told_s = 0.0
    do, lost = partial(task, orders=orders), partial(keep_loss, orders=orders)
    with crew(place, Limits(orders.limit_s, orders.memory_bytes)) as processes:
        progress.begun_s = time.monotonic()
        for _, answer in processes.map(do, missing, lost):
            progress.outcomes[answer.outcome] += 1
            tell(progress)
            if time.monotonic() - told_s > _TOLD_S:
                store.tell(progress.json())
                told_s = time.monotonic()
            if progress.done % _COMPACTED == 0:
                store.compact()


def _planned(archive: Archive, orders: Orders, known: Known) -> Progress:
    """How much there is to do."""
    progress = Progress()

    def other(name: str) -> None:
        progress.left_out[Path(name).suffix or "without a suffix"] += 1

    for entry in archive.entries(other):
        progress.total += 1
        progress.before += known.holds(stamp(entry, orders))
    progress.total -= progress.before
    progress.begun_s = time.monotonic()
    return progress
