"""A command never replaces a file that it reads: a recording of a device cannot be made again."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    "words",
    [
        ("diagnose", "{0}", "--json", "{0}"),
        ("diagnose", "{0}", "--spec", "{1}", "--json", "{1}"),
        ("diagnose", "{0}", "--simulation", "{1}", "--json", "{1}"),
        ("calibrate", "{0}", "--json", "{0}"),
        ("calibrate", "{0}", "--model", "{1}", "--json", "{1}"),
        ("evaluate", "{0}", "--calibration", "{1}", "--json", "{1}"),
        ("evaluate", "{0}", "--calibration", "{1}", "--figure", "{0}"),
        ("replay", "{0}", "--json", "{0}"),
        ("replay", "{0}", "--rerun", "{0}"),
        ("convert", "{0}", "-o", "{0}"),
    ],
)
def test_input_is_not_replaced(run, tmp_path, capsys, words):
    recording, other = tmp_path / "dive.parquet", tmp_path / "other.json"
    for path in (recording, other):
        path.write_text("as it was")
    assert run(*(word.format(recording, other) for word in words)) == 2
    assert "is what this command reads; give another name" in capsys.readouterr().err
    assert recording.read_text() == other.read_text() == "as it was"


def test_calibration_in_the_folder_of_the_evaluation_is_not_replaced(run, tmp_path, capsys):
    mine = tmp_path / "evaluation.json"
    mine.write_text("as it was")
    words = ("evaluate", tmp_path / "dive.csv", "--calibration", mine, "--report", tmp_path)
    assert run(*map(str, words)) == 2
    assert "is what this command reads" in capsys.readouterr().err
    assert mine.read_text() == "as it was"
