"""How an answer to a case of another author's is judged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from blind_trials.answers import read_answer
from blind_trials.judge import judge
from generators.truths import WORLDS, made, truth_of

pytestmark = pytest.mark.slow


def told(kind: str, *names: str, noise: str = "white") -> dict:
    effects = [
        {"effect": name, "onset_s": None, "frame": "sensor", "visibility_without_attitude": 20.0}
        for name in names
    ]
    return {"id": "x", "kind": kind, "noise": noise, "effects": effects, "what": ""}


def said(*names: str, unknown: bool = False) -> dict:
    findings = [{"effect": name, "confidence": 0.9, "alternatives": []} for name in names]
    return {
        "answer": {
            "mismatch": bool(names) or unknown,
            "findings": findings,
            "unexplained": {"detected": unknown, "where": {"frame": "sensor"}},
        },
        "failure": None,
        "cpu_seconds": 1.0,
        "said": "",
    }


@pytest.mark.parametrize(
    ("case", "answer", "word"),
    [
        (told("null"), said(), "quiet"),
        (told("null"), said("hard_iron_step"), "false name"),
        (told("null", noise="heavy_tailed_gaps"), said("dropped_samples", "noise_burst"), "quiet"),
        (told("single", "mag_time_lag"), said("gyro_time_lag"), "right"),
        (told("single", "mag_time_lag"), said("mag_time_lag", "eddy_current"), "name added"),
        (
            told("single", "gyro_scale", noise="red_gaps"),
            said("dropped_samples", "gyro_scale"),
            "right",
        ),
        (told("single", "eddy_current"), said("mag_time_lag"), "wrong name"),
        (told("single", "eddy_current"), said(), "missed"),
        (told("pair", "gyro_scale", "hard_iron_step"), said("clock_rate"), "one of two"),
        (told("withheld", "mag_bias_temperature"), said("hard_iron_drift"), "right"),
        (told("withheld", "motor_current_field"), said("hard_iron_step"), "false name"),
        (told("outside", "outside:passing_lorry"), said("field_anomaly"), "right"),
        (told("outside", "crane_slew"), said(unknown=True), "right"),
        (told("outside", "crane_slew"), said("moving_iron"), "false name"),
    ],
)
def test_the_word_for_an_answer(case: dict, answer: dict, word: str) -> None:
    assert judge(truth_of(case), read_answer(answer)).word == word


@pytest.mark.slow
@pytest.mark.parametrize("world", sorted(WORLDS))
def test_a_written_case_has_its_table_its_truth_and_a_spec_or_none(
    world: str, tmp_path: Path
) -> None:
    cases = list(made(world, tmp_path, 3, {"null": 1, "single": 1}))
    assert sorted(one.truth["kind"] for one in cases) == ["null", "single"]
    for one in cases:
        assert one.table.exists()
        assert one.spec is None or "sigma_mag_gauss" in json.loads(one.spec.read_text())
        for effect in one.truth["effects"]:
            assert effect["effect"] in effect["right"]
            assert effect["multiple"] > 0.0
