"""`ahrsd diagnose --engine one-model`: hidden, answers in the contract's form."""

from __future__ import annotations

import json
import logging
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from tracks import experiment

from ahrsd.__main__ import main
from ahrsd.diagnosis.repaired_model.model_file import from_text
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


class Reported(NamedTuple):
    """What `ahrsd diagnose --engine ENGINE --report FOLDER` says and writes."""

    code: int | str | None
    words: str
    folder: Path

    @property
    def body(self):
        return json.loads((self.folder / "diagnosis.json").read_text())


@pytest.fixture(scope="module")
def reported(recording, tmp_path_factory):
    """Both engines' reports of the recording, each made once."""
    found, root = {}, logging.getLogger()
    handlers = root.handlers[:]
    for engine in ("rules", "one-model"):
        folder, said = tmp_path_factory.mktemp("reports") / engine, StringIO()
        words = ["diagnose", str(recording), "--engine", engine, "--report", str(folder)]
        with redirect_stdout(said), pytest.raises(SystemExit) as ended:
            main(words)
        found[engine] = Reported(ended.value.code, said.getvalue(), folder)
    root.handlers[:] = handlers
    return found


def test_the_step_is_named_in_the_same_form(reported):
    assert [one.code for one in reported.values()] == [0, 0]
    body = reported["one-model"].body
    assert body["schema"] == "ahrsd.diagnosis/1"
    assert [one["effect"] for one in body["findings"]] == ["hard_iron_step"]
    (one,) = body["findings"]
    assert one["where"]["intervals_s"][0][0] == pytest.approx(70.0, abs=0.5)
    found = [p["value"] for p in one["parameters"]]
    np.testing.assert_allclose(found, [0.0, 9e-3, -4e-3], atol=8e-4)
    assert any("experimental" in note for note in body["notes"])
    assert "hard_iron_step" in reported["one-model"].words


def keys_of(body, prefix=""):
    """Paths of an answer's keys; of a list, those of its first entry."""
    if isinstance(body, dict):
        for key, value in body.items():
            yield f"{prefix}.{key}"
            yield from keys_of(value, f"{prefix}.{key}")
    elif isinstance(body, list) and body:
        yield from keys_of(body[0], f"{prefix}[]")


def test_nothing_that_the_rules_tell_is_missing(reported):
    bodies, words = {}, {}
    for engine, (_, said, folder) in reported.items():
        bodies[engine] = reported[engine].body
        words[engine] = said
        page = (folder / "report.html").read_text()
        words[engine, "pictures"] = page.count("<figure") + page.count("<svg")
        assert (folder / "diagnosis.rrd").stat().st_size > 100_000
        model = from_text((folder / "model.json").read_text())
        (term,) = model.terms
        assert term.identifier == "hard_iron_step"
        assert model.noise.mag_gauss == pytest.approx(1e-3, rel=0.1)
    missing = set(keys_of(bodies["rules"])) - set(keys_of(bodies["one-model"]))
    assert {one for one in missing if ".alternatives" not in one} == set()
    assert words["one-model", "pictures"] == words["rules", "pictures"] > 4
    for line in ("held out", "or else", "without it", "checks:", "innovations:"):
        assert line in words["one-model"] or line not in words["rules"]
    (one,) = bodies["one-model"]["findings"]
    assert one["term"] == 0
    assert one["heldout"]["nll_gain_per_sample"] > 10 * max(one["heldout"]["placebo_gain"], 0.001)
    assert one["priors"]["stays"]
    assert one["priors"]["log_odds"] == pytest.approx(one["evidence_nats"])


@pytest.mark.slow
def test_what_the_simulation_has_as_well_is_no_difference(run, recording, capsys):
    words = ["diagnose", str(recording), "--simulation", str(recording), "--engine", "one-model"]
    assert run(*words) == 0
    told = capsys.readouterr().out
    assert "hard_iron_step is in the simulation already, to the same size" in told
    assert "recording and model agree" in told


def test_the_option_is_hidden_and_a_wrong_one_is_refused(run, recording, capsys):
    assert run("diagnose", "--help") == 0
    assert "--engine" not in capsys.readouterr().out
    assert run("diagnose", str(recording), "--engine", "other") == 2
    assert "one-model" in capsys.readouterr().err
