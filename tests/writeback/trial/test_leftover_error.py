"""A trial separates correct from wrong registers by a statistic of its own noise, with a margin."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock
from ahrsd.writeback.trial import (
    Leftover,
    LeftoverError,
    LiveTrial,
    Trial,
    TrialMetrics,
    TrialPolicy,
    TrialVerdict,
)

FIELD_N = np.array([0.24, 0.0, 0.42])
TRUE = Affine(np.diag([1.05, 1.0, 0.95]), np.array([0.05, -0.03, 0.02]))
OLD = Affine.identity()
NOISES = (0.0005, 0.002, 0.005, 0.01)  # gauss per axis: 0.1 to 2 % of the field
EXTREMES = ((NOISES[0], "tumble"), (NOISES[-1], "level"))
SEEDS = range(6)


def driven(seed: int, noise_gauss: float, motion: str, *, places: bool = False) -> SampleBlock:
    """Four minutes at 10 Hz: level circles or tumbling, optionally with places whose fields
    differ by 2 %.
    """
    draw = np.random.default_rng(seed)
    time_s = 0.1 * np.arange(2400)
    yaw = 0.35 * time_s + draw.uniform(0, 6)
    tilt = (0.1 if motion == "level" else 0.8) * np.column_stack(
        [np.sin(0.9 * time_s + draw.uniform(0, 6)), np.sin(0.6 * time_s + draw.uniform(0, 6))]
    )
    R_nb = so3.exp(np.column_stack([0 * yaw, 0 * yaw, yaw])) @ so3.exp(
        np.column_stack([tilt, 0 * yaw])
    )
    strength = np.ones(len(time_s))
    if places:  # another place for each half circle, so that heading and place are correlated
        strength += 0.02 * np.sign(np.sin(yaw)) * (np.floor(time_s / 30.0) % 2)
    true = strength[:, None] * np.einsum("kji,j->ki", R_nb, FIELD_N)
    raw = true @ np.linalg.inv(TRUE.matrix).T + TRUE.offset
    raw += noise_gauss * draw.normal(size=raw.shape)
    # slow noise: passing steel, the vehicle's own currents
    slow = np.convolve(draw.normal(size=len(time_s) + 19), np.ones(20) / np.sqrt(20), "valid")
    raw += 0.5 * noise_gauss * slow[:, None] * draw.normal(size=3)
    accel = np.einsum("kji,j->ki", R_nb, np.array([0.0, 0.0, -9.81]))
    dt_s = np.full(len(time_s), 0.1)
    gyro = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:]) / 0.1
    return SampleBlock(time_s, dt_s, time_s, raw, np.vstack([gyro[:1], gyro]), accel)


def judged(written: Affine, block: SampleBlock) -> tuple[float, list[TrialVerdict]]:
    """The excess error in sigmas at the end, and all findings until then."""
    policy = TrialPolicy(duration_s=1e9, turns=1e9)
    limit, trial = 0.01 * policy.max_wrong_percent, Trial(policy, 180.0)
    error, findings, left = LeftoverError(), [], Leftover()
    for k, (time_s, field) in enumerate(zip(block.time_s, block.raw_b_gauss, strict=True)):
        error.add(float(time_s), written.apply(field[None])[0])
        if k % 20 == 19:
            left = error.leftover(limit)
            figures = {"wrong": left.share, "wrong_sigmas": left.sigmas}
            findings.append(trial.judge(TrialMetrics(time_s, 9.0, 0.01, 0.02, 0.01, **figures))[0])
    return left.sigmas, findings


def test_live_trial_reports_the_excess_error():
    block = driven(3, 0.002, "tumble")
    off = Affine(TRUE.matrix, TRUE.offset + np.array([0.02, 0.015, 0.0]))
    for written, wrong in ((TRUE, False), (off, True)):
        live = LiveTrial(written, OLD, np.zeros(3))
        for at in range(0, len(block), 20):
            names = ("time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")
            metrics = live.take(SampleBlock(*(getattr(block, n)[at : at + 20] for n in names)))
        assert (metrics.wrong > 0.01) is wrong
        assert (metrics.wrong_sigmas > 6.0) is wrong
        assert metrics.old_wrong > 0.03


@pytest.mark.parametrize(
    ("noise_gauss", "motion"),
    [
        pytest.param(one, motion, marks=() if (one, motion) in EXTREMES else pytest.mark.slow)
        for one in NOISES
        for motion in ("level", "tumble")
    ],
)
def test_correct_and_wrong_registers_are_separated_at_every_noise_level(noise_gauss, motion):
    """25 mG, about 6 deg of heading, or six times a larger noise; the limit is 2.5."""
    right, wrong = [], []
    for seed in SEEDS:
        block = driven(seed, noise_gauss, motion)
        off = np.random.default_rng(1000 + seed).normal(size=3) * [
            1,
            1,
            0,
        ]  # accuracy that the heading needs
        off *= max(0.025, 6.0 * noise_gauss) / np.linalg.norm(off)
        sigmas, findings = judged(TRUE, block)
        right.append(sigmas)
        assert TrialVerdict.FAILED not in findings
        sigmas, findings = judged(Affine(TRUE.matrix, TRUE.offset + off), block)
        wrong.append(sigmas)
        assert TrialVerdict.FAILED in findings
    print(
        f"{noise_gauss} {motion}: right at most {max(right):.1f}, wrong at least {min(wrong):.1f}"
    )
    assert max(right) < 0.0
    assert min(wrong) > (3.5 if noise_gauss > 0.005 else 6.0)


@pytest.mark.parametrize("motion", ["level", "tumble"])
def test_varying_field_between_places_does_not_fail_correct_registers(motion):
    for seed in SEEDS:
        sigmas, findings = judged(TRUE, driven(seed, 0.002, motion, places=True))
        assert sigmas < 2.0
        assert TrialVerdict.FAILED not in findings


def test_wrong_soft_iron_fails():
    for seed in SEEDS:
        block = driven(seed, 0.002, "tumble")
        sigmas, findings = judged(Affine(np.diag([1.10, 1.0, 0.95]), TRUE.offset), block)
        assert sigmas > 6.0
        assert TrialVerdict.FAILED in findings


def test_significant_error_below_the_limit_does_not_fail():
    for seed in SEEDS:
        block = driven(seed, 0.0005, "tumble")
        small = Affine(TRUE.matrix, TRUE.offset + np.array([0.002, 0.0, 0.0]))
        sigmas, _ = judged(small, block)
        assert sigmas < 0.0


def test_no_statistic_without_turns():
    block = driven(1, 0.002, "level")
    still = SampleBlock(
        block.time_s, block.dt_s, block.host_s, np.tile(block.raw_b_gauss[0], (len(block), 1)),
        0 * block.gyro_b_rad_s, np.tile(block.accel_b_m_s2[0], (len(block), 1)),
    )  # fmt: skip
    sigmas, findings = judged(Affine(TRUE.matrix, TRUE.offset + 0.05), still)
    assert np.isnan(sigmas)
    assert set(findings) <= {TrialVerdict.GOES_ON}
