"""`ahrsd fleet` on the command line: exit codes, text and files."""

from __future__ import annotations

import json

import pytest
from browser import BROWSER, look_at
from fleet_rows import row, store_of

from ahrsd.__main__ import main
from ahrsd.fleet.archive import Archive
from ahrsd.fleet.run import Orders, stamp

pytest.importorskip("duckdb", reason="duckdb (the extra fleet) is not installed")


@pytest.fixture
def said(capsys):
    def run(*words: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(["fleet", *map(str, words)])
        out, err = capsys.readouterr()
        return ended.value.code, out, err

    return run


@pytest.fixture
def out(tmp_path):
    rows = [
        row(i, day=10.0 * i, serial_number=7, vehicle="rov1", effects=("motor_current",),
            hard_iron_x_gauss=0.1 + 0.03 * (i >= 6))
        for i in range(12)
    ]  # fmt: skip
    rows += [row(20 + i, day=i, serial_number=8, vehicle="rov2") for i in range(12)]
    rows.append(row(50, outcome="refused", error="<b>is empty</b>", remedy="record again"))
    store_of(tmp_path / "out", rows)
    return tmp_path / "out"


def test_archive_without_any_result_exits_with_code_one(said, tmp_path):
    (tmp_path / "archive").mkdir()
    (tmp_path / "archive" / "a.csv").write_text("a\n1\n")
    (tmp_path / "archive" / "notes.md").write_text("x")
    code, text, err = said("run", tmp_path / "archive", "-o", tmp_path / "out", "--jobs", 1)
    assert code == 1, err
    assert text.splitlines() == [
        f"{tmp_path}/out: 1 recording: 1 refused",
        "  left out, no recordings by their names: 1 .md (--match takes others)",
        f"  why: ahrsd fleet ask {tmp_path}/out failures",
    ]
    code, text, _ = said("run", tmp_path / "archive", "-o", tmp_path / "out", "--jobs", 1)
    assert code == 0
    assert "0 recordings: nothing to do\n  1 recording had a row already" in text


def test_names_that_are_given_later_change_the_rows_and_examine_nothing_again(said, tmp_path):
    archive, out = tmp_path / "archive", tmp_path / "out"
    for name in ("vn7/bay", "vn8/fjord"):
        (archive / name).mkdir(parents=True)
        (archive / name / f"{name[:3]}.csv").write_text("a\n1\n")
    rows = [
        row(i, recording=one.url, stamp=stamp(one, Orders(str(out))), vehicle=one.folders[0],
            serial_number=None)
        for i, one in enumerate(Archive(str(archive)).entries())
    ]  # fmt: skip
    store_of(out, rows)

    def labels(*options):
        code, text, _ = said("run", archive, "-o", out, "--jobs", 1, *options)
        assert code == 0
        assert "0 recordings: nothing to do\n  2 recordings had a row already" in text
        query = "select vehicle, place, serial_number from results order by recording"
        found = json.loads(said("ask", out, query, "--json", "-")[1])
        changed = [int(line.split()[0]) for line in text.splitlines() if "as given now" in line]
        return [tuple(row.values()) for row in found], changed

    assert labels() == ([("vn7", None, None), ("vn8", None, None)], [])
    assert labels("--vehicle", "rov1") == ([("rov1", None, None)] * 2, [2])
    assert labels() == ([("rov1", None, None)] * 2, [])
    places = [("rov1", "bay", 7), ("rov1", "fjord", 8)]
    assert labels("--folders", "serial,place") == (places, [2])
    assert labels("--place", "bay") == ([("rov1", "bay", 7), ("rov1", "bay", 8)], [1])
    assert labels("--place", "bay") == ([("rov1", "bay", 7), ("rov1", "bay", 8)], [])


def test_no_question_about_no_rows_is_answered_as_if_all_were_well(said, tmp_path):
    store_of(tmp_path / "out", [])
    for question in ("drift", "recurring", "failures"):
        code, text, _ = said("ask", tmp_path / "out", question)
        assert (code, text) == (0, f"{tmp_path}/out: no recording has a row yet\n")
    said("status", tmp_path / "out", "--report", tmp_path / "page")
    page = (tmp_path / "page" / "report.html").read_text()
    assert "No recording has a row yet." in page
    assert "Every recording gave an answer." not in page


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--limit", "3 weeks"), "--limit 3 weeks: a number with one of s, min, h"),
        (("--memory", "-1G"), "--memory -1G: a number with one of K, M, G"),
        (("--folders", "ship"), "--folders ship: a level is one of vehicle, place, serial, or -"),
    ],
)
def test_wrong_option_is_refused_in_one_line(said, tmp_path, options, words):
    code, _, err = said("run", tmp_path, "-o", tmp_path / "out", *options)
    assert (code, err) == (2, f"ahrsd: {words}\n")


def test_status_counts_outcomes(said, out):
    code, text, _ = said("status", out)
    assert code == 0
    assert text.splitlines() == [
        f"{out}: 25 recordings: 24 done, 1 refused",
        "  3 devices, 2 vehicles; 12 recordings with a mismatch",
        "  3 parts, 0 rows in the spool; version 0.1.0",
    ]
    code, text, _ = said("status", out, "--json", "-")
    body = json.loads(text)
    assert body["outcomes"] == {"done": 24, "refused": 1}
    assert (body["seconds"], body["at_work"], body["run"]) == (50.0, False, {})


def test_compact_moves_rows_out_of_the_spool(said, out):
    store_of(out, [row(60, serial_number=9)], compacted=False)
    assert said("compact", out)[:2] == (0, f"{out}: 1 row moved; 4 parts\n")
    assert said("compact", out)[:2] == (0, f"{out}: 0 rows moved; 4 parts\n")


def test_drift_question_reports_the_step(said, out):
    code, text, _ = said("ask", out, "drift")
    assert code == 0
    assert text.startswith("7, rov1: 12 calibrations, 2026-01-01 to 2026-04-21\n")
    assert "steps by (+30.0, +0.0, +0.0)" in text.replace("-0.0", "+0.0")
    assert "between 2026-02-20 and 2026-03-02" in text
    body = json.loads(said("ask", out, "drift", "--json", "-")[1])
    assert [one["device"] for one in body] == ["7", "8"]
    assert body[0]["hard_iron"]["changes"][0]["size_gauss"][0] == pytest.approx(0.03, abs=1e-4)
    assert body[1]["hard_iron"]["changes"] == []


def test_other_questions_are_answered(said, out):
    assert "motor_current  vehicle  rov1" in said("ask", out, "recurring")[1]
    assert "1 refused: <b>is empty</b>\n  record again" in said("ask", out, "failures")[1]
    code, text, _ = said("ask", out, "select vehicle, count(*) as n from results group by 1")
    assert code == 0
    assert sorted(text.split()[2:]) == ["12", "13", "rov1", "rov2"]


@pytest.mark.parametrize(
    "question", ["drop table spool", "what drifts?", "select * from read_csv('/etc/passwd')"]
)
def test_invalid_question_exits_with_code_two(said, out, question):
    code, text, err = said("ask", out, question)
    assert (code, text) == (2, "")
    assert err.startswith("ahrsd: ask: ")
    assert err.count("\n") == 1


def test_folder_without_rows_exits_with_code_two(said, tmp_path):
    for words in (("status",), ("compact",), ("ask", "drift")):
        code, _, err = said(words[0], tmp_path, *words[1:])
        assert (code, err) == (
            2,
            f"ahrsd: {tmp_path}: holds no rows of a fleet; make some: ahrsd fleet run\n",
        )


def test_page_shows_worst_devices_first_and_escapes_foreign_text(said, out, tmp_path):
    code, text, _ = said("status", out, "--report", tmp_path / "page")
    assert code == 0
    assert text.splitlines()[-1] == f"report: {tmp_path}/page/report.html"
    page = (tmp_path / "page" / "report.html").read_text()
    assert page.index("<td>7</td>") < page.index("<td>8</td>")
    assert "&lt;b&gt;is empty&lt;/b&gt;" in page
    assert "<b>is empty" not in page
    assert "12 of 12" in page
    assert page.count("<img alt=") == 2


@pytest.mark.skipif(BROWSER is None, reason="no browser is installed")
@pytest.mark.parametrize("width_px", [400, pytest.param(1000, marks=pytest.mark.slow)])
def test_page_is_complete_in_a_browser(said, out, tmp_path, width_px):
    said("status", out, "--report", tmp_path / "page")
    seen = look_at(tmp_path / "page" / "report.html", width_px, tmp_path)
    assert seen["errors"] == []
    assert [complete and width > 0 for _, width, complete in seen["pictures"]] == [True, True]
    assert seen["width"] <= seen["window"]
    assert seen["headings"] == [
        "Fleet out", "Devices, worst first", "Drift", "Findings by vehicle",
        "Recordings without an answer",
    ]  # fmt: skip


def test_unknown_question_is_refused_with_the_possible_ones(said, out):
    code, _, err = said("ask", out, "nonsense")
    assert code == 2
    assert err.endswith("a question is drift, recurring, failures, or a SELECT over `results`\n")
    assert err.count("\n") == 1
