"""Diagnoses with a gyro that is noisier than the magnetometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.answer.text import answer_lines, verdict
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.simulation import Experiment

STEP_GAUSS = np.array([1.6e-3, -1.2e-3, 0.0])


def _made(sigma_mag: float, sigma_gyro: float, scenario: str = "wam", seed: int = 0) -> Experiment:
    return experiment(
        scenario,
        motion="slow",
        seed=seed,
        samples=3000,
        sigma_mag=sigma_mag,
        sigma_gyro=sigma_gyro,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "seed"), [("wam", 3), ("lam", 1)])
def test_fit_like_those_of_null_simulations_is_no_mismatch(scenario: str, seed: int) -> None:
    """Without the comparison an unknown cause is found in the first case, with 1391 nats."""
    found = diagnose(track_of(_made(3.2e-4, 5.5e-2, scenario, seed)))
    assert not found.mismatch
    assert verdict(found) == "recording and model agree"
    assert found.p_value > 0.05
    for name, check in found.posterior_predictive.items():
        assert check.inside_after, name


@pytest.mark.slow
def test_magnetometer_without_noise_is_no_mismatch() -> None:
    found = diagnose(track_of(_made(0.0, 5e-3, "lam", 2)))
    assert verdict(found) == "recording and model agree"


@pytest.mark.slow
def test_no_verdict_when_no_null_simulation_can_be_fitted(monkeypatch) -> None:
    """The evidence may be chance, and it is unknown how much evidence chance alone produces."""
    track = track_of(_made(1e-4, 5e-2))
    since = (np.arange(len(track)) >= 1500)[:, None]
    stepped = replace(track, mag_b_gauss=track.mag_b_gauss + since * STEP_GAUSS)

    def diverging_fit(*_, **__):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr("ahrsd.diagnosis.answer.null_simulations.fit_null", diverging_fit)
    found = diagnose(stepped)
    assert found.findings == ()
    assert verdict(found) == (
        "no verdict: of 16 simulations of the calibration model alone, with this noise, only 0 can "
        "be fitted"
    )
    assert "would have shown" not in "\n".join(answer_lines(found))
    assert found.to_json()["undecided"].startswith("of 16 simulations")


@pytest.mark.slow
def test_nothing_is_simulated_when_the_gyro_is_less_noisy() -> None:
    track = track_of(_made(1e-3, 5e-3))
    since = (np.arange(len(track)) >= 1500)[:, None]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + 5 * since * STEP_GAUSS))
    assert found.mismatch
    assert not any("noisier than the magnetometer" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="simulations of the null model have a false drift there")
def test_step_far_beyond_the_null_simulations_is_found() -> None:
    """2 mG of hard iron at a noise of 0.1 mG and 50 mrad/s."""
    track = track_of(_made(1e-4, 5e-2))
    since = (np.arange(len(track)) >= 1500)[:, None]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + since * STEP_GAUSS))
    assert [one.effect for one in found.findings] == ["hard_iron_step"]
    sizes = [value.value for value in found.findings[0].parameters]
    assert sizes == pytest.approx(STEP_GAUSS.tolist(), abs=3e-4)
    assert any("(seeds 0 to 4), show no effect" in note for note in found.notes)
