"""Data that no sensor produces: an answer is finite and positive definite, or there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ahrsd.baselines import METHODS, MethodData, MethodSettings, run


def junk(seed, n, size, smooth, rate):
    """Readings from white noise to smooth loops, rates that have nothing to do with them."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n)
    raw = size * (smooth * walk + (1 - smooth) * rng.normal(size=(n, 3)) + 0.5)
    return MethodData(
        time_s=0.04 * np.arange(n), dt_s=np.full(n, 0.04), raw_b_gauss=raw,
        gyro_b_rad_s=rate * rng.normal(size=(n, 3)) + rate * np.sin(0.01 * np.arange(n))[:, None],
        R_nb=np.tile(np.eye(3), (n, 1, 1)), field_n_gauss=np.array([0.2, 0.0, 0.4]),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(20, 700),
    size=st.sampled_from([0.02, 0.5, 5.0]),
    smooth=st.sampled_from([0.0, 0.9, 0.999, 1.0]),
    rate=st.sampled_from([0.0, 1e-3, 0.5, 5.0]),
    derivative=st.sampled_from(["median", "savgol"]),
    constraint=st.sampled_from(["trace", "fang"]),
)
@settings(max_examples=10, deadline=None)
def test_junk_gives_a_valid_answer_or_none(
    method, seed, n, size, smooth, rate, derivative, constraint
):
    chosen = MethodSettings(
        derivative=derivative, ellipsoid_constraint=constraint, sigma_mag_gauss=1e-3 * size
    )
    result = run(method, junk(seed, n, size, smooth, rate), chosen)
    if result.converged:
        assert np.isfinite(result.hard_iron_gauss).all()
        if result.soft_iron is not None:
            assert np.linalg.eigvalsh(result.soft_iron)[0] > 0
    else:
        assert result.hard_iron_gauss is None
        assert result.soft_iron is None
        assert result.reason
