"""`ahrsd simulate --effect` and `--model FILE --along RECORDING`: files with a known truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import NullModel, Term
from ahrsd.diagnosis.repaired_model import forward
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel, to_text
from ahrsd.recording.table import read_table
from ahrsd.simulation import ScenarioSettings, simulate

SHORT = ("--motion", "rov", "--seconds", 40, "--seed", 3)


def truth_of(path):
    return json.loads((path.parent / f"{path.name}.truth.json").read_text())


def plain():
    return simulate(ScenarioSettings("mam", "rov", seed=3, samples=1000))


@pytest.mark.parametrize("name", list(EFFECTS))
def test_every_effect_is_in_the_file_and_in_its_truth(run, tmp_path, name):
    path = tmp_path / "x.parquet"
    assert run("simulate", "mam", "-o", path, *SHORT, "--effect", name) == 0
    rows, before = read_table(path).rows, plain().samples
    (message,) = truth_of(path)["effects"]
    assert message["effect"] == name
    assert [p["unit"] for p in message["parameters"]] == [p.unit for p in EFFECTS[name].parameters]
    same_rows = len(rows) == len(before)
    assert same_rows == (name != "dropped_samples")
    changed = not same_rows or not (
        np.array_equal(rows.raw_b_gauss, before.raw_b_gauss)
        and np.array_equal(rows.gyro_b_rad_s, before.gyro_b_rad_s)
        and np.array_equal(rows.time_s, before.time_s)
    )
    assert changed


def test_effect_has_the_requested_size(run, tmp_path):
    path = tmp_path / "x.csv"
    wanted = "motor_current_field=field_per_ampere_x=0.002,field_per_ampere_z=-0.001"
    assert run("simulate", "mam", "-o", path, *SHORT, "--effect", wanted) == 0
    rows = read_table(path).rows
    current = rows.covariates["motor_current_a"]
    assert 0.5 <= current.min() < current.max() <= 12.0
    added = rows.raw_b_gauss - plain().samples.raw_b_gauss
    assert added[:, 0] == pytest.approx(0.002 * current, abs=1e-12)
    assert added[:, 1] == pytest.approx(np.zeros(1000), abs=1e-12)
    assert added[:, 2] == pytest.approx(-0.001 * current, abs=1e-12)


def test_strength_and_onset_of_several_effects_are_applied(run, tmp_path):
    path = tmp_path / "x.csv"
    wanted = ("--effect", "hard_iron_step=3,onset_s=25", "--effect", "gyro_scale=2")
    assert run("simulate", "mam", "-o", path, *SHORT, *wanted) == 0
    rows, before = read_table(path).rows, plain()
    added = rows.raw_b_gauss - before.samples.raw_b_gauss
    late = rows.time_s >= 25
    size = np.linalg.norm(added, axis=1)
    assert size[late] == pytest.approx(np.full(late.sum(), 0.015))
    assert np.abs(added[~late]).max() < 1e-12
    gyro = rows.gyro_b_rad_s - before.samples.gyro_b_rad_s
    assert gyro == pytest.approx(before.rate_b_rad_s * [0.01, -0.008, 0.012], abs=1e-12)
    assert [entry["effect"] for entry in truth_of(path)["effects"]] == [
        "hard_iron_step",
        "gyro_scale",
    ]


def test_simulated_delay_of_one_sample_gives_the_previous_field(run, tmp_path):
    path = tmp_path / "x.csv"
    assert run("simulate", "mam", "-o", path, *SHORT, "--effect", "mag_time_lag=lag=0.04") == 0
    rows, before = read_table(path).rows, plain()
    A, b = before.truth.soft_iron, before.truth.hard_iron_gauss
    noise = before.samples.raw_b_gauss - (before.field_b @ A.T + b)
    seen = rows.raw_b_gauss - noise
    # one sample at 25 Hz; only coning within a step differs
    assert seen[1:] == pytest.approx(before.field_b[:-1] @ A.T + b, abs=2e-6)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("motor_curent_field", "no effect 'motor_curent_field'; is motor_current_field meant?"),
        ("xyz", "no effect 'xyz'; docs/reference/effects.md lists them"),
        ("gyro_scale=big", "gyro_scale: strength is 'big', a number is needed"),
        ("gyro_scale=-1", "the strength -1 is negative"),
        ("gyro_scale=1,2", "'2' is neither a strength nor name=value"),
        ("gyro_scale=size=2", "gyro_scale has no size; it has scale_error_x"),
        ("hard_iron_step=onset_s=soon", "onset_s is 'soon'"),
    ],
)
def test_bad_effect_is_refused_in_one_line(run, tmp_path, capsys, wanted, message):
    assert run("simulate", "mam", "-o", tmp_path / "x.csv", "--effect", wanted) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_byte_stream_cannot_have_a_current(run, tmp_path, capsys):
    path = tmp_path / "x.vnraw"
    arguments = ("simulate", "mam", "-o", path, *SHORT, "--effect")
    assert run(*arguments, "motor_current_field") == 2
    assert (
        "a byte stream has no place for motor_current_a; write a table" in capsys.readouterr().err
    )
    assert run(*arguments, "mag_gyro_misalignment") == 0


def repaired(tmp_path, source):
    before = plain()
    truth = before.truth
    model = NullModel(truth.soft_iron, truth.hard_iron_gauss, truth.gyro_bias_rad_s, 1e-3, 5e-3)
    setting = {"covariate": "motor_current_a", "reference": 0.0}
    value = np.array([2e-3, 0.0, 0.0])
    term = Term("motor_current_field", value, 0.1 * np.abs(value), setting)
    path = tmp_path / "model.json"
    path.write_text(to_text(RepairedModel(model, forward.model_noise(model), (term,), source.name)))
    return path, value


def test_simulation_of_a_repaired_model_along_a_recording(run, tmp_path):
    source, made = tmp_path / "s.csv", tmp_path / "y.csv.gz"
    effect = "motor_current_field=field_per_ampere_x=0.002"
    assert run("simulate", "mam", "-o", source, *SHORT, "--effect", effect, "--gap", 20) == 0
    path, value = repaired(tmp_path, source)
    arguments = ("simulate", "--model", path, "--along", source, "-o", made)
    assert run(*arguments, "--seed", 1) == 0
    rows, given = read_table(made).rows, read_table(source).rows
    assert np.array_equal(rows.time_s, given.time_s)
    assert read_table(made).starts == read_table(source).starts
    assert rows.covariates["motor_current_a"] == pytest.approx(given.covariates["motor_current_a"])
    # same field, headings and current: the two differ by their noise only
    left = rows.raw_b_gauss - given.raw_b_gauss
    assert left.std() == pytest.approx(np.sqrt(2) * 1e-3, rel=0.3)
    slope = np.polyfit(given.covariates["motor_current_a"], left[:, 0], 1)[0]
    assert abs(slope) < 0.05 * value[0]
    assert truth_of(made)["effects"][0]["effect"] == "motor_current_field"
    first = made.read_bytes()
    assert run(*arguments, "--seed", 1) == 0
    assert made.read_bytes() == first


def test_rate_is_that_of_a_stream_without_time_whose_motion_is_followed(run, tmp_path):
    source, path = tmp_path / "s.vnraw", tmp_path / "m.json"
    assert run("simulate", "mam", "-o", source, *SHORT) == 0
    model = NullModel(np.eye(3), np.zeros(3), np.zeros(3), 1e-3, 5e-3)
    path.write_text(to_text(RepairedModel(model, forward.model_noise(model), (), "s")))
    made = tmp_path / "y.csv"
    along = ("--model", path, "--along", source, "--rate", 20.0)
    assert run("simulate", *along, "-o", made) == 0
    assert np.median(np.diff(read_table(made).rows.time_s)) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--model", "m.json"), "--model and --along need each other"),
        (("wam", "--model", "m.json", "--along", "s.csv"), "take no scenario"),
        (
            ("--model", "m.json", "--along", "s.csv", "--seconds", "9", "--outliers", "0.1"),
            "--model and --along take no --seconds and no --outliers",
        ),
        (("--model", "none.json", "--along", "s.csv"), "none.json: cannot be read"),
        (("--model", "s.csv", "--along", "s.csv"), "s.csv: is no JSON"),
        (("--model", "m.json", "--along", "none.csv"), "none.csv: does not exist"),
        (("--model", "m.json", "--along", "p.csv"), "needs the column motor_current_a"),
        ((), "name a scenario"),
    ],
)
def test_bad_use_is_refused_in_one_line(run, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    effect = ("--effect", "motor_current_field")
    assert run("simulate", "mam", "-o", tmp_path / "s.csv", *SHORT, *effect) == 0
    assert run("simulate", "mam", "-o", tmp_path / "p.csv", *SHORT) == 0
    repaired(tmp_path, tmp_path / "s.csv")[0].rename(tmp_path / "m.json")
    capsys.readouterr()
    assert run("simulate", "-o", "y.csv", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "y.csv").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--effect", "motor_current_field=covariate=foo_a"), "no column foo_a; there is motor_"),
        (("--effect", "hard_iron_step=onset_s=500"), "onset_s is 500, the recording ends at 40 s"),
        (("--step", "500"), "step_at_s is 500: the recording lasts 39.96 s"),
        (("--step", "nan"), "'--step': nan is not a finite number"),
        (("--magnet", "-3"), "'--magnet': -3.0 is not in the range x>=0.0"),
        (("--gap", "41"), "gap_at_s is 41: the recording lasts 39.96 s"),
    ],
)
def test_request_that_would_change_no_sample_is_refused(run, tmp_path, capsys, options, words):
    path = tmp_path / "x.csv"
    assert run("simulate", "mam", "-o", path, *SHORT, *options) == 2
    assert words in capsys.readouterr().err
    assert not path.exists()


def test_recording_that_is_read_is_not_replaced_by_its_simulation(run, tmp_path, capsys):
    path, model = tmp_path / "dive.csv", tmp_path / "model.json"
    assert run("simulate", "mam", "-o", path, *SHORT) == 0
    model.write_text("{}")
    before = path.read_bytes()
    (tmp_path / "link.csv").symlink_to(path)
    for output in (path, tmp_path / "link.csv", model):
        assert run("simulate", "--model", model, "--along", path, "-o", output) == 2
        assert "is what this command reads; give another name" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert model.read_text() == "{}"


def test_truth_of_the_last_recording_does_not_stay_beside_one_that_was_cut_short(
    run, tmp_path, monkeypatch
):
    path = tmp_path / "x.csv"
    assert run("simulate", "mam", "-o", path, *SHORT, "--effect", "hard_iron_step") == 0

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("ahrsd.cli.recordings.simulate.write_json", killed)
    assert run("simulate", "mam", "-o", path, *SHORT) == 130
    assert path.exists()
    assert not (tmp_path / "x.csv.truth.json").exists()
