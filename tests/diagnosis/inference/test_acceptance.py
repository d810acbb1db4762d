"""Which members of a set are accepted, where each is certain only given the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from search_spaces import middle_setting, sets_of
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.decision.acceptance import accept_members
from ahrsd.samples import Array

ALONG = np.array([0.6, 0.64, 0.48])


def slow_process(time_s: Array, seed: int, highest_hz: float) -> Array:
    """(N,) white noise below a frequency, of variance one."""
    rng = np.random.default_rng(seed)
    frequency_hz = np.fft.rfftfreq(len(time_s), time_s[1] - time_s[0])
    spectrum = rng.normal(size=len(frequency_hz)) + 1j * rng.normal(size=len(frequency_hz))
    inside = (frequency_hz > 0.0) & (frequency_hz < highest_hz)
    values = np.fft.irfft(spectrum * inside, len(time_s))
    return np.asarray(values / values.std())


@pytest.mark.parametrize(("gauss", "accepted"), [(5e-4, False), (8e-4, True)])
def test_two_effects_have_to_exceed_one_free_process_by_what_both_require(gauss, accepted):
    """The field follows the difference of two logged columns, so each needs the other.

    A free process in time fits a difference that is slow nearly as well.
    """
    track = replace(track_of(experiment("wam", seed=21, samples=3000)), accel_b_m_s2=None)
    common, difference = (slow_process(track.time_s, *one) for one in ((1, 0.05), (2, 0.02)))
    columns = {
        "motor_current_a": 6.0 + 2.0 * (0.8 * common + 0.6 * difference),
        "speed_m_s": 2.0 + 0.5 * (0.8 * common - 0.6 * difference),
    }
    mag = track.mag_b_gauss + gauss * difference[:, None] * ALONG
    all_sets, space = sets_of(replace(track, mag_b_gauss=mag, covariates=columns))
    current, speed = (middle_setting(space, one) for one in ("motor_current_field", "speed_field"))
    pair, process = all_sets.judge({current, speed}), all_sets.judge({"free sensor"})
    for one in (current, speed):
        for without in ({one}, {one, "free sensor"}):
            assert pair.score - all_sets.judge(without).score > priors.NAME_ODDS
    assert (pair.score - process.score > 2 * priors.NAME_ODDS) == accepted
    members = accept_members(all_sets, space, pair)[0].names
    assert members == (frozenset({current, speed}) if accepted else frozenset({"free sensor"}))
