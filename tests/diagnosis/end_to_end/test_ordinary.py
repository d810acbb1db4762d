"""Size of the remaining residual, compared with fields of known size that were added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track

SAMPLES = 3000  # two minutes


@pytest.fixture(scope="module")
def made():
    return experiment("wam", seed=8, samples=SAMPLES)


def with_field(track: Track, added: np.ndarray) -> Track:
    return replace(track, mag_b_gauss=track.mag_b_gauss + added)


@pytest.mark.slow
def test_unlogged_current_is_unknown_and_not_ordinary_in_a_simulation(made):
    """A recording that is more probable without the ordinary remainder has no ordinary residual."""
    track = track_of(made)
    current = np.repeat(np.random.default_rng(3).uniform(0.0, 1.0, 30), SAMPLES // 30)
    added = current[:, None] * np.array([4e-3, -8e-3, 5e-3])
    found = diagnose(with_field(track, added))
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"
    assert found.unexplained.ordinary is None


@pytest.mark.slow
@pytest.mark.recordings
def test_rotated_board_is_ordinary_and_a_watch_near_the_sensor_is_not():
    board = diagnose(recorded("broad/02_undisturbed_slow_rotation_B"))
    assert not board.unexplained.detected
    assert board.unexplained.ordinary.field_gauss == pytest.approx(5.0e-3, rel=0.3)
    watch = diagnose(recorded("vn100_distorters/vn7Hard"))
    assert watch.unexplained.detected
    assert "a field on the sensor that varies with time" in watch.unexplained.ordinary.why


@pytest.mark.slow
@pytest.mark.recordings
def test_step_of_ordinary_size_is_reported_in_the_residual_with_time_and_size():
    """It is no finding, because such recordings have steps of this size, but it is reported as a
    part of the ordinary residual.
    """
    track = recorded("broad/02_undisturbed_slow_rotation_B")
    middle_s = float(np.mean(track.time_s[[0, -1]]))
    step = np.array([12e-3, -4e-3, -10e-3])
    found = diagnose(with_field(track, (track.time_s > middle_s)[:, None] * step))
    left = found.unexplained
    assert "hard_iron_step" not in [one.effect for one in found.findings]
    assert not left.detected
    (there,) = [one for one in left.ordinary.components if "hard_iron_step" in one.component]
    assert there.there
    assert f"at {middle_s:.0f} s" in there.words
    assert there.size == pytest.approx(np.linalg.norm(step) / 2, rel=0.25)  # about its mean
    assert there.size < there.up_to < 4 * there.size
    assert left.ordinary.field_gauss > there.size / 2
