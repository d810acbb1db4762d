"""An effect that follows a column of the vehicle is removed from the running stream."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from patience import PATIENCE_S

from ahrsd.config.config import Config, check_config, core_settings, terms_text
from ahrsd.core.column_compensation import VehicleTerms
from ahrsd.core.core import Core
from ahrsd.daemon.vehicle_files import ColumnsFile
from ahrsd.diagnosis.model import Noise, NullModel, Term
from ahrsd.diagnosis.repaired_model.column_terms import follows_a_column
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel, to_text
from ahrsd.errors import ConfigError
from ahrsd.inputs import Columns, RegistersKnown, Samples, Stop, TermsKnown
from ahrsd.samples import SampleBlock
from ahrsd.simulation import ScenarioSettings, simulate
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode

K = np.array([0.004, -0.003, 0.002])  # gauss per ampere
CURRENT = {"covariate": "motor_current_a", "reference": 0.0}


def term(name="motor_current_field", value=K, setting=None):
    return Term(name, np.asarray(value), np.zeros(len(value)), setting or CURRENT)


def model_text(*terms):
    calibration = NullModel(np.eye(3), np.zeros(3), np.zeros(3), 1e-3, 5e-4)
    return to_text(RepairedModel(calibration, Noise(1e-3, 5e-4), terms))


def block(host_s, **columns):
    n = len(host_s)
    return SampleBlock(
        time_s=host_s - 7.0, dt_s=np.full(n, 0.1), host_s=host_s, raw_b_gauss=np.full((n, 3), 0.3),
        gyro_b_rad_s=np.zeros((n, 3)), accel_b_m_s2=np.full((n, 3), np.nan), covariates=columns,
    )  # fmt: skip


def vehicle(*terms):
    said = []
    made = VehicleTerms(said.append, max_age_s=0.5)
    if terms:
        made.load_terms(model_text(*terms))
    return made, said


@pytest.mark.parametrize(
    ("one", "follows"),
    [
        (term(), True),
        (term("gyro_bias_temperature", K, {"covariate": "temperature_c", "reference": 20.0}), True),
        (term("moving_iron", [*K, *K], {"covariate": "joint_rad", "reference": 0.0}), True),
        (term("current_derivative_field"), False),  # needs the sample before
        (term("motor_current_field", K, {"covariate": "motor_current_a"}), False),  # less its mean
        (term("hard_iron_step", K, {"onset_s": 3.0}), False),  # of that recording
        (term("mag_time_lag", [0.01], {}), False),
        (term("rotor_field", K, {"covariate": "rpm"}), False),  # its setting is not whole
    ],
    ids=lambda value: getattr(value, "identifier", None),
)
def test_only_effects_that_follow_a_column_sample_by_sample_are_removed(one, follows):
    assert follows_a_column(one) is follows


def test_columns_are_interpolated_between_messages_and_unknown_far_from_them():
    told, _ = vehicle()
    for at_s, ampere in ((10.0, 0.0), (11.0, 4.0)):
        told.record_columns(at_s, {"motor_current_a": ampere})
    host_s = np.array([9.4, 9.6, 10.0, 10.25, 10.5, 11.0, 11.4, 11.6])
    column = told.with_columns(block(host_s)).covariates["motor_current_a"]
    assert column == pytest.approx([np.nan, 0.0, 0.0, 1.0, 2.0, 4.0, 4.0, np.nan], nan_ok=True)
    own = told.with_columns(block(host_s, motor_current_a=np.arange(8.0)))
    assert own.covariates["motor_current_a"].tolist() == list(range(8))  # the stream's own wins


def test_term_is_subtracted_and_a_missing_column_is_a_gap():
    free, said = vehicle(term(), term("mag_time_lag", [0.01], {}))
    host_s = np.array([10.0, 10.1])
    assert free.without_terms(block(host_s)) is None
    assert free.waits_for == ("motor_current_a",)
    assert said == [
        "mag_time_lag is in the model but is no function of a column, sample by sample: it stays "
        "in the readings",
        "calibrated without motor_current_field (motor_current_a)",
        "samples without motor_current_a are not calibrated",
    ]
    after = free.without_terms(block(host_s, motor_current_a=np.array([1.0, 2.0])))
    assert after.gap_before
    assert after.raw_b_gauss == pytest.approx(np.array([0.3 - K, 0.3 - 2 * K]))
    assert after.gyro_b_rad_s.tolist() == [[0.0] * 3] * 2
    again = free.without_terms(block(host_s, motor_current_a=np.zeros(2)))
    assert not again.gap_before
    assert free.waits_for == ()


def test_block_is_unchanged_without_a_model():
    plain, said = vehicle()
    given = block(np.array([1.0, 2.0]))
    assert plain.with_columns(given) is given
    assert plain.without_terms(given) is given
    plain.take(TermsKnown(0, "{}"))
    assert said == ["the model of the terms is no model: its schema must be 'ahrsd.model/1'"]


@pytest.mark.slow
def test_core_calibrates_as_without_the_current():
    made = simulate(ScenarioSettings("mam", "rov", seed=4, samples=5000, rate_hz=25.0))
    s, host_s = made.samples, made.samples.time_s + 100.0
    ampere = 6.0 + 5.0 * np.sign(np.sin(host_s / 5.0)) * (host_s > 130.0)
    dirty = s.raw_b_gauss + ampere[:, None] * K
    errors = {}
    for name in ("with", "without"):
        core = Core(core_settings(Config(), policy=WriteBackPolicy(mode=Mode.PASSIVE)))
        core.handle(RegistersKnown(0, {}, "test"))
        if name == "with":
            core.handle(TermsKnown(0, model_text(term())))
        for k in range(0, len(s), 25):
            rows = slice(k, k + 25)
            for j in range(k, min(k + 25, len(s)), 2):
                ns = int(host_s[j] * 1e9)
                core.handle(Columns(ns, {"motor_current_a": float(ampere[j])}))
            part = replace(
                block(host_s[rows]), time_s=s.time_s[rows], dt_s=s.dt_s[rows],
                raw_b_gauss=dirty[rows], gyro_b_rad_s=s.gyro_b_rad_s[rows], gap_before=k == 0,
            )  # fmt: skip
            core.handle(Samples(int(host_s[rows][-1] * 1e9), part))
        core.handle(Stop(int(host_s[-1] * 1e9) + 1, "end"))
        found = core.calibrator.finish()
        errors[name] = np.linalg.norm(found.hard_iron_gauss - made.truth.hard_iron_gauss)
        told = [text for text in core.stream.warnings if "motor_current_a" in text]
        assert told == (["calibrated without motor_current_field (motor_current_a)"]
                        if name == "with" else [])  # fmt: skip
    assert errors["with"] < 0.002
    assert errors["without"] > 0.02


def test_file_is_read_once_and_its_faults_are_reported(tmp_path):
    path = tmp_path / "columns"
    file = ColumnsFile(path, 60.0)
    until(lambda: "No such file" in file.fault)
    assert file.news() is None
    path.write_text("{}")
    until(lambda: file.fault == "")
    assert file.news() is None  # the time of writing is not known
    rewrite(path, '{"motor_current_a": 3.2, "rudder_deg": -4}')
    found = []
    until(lambda: found.append(file.news()) or found[-1])
    assert found[-1] == {"motor_current_a": 3.2, "rudder_deg": -4.0}
    assert (file.news(), file.fault) == (None, "")
    for text, words in (
        ("", "is not JSON"), ("[1]", "object of numbers"), ('{"a": NaN}', "object of numbers"),
        ('{"a": true}', "object of numbers"), ("[" * 4000, "is not JSON"),
        ('{"a": 1' + "0" * 400 + "}", "object of numbers"),
    ):  # fmt: skip
        rewrite(path, text)
        until(lambda words=words: file.news() is None and words in file.fault)
    file.close()


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


def rewrite(path, text):
    draft = path.with_name(".draft")
    draft.write_text(text)
    draft.rename(path)


def test_configured_model_must_be_valid(tmp_path):
    path = tmp_path / "model.json"
    config = check_config({"terms": {"model": str(path)}}, "c.toml")
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        terms_text(config)
    path.write_text(json.dumps({"schema": "x"}))
    with pytest.raises(ConfigError, match="is no model"):
        terms_text(config)
    path.write_text(model_text(term()))
    assert terms_text(config) == path.read_text()
    assert terms_text(Config()) == ""


def test_effects_library_is_not_loaded_without_a_model():
    code = "import sys, ahrsd.daemon.service; print([m for m in sys.modules if 'effects' in m])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"
