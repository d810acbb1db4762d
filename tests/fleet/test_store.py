"""Every row exists exactly once, wherever a process was stopped."""

from __future__ import annotations

import json

import pytest
from fleet_rows import row, store_of

from ahrsd.errors import AhrsdError
from ahrsd.fleet.questions import FleetRows
from ahrsd.fleet.store import Known, Store

pytest.importorskip("duckdb", reason="duckdb (the extra fleet) is not installed")


def recordings(store: Store) -> list[str]:
    with FleetRows(store) as rows:
        return [name for (name,) in rows.sql("select recording from results order by 1").rows]


def names(*numbers: int) -> list[str]:
    return sorted(f"dive_{n}.mcap" for n in numbers)


def test_rows_in_the_spool_and_in_parts_are_both_read(tmp_path):
    store = store_of(tmp_path / "out", [row(1), row(2, serial_number=7)])
    store.put(row(3, serial_number=None))
    assert [p.parent.name for p in store.parts()] == ["serial=100", "serial=7"]
    assert recordings(store) == names(1, 2, 3)
    assert store.compact() == 1
    assert [p.parent.name for p in store.parts()] == ["serial=100", "serial=7", "serial=unknown"]
    assert recordings(store) == names(1, 2, 3)
    assert list(store.spool.iterdir()) == []


def test_stop_after_the_list_was_written_duplicates_no_row(tmp_path):
    store = store_of(tmp_path / "out", [row(1), row(2)])
    store.put(row(1))  # as if the spool file had not been removed
    assert recordings(store) == names(1, 2)
    assert store.compact() == 1
    assert recordings(store) == names(1, 2)


def test_stop_before_the_list_was_written_counts_no_unlisted_part(tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    before = (tmp_path / "out" / "parts.json").read_bytes()
    store.put(row(2))
    spooled = {path: path.read_bytes() for path in store.spool.iterdir()}
    old = {path: path.read_bytes() for path in store.parts()}
    store.compact()
    (tmp_path / "out" / "parts.json").write_bytes(before)
    for path, data in (spooled | old).items():
        path.write_bytes(data)
    assert len(list((tmp_path / "out" / "parts").rglob("*.parquet"))) == 2
    assert recordings(store) == names(1, 2)
    store.compact()
    assert recordings(store) == names(1, 2)
    assert len(list((tmp_path / "out" / "parts").rglob("*.parquet"))) == 1


def test_incomplete_file_is_never_read_and_removed(tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    half = store.spool / f".{2:032x}.999999999"
    half.write_text('{"key": "0')
    part = store.parts()[0].with_name(".0123456789abcdef.parquet.999999999")
    part.write_bytes(b"PAR1")
    assert recordings(store) == names(1)
    store.put(row(3))
    store.compact()
    assert recordings(store) == names(1, 3)
    assert not half.exists()
    assert not part.exists()


def test_new_row_replaces_the_old_one_in_another_part(tmp_path):
    failed = row(1, serial_number=None, outcome="too slow", error="stopped")
    store = store_of(tmp_path / "out", [failed, row(2)])
    store.put(row(1, serial_number=100))
    for _ in range(2):
        with FleetRows(store) as rows:
            found = rows.sql("select key, outcome, serial_number from results order by key").rows
        assert found == [(f"{1:032x}", "done", 100), (f"{2:032x}", "done", 100)]
        store.compact()
    assert [p.parent.name for p in store.parts()] == ["serial=100"]


def test_small_parts_of_a_device_are_joined(tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    for number in range(2, 6):
        store.put(row(number))
        store.compact()
    assert len(store.parts()) == 1
    assert recordings(store) == names(1, 2, 3, 4, 5)


def test_known_rows_can_exclude_failures(tmp_path):
    store = store_of(tmp_path / "out", [row(1), row(2, outcome="crashed")])
    store.put(row(3, outcome="refused"))
    every = store.known("stamp", failures=True)
    answered = store.known("stamp", failures=False)
    held = [[known.holds(f"{n:032x}") for n in (1, 2, 3, 4)] for known in (every, answered)]
    assert held == [[True, True, True, False], [True, False, False, False]]
    assert store.has(f"{2:032x}", failures=True)
    assert not store.has(f"{2:032x}", failures=False)


def test_part_replaced_during_a_lookup_is_looked_up_again(tmp_path, monkeypatch):
    store = store_of(tmp_path / "out", [row(1)])
    old = store.parts()
    store.put(row(2))
    store.compact()  # the first part is gone
    lists = iter([old, store.parts(), store.parts()])
    monkeypatch.setattr(Store, "parts", lambda _: next(lists))
    assert store.has(f"{1:032x}", failures=True)
    monkeypatch.setattr(Store, "parts", lambda _: old)
    with pytest.raises(AhrsdError, match="names parts that are not there"):
        store.has(f"{3:032x}", failures=True)


def test_no_row_is_known_in_an_empty_store():
    assert not Known([]).holds("0" * 32)


def test_only_one_run_is_active(tmp_path):
    store = store_of(tmp_path / "out", [])
    assert not store.at_work()
    with store.alone():
        assert store.at_work()
        with pytest.raises(AhrsdError, match="another `ahrsd fleet`") as busy, store.alone():
            pass
        assert busy.value.exit_code == 75
    assert not store.at_work()


def test_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(AhrsdError, match="holds other files"):
        Store(tmp_path).create()
    with pytest.raises(AhrsdError, match="holds no rows of a fleet"):
        Store(tmp_path).rows()


def test_list_of_a_later_format_is_refused(tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    (tmp_path / "out" / "parts.json").write_text(json.dumps({"schema": "ahrsd.fleet/9"}))
    with pytest.raises(AhrsdError, match=r"is not ahrsd\.fleet/1"):
        store.parts()
