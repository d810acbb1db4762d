"""One recording in, one row out and on the disk: what a process of the guard does.

A row's key names the work and not the place: the same bytes under the same version and options are
never worked twice, wherever they lie. A stamp names the place: it tells without reading a recording
that its row is there.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from ahrsd import __version__
from ahrsd.errors import AhrsdError
from ahrsd.fleet import row as rows
from ahrsd.fleet.archive import ArchiveEntry, local_file, pieces
from ahrsd.fleet.processes import TOO_LARGE, TOO_SLOW, Loss
from ahrsd.fleet.row import Calibrated, Row
from ahrsd.fleet.store import Store
from ahrsd.printable import printable
from ahrsd.recording.column_names import NO_MAP, ColumnMap

if TYPE_CHECKING:
    from ahrsd.diagnosis.diagnosis import Diagnosis

_T = TypeVar("_T")

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
    """What the driver is told; the row itself is on the disk by then."""

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
    """Whose recording it is: by its folders, or by what was said of all."""
    named = dict(zip(orders.levels, entry.folders))
    serial = named.get("serial", "")
    digits = "".join(char for char in serial if char.isdigit())
    return {
        "stamp": stamp(entry, orders),
        "recording": printable(entry.url, 1000),
        "size_bytes": entry.size_bytes,
        "version": __version__,
        "options": orders.options,
        "vehicle": orders.vehicle or _text(named.get("vehicle")),
        "place": orders.place or _text(named.get("place")),
        "serial_number": int(digits) if digits and len(digits) < 19 else None,
        "tries": 1,
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
