"""Segments: roles, gaps, averages, bounded memory."""

from dataclasses import replace

import numpy as np
import pytest

from ahrsd.evidence.segments import HistoryParameters, SegmentHistory
from ahrsd.samples import SampleBlock


def block(start_s=0.0, seconds=1.0, rate_hz=100.0, *, turn=0.0, gap=False, epoch=0):
    t = start_s + np.arange(round(seconds * rate_hz)) / rate_hz
    n = len(t)
    gyro = np.tile([0.0, 0.0, turn], (n, 1))
    mag = np.column_stack([t, -t, np.ones(n)])
    dt = np.full(n, 1 / rate_hz)
    return SampleBlock(t, dt, t, mag, gyro, np.tile([0, 0, -9.81], (n, 1)), {}, epoch, gap)


def fill(history: SegmentHistory, start_s: float, end_s: float, **given) -> None:
    for t in np.arange(start_s, end_s):
        for _, part in history.split(block(float(t), **given)):
            history.add(part)


def test_every_fourth_slot_of_thirty_seconds_is_held_out() -> None:
    history = SegmentHistory()
    fill(history, 100.0, 350.0)
    history.close_segment()
    assert [s.heldout for s in history.segments] == [False] * 3 + [True] + [False] * 3 + [True] + [
        False
    ]
    assert [round(float(s.time_s[0])) for s in history.segments] == list(range(100, 350, 30))
    assert history.role(block(350.0)) == "train"
    assert history.role(block(425.0)) == "train"
    assert history.role(block(450.5)) == "heldout"


def test_roles_do_not_depend_on_the_block_size() -> None:
    whole = block(0.0, 250.0)
    one, many = SegmentHistory(), SegmentHistory()
    for _, part in one.split(whole):
        one.add(part)
    fill(many, 0.0, 250.0)
    one.close_segment()
    many.close_segment()
    assert len(one.segments) == len(many.segments) == 9
    for a, b in zip(one.segments, many.segments, strict=True):
        assert a.heldout == b.heldout
        np.testing.assert_allclose(a.time_s, b.time_s)
        np.testing.assert_allclose(a.raw_b_gauss, b.raw_b_gauss)


def test_parts_are_disjoint_and_complete_with_gaps_at_role_changes() -> None:
    history = SegmentHistory()
    parts = history.split(block(0.0, 125.0))
    assert [role for role, _ in parts] == ["train"] * 3 + ["heldout", "train"]
    assert [part.gap_before for _, part in parts] == [False, False, False, True, True]
    np.testing.assert_array_equal(
        np.concatenate([p.time_s for _, p in parts]), block(0.0, 125.0).time_s
    )
    assert [float(p.time_s[0]) for _, p in parts] == [0.0, 30.0, 60.0, 90.0, 120.0]


def test_averaged_quantities_refer_to_one_instant() -> None:
    """At 100 Hz four samples are averaged; a field linear in time and the angle give the same
    time.
    """
    history = SegmentHistory()
    fill(history, 0.0, 20.0, turn=0.5)
    history.close_segment()
    segment = history.segments[0]
    assert segment.averaged == 4
    np.testing.assert_allclose(np.diff(segment.time_s), 0.04)
    np.testing.assert_allclose(segment.raw_b_gauss[:, 0], segment.time_s, atol=1e-12)
    np.testing.assert_allclose(segment.angle_b_rad[1:, 2], 0.5 * 0.04, atol=1e-12)
    assert segment.angle_b_rad[0, 2] == 0.0
    assert segment.turned_rad == pytest.approx(0.5 * 20, rel=0.01)


@pytest.mark.parametrize("change", [{"gap_before": True}, {"epoch": 1}])
def test_gap_and_new_register_epoch_end_a_segment(change) -> None:
    history = SegmentHistory()
    fill(history, 0.0, 10.0)
    history.add(replace(block(10.5), **change))
    fill(history, 12.0, 20.0, epoch=change.get("epoch", 0))
    history.close_segment()
    assert [float(s.time_s[0]) for s in history.segments] == pytest.approx([0.015, 10.515])


def test_non_finite_sample_ends_the_segment() -> None:
    history = SegmentHistory()
    fill(history, 0.0, 10.0)
    bad = block(10.0)
    bad.raw_b_gauss[3, 1] = np.nan
    history.add(bad)
    fill(history, 11.0, 20.0)
    history.close_segment()
    assert [len(s) for s in history.segments] == [250, 225]
    assert all(np.isfinite(s.raw_b_gauss).all() for s in history.segments)


def test_clock_restart_starts_a_segment() -> None:
    history = SegmentHistory()
    fill(history, 1000.0, 1010.0)
    fill(history, 0.0, 10.0)
    history.close_segment()
    assert [float(s.time_s[0]) for s in history.segments] == pytest.approx([1000.015, 0.015])
    assert history.role(block(95.0)) == "heldout"


def test_memory_is_bounded_and_rest_is_dropped_first() -> None:
    history = SegmentHistory(HistoryParameters(segment_s=10.0, segments=8))
    fill(history, 0.0, 40.0, turn=0.5, rate_hz=10)
    fill(history, 40.0, 60.0, rate_hz=10)
    fill(history, 60.0, 200.0, turn=0.5, rate_hz=10)
    history.close_segment()
    assert len(history.segments) == 8
    assert all(s.turned_rad > 1.0 for s in history.segments)
    quiet = SegmentHistory(HistoryParameters(segment_s=10.0, segments=8))
    fill(quiet, 0.0, 40.0, turn=0.5, rate_hz=10)
    fill(quiet, 40.0, 200.0, rate_hz=10)
    quiet.close_segment()
    assert [s.turned_rad > 1.0 for s in quiet.segments] == [True] * 4 + [False] * 4


def test_empty_block_changes_nothing() -> None:
    history = SegmentHistory()
    history.add(block(0.0, 0.0))
    assert history.split(block(0.0, 0.0)) == []
    assert history.role(block(0.0, 0.0)) == "train"
    assert history.segments == []
