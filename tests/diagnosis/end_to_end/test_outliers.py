"""A few outliers are no physical cause."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
def test_outliers_are_not_an_object_or_a_step():
    track = made(Trial(9, samples=4_500, rate_hz=25.0)).track
    rng = np.random.default_rng(4)
    mag = track.mag_b_gauss.copy()
    rows = rng.choice(len(mag), 24, replace=False)
    mag[rows] += 12 * 6e-4 * rng.standard_normal((24, 3))
    found = diagnose(replace(track, mag_b_gauss=mag))
    assert found.findings == ()
    assert not found.unexplained.detected
