"""The effects of a repaired model are removed from a recording, so that its calibration is
correct.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Noise, Term
from ahrsd.diagnosis.repaired_model import injection
from ahrsd.diagnosis.repaired_model.forward import (
    context_along,
    noise_free_readings,
    remove_terms,
    simulate_readings,
)
from ahrsd.diagnosis.repaired_model.forward import track_from_readings as track_from
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel, to_text

LEFT = ("mag_quantisation", "dropped_samples", "noise_level")
UNDONE = (  # share of the effect that may remain: its contribution follows the measured motion
    ("motor_current_field", 0.0),
    ("gyro_bias_temperature", 0.0),
    ("hard_iron_step", 0.0),
    ("gyro_scale", 0.02),
    ("mag_time_lag", 0.05),
    ("mag_nonlinearity", 0.05),
    ("eddy_current", 0.05),
)


def with_columns(track, names):
    columns = injection.columns_for([EFFECTS[name] for name in names], track.time_s, 5)
    return type(track)(
        track.time_s, track.dt_s, track.mag_b_gauss, track.gyro_b_rad_s,
        track.accel_b_m_s2, columns, track.runs,
    )  # fmt: skip


def term_of(name, readings, strength=1.0):
    effect = EFFECTS[name]
    value, setting = effect.example(readings, strength)
    return Term(name, np.asarray(value), np.zeros(len(value)), setting)


@pytest.mark.parametrize(("name", "share"), UNDONE)
def test_contribution_of_an_effect_is_removed(name, share):
    made = experiment("wam", samples=1500)
    model, track = true_model(made), with_columns(track_of(made), [name])
    clean = noise_free_readings(context_along(track, model))
    term = term_of(name, clean)
    dirty = simulate_readings(clean, [term])
    mended, left = remove_terms(track_from(dirty, track), model, [term])
    assert left == ()
    for after, before, true in (
        (mended.mag_b_gauss, dirty.mag_b_gauss, clean.mag_b_gauss),
        (mended.gyro_b_rad_s, dirty.gyro_b_rad_s, clean.gyro_b_rad_s),
    ):
        added = np.sqrt(np.mean((before - true) ** 2))
        assert np.sqrt(np.mean((after - true) ** 2)) <= share * added + 1e-12


def test_effects_that_cannot_be_removed_are_returned():
    made = experiment("wam", samples=500)
    track, model = track_of(made), true_model(made)
    terms = [Term(name, np.zeros(1), np.zeros(1), {}) for name in LEFT]
    same, left = remove_terms(track, model, terms)
    assert same is track
    assert left == LEFT


def test_missing_column_is_named_in_the_error():
    made = experiment("wam", samples=500)
    term = Term("motor_current_field", np.ones(3), np.zeros(3), {"covariate": "motor_current_a"})
    with pytest.raises(ValueError, match="motor_current_field needs the column motor_current_a"):
        remove_terms(track_of(made), true_model(made), [term])


@pytest.mark.slow
def test_calibrate_with_a_model_removes_the_effect(run, tmp_path, capsys):
    path, model_path = tmp_path / "x.csv", tmp_path / "model.json"
    wanted = ("--motion", "rov", "--seconds", 200, "--seed", 4)
    assert run("simulate", "mam", "-o", path, *wanted, "--effect", "motor_current_field=6") == 0
    truth = json.loads((tmp_path / "x.csv.truth.json").read_text())
    made = experiment("mam", samples=500)
    (said,) = truth["effects"]
    value = np.array([p["value"] for p in said["parameters"]])
    term = Term(said["effect"], value, np.zeros(3), said["setting"])
    model = RepairedModel(true_model(made), Noise(1e-3, 5e-4), (term,))
    model_path.write_text(to_text(model))

    def hard_iron_error(*options):
        out = tmp_path / "c.json"
        run("calibrate", path, "--json", out, *options)
        found = json.loads(out.read_text())
        return np.linalg.norm(np.subtract(found["hard_iron_gauss"], truth["hard_iron_gauss"]))

    assert hard_iron_error() > 0.01
    assert hard_iron_error("--model", model_path) < 0.001
    capsys.readouterr()
    clean = tmp_path / "clean.csv"
    assert run("simulate", "mam", "-o", clean, "--seconds", 60) == 0
    assert run("calibrate", clean, "--model", model_path) == 2
    assert "needs the column motor_current_a" in capsys.readouterr().err
    model_path.write_text("{}")
    assert run("calibrate", clean, "--model", model_path) == 2
    assert "is no model: its schema must be" in capsys.readouterr().err
