"""Where down is: on a vehicle that goes round bends, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ahrsd.estimator.epoch_builder import EpochBuilder
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.samples import SampleBlock

RATE_HZ, N = 33.0, 600


def circling(rate_rad_s, sideways_m_s2):
    """A level vehicle on a circle: the force of the bend is constant in its own frame."""
    dt = np.full(N, 1 / RATE_HZ)
    dt[0] = np.nan
    time_s = np.arange(N) / RATE_HZ
    return SampleBlock(
        time_s=time_s,
        dt_s=dt,
        host_s=time_s,
        raw_b_gauss=np.tile([0.2, 0.0, 0.4], (N, 1)),
        gyro_b_rad_s=np.tile([0.0, 0.0, rate_rad_s], (N, 1)),
        accel_b_m_s2=np.tile([0.0, sideways_m_s2, -9.81], (N, 1)),
        gap_before=True,
    )


def tilts_deg(block):
    (data,) = EpochBuilder(EstimatorParameters()).add(block)
    return np.degrees(np.arccos(data.down_b[:, 2]))


def test_a_bend_is_no_tilt():
    turns_per_epoch = 3
    rate = turns_per_epoch * 2 * np.pi * RATE_HZ / 512
    assert np.max(tilts_deg(circling(rate, 3.0))) < 0.3
    assert tilts_deg(circling(0.0, 3.0)) == pytest.approx(np.degrees(np.arctan2(3.0, 9.81)))


def test_a_gyro_bias_cancels_in_the_middle():
    block = circling(0.0, 0.0)
    biased = replace(block, gyro_b_rad_s=np.tile([5e-3, 0.0, 0.0], (N, 1)))
    tilt = tilts_deg(biased)
    assert tilt[len(tilt) // 2] < 0.05
    assert tilt[0] > 1.0


def test_without_an_accelerometer_nothing_is_down():
    block = circling(0.1, 0.0)
    silent = replace(block, accel_b_m_s2=np.full((N, 3), np.nan))
    (data,) = EpochBuilder(EstimatorParameters()).add(silent)
    assert np.isnan(data.down_b).all()
