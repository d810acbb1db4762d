"""FleetRows of a fleet by hand, and tasks that go wrong in every way a task can."""

from __future__ import annotations

import os
import signal
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ahrsd.fleet.row import Row, whole
from ahrsd.fleet.run import Answer, key, stamp
from ahrsd.fleet.store import Store

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


def row(
    number: int, *, day: float | None = None, effects: tuple[str, ...] = (), **values: object
) -> Row:
    """A row with an answer, of device 100 unless it is said otherwise."""
    at = None if day is None else (BEGIN + timedelta(days=day)).isoformat()
    findings = [
        {"effect": name, "probability": 0.9, "frame": "sensor", "words": f"{name} in words"}
        for name in effects
    ]
    usual: Row = {
        "key": f"{number:032x}", "stamp": f"{number:032x}", "content_sha256": f"{number:064x}",
        "recording": f"dive_{number}.mcap", "size_bytes": 1000, "version": "0.1.0", "options": "",
        "outcome": "done", "serial_number": 100, "vehicle": "rov1", "recorded_utc": at,
        "recorded_by": "its name", "converged": True, "field_gauss": 0.5, "heading_sigma_deg": 0.1,
        "mismatch": bool(effects), "findings": findings, "seconds": 2.0, "tries": 1,
        "finished_utc": BEGIN.isoformat(),
        **{f"hard_iron_{a}_gauss": 0.1 for a in "xyz"},
        **{f"hard_iron_sigma_{a}_gauss": 1e-4 for a in "xyz"},
        **{f"gyro_bias_{a}_rad_s": 1e-3 for a in "xyz"},
        **{f"gyro_bias_sigma_{a}_rad_s": 1e-5 for a in "xyz"},
    }  # fmt: skip
    return whole([usual, values])


def store_of(folder: Path, rows: list[Row], *, compacted: bool = True) -> Store:
    store = Store(folder)
    store.create()
    for one in rows:
        store.put(one)
    if compacted:
        store.compact()
    return store


def _done(entry, orders) -> Answer:
    own = key(entry.url, orders)
    labels = {"key": own, "stamp": stamp(entry, orders), "outcome": "done", "recording": entry.url}
    Store(Path(orders.out)).put(whole([labels]))
    return Answer(own, "done")


def by_name(entry, orders) -> Answer:
    """Whatever the file's name asks for."""
    name = Path(entry.url).name
    if "hang" in name:
        time.sleep(600)
    if "hog" in name:
        waste = [np.empty(512 << 20, np.uint8) for _ in range(10)]  # asked for, never touched
        return Answer(str(len(waste)), "done")
    if "kill" in name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "once" in name:  # dies the first time only
        mark = Path(f"{entry.url}.seen")
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    if "bug" in name:
        raise KeyError("nobody foresaw it")
    return _done(entry, orders)


def sleeping(entry, orders) -> Answer:
    """A task of so many milliseconds as the file's size says, which does nothing."""
    time.sleep(entry.size_bytes / 1000.0)
    return _done(entry, orders)


def computing(entry, orders) -> Answer:
    """A task that needs so many milliseconds of a processor."""
    until = time.process_time() + entry.size_bytes / 1000.0
    while time.process_time() < until:
        sum(range(10_000))
    return _done(entry, orders)


def held(entry, orders) -> Answer:
    """Like `sleeping`; one that is called held*.mcap waits until the file `open` lies beside it."""
    path = Path(entry.url)
    while path.name.startswith("held") and not path.with_name("open").exists():
        time.sleep(0.05)
    return sleeping(entry, orders)


def nothing(entry, orders) -> Answer:
    """A task that costs nothing and leaves nothing."""
    return Answer(entry.url, "done")
