"""The corrected field, propagated by the corrected gyro, is constant; wrong corrections make it
vary.
"""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock
from ahrsd.writeback.trial import CarriedField

FIELD_N = np.array([0.24, 0.0, 0.42])
BIAS = np.array([0.004, -0.003, 0.006])
MAG = Affine(np.diag([1.1, 0.9, 1.0]), np.array([0.05, -0.03, 0.02]))


def tumbling(seconds: float = 35.0, rate_hz: float = 40.0) -> SampleBlock:
    """Samples of a sensor that turns about all axes, exact but for bias and iron."""
    count = round(seconds * rate_hz)
    t = np.arange(count) / rate_hz
    rate = np.column_stack([0.4 * np.sin(0.5 * t), 0.3 * np.cos(0.3 * t), np.full(count, 0.5)])
    R, field = np.eye(3), []
    for step in so3.exp(rate / rate_hz):
        R = R @ step
        field.append(R.T @ FIELD_N)
    return SampleBlock(
        time_s=t,
        dt_s=np.full(count, 1.0 / rate_hz),
        host_s=t,
        raw_b_gauss=MAG.undo(np.array(field)),
        gyro_b_rad_s=rate + BIAS,
        accel_b_m_s2=np.zeros((count, 3)),
    )


def test_field_is_constant_with_correct_registers_and_varies_with_any_wrong_one():
    turned = Affine(so3.exp(np.radians([0.0, 0.0, 10.0])) @ MAG.matrix, MAG.offset)
    carried = CarriedField([(MAG, BIAS), (MAG, -BIAS), (Affine.identity(), BIAS), (turned, BIAS)])
    carried.take(tumbling())
    right, gyro, mag, rotated = carried.spreads
    assert right < 1e-9
    assert gyro > 0.01
    assert mag > 0.05
    assert rotated > 0.01


def test_bias_rotates_the_level_field_in_proportion_to_the_interval():
    """At rest. An angle that grows to 10 s x 5 mrad/s has a standard deviation of its range over
    sqrt 12.
    """
    block = tumbling(0.05)
    still = 450
    rest = SampleBlock(
        time_s=np.arange(still) / 40.0,
        dt_s=np.full(still, 1 / 40.0),
        host_s=np.arange(still) / 40.0,
        raw_b_gauss=np.tile(block.raw_b_gauss[0], (still, 1)),
        gyro_b_rad_s=np.tile(BIAS, (still, 1)),
        accel_b_m_s2=np.zeros((still, 3)),
    )
    axis = np.cross(MAG.apply(block.raw_b_gauss[:1])[0], [0.3, 0.5, 0.1])
    axis *= 0.005 / np.linalg.norm(axis)
    carried = CarriedField([(MAG, BIAS), (MAG, BIAS - axis)])
    carried.take(rest)
    assert carried.spreads[0] < 1e-12
    assert carried.spreads[1] == pytest.approx(10.0 * 0.005 / np.sqrt(12.0), rel=0.02)


def test_spread_is_nan_before_the_first_interval_has_ended():
    carried = CarriedField([(MAG, BIAS)])
    carried.take(tumbling(5.0))
    assert np.isnan(carried.spreads).all()
