"""A recording without faults, which the tests modify."""

from __future__ import annotations

import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return track_of(experiment("mam", samples=6000, seed=3))
