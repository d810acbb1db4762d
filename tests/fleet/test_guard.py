"""Whatever a task does, it gives one row, and the others continue."""

from __future__ import annotations

import time

import pytest
from fleet_rows import by_name

from ahrsd.fleet import processes
from ahrsd.fleet.archive import Archive
from ahrsd.fleet.processes import Place
from ahrsd.fleet.run import Orders, run
from ahrsd.fleet.store import Store

NAMES = ("good1", "hang", "good2", "hog", "kill", "good3", "once", "bug", "good4")


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "archive").mkdir()
    for name in NAMES:
        (folder / "archive" / f"{name}.mcap").write_bytes(name.encode())
    orders = Orders(out=str(folder / "out"), limit_s=9.0, memory_bytes=1 << 30)
    begun = time.monotonic()
    done = run(Archive(str(folder / "archive")), orders, by_name, Place(2), lambda _: None)
    assert time.monotonic() - begun < 120
    table, parts = Store(folder / "out").rows()
    assert (table.num_rows, len(parts)) == (0, 1)
    import pyarrow.parquet

    found = pyarrow.parquet.read_table(parts[0], partitioning=None).to_pylist()
    assert done.done == len(found) == len(NAMES)
    return {one["recording"].rpartition("/")[2].removesuffix(".mcap"): one for one in found}


def test_good_tasks_finish_despite_bad_ones(ended):
    good = [ended[name]["outcome"] for name in NAMES if "good" in name]
    assert good == ["done"] * 4


@pytest.mark.parametrize(
    ("name", "outcome", "words"),
    [
        ("hang", "too slow", "stopped after 9 s"),
        ("hog", "out of memory", "asked for more than 1024 MiB"),
        ("kill", "crashed", "its process ended by signal 9 (SIGKILL), 3 times"),
        ("bug", "internal error", "KeyError: 'nobody foresaw it'"),
    ],
)
def test_failure_is_a_row_with_its_message(ended, name, outcome, words):
    assert (ended[name]["outcome"], ended[name]["error"]) == (outcome, words)
    assert len(ended[name]["content_sha256"]) == 64


def test_task_killed_once_succeeds_at_the_second_try(ended):
    assert ended["once"]["outcome"] == "done"
    assert ended["kill"]["tries"] == processes.TRIES == 3


def test_task_ended_by_a_limit_has_a_remedy(ended):
    remedies = {name: ended[name]["remedy"] for name in ("hang", "hog", "kill", "bug")}
    assert remedies == {
        "hang": "give more time: --limit 1h --retry-failed",
        "hog": "give more memory: --memory 4G --retry-failed",
        "kill": None,
        "bug": None,
    }
