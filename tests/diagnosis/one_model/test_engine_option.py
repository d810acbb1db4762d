"""`ahrsd diagnose --engine one-model`: hidden, answers in the contract's form."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tracks import experiment

from ahrsd.recording.table import write_table


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A simulated recording with a step of the hard iron at 70 s."""
    made = experiment("wam", seed=8, samples=3500).samples
    step = (made.time_s >= 70.0)[:, None] * np.array([0.0, 9e-3, -4e-3])
    columns = {"time_s": made.time_s}
    for k, axis in enumerate("xyz"):
        columns[f"mag_{axis}_gauss"] = (made.raw_b_gauss + step)[:, k]
        columns[f"gyro_{axis}_rad_s"] = made.gyro_b_rad_s[:, k]
    path = tmp_path_factory.mktemp("one_model") / "step.csv"
    write_table(path, columns)
    return path


def test_the_step_is_named_in_the_same_form(run, recording, tmp_path, capsys):
    answer = tmp_path / "answer.json"
    words = ["diagnose", str(recording), "--engine", "one-model", "--json", str(answer)]
    assert run(*words) == 0
    body = json.loads(answer.read_text())
    assert body["schema"] == "ahrsd.diagnosis/1"
    assert [one["effect"] for one in body["findings"]] == ["hard_iron_step"]
    (one,) = body["findings"]
    assert one["where"]["intervals_s"][0][0] == pytest.approx(70.0, abs=0.5)
    found = [p["value"] for p in one["parameters"]]
    np.testing.assert_allclose(found, [0.0, 9e-3, -4e-3], atol=8e-4)
    assert any("experimental" in note for note in body["notes"])
    assert "hard_iron_step" in capsys.readouterr().out


def test_the_option_is_hidden_and_a_wrong_one_is_refused(run, recording, capsys):
    assert run("diagnose", "--help") == 0
    assert "--engine" not in capsys.readouterr().out
    assert run("diagnose", str(recording), "--engine", "other") == 2
    assert "one-model" in capsys.readouterr().err
