"""A run: what of the archive has no row yet, through a bounded window, here or on a cluster.

The driver keeps nothing of what is done: rows are on the disk before it hears of them. It may be
killed at any moment; started again it looks which stamps have rows and goes on with the others.
"""

from __future__ import annotations

import collections
import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from ahrsd.errors import AhrsdError
from ahrsd.fleet.archive import Archive, ArchiveEntry
from ahrsd.fleet.guard import Guard, Task
from ahrsd.fleet.row import ANSWERED
from ahrsd.fleet.store import Known, Store
from ahrsd.fleet.work import THERE, Answer, Orders, stamp

_WINDOW = 4  # recordings in flight for each process
_COMPACTED = 4096  # rows in the spool after which they are moved
_TOLD_S = 2.0

Submit = Callable[[ArchiveEntry], "Future[Answer]"]


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


@dataclass(frozen=True, slots=True)
class Place:
    """Where recordings are examined: so many processes here, or a Dask cluster.

    loads: modules that the task needs
    """

    jobs: int
    task: Task
    loads: tuple[str, ...] = ()
    cluster: str | None = None


def run(
    archive: Archive, orders: Orders, place: Place, tell: Callable[[Progress], None]
) -> Progress:
    """Give every recording of the archive its row; what happened.  AhrsdError.

    tell: called after each recording; where a run is interrupted, all rows so far are kept
    """
    store = Store(Path(orders.out))
    store.create()
    with store.alone():
        store.compact()
        known = store.known("stamp", failures=not orders.again)
        progress = _planned(archive, orders, known)
        tell(progress)
        missing = (one for one in archive.entries() if not known.holds(stamp(one, orders)))
        try:
            if progress.total:
                _through(missing, orders, place, store, progress, tell)
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
    place: Place,
    store: Store,
    progress: Progress,
    tell: Callable[[Progress], None],
) -> None:
    told_s = 0.0
    with _executor(place, orders) as (submit, window):
        progress.begun_s = time.monotonic()
        for answer in answers(missing, submit, window):
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


def answers(entries: Iterable[ArchiveEntry], submit: Submit, window: int) -> Iterator[Answer]:
    """The answers as they come, with at most `window` recordings in flight."""
    waiting = iter(entries)
    flight = {submit(entry) for entry in islice(waiting, window)}
    while flight:
        done, flight = wait(flight, return_when=FIRST_COMPLETED)
        for future in done:
            answer = future.result()
            flight |= {submit(entry) for entry in islice(waiting, 1)}
            yield answer


@contextmanager
def _executor(place: Place, orders: Orders) -> Iterator[tuple[Submit, int]]:
    """What takes a recording, and how many may be in flight."""
    if place.cluster is not None:
        from ahrsd.fleet.cluster import connected

        with connected(place.cluster, orders, place.task, place.loads) as (submit, processes):
            yield submit, _WINDOW * processes
        return
    guard = Guard(place.jobs, orders.memory_bytes, place.task, place.loads)
    threads = Threads(place.jobs, thread_name_prefix="fleet")
    try:
        yield lambda entry: threads.submit(guard.examine, entry, orders), _WINDOW * place.jobs
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        guard.close()
