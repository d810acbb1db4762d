"""Whole diagnoses of short simulated recordings: findings, agreement, unknown causes, and facts
that stop.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose

SAMPLES, RATE_HZ = 8_000, 25.0


def answer(*effects, seed=3, samples=SAMPLES, **more):
    one = made(Trial(seed, tuple(effects), samples=samples, rate_hz=RATE_HZ, **more))
    return diagnose(one.track), one


@pytest.mark.slow  # a shorter one: test_undisturbed
@pytest.mark.parametrize("noise", ["white", "red"])
def test_undisturbed_recording_has_no_findings(noise):
    found, _ = answer(noise=noise)
    assert not found.mismatch
    assert found.findings == ()
    limits = {(x.effect, x.parameter): x.smallest for x in found.sensitivity}
    lag = limits[("mag_time_lag", "lag")]
    assert lag is not None and 0.0 < lag < 0.01


@pytest.mark.slow
def test_delay_is_found_with_its_size_and_not_as_a_low_pass():
    found, _ = answer(("mag_time_lag", 0.7))  # 20 ms would be half a sample
    assert [one.effect for one in found.findings] == ["mag_time_lag"]
    value = found.findings[0].parameters[0]
    assert abs(value.value - 0.014) < 4 * value.std < 2e-3
    assert found.findings[0].confidence > 0.5
    assert not found.unexplained.detected


@pytest.mark.slow
def test_slow_low_pass_is_a_single_finding():
    found, _ = answer(("mag_low_pass", 3.0))
    assert [one.effect for one in found.findings] == ["mag_low_pass"]
    assert found.findings[0].parameters[0].value == pytest.approx(0.09, abs=1e-3)


@pytest.mark.slow
def test_two_effects_are_both_found_and_nothing_else():
    found, one = answer(("hard_iron_step", 1.0), ("gyro_scale", 1.0), samples=5000)
    assert sorted(x.effect for x in found.findings) == ["gyro_scale", "hard_iron_step"]
    step = next(x for x in found.findings if x.effect == "hard_iron_step")
    _, value, setting = one.truth[0]
    assert abs(step.where.intervals_s[0][0] - setting["onset_s"]) < 1.0
    np.testing.assert_allclose([p.value for p in step.parameters], value, atol=1e-4)
    assert step.cost_if_left_out.hard_iron_shift_gauss > 2e-4


@pytest.mark.slow
def test_current_is_found_if_logged_and_unknown_if_not():
    seen, one = answer(("motor_current_field", 0.5))
    assert [x.effect for x in seen.findings] == ["motor_current_field"]
    np.testing.assert_allclose(
        [p.value for p in seen.findings[0].parameters], one.truth[0][1], atol=3e-5
    )
    hidden, _ = answer(("motor_current_field", 0.5), hidden=("motor_current_a",))
    assert hidden.findings == ()
    assert hidden.unexplained.detected
    assert hidden.unexplained.where.frame == "sensor"
    direction = np.array(hidden.unexplained.where.direction)
    k = one.truth[0][1] / np.linalg.norm(one.truth[0][1])
    assert abs(direction @ k) > 0.9


def test_swapped_axes_end_the_diagnosis():
    found, _ = answer(("frame_error", 1.0))
    assert [x.effect for x in found.findings] == ["frame_error"]
    assert found.baseline is None


@pytest.mark.slow
def test_answer_has_the_documented_json_form_and_is_deterministic():
    found, one = answer(("mag_time_lag", 1.0))
    body = found.to_json()
    assert body == diagnose(one.track).to_json()
    assert json.loads(json.dumps(body, allow_nan=False)) == body
    assert set(body) >= {
        "schema", "recording", "baseline", "mismatch", "p_value", "findings", "unexplained",
        "posterior_predictive",
    }  # fmt: skip
    assert set(body["findings"][0]) >= {
        "effect", "confidence", "alternatives", "where", "parameters", "heldout",
        "cost_if_left_out", "separate_from",
    }  # fmt: skip
