"""Answers from the rows: drift, recurring findings, failures, and read-only SQL."""

from __future__ import annotations

import numpy as np
import pytest
from fleet_rows import row, store_of

from ahrsd.errors import AhrsdError
from ahrsd.fleet import questions
from ahrsd.fleet.questions import FleetRows, duration

pytest.importorskip("duckdb", reason="duckdb (the extra fleet) is not installed")


def drifting(first: int, serial: int | None, slope: float, *, step: float = 0.0, n: int = 40):
    """A device whose hard iron drifts along x by `slope` gauss a year and steps on day 200."""
    rng = np.random.default_rng(first)
    for i in range(n):
        day = 10.0 * i
        x = 0.1 + slope * day / 365.25 + (step if day >= 200 else 0.0) + rng.normal(0.0, 1e-4)
        yield row(first + i, day=day, serial_number=serial, vehicle=f"rov{serial or 9}",
                  hard_iron_x_gauss=x, temperature_c=10.0 + i % 7)  # fmt: skip


def test_drift_of_each_device_worst_first(tmp_path):
    rows = [*drifting(0, 1, 1e-3), *drifting(100, 2, 0.0, step=0.02), *drifting(200, None, 4e-3)]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        found = asked.drift()
    assert [one.device for one in found] == ["2", "rov9", "1"]
    stepped, unnamed, slow = found
    assert slow.iron.per_year[0] == pytest.approx(1e-3, abs=4 * slow.iron.per_year_sigma[0])
    assert slow.iron.per_year_sigma[0] < 1e-4
    assert unnamed.iron.per_year[0] == pytest.approx(4e-3, rel=0.05)
    (change,) = stepped.iron.changes
    assert change.size[0] == pytest.approx(0.02, abs=4 * change.sigma[0])
    assert questions.date(change.after_day) == "2026-07-20"
    assert slow.bias.changes == ()
    # 20 mG against half of 500 mG
    assert stepped.heading_kept_deg == pytest.approx(np.degrees(np.arctan2(0.02, 0.25)), rel=0.05)
    body = stepped.json()
    assert body["hard_iron"]["changes"][0]["until_utc"] == "2026-07-20T00:00:00"
    assert body["recordings"] == 40
    text = "\n".join(questions.drift_lines(found))
    assert "steps by (+20.0, -0.0, +0.0)" in text or "steps by (+20.0" in text
    assert "between 2026-07-10 and 2026-07-20" in text
    assert text.startswith("2, rov2: 40 calibrations, 2026-01-01 to 2027-01-26")


def test_recordings_of_unknown_devices_are_not_one_device(tmp_path):
    rows = [row(i, day=float(i), serial_number=None, vehicle=None) for i in range(3)]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        assert asked.drift() == []
        assert asked.counts()["devices"] == 0
        left_out = asked.of_no_device()
    assert left_out == 3
    assert questions.drift_lines([], left_out) == [
        "no device has two calibrations whose time is known",
        "left out: 3 calibrations of no known device: the same `ahrsd fleet run` with --vehicle or "
        "--folders says whose they are",
    ]


def test_unconverged_or_undated_calibrations_are_excluded(tmp_path):
    rows = [row(1, day=0.0), row(2, day=1.0, converged=False), row(3)]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        assert asked.drift() == []
    assert questions.drift_lines([]) == ["no device has two calibrations whose time is known"]


def test_findings_recur_by_vehicle_place_and_temperature(tmp_path):
    rows = []
    for i in range(60):
        bad = i % 3 == 0
        rows.append(
            row(i, serial_number=None, vehicle=f"rov{i % 3}", place="harbour" if i < 30 else "lake",
                temperature_c=5.0 if i < 50 else 25.0,
                effects=("motor_current",) if bad and i % 2 == 0 else ())
        )  # fmt: skip
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        found = asked.recurring()
    effect, by, which, n, of, share, everywhere, p = found.rows[0]
    assert (effect, by, which, n, of) == ("motor_current", "device", "rov0", 10, 20)
    assert share == 0.5
    assert everywhere == pytest.approx(10 / 60)
    # all ten of sixty within twenty of them: C(20, 10) / C(60, 10)
    assert p == pytest.approx(184756 / 75394027566, rel=1e-6)
    by_place = {row[2]: row[3:5] for row in found.rows if row[1] == "place"}
    assert by_place == {"harbour": (5, 30), "lake": (5, 30)}
    assert {row[2] for row in found.rows if row[1] == "temperature"} == {"0 to 10 degC"}
    lines = questions.recurring_lines(found)
    assert any("rov0" in line and "10 of 20" in line and "50%" in line for line in lines)
    assert not any("harbour" in line for line in lines)


def test_failures_by_reason_the_most_frequent_first(tmp_path):
    rows = [row(1)]
    rows += [row(i, outcome="refused", error="is empty", remedy="record again") for i in (2, 3)]
    rows += [row(4, outcome="too slow", error="stopped after 600 s")]
    rows += [row(5, outcome="partly done", error="diagnose: is too short")]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        found = asked.failures()
    assert [r[:3] for r in found.rows] == [
        ("refused", "is empty", 2),
        ("partly done", "diagnose: is too short", 1),
        ("too slow", "stopped after 600 s", 1),
    ]
    assert questions.failure_lines(found)[:3] == [
        "2 refused: is empty",
        "  record again",
        "  for example dive_2.mcap",
    ]


def test_sql_reads_the_rows(tmp_path):
    store = store_of(tmp_path / "out", [row(1), row(2, vehicle="rov2")], compacted=False)
    with FleetRows(store) as asked:
        found = asked.sql("select vehicle, count(*) as n from results group by 1 order by 1")
    assert found.columns == ("vehicle", "n")
    assert found.rows == [("rov1", 1), ("rov2", 1)]
    assert found.json() == [{"vehicle": "rov1", "n": 1}, {"vehicle": "rov2", "n": 1}]


@pytest.mark.parametrize(
    "query",
    [
        "copy recordings to '{out}/x.csv'",
        "create table x as select 1",
        "select 1; drop view results",
        "set enable_external_access = true",
        "attach '{out}/x.db'",
        "select * from read_text('{out}/secret.txt')",
        "select * from glob('{out}/*')",
        "select nonsense from results",
        "selec",
        "",
    ],
)
def test_sql_can_only_read_the_rows(tmp_path, query):
    secret = tmp_path / "secret.txt"
    secret.write_text("x")
    store = store_of(tmp_path / "out", [row(1)])
    with FleetRows(store) as asked, pytest.raises(AhrsdError, match=r"^ask: [^\n]+$"):
        asked.sql(query.format(out=tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "secret.txt"]


def test_newest_row_of_each_recording_counts(tmp_path):
    old = [row(i, version="0.1.0", finished_utc="2026-01-01T00:00:00+00:00") for i in (1, 2)]
    new = row(9, version="0.2.0", content_sha256=f"{1:064x}", recording="dive_1.mcap",
              finished_utc="2026-02-01T00:00:00+00:00")  # fmt: skip
    with FleetRows(store_of(tmp_path / "out", [*old, new])) as asked:
        found = asked.sql("select recording, version from results order by 1").rows
        counts = asked.counts()
    assert found == [("dive_1.mcap", "0.2.0"), ("dive_2.mcap", "0.1.0")]
    assert counts["recordings"] == 2
    assert counts["versions"] == ["0.1.0", "0.2.0"]


def test_replaced_parts_are_looked_up_again(tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    with FleetRows(store) as asked:
        store.put(row(2))
        store.compact()  # the opened part is gone
        assert asked.sql("select count(*) from results").rows == [(2,)]


def test_foreign_texts_do_not_reach_the_terminal(tmp_path):
    rows = [
        row(i, day=i, vehicle="\x1b[2J", serial_number=None, effects=("drift",)) for i in range(9)
    ]
    rows += [row(20, outcome="refused", error="\x1b]0;x", recording="a\x1bb")]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        lines = [
            *questions.drift_lines(asked.drift()),
            *questions.failure_lines(asked.failures()),
            *questions.table_lines(*(lambda a: (a.columns, a.rows))(asked.sql("from results"))),
            *questions.table_lines(("\x1b",), []),
        ]
    assert lines
    assert all(text.isprintable() for text in lines)


def test_long_table_is_truncated_with_a_note():
    lines = questions.table_lines(("n",), [(i,) for i in range(1000)])
    assert lines[0].strip() == "n"
    assert lines[-1] == "... and 960 more rows: --json has all"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (90, "90 s"), (600, "10 min"), (9000, "2.5 h"), (864000, "10 days")],
)
def test_durations_are_formatted(seconds, words):
    assert duration(seconds) == words
