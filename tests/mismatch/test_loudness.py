"""Noise that comes and goes: each reading counts by the noise of its time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.mismatch.engine import diagnose


@pytest.mark.parametrize("seed", range(3))
def test_a_louder_time_leaves_no_unknown_behind(seed: int) -> None:
    made = experiment("wam", seed=seed, samples=6000)
    rng = np.random.default_rng([seed, 4])
    extra = np.zeros((6000, 3))
    for first in (900, 2200, 4100):
        extra[first : first + 180] = 5e-3 * rng.standard_normal((180, 3))
    track = track_of(made)
    said = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + extra), recording="louder")
    assert [one.effect for one in said.findings] == ["noise_burst"]
    assert not said.unexplained.detected
