"""`ahrsd diagnose` on a step of the hard iron: the finding, its JSON form and the report."""

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
    made = experiment("wam", seed=8, samples=2800).samples
    step = (made.time_s >= 70.0)[:, None] * np.array([0.0, 9e-3, -4e-3])
    columns = {"time_s": made.time_s}
    for k, axis in enumerate("xyz"):
        columns[f"mag_{axis}_gauss"] = (made.raw_b_gauss + step)[:, k]
        columns[f"gyro_{axis}_rad_s"] = made.gyro_b_rad_s[:, k]
    path = tmp_path_factory.mktemp("recordings") / "step.csv"
    write_table(path, columns)
    return path


class Reported(NamedTuple):
    """Output and files of `ahrsd diagnose --report FOLDER`."""

    code: int | str | None
    words: str
    folder: Path

    @property
    def body(self):
        return json.loads((self.folder / "diagnosis.json").read_text())


@pytest.fixture(scope="module")
def reported(recording, tmp_path_factory):
    """The report of the recording, made once."""
    root = logging.getLogger()
    handlers = root.handlers[:]
    folder, said = tmp_path_factory.mktemp("report"), StringIO()
    with redirect_stdout(said), pytest.raises(SystemExit) as ended:
        main(["diagnose", str(recording), "--report", str(folder)])
    root.handlers[:] = handlers
    return Reported(ended.value.code, said.getvalue(), folder)


@pytest.mark.slow
def test_step_is_found_with_its_onset_and_size(reported):
    assert reported.code == 0
    body = reported.body
    assert body["schema"] == "ahrsd.diagnosis/1"
    assert [one["effect"] for one in body["findings"]] == ["hard_iron_step"]
    (one,) = body["findings"]
    assert one["where"]["intervals_s"][0][0] == pytest.approx(70.0, abs=0.5)
    found = [p["value"] for p in one["parameters"]]
    np.testing.assert_allclose(found, [0.0, 9e-3, -4e-3], atol=8e-4)
    assert "hard_iron_step" in reported.words


def test_report_has_figures_model_and_checks(reported):
    page = (reported.folder / "report.html").read_text()
    assert page.count("<figure") + page.count("<svg") > 4
    assert (reported.folder / "diagnosis.rrd").stat().st_size > 100_000
    model = from_text((reported.folder / "model.json").read_text())
    (term,) = model.terms
    assert term.identifier == "hard_iron_step"
    assert model.noise.mag_gauss == pytest.approx(1e-3, rel=0.1)
    for line in ("held out", "cost", "checks:", "innovations:"):
        assert line in reported.words
    (one,) = reported.body["findings"]
    assert one["term"] == 0
    assert one["heldout"]["nll_gain_per_sample"] > 10 * max(one["heldout"]["placebo_gain"], 0.001)
    assert one["priors"]["stays"]
    assert one["priors"]["log_odds"] == pytest.approx(one["evidence_nats"])


@pytest.mark.slow
def test_effect_that_the_simulation_contains_is_no_mismatch(run, recording, capsys):
    words = ["diagnose", str(recording), "--simulation", str(recording)]
    assert run(*words) == 0
    told = capsys.readouterr().out
    assert "hard_iron_step is in the simulation already, to the same size" in told
    assert "recording and model agree" in told
