"""A run over an archive: every recording that has no row yet gets one, here or on a cluster.

**One recording in, one row out** and on the disk: what a process does. A row's key names the work
and not the place: the same bytes under the same version and options are never worked twice,
wherever they lie. A stamp names the place: it tells without reading a recording that its row is
there.

**The run** goes through a bounded window and keeps nothing of what is done: rows are on the disk
before it hears of them. It may be killed at any moment; started again it looks which stamps have
rows and goes on with the others.
"""

from __future__ import annotations

import collections
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

from ahrsd import __version__
from ahrsd.errors import AhrsdError
from ahrsd.fleet import row as rows
from ahrsd.fleet.archive import Archive, ArchiveEntry, local_file, pieces, sweep
from ahrsd.fleet.processes import TOO_LARGE, TOO_SLOW, Limits, Loss, Place, crew
from ahrsd.fleet.row import ANSWERED, Calibrated, Row
from ahrsd.fleet.store import Known, Store
from ahrsd.printable import printable
from ahrsd.recording.column_names import NO_MAP, ColumnMap

if TYPE_CHECKING:
    from ahrsd.diagnosis.answer.diagnosis import Diagnosis

# -- One recording, one row ------------------------------------------------------------------------


_T = TypeVar("_T")

_DIGITS = re.compile(r"[0-9]+")
ROLES = ("vehicle", "place", "serial")  # what a level of folders may name
_REMEDIES = {
    TOO_SLOW: "give more time: --limit 1h --retry-failed",
    TOO_LARGE: "give more memory: --memory 4G --retry-failed",
}
THERE = "was there"  # the answer about the same bytes under another name


@dataclass(frozen=True, slots=True)
class Orders:
    """What is done with every recording of a run.

    levels: what the folders of the archive name, from the top; vehicle, place: of all recordings
    again: rows that are failures are made anew
    relabel: vehicle, place, serial: which of them rows that are there take too
    """

    out: str
    columns: ColumnMap = NO_MAP
    rate_hz: float | None = None
    levels: tuple[str, ...] = ("vehicle",)
    vehicle: str | None = None
    place: str | None = None
    limit_s: float = 600.0
    memory_bytes: int = 2 << 30
    again: bool = False
    relabel: tuple[str, ...] = ()

    @property
    def options(self) -> str:
        """What changes an answer, as the row keeps it; empty where all is as usual."""
        given: dict[str, object] = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        if self.columns:
            sources = sorted(self.columns.sources.items())
            given["columns"] = {name: [one.column, one.factor] for name, one in sources}
        return dumps(given, sort_keys=True) if given else ""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the run is told; the row itself is on the disk by then."""

    key: str
    outcome: str


def stamp(entry: ArchiveEntry, orders: Orders) -> str:
    """Names a recording by place, size and date, with version and options."""
    return _digest([_place(entry)], orders)


def key(content_sha256: str, orders: Orders) -> str:
    """Names the work."""
    return _digest([content_sha256.encode()], orders)


def content(path: Path) -> str:
    """sha256 of a recording's bytes.  OSError."""
    digest = hashlib.sha256()
    for piece in pieces(path):
        digest.update(piece)
    return digest.hexdigest()


def _place(entry: ArchiveEntry) -> bytes:
    words = f"{entry.url}\0{entry.size_bytes}\0{entry.changed}"
    return words.encode("utf-8", "surrogateescape")


def _digest(parts: Iterable[bytes], orders: Orders) -> str:
    said = [*parts, __version__.encode(), orders.options.encode()]
    return hashlib.sha256(b"\0".join(said)).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class Examiner:
    """Calibrates and diagnoses a recording, and makes its row durable.

    calibrate, diagnose: the library's functions, given by who starts a run
    """

    calibrate: Callable[[Path, Orders], Calibrated]
    diagnose: Callable[[Path, Orders], Diagnosis]

    def __call__(self, entry: ArchiveEntry, orders: Orders) -> Answer:
        """The answer, once the row is on the disk."""
        return _examined(self, entry, orders)


def _examined(by: Examiner, entry: ArchiveEntry, orders: Orders) -> Answer:
    from ahrsd.daemon.heap import keep_heap

    begun, begun_cpu = time.monotonic(), time.process_time()
    store = Store(Path(orders.out))
    keep_heap()  # also where Dask has told glibc to give every array back
    try:
        with local_file(entry) as path:
            sha256 = content(path)
            own = key(sha256, orders)
            if store.has(own, failures=not orders.again):
                return Answer(own, THERE)
            found = [_labels(entry, orders), {"key": own, "content_sha256": sha256}]
            found.append(_answers(by, path, entry, orders))
    except OSError as error:
        words = error.strerror or str(error)
        return keep_loss(entry, Loss(rows.UNREADABLE, words, 1, 0.0), orders)
    spent: Row = {
        "seconds": time.monotonic() - begun,
        "cpu_s": time.process_time() - begun_cpu,
        "finished_utc": rows.now_utc(),
    }
    made = rows.whole([*found, spent])
    store.put(made)
    return Answer(own, made["outcome"])


def keep_loss(entry: ArchiveEntry, loss: Loss, orders: Orders) -> Answer:
    """The row of a recording that gave no answer."""
    sha256, words = None, loss.words
    if loss.outcome != rows.UNREADABLE:
        try:
            with local_file(entry) as path:
                sha256 = content(path)
        except OSError as error:
            words = f"{words}; then it could not be read: {error.strerror or error}"
    own = key(sha256, orders) if sha256 else stamp(entry, orders)
    lost: Row = {
        "key": own,
        "content_sha256": sha256,
        "outcome": loss.outcome,
        "error": printable(words, 500),
        "remedy": _REMEDIES.get(loss.outcome),
        "tries": loss.tries,
        "seconds": loss.seconds,
        "finished_utc": rows.now_utc(),
        **rows.recorded(None, entry.url, entry.modified_s),
    }
    Store(Path(orders.out)).put(rows.whole([_labels(entry, orders), lost]))
    return Answer(own, loss.outcome)


def _labels(entry: ArchiveEntry, orders: Orders) -> Row:
    return {
        "stamp": stamp(entry, orders),
        "recording": printable(entry.url, 1000),
        "size_bytes": entry.size_bytes,
        "version": __version__,
        "options": orders.options,
        "tries": 1,
        **_whose(entry, orders),
    }


def _whose(entry: ArchiveEntry, orders: Orders) -> Row:
    """Whose recording it is: by its folders, or by what was given for all."""
    named = dict(zip(orders.levels, entry.folders))
    serial = named.get("serial", "")
    digits = max(_DIGITS.findall(serial), key=len, default="")  # of vn100-100130608 the number
    return {
        "vehicle": orders.vehicle or _text(named.get("vehicle")),
        "place": orders.place or _text(named.get("place")),
        "serial_number": int(digits) if 0 < len(digits) < 19 else None,
    }


def _text(name: str | None) -> str | None:
    return None if name is None else printable(name, 200)


def _answers(by: Examiner, path: Path, entry: ArchiveEntry, orders: Orders) -> Row:
    """The columns that `calibrate` and `diagnose` give, and what they refused."""
    errors: dict[str, Exception] = {}
    result = _tried("calibrate", errors, lambda: by.calibrate(path, orders))
    found = _tried("diagnose", errors, lambda: by.diagnose(path, orders))
    out: Row = {"outcome": (rows.DONE, rows.PARTLY, rows.REFUSED)[len(errors)]}
    out |= rows.error_words(errors)
    out |= rows.recorded(result, entry.url.rpartition("/")[2], entry.modified_s)
    if result is not None:
        said = rows.calibration_columns(result)
        if said["serial_number"] is None:  # then what the folder says stays
            del said["serial_number"]
        out |= said
    if found is not None:
        out |= rows.diagnosis_columns(found)
    return out


def _tried(name: str, errors: dict[str, Exception], ask: Callable[[], _T]) -> _T | None:
    try:
        return ask()
    except AhrsdError as error:
        errors[name] = error
        return None


def summary(outcomes: Mapping[str, int]) -> str:
    """Outcomes of a run in words, the most frequent first."""
    ordered = sorted(outcomes.items(), key=lambda item: -item[1])
    return ", ".join(f"{number:,} {outcome}" for outcome, number in ordered) or "nothing to do"


# -- The run ---------------------------------------------------------------------------------------


_COMPACTED = 4096  # rows in the spool after which they are moved
_TOLD_S = 2.0


class Task(Protocol):
    """One recording, one row: an `Examiner`."""

    def __call__(self, entry: ArchiveEntry, orders: Orders) -> Answer: ...  # noqa: D102


@dataclass(slots=True)
class Progress:
    """How far a run is.

    left_out: files that by their name are no recordings, by suffix; linked: how many folders are
    only linked to, and the first of them; before: recordings with a row; relabelled: rows that
    have another vehicle, place or serial number now
    """

    total: int = 0
    before: int = 0
    relabelled: int = 0
    left_out: collections.Counter[str] = field(default_factory=collections.Counter)
    linked: int = 0
    first_linked: str = ""
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
            if orders.relabel:
                progress.relabelled = store.relabel(_whose_are(archive, orders, known))
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


def _whose_are(archive: Archive, orders: Orders, known: Known) -> dict[str, Row]:
    """By stamp, of all recordings that have a row: what they are to take."""
    columns = ["serial_number" if name == "serial" else name for name in orders.relabel]
    stamped = ((stamp(entry, orders), entry) for entry in archive.entries())
    return {
        name: {column: whose[column] for column in columns}
        for name, whose in ((n, _whose(entry, orders)) for n, entry in stamped if known.holds(n))
    }


def _planned(archive: Archive, orders: Orders, known: Known) -> Progress:
    """How much there is to do."""
    progress = Progress()

    def other(name: str) -> None:
        progress.left_out[printable(Path(name).suffix, 20) or "without a suffix"] += 1

    def link(path: str) -> None:
        progress.linked += 1
        progress.first_linked = progress.first_linked or printable(path, 500)

    for entry in archive.entries(other, link):
        progress.total += 1
        progress.before += known.holds(stamp(entry, orders))
    progress.total -= progress.before
    progress.begun_s = time.monotonic()
    return progress
