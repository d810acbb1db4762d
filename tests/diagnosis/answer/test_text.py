"""Text of the answer: the remaining residual, ordinary or beyond it, and how an effect was read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_motion import moving

from ahrsd.diagnosis.answer.diagnosis import (
    Check,
    Component,
    Diagnosis,
    Finding,
    Ordinary,
    Unexplained,
    Where,
)
from ahrsd.diagnosis.answer.text import (
    REPORTED_SETTINGS,
    UNREPORTED_SETTINGS,
    answer_lines,
    component_lines,
    ordinary_residual,
    ordinary_text,
    setting_text,
    verdict,
)
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.report.diagnosis_page import write_diagnosis_report

WHY = "beyond the ordinary: a field by attitude, 80 mG where up to 19 mG is ordinary"


def component(name: str, words: str, size: float, there: bool = True) -> Component:
    nats = 100.0 if there else 0.0
    return Component(name, words, "sensor", size, 19e-3, "gauss", 100.0 * size, nats, there)


def remaining(attitude: float, *, within: bool = True, there: bool = True) -> Ordinary:
    """A field that varies with attitude, and one of 10 mG that varies with place."""
    field = float(np.hypot(attitude, 10e-3))
    return Ordinary(
        within=within,
        why=None if within else WHY,
        field_gauss=field,
        field_up_to_gauss=27e-3,
        heading_deg=100.0 * field,
        heading_up_to_deg=2.6,
        gyro_rad_s=0.0,
        gyro_up_to_rad_s=0.01,
        recordings=20,
        components=(
            component("by_direction", "a field by attitude", attitude, there),
            component("world_course", "a field by place", 10e-3, there),
        ),
    )


def diagnosis_of(one: Ordinary, *findings: Finding) -> Diagnosis:
    """A diagnosis with this remaining residual in the world frame."""
    unknown = Unexplained(
        detected=not one.within,
        where=Where(((0.0, 100.0),), ("x", "y"), "world"),
        size=0.03,
        unit="gauss",
        evidence_nats=120.0,
        ordinary=one,
    )
    something = bool(findings) or unknown.detected
    return Diagnosis("walk.csv", None, something, 1e-20, findings, unknown, {})


def test_ordinary_residual_is_reported_and_is_no_mismatch():
    one = diagnosis_of(remaining(8e-3))
    told = one.to_json()["unexplained"]
    assert told["where"]["frame"] == "world"
    assert told["evidence_nats"] == 120.0
    assert told["ordinary"]["within"] is True
    said = verdict(one)
    assert "agree" not in said
    assert said.startswith(
        "nothing beyond the ordinary: the residual is ordinary for a real recording: 13 mG, "
        "1.3 deg of heading (95 % of 20 untouched recordings have less than 27 mG, 2.6 deg)"
    )
    assert said.endswith("; p = 1e-20 that there is none")
    assert "remaining residual, ordinary:" in answer_lines(one)
    assert not any(line.startswith("unknown, here") for line in answer_lines(one))


def test_unknown_cause_is_reported_with_direction_frequencies_and_size():
    where = Where(
        ((0.0, 110.0),), ("x", "y"), "sensor", band_hz=(0.26, 2.08), direction=(0.6, -0.8, 0.0)
    )
    remaining = Unexplained(True, where, None, 4.19e-4, "gauss", evidence_nats=40.0)
    said = answer_lines(Diagnosis("walk.csv", None, True, 1e-17, (), remaining, {}))
    at = said.index("unknown, here (no effect of the library explains it):")
    assert said[at + 1 : at + 4] == [
        "   where      0.0-110.0 s; axes x y; turns with the vehicle; 0.26-2.08 Hz",
        "   along      x +0.60, y -0.80, z +0.00 (a unit vector of that frame)",
        "   size       0.42 mG",
    ]


def test_finding_next_to_an_ordinary_residual_is_a_mismatch():
    lag = Finding(
        "mag_time_lag", 0.99, (), Where((), (), "link"), (), None, None, None, words="it is late"
    )
    one = diagnosis_of(remaining(8e-3), lag)
    assert verdict(one).startswith(
        "MISMATCH: 1 effect left out (p = 1e-20); the remaining residual is"
    )
    assert ordinary_residual(one) is one.unexplained.ordinary


def test_residual_beyond_the_ordinary_is_unknown_and_reported_with_its_excess():
    one = diagnosis_of(remaining(80e-3, within=False))
    assert ordinary_residual(one) is None
    said = "\n".join(answer_lines(one))
    assert said.startswith("walk.csv: MISMATCH: an unknown cause (p = 1e-20)")
    assert "component  a field by attitude: 80 mG, 8 deg of heading, 100 nats" in said
    assert "why        beyond the ordinary: a field by attitude, 80 mG where up to" in said


def test_report_page_distinguishes_ordinary_residual_from_unknown(tmp_path):
    page = tmp_path / "report.html"
    write_diagnosis_report(page, diagnosis_of(remaining(8e-3)), "ahrsd diagnose walk.csv")
    said = page.read_text(encoding="utf-8")
    assert "Remaining residual, ordinary" in said
    assert "13 mG, 1.3 deg of heading" in said
    assert "a field by attitude: 8 mG, 0.8 deg of heading, 100 nats (ordinary: up to " in said
    assert "Unknown, here" not in said
    write_diagnosis_report(
        page, diagnosis_of(remaining(80e-3, within=False)), "ahrsd diagnose walk.csv"
    )
    said = page.read_text(encoding="utf-8")
    assert "Unknown, here" in said
    assert WHY in said
    assert "Remaining residual, ordinary" not in said


@pytest.mark.parametrize("within", [True, False])
def test_page_has_the_components_of_a_residual_that_is_at_no_place(tmp_path, within):
    page, found = tmp_path / "report.html", diagnosis_of(remaining(80e-3, within=within))
    placeless = replace(found, unexplained=replace(found.unexplained, where=None))
    write_diagnosis_report(page, placeless, "ahrsd diagnose walk.csv")
    said = page.read_text(encoding="utf-8")
    assert ("Unknown, here" in said) != within
    for line in component_lines(found.unexplained.ordinary):
        assert line in said


@pytest.mark.parametrize("size", [8e-3, 80e-3, None])
def test_checks_of_a_model_with_a_free_residual_say_so(tmp_path, size):
    """What is simulated with the model file does not have that residual."""
    found = diagnosis_of(remaining(size or 0.0, within=size == 8e-3))
    if size is None:
        found = replace(found, unexplained=Unexplained(False), mismatch=False)
    check = Check(1.0, (0.5, 2.0), inside_before=False, inside_after=True)
    found = replace(found, posterior_predictive={"line": check})
    said = next(line for line in answer_lines(found) if line.startswith("checks:"))
    free = "" if size is None else " with the remaining residual as a free time series"
    assert said == f"checks: 1 statistics; the repaired model{free} passes all of them"
    write_diagnosis_report(tmp_path / "report.html", found, "ahrsd diagnose walk.csv")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ("the repaired model in model.json does not have it" in page) == (size is not None)


def test_page_marks_only_an_agreement_as_good(tmp_path):
    """Undecided, or unlike its simulations in a statistic, is neither good nor bad."""
    page, agreeing = tmp_path / "report.html", diagnosis_of(remaining(8e-3))
    plain = replace(agreeing, unexplained=Unexplained(False))
    unlike = {"line": Check(9.0, (1.0, 2.0), inside_before=False, inside_after=False)}
    marks = {
        "yes": (agreeing, plain, replace(agreeing, posterior_predictive=unlike)),
        "": (replace(plain, posterior_predictive=unlike), replace(plain, undecided="too short")),
        "no": (replace(plain, mismatch=True), diagnosis_of(remaining(80e-3, within=False))),
    }
    for mark, diagnoses in marks.items():
        for one in diagnoses:
            write_diagnosis_report(page, one, "ahrsd diagnose walk.csv")
            assert f'<p class="verdict {mark}">' in page.read_text(encoding="utf-8")


def test_residual_without_a_single_component_is_reported_as_a_whole():
    one = replace(remaining(0.0, there=False), field_gauss=3e-3, heading_deg=0.4)
    assert component_lines(one) == ["3 mG, 0.4 deg of heading, in no single component"]
    assert "3 mG, 0.4 deg of heading" in ordinary_text(one)


@pytest.mark.parametrize("name", list(EFFECTS))
def test_every_setting_key_is_either_reported_or_listed_as_unreported(name):
    context, readings = moving(5)
    settings = [*EFFECTS[name].settings(context), EFFECTS[name].example(readings, 1.0)[1]]
    keys = {key for setting in settings for key in setting}
    assert keys <= REPORTED_SETTINGS.keys() | UNREPORTED_SETTINGS.keys()
    assert not REPORTED_SETTINGS.keys() & UNREPORTED_SETTINGS.keys()


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({}, ""),
        ({"onset_s": 12.5, "searched": 40}, ""),
        (
            {"covariate": "motor_current_a", "reference": 0.2, "late_s": 0.2375, "mean_s": 0.4},
            "by the column motor_current_a; logged 0.237 s late; each value the mean of 0.4 s",
        ),
        (
            {"late_s": -0.05, "covariate": "heater"},
            "by the column heater; logged 0.05 s early",
        ),
        ({"covariate": "i_a", "late_s": 0.0, "mean_s": 0.0}, "by the column i_a"),
        (
            {"start_s": 3.0, "period_s": 2.0000012, "phase_s": 0.4, "width_s": 0.0612},
            "every 2 s; for 0.0612 s",
        ),
        ({"radius_gauss": 0.0063, "memory": (0.0, 0.5, 0.0)}, "half width of the loop 6.3 mG"),
        ({"time_constant_s": 1.2096}, "time constant 1.21 s"),
        ({"frequency_hz": 10.0031, "mains_hz": []}, "seen at 10 Hz"),
        (
            {"frequency_hz": 10.0031, "mains_hz": [50.0, 60.0]},
            "seen at 10 Hz; as an alias of mains at 50 or 60 Hz",
        ),
        ({"covariate": "rpm", "harmonic": 2, "off_hz": -0.012},
         "by the column rpm; 2 periods per turn of the shaft; 0.012 Hz slower than the column"),
        ({"hold_samples": 4, "phase": 3}, "each reading held for 4 samples"),
        ({"shape": "wave", "length_s": 40.0}, "shape: wave; lasts 40 s"),
        ({"covariate": "an\nodd name"}, "by the column an\\nodd name"),
    ],
)  # fmt: skip
def test_text_of_a_setting(setting, text):
    assert setting_text(setting) == text
