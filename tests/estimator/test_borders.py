"""Noise of epochs whose border directions started from one noisy field reading."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator.online import Estimator
from ahrsd.samples import SampleBlock

RATE_HZ, MAG_GAUSS, GYRO_RAD_S = 50.0, 2e-3, 8e-4
FIELD_GAUSS = np.array([0.2, 0.03, 0.43])
HARD_GAUSS = np.array([0.07, 0.02, 0.09])


def _stream(seconds, rests, seed):
    """A vehicle that turns about all axes and stands still in `rests`, (from_s, to_s)."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    rate = 0.35 * np.sin(t[:, None] * [0.31, 0.23, 0.11] + [0.0, 1.0, 2.0])
    for from_s, to_s in rests:
        rate[(t >= from_s) & (t < to_s)] = 0.0
    body, R = np.empty((len(t), 3)), np.eye(3)
    for k, w in enumerate(rate):
        R = R @ so3.exp(w[None] / RATE_HZ)[0]
        body[k] = R.T @ FIELD_GAUSS
    return SampleBlock(
        t,
        np.r_[np.nan, np.diff(t)],
        t,
        body + HARD_GAUSS + MAG_GAUSS * rng.standard_normal(body.shape),
        rate + GYRO_RAD_S * rng.standard_normal(body.shape),
        np.full_like(body, np.nan),
        gap_before=True,
    )


def _estimates(block, every_s=10.0):
    """The estimates of a stream, one at every epoch."""
    estimator, out = Estimator(), []
    edges = np.searchsorted(block.time_s, np.arange(0.0, block.time_s[-1], every_s))
    for a, b in zip(edges, [*edges[1:], len(block)], strict=True):
        part = SampleBlock(
            block.time_s[a:b],
            block.dt_s[a:b],
            block.host_s[a:b],
            block.raw_b_gauss[a:b],
            block.gyro_b_rad_s[a:b],
            block.accel_b_m_s2[a:b],
            gap_before=a == 0,
        )
        if estimator.add(part):
            out.append(estimator.estimate())
    return out


@pytest.mark.slow
def test_noise_and_sigma_do_not_grow_when_epochs_are_linearised_once():
    found = _estimates(_stream(300.0, ((120.0, 170.0),), seed=5))
    late = [e for e in found if e is not None and e.duration_s > 100.0]
    assert len(late) > 15
    assert [e.noise_mag_gauss for e in late] == pytest.approx([MAG_GAUSS] * len(late), rel=0.05)
    sigma = np.array([e.sigma[6:9].max() for e in late])
    assert np.all(sigma[1:] < 1.15 * np.minimum.accumulate(sigma)[:-1])
    error = late[-1].hard_iron_gauss - HARD_GAUSS
    assert np.all(np.abs(error) < 4 * late[-1].sigma[6:9])
