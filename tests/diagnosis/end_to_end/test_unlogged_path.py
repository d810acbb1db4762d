"""A field that varies along an unlogged path."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.simulation import simulate

PLACES = ("position_north_m", "position_east_m", "position_down_m")


@pytest.mark.slow
def test_field_along_an_unlogged_path_is_unknown_in_the_world_frame():
    """Three gains of an on-board calibration once followed it to a quarter of a percent."""
    trial = made(Trial(2, (), PLACES, scenario="lam", samples=4000))
    R_nb = simulate(trial.settings).R_nb
    rng, track = np.random.default_rng(2), trial.track
    phase = np.pi * (track.time_s - track.time_s[0]) / track.duration_s
    field_n = 1.5e-3 * sum(
        np.cos(j * phase + rng.uniform(0, 6.28))[:, None] * rng.standard_normal(3) * j**-1.5
        for j in range(2, 9)
    )
    mag = track.mag_b_gauss + np.einsum("nji,nj->ni", R_nb, field_n)
    found = diagnose(replace(track, mag_b_gauss=mag))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "world"
