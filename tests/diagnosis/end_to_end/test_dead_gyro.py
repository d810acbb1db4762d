"""A gyro with constant readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.data_quality.stuck import dead_sensor_reason
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return track_of(experiment("mam", samples=6000, seed=3))


@pytest.mark.parametrize("value", [0.0, 0.013])
def test_constant_gyro_is_refused_when_the_field_turns(track: Track, value: float) -> None:
    still = replace(track, gyro_b_rad_s=np.full_like(track.gyro_b_rad_s, value))
    why = dead_sensor_reason(still)
    assert why is not None
    assert f"the gyro reads {value:g} {value:g} {value:g} rad/s in every row" in why
    assert "it is stuck or was not logged" in why
    with pytest.raises(ValueError, match="stuck or was not logged"):
        diagnose(still)
