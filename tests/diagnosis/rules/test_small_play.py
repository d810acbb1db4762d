"""Hysteresis narrower than the noise of a reading."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.name import _of_own_noise
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.track import Spec


def play(values, radius):
    """The play operator, sample by sample, (N, 3)."""
    out = values.copy()
    for k in range(1, len(values)):
        out[k] = np.clip(out[k - 1], values[k] - radius, values[k] + radius)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("radius_gauss", [0.0007, pytest.param(0.003, marks=pytest.mark.slow)])
def test_a_small_play_is_named_once_with_its_width(radius_gauss):
    noisy = made(Trial(6, samples=8_000, rate_hz=25.0)).track
    clean = made(Trial(6, samples=8_000, rate_hz=25.0, sigma_mag=1e-9)).track.mag_b_gauss
    bent = noisy.mag_b_gauss + play(clean, radius_gauss) - clean
    (found,) = diagnose(replace(noisy, mag_b_gauss=bent)).findings
    assert found.effect == "hysteresis"
    widths = [one.value for one in found.parameters]
    np.testing.assert_allclose(widths, radius_gauss, rtol=0.1)


def test_a_play_no_wider_than_its_own_errors_is_none():
    """In red noise the field that a narrow play is made of holds the noise itself."""
    problem, cold = problem_of(made(Trial(3, samples=6000)).track, Spec(), EFFECTS, LIMITS)
    basis = formed_basis_of(State(problem, fit_null(problem.track, Spec(), cold, walk=False)))
    noise = basis.context.model.sigma_mag_gauss

    def of_own_noise(radius: float, width: float) -> bool:
        candidate = Candidate(EFFECTS["hysteresis"], {"radius_gauss": radius * noise}, 1, 0.0)
        return _of_own_noise(candidate, noise * np.array([0.1, -width, 0.0]), basis)

    assert of_own_noise(2.0, 0.4)  # `ring600j`, d77eb47b: 3.2 deviations, a width of 0.41
    assert of_own_noise(4.9, 0.49)
    assert not of_own_noise(1.1, 1.1)  # all of a narrow play
    assert not of_own_noise(5.1, 0.4)
    step = Candidate(EFFECTS["hard_iron_step"], {"onset_s": 30.0}, 1, 0.0)
    assert not _of_own_noise(step, noise * np.array([0.1, -0.4, 0.0]), basis)
