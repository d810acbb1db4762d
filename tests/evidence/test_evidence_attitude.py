"""Attitude of a segment compared with the truth; the first-order bias correction; gravity."""

import numpy as np
import pytest

from ahrsd.evidence.segments import SegmentHistory, integrate_attitude, join_tracks


def segments(scene):
    history = SegmentHistory()
    for _, part in history.split(scene.block()):
        history.add(part)
    history.close_segment()
    return history.segments


def test_attitude_follows_the_truth(world) -> None:
    scene = world.Scene(duration_s=60.0, noise_rad_s=0.0)
    for t in (integrate_attitude(s, world.BIAS) for s in segments(scene)):
        truth = scene.attitude(t.time_s)
        start = scene.attitude(t.segment.time_s[:1])[0]
        expected = (start.inv() * truth).as_matrix()
        assert np.max(np.linalg.norm(t.R_0b - expected, axis=(1, 2))) < 2e-3


def test_bias_correction_is_first_order(world) -> None:
    """d R_0k / d bias by P_k, against integrating again."""
    segment = segments(world.Scene(duration_s=40.0))[0]
    step = np.array([3e-4, -4e-4, 5e-4])
    moved = join_tracks([integrate_attitude(segment, world.BIAS)], world.BIAS + step)
    again = integrate_attitude(segment, world.BIAS + step)
    shift = np.linalg.norm(again.R_0b - integrate_attitude(segment, world.BIAS).R_0b, axis=(1, 2))
    assert np.max(shift) > 1e-2
    assert np.max(np.linalg.norm(moved.R_0b - again.R_0b, axis=(1, 2))) < 2e-4
    assert integrate_attitude(segment, world.BIAS).usable_for(world.BIAS + step)
    assert not integrate_attitude(segment, world.BIAS).usable_for(world.BIAS + 10 * step)


@pytest.mark.parametrize("forward_m_s2", [0.0, 2.0])
def test_gravity_is_found_while_the_vehicle_accelerates(world, forward_m_s2) -> None:
    scene = world.Scene(duration_s=90.0, forward_m_s2=forward_m_s2)
    nodes = join_tracks([integrate_attitude(s, world.BIAS) for s in segments(scene)], world.BIAS)
    down_b = scene.attitude(nodes.time_s).inv().apply([0.0, 0.0, 1.0])
    off_deg = np.degrees(np.arccos(np.clip(np.sum(down_b * nodes.down_b, axis=1), -1, 1)))
    assert np.max(off_deg) < (0.3 if forward_m_s2 == 0 else 1.5)


def test_selected_segments_equal_those_joined_alone(world) -> None:
    tracks = [integrate_attitude(s, world.BIAS) for s in segments(world.Scene(duration_s=100.0))]
    nodes = join_tracks(tracks, world.BIAS)
    some = nodes.select(np.array([False, True, False, True]))
    direct = join_tracks([tracks[1], tracks[3]], world.BIAS)
    np.testing.assert_allclose(some.R_0b, direct.R_0b)
    np.testing.assert_array_equal(some.starts, direct.starts)
    np.testing.assert_allclose(some.down_b, direct.down_b)
    assert some.tracks == (tracks[1], tracks[3])
    assert nodes.select(np.zeros(4, dtype=bool)) is None
    assert join_tracks([], world.BIAS) is None
