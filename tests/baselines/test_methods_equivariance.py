"""Turning or shifting all readings turns or shifts the answer, noise and all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from simulation import GYRO_BIAS, simulate

from ahrsd.baselines import MethodSettings, run

DATA = simulate("wam", 5, n=4000, faster=2.0).data
# the medians of windows are taken axis by axis, so they are not in this list
TURNED = ["magical-ls", "magical-nls", "twostep", "ellipsoid", "tls", "np", "fnp"]
SHIFTED = [method for method in TURNED if method not in ("twostep", "magical-nls")]
# where the iteration ends: TWOSTEP's first step and the trust region depend on the axes
ATOL = {"magical-nls": 5e-4, "magical-ls": 1e-5, "twostep": 1e-6}


@pytest.mark.slow
@pytest.mark.parametrize("method", TURNED)
@given(seed=st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_another_sensor_frame(method, seed):
    Q = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    turned = replace(
        DATA,
        raw_b_gauss=DATA.raw_b_gauss @ Q.T,
        gyro_b_rad_s=DATA.gyro_b_rad_s @ Q.T,
        R_nb=DATA.R_nb @ Q.T,
    )
    a = run(method, DATA, MethodSettings(known_gyro_bias_rad_s=GYRO_BIAS))
    b = run(method, turned, MethodSettings(known_gyro_bias_rad_s=Q @ GYRO_BIAS))
    atol = ATOL.get(method, 1e-9)
    assert np.allclose(Q @ a.hard_iron_gauss, b.hard_iron_gauss, atol=atol)
    if a.soft_iron is not None:
        assert np.allclose(Q @ a.soft_iron @ Q.T, b.soft_iron, atol=atol)
    if a.gyro_bias_rad_s is not None:
        assert np.allclose(Q @ a.gyro_bias_rad_s, b.gyro_bias_rad_s, atol=atol)


@pytest.mark.parametrize("method", SHIFTED)
@given(shift=st.tuples(*[st.floats(-0.4, 0.4)] * 3))
@settings(max_examples=8, deadline=None)
def test_another_hard_iron(method, shift):
    chosen = MethodSettings(known_gyro_bias_rad_s=GYRO_BIAS)
    a = run(method, DATA, chosen)
    b = run(method, replace(DATA, raw_b_gauss=DATA.raw_b_gauss + shift), chosen)
    atol = ATOL.get(method, 1e-9)
    assert np.allclose(a.hard_iron_gauss + shift, b.hard_iron_gauss, atol=atol)
    if a.soft_iron is not None:
        assert np.allclose(a.soft_iron, b.soft_iron, atol=atol)
