"""Figures of a trial: new and old registers compared on the same raw samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock
from ahrsd.writeback.trial import LiveTrial, Trial, TrialPolicy, TrialVerdict

RATE_HZ = 40.0
FIELD_N = np.array([0.24, 0.0, 0.42])
RIGHT = Affine(np.eye(3), np.array([0.05, -0.03, 0.02]))
IDENTITY = Affine.identity()
NO_BIAS = np.zeros(3)


def circle(
    seconds: float, turns: float, *, start_s: float = 0.0, force: bool = True
) -> SampleBlock:
    """A level turn to the right of a sensor with hard iron `RIGHT.offset` and no noise."""
    count = round(seconds * RATE_HZ)
    time_s = start_s + np.arange(count) / RATE_HZ
    rate = 2 * np.pi * turns / seconds
    yaw = rate * (time_s - start_s)
    R_nb = so3.exp(np.column_stack([np.zeros((count, 2)), yaw]))
    accel = np.tile([0.0, 0.0, -9.81], (count, 1)) if force else np.full((count, 3), np.nan)
    return SampleBlock(
        time_s=time_s,
        dt_s=np.full(count, 1.0 / RATE_HZ),
        host_s=time_s,
        raw_b_gauss=FIELD_N @ R_nb + RIGHT.offset,
        gyro_b_rad_s=np.tile([0.0, 0.0, rate], (count, 1)),
        accel_b_m_s2=accel,
    )


def pieces(block: SampleBlock, rows: int = 10) -> list[SampleBlock]:
    return [
        SampleBlock(*(getattr(block, name)[at : at + rows] for name in (
            "time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2",
        )))
        for at in range(0, len(block), rows)
    ]  # fmt: skip


def run(trial: LiveTrial, block: SampleBlock):
    for piece in pieces(block):
        metrics = trial.take(piece)
    return metrics


def test_figure_is_the_spread_of_the_field_magnitude():
    block = circle(30.0, 2.0)
    metrics = run(LiveTrial(RIGHT, IDENTITY, NO_BIAS), block)
    assert metrics.new_figure == pytest.approx(0.0, abs=1e-12)
    norms = np.linalg.norm(block.raw_b_gauss[::4], axis=1)
    assert metrics.old_figure == pytest.approx(norms.std() / norms.mean(), rel=0.02)
    assert metrics.old_figure > 0.03
    assert metrics.field_spread == metrics.new_figure
    assert metrics.finite


def test_turns_and_duration_equal_those_of_the_motion():
    metrics = run(LiveTrial(RIGHT, IDENTITY, NO_BIAS), circle(30.0, 2.0))
    assert metrics.turns == pytest.approx(2.0, rel=1e-6)
    assert metrics.duration_s == pytest.approx(30.0 - 1 / RATE_HZ)


def test_gyro_bias_is_not_counted_as_turns():
    still = circle(30.0, 0.0)
    biased = SampleBlock(
        still.time_s, still.dt_s, still.host_s, still.raw_b_gauss,
        still.gyro_b_rad_s + np.array([0.0, 0.0, 0.05]), still.accel_b_m_s2,
    )  # fmt: skip
    known = run(LiveTrial(RIGHT, IDENTITY, np.array([0.0, 0.0, 0.05])), biased)
    assert known.turns == pytest.approx(0.0, abs=1e-9)
    assert run(LiveTrial(RIGHT, IDENTITY, NO_BIAS), biased).turns == pytest.approx(0.2387, rel=1e-3)


def test_heading_jump_is_the_difference_of_the_headings_at_the_change():
    """Heading north: hard iron (0.05, -0.03) rotates the heading in 0.24 G by atan2(0.03, 0.29)."""
    metrics = run(LiveTrial(RIGHT, IDENTITY, NO_BIAS), circle(5.0, 0.0))
    assert metrics.heading_jump_deg == pytest.approx(-np.degrees(np.arctan2(0.03, 0.29)), abs=1e-9)


def test_heading_jump_uses_only_the_first_seconds():
    trial = LiveTrial(RIGHT, IDENTITY, NO_BIAS)
    early = run(trial, circle(3.0, 0.0)).heading_jump_deg
    later = run(trial, circle(20.0, 0.5, start_s=3.0)).heading_jump_deg
    assert later == pytest.approx(early)


def gapped(yaws_deg: list[float], seconds: float, gap_s: float) -> SampleBlock:
    """Samples at rest at these headings for some seconds each, with a gap before each."""
    parts = []
    for k, yaw in enumerate(yaws_deg):
        part = circle(seconds, 0.0, start_s=100.0 + k * (seconds + gap_s))
        R_nb = so3.exp(np.array([[0.0, 0.0, np.radians(yaw)]]))[0]
        raw = np.tile(FIELD_N @ R_nb + RIGHT.offset, (len(part), 1))
        parts.append(replace(part, raw_b_gauss=raw))
    names = ("time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")
    return SampleBlock(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def jump_deg(yaw_deg: float) -> float:
    """Heading jump at one heading between the factory registers and the correct ones."""
    x, y = 0.24 * np.cos(np.radians(yaw_deg)), -0.24 * np.sin(np.radians(yaw_deg))
    old_deg = np.degrees(np.arctan2(-(y - 0.03), x + 0.05))
    return float((yaw_deg - old_deg + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize("rows", [5, 40, 10_000])
def test_gaps_and_large_blocks_do_not_change_the_heading_jump(rows):
    """For any block size. Over a turn the mean field is not that of a heading: the mean of four
    headings a quarter turn apart contains only the hard iron, from which the old registers
    give an arbitrary heading.
    """
    yaws = [0.0, 90.0, 180.0, 270.0]
    block = gapped(yaws, 0.5, 8.0)
    trial = LiveTrial(RIGHT, IDENTITY, NO_BIAS)
    for piece in pieces(block, rows):
        metrics = trial.take(piece)
    expected = float(np.mean([jump_deg(yaw) for yaw in yaws]))
    assert metrics.heading_jump_deg == pytest.approx(expected, abs=0.05)
    assert max(abs(jump_deg(yaw)) for yaw in yaws) < 15.0


def test_gap_after_the_write_does_not_shorten_the_heading_jump():
    trial = LiveTrial(RIGHT, IDENTITY, NO_BIAS)
    trial.take(circle(0.5, 0.0))  # at rest facing north
    far = gapped([180.0], 10.0, 0.0)  # half a minute later facing south
    metrics = run(trial, far)
    expected = (0.5 * jump_deg(0.0) + 2.5 * jump_deg(180.0)) / 3.0
    assert metrics.heading_jump_deg == pytest.approx(expected, abs=0.2)


def test_heading_jump_is_measured_only_when_level():
    """When rolled, the hard iron of z rotates the heading too, and the jump was predicted for
    level.
    """
    level = circle(5.0, 0.0)
    side = so3.exp(np.array([[np.radians(70.0), 0.0, 0.0]]))[0]
    rolled = replace(
        level, raw_b_gauss=FIELD_N @ side + np.tile(RIGHT.offset, (len(level), 1)),
        accel_b_m_s2=level.accel_b_m_s2 @ side,
    )  # fmt: skip
    trial = LiveTrial(RIGHT, IDENTITY, NO_BIAS)
    assert run(trial, rolled).heading_jump_deg is None
    jump = run(trial, circle(5.0, 0.0, start_s=5.0)).heading_jump_deg
    assert jump == pytest.approx(-np.degrees(np.arctan2(0.03, 0.29)), abs=1e-9)


@pytest.mark.parametrize("roll_deg", [-14.0, 0.0, 14.0])
@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, 200.0])
def test_small_tilt_does_not_change_the_heading_jump(roll_deg, yaw_deg):
    """The jump was predicted for level, so a vertical hard iron must not contribute."""
    iron = Affine(np.eye(3), np.array([0.05, -0.03, 0.25]))
    still = circle(5.0, 0.0)
    yaw, roll = np.radians(yaw_deg), np.radians(roll_deg)
    R_nb = so3.exp(np.array([[0.0, 0.0, yaw]]))[0] @ so3.exp(np.array([[roll, 0.0, 0.0]]))[0]
    rolled = replace(
        still,
        raw_b_gauss=np.tile(FIELD_N @ R_nb + iron.offset, (len(still), 1)),
        accel_b_m_s2=np.tile(np.array([0.0, 0.0, -9.81]) @ R_nb, (len(still), 1)),
    )
    jump = run(LiveTrial(iron, IDENTITY, NO_BIAS), rolled).heading_jump_deg
    assert jump == pytest.approx(jump_deg(yaw_deg), abs=1e-6)


def test_only_the_figure_is_available_without_specific_force():
    metrics = run(LiveTrial(RIGHT, IDENTITY, NO_BIAS), circle(30.0, 2.0, force=False))
    assert metrics.heading_jump_deg is None
    assert metrics.turns == 0.0
    assert metrics.new_figure == pytest.approx(0.0, abs=1e-12)


def test_figure_covers_the_newest_minute():
    trial = LiveTrial(IDENTITY, RIGHT, NO_BIAS)
    assert run(trial, circle(60.0, 2.0)).new_figure > 0.03
    assert run(trial, circle(61.0, 0.0, start_s=60.0)).new_figure < 1e-12


def test_single_sample_has_no_spread():
    metrics = LiveTrial(RIGHT, IDENTITY, NO_BIAS).take(pieces(circle(1.0, 0.0), 1)[0])
    assert not metrics.finite


def at_rest(seconds: float, *, noise_gauss: float, bias_b_rad_s: np.ndarray) -> SampleBlock:
    """A vehicle at rest with its longitudinal axis along the axis that the matrix below
    shortens.
    """
    draw = np.random.default_rng(5)
    block = circle(seconds, 0.0)
    field = np.array([0.5, 0.0, 0.0]) + RIGHT.offset
    return replace(
        block,
        raw_b_gauss=field + noise_gauss * draw.standard_normal((len(block), 3)),
        gyro_b_rad_s=bias_b_rad_s + 1e-3 * draw.standard_normal((len(block), 3)),
    )


def judged(trial: LiveTrial, block: SampleBlock) -> list[str]:
    """Reasons why the trial fails, piece by piece."""
    rules = Trial(TrialPolicy(), 90.0)
    found = [rules.judge(trial.take(piece)) for piece in pieces(block)]
    return [reason for finding, reason in found if finding is TrialVerdict.FAILED]


def test_noise_amplified_by_the_matrix_is_not_judged_at_rest():
    flat = Affine(np.diag([0.8, 1.1, 1.0 / 0.88]), RIGHT.offset)
    block = at_rest(200.0, noise_gauss=2e-3, bias_b_rad_s=NO_BIAS)
    trial = LiveTrial(flat, RIGHT, NO_BIAS)
    assert judged(trial, block) == []
    metrics = trial.take(pieces(block)[-1])
    assert not metrics.turned
    assert metrics.new_swing > 1.1 * run(LiveTrial(RIGHT, RIGHT, NO_BIAS), block).new_swing


def test_wrong_gyro_bias_is_found_at_rest():
    bias = np.array([0.0, 0.01, 0.0])
    block = at_rest(200.0, noise_gauss=2e-3, bias_b_rad_s=bias)
    reasons = judged(LiveTrial(RIGHT, IDENTITY, NO_BIAS, bias), block)
    assert reasons
    assert "propagated by the gyroscope" in reasons[0]
