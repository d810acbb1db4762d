"""Hysteresis narrower than the noise of a reading."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


def play(values, radius):
    """The play operator, sample by sample, (N, 3)."""
    out = values.copy()
    for k in range(1, len(values)):
        out[k] = np.clip(out[k - 1], values[k] - radius, values[k] + radius)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("radius_gauss", [0.0007, pytest.param(0.003, marks=pytest.mark.slow)])
def test_small_hysteresis_is_a_single_finding_with_its_width(radius_gauss):
    noisy = made(Trial(6, samples=8_000, rate_hz=25.0)).track
    clean = made(Trial(6, samples=8_000, rate_hz=25.0, sigma_mag=1e-9)).track.mag_b_gauss
    bent = noisy.mag_b_gauss + play(clean, radius_gauss) - clean
    (found,) = diagnose(replace(noisy, mag_b_gauss=bent)).findings
    assert found.effect == "hysteresis"
    widths = [one.value for one in found.parameters]
    np.testing.assert_allclose(widths, radius_gauss, rtol=0.1)
