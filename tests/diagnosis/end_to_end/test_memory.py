"""Magnetisation from before the recording is a part of its effect, not a step in the first
seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model.forward import terms_contribution


def test_play_operator_starts_from_its_memory() -> None:
    values = np.array([[0.0], [0.2], [-0.3], [-0.8], [1.0], [0.9]])
    middle = time_series.play_operator(values, 0.5, (1.0,))[:, 0]
    np.testing.assert_allclose(middle, [0.5, 0.5, 0.2, -0.3, 0.5, 0.5], atol=1e-12)
    assert (
        time_series.play_operator(values, 0.5, (0.0,)).tolist()
        == time_series.play_operator(values, 0.5).tolist()
    )


@pytest.mark.slow
@pytest.mark.parametrize("memory", [(1.0, -1.0, 1.0), (0.5, -0.75, 1.0)])
def test_hysteresis_is_found_with_its_memory_as_the_only_finding(memory) -> None:
    track = made(Trial(5, scenario="wam", samples=6000)).track
    setting = {"radius_gauss": 0.03, "memory": memory}
    value = np.array([2e-3, 2.5e-3, 3e-3])
    term = Term("hysteresis", value, np.zeros(3), setting)
    added, _ = terms_contribution(fit_null(track).context(), [term])
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert [one.effect for one in found.findings] == ["hysteresis"]
    assert not found.unexplained.detected
    assert found.findings[0].setting["memory"] == pytest.approx(memory, abs=0.26)
    assert abs(found.findings[0].setting["radius_gauss"] - 0.03) < 1e-3


def test_low_pass_starts_from_its_memory() -> None:
    values = np.array([[1.0], [1.0], [1.0], [2.0], [2.0]])
    dt_s = np.array([np.nan, 0.5, 0.5, np.nan, 0.5])  # the second run begins settled
    slow = time_series.low_pass(values, dt_s, 2.0, (0.3,))[:, 0]
    expected = [1.3, 1 + 0.3 * np.exp(-0.25), 1 + 0.3 * np.exp(-0.5), 2.0, 2.0]
    np.testing.assert_allclose(slow, expected, atol=1e-12)


@pytest.mark.slow
def test_unsettled_viscous_magnetisation_is_not_a_step_or_drift() -> None:
    track = made(Trial(6, scenario="wam", samples=2500)).track
    setting = {"time_constant_s": 25.0, "memory": (0.3, -0.25, 0.2)}
    value = np.array([0.02, 0.012, -0.008, 0.004, -0.006, 0.005])
    term = Term("viscous_magnetisation", value, np.zeros(6), setting)
    added, _ = terms_contribution(fit_null(track).context(), [term])
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert [one.effect for one in found.findings] == ["viscous_magnetisation"]
    assert not found.unexplained.detected
    seen = found.findings[0]
    np.testing.assert_allclose(seen.setting["memory"], setting["memory"], atol=0.05)
    assert abs(seen.setting["time_constant_s"] / 25.0 - 1) < 0.15


@pytest.mark.slow
def test_settled_viscous_magnetisation_has_no_memory() -> None:
    track = made(Trial(6, (("viscous_magnetisation", 2.0),), scenario="wam", samples=6000)).track
    (seen,) = diagnose(track).findings
    assert seen.effect == "viscous_magnetisation"
    assert "memory" not in seen.setting
