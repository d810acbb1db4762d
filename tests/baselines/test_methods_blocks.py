"""Blocks of a recording: gaps are never bridged."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from simulation import GYRO_BIAS, HARD_IRON, blocks, clean

from ahrsd.baselines import METHODS, MethodSettings, calibrate_with, joined, run
from ahrsd.baselines.graph_methods import per_sample, windowed

KNOWN = MethodSettings(known_gyro_bias_rad_s=GYRO_BIAS)


@pytest.mark.parametrize("method", METHODS)
def test_any_split_without_gaps_is_the_same(method):
    data = clean(n=3000).data
    given = {"R_nb": data.R_nb, "field_n_gauss": data.field_n_gauss}
    whole = run(method, data, KNOWN)
    split = calibrate_with(method, blocks(data, (1000, 0, 1, 1499, 500)), settings=KNOWN, **given)
    assert whole.converged
    assert np.array_equal(whole.hard_iron_gauss, split.hard_iron_gauss)
    assert split.iterations == whole.iterations


def jumped(n=6000):
    """Clean samples whose middle third is lost: the field jumps there."""
    data = clean(n=n).data
    kept = np.r_[0 : n // 3, 2 * n // 3 : n]
    dt = data.dt_s[kept].copy()
    return replace(
        data, time_s=data.time_s[kept], dt_s=dt, raw_b_gauss=data.raw_b_gauss[kept],
        gyro_b_rad_s=data.gyro_b_rad_s[kept], R_nb=None,
    )  # fmt: skip


@pytest.mark.parametrize("method", ["magical-ls", "magical-nls", "magical-bfg", "magyc-ifg"])
def test_a_gap_is_not_differentiated(method):
    data = jumped()
    half = len(data) // 2
    across = calibrate_with(method, blocks(data, (half, half)), settings=KNOWN)
    apart = calibrate_with(method, blocks(data, (half, half), gaps=(1,)), settings=KNOWN)
    assert np.linalg.norm(apart.hard_iron_gauss - HARD_IRON) < 1e-3
    if method in ("magical-ls", "magical-nls"):  # the others' median hides one bad difference
        assert not across.converged
        assert "explains" in across.reason


@pytest.mark.parametrize("derivative", ["median", "savgol"])
def test_windows_and_differences_stay_inside_segments(derivative):
    data = jumped(3000)
    cut = blocks(data, (700, 300, 1000), gaps=(1, 2))
    settings = MethodSettings(derivative=derivative)
    kin = joined(cut)
    assert kin.starts == (0, 700, 1000)
    assert len(per_sample(kin, settings)) == 699 + 299 + 999
    assert len(windowed(kin, settings)) == 27 + 11 + 39


def test_an_unknown_step_begins_a_segment():
    data = clean(n=300).data
    dt = data.dt_s.copy()
    dt[[0, 120]] = np.nan
    assert joined(blocks(replace(data, dt_s=dt), (300,))).starts == (0, 120)


def test_segments_too_short_to_differentiate():
    data = clean(n=300, rate_hz=2.0).data
    dt = np.full(300, np.nan)
    result = calibrate_with("magical-nls", blocks(replace(data, dt_s=dt), (300,)))
    assert not result.converged
    assert "long enough" in result.reason


def test_no_samples():
    result = calibrate_with("fnp", [])
    assert not result.converged
    assert result.reason == "no samples"


def test_time_is_taken_from_the_clock_that_is_given():
    ticks = itertools.count(10.0, 2.5)
    data = clean(n=500).data
    assert run("fnp", data, clock=lambda: next(ticks)).seconds == 2.5
    assert (
        run("fnp", replace(data, time_s=data.time_s * np.nan), clock=lambda: next(ticks)).seconds
        == 2.5
    )
    assert np.isnan(run("fnp", data).seconds)
