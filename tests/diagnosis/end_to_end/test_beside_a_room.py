"""Names held against the spectrum of what is left; delays beside wider names."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.one_model.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@cache
def room(samples: int = 4000) -> Track:
    """A recording in whose remainder a field in sensor axes changes every eight seconds."""
    track = track_of(experiment("wam", motion="rov", samples=samples))
    pieces = np.floor(track.time_s / 8.0).astype(int)
    values = np.random.default_rng(8).normal(0.0, 4e-3, (pieces.max() + 1, 3))
    return replace(track, mag_b_gauss=track.mag_b_gauss + values[pieces])


def switched(track: Track) -> np.ndarray:
    """(N,) a lamp that is on for a few seconds now and then."""
    seconds = np.floor(track.time_s / 3.0).astype(int)
    return np.random.default_rng(9).integers(0, 2, seconds.max() + 1)[seconds].astype(float)


@pytest.mark.slow
def test_a_room_alone_gets_no_name():
    track = room()
    found = diagnose(replace(track, covariates={"lamp_on": switched(track)}))
    assert found.findings == ()
    assert found.unexplained.detected
