"""What no method may answer: every refusal is a reason, never a number."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation import HARD_IRON, clean, simulate

from ahrsd.baselines import METHODS, MethodError, MethodSettings, run

EVERY = list(METHODS)


def refused(method, data, chosen=None):
    result = run(method, data, chosen)
    assert not result.converged
    assert result.soft_iron is None
    assert result.hard_iron_gauss is None
    assert result.gyro_bias_rad_s is None
    assert result.reason
    return result.reason


def changed(data, name, row, value):
    array = getattr(data, name).copy()
    array[row] = value
    return replace(data, **{name: array})


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("method", [m for m in EVERY if m != "magfactor3"])
def test_a_planar_turn(method, noise):
    data = simulate("planar", n=4000, sigma_mag=noise).data
    assert "turned about one axis only" in refused(method, data)


@pytest.mark.parametrize("method", ["fnp", "magical-ls"])
def test_weak_motion_is_remarked(method):
    """A car that circles: readings leave their plane by a twentieth of what they span in it."""
    data = clean(soft_iron=np.eye(3)).data
    spread = data.raw_b_gauss.std(axis=0)
    flat = HARD_IRON + (data.raw_b_gauss - HARD_IRON) * [1.0, 1.0, 0.05 * spread[0] / spread[2]]
    result = run(method, replace(data, raw_b_gauss=flat))
    assert "weak motion: readings leave a plane by" in result.reason


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("method", EVERY)
def test_a_sensor_at_rest(method, noise):
    assert "hardly turned" in refused(method, simulate("static", n=4000, sigma_mag=noise).data)


@pytest.mark.parametrize("method", EVERY)
def test_not_a_number(method):
    data = clean(n=2000).data
    for name in ("raw_b_gauss", "gyro_b_rad_s", "time_s"):
        assert f"{name} of row 77 is not finite" in refused(method, changed(data, name, 77, np.nan))


@pytest.mark.parametrize("method", EVERY)
def test_too_few_samples(method):
    assert refused(method, clean(n=19).data).startswith("19 samples: at least 20")


@pytest.mark.parametrize("method", ["magical-bfg", "magical-ifg", "magyc-bfg", "magyc-ifg"])
def test_too_few_windows(method):
    assert "whole windows of 25" in refused(method, clean(n=200, rate_hz=2.5).data)


def test_an_update_that_never_fills():
    data = clean(n=1000, rate_hz=12.5).data
    assert "the first update needs 60" in refused(
        "magyc-ifg", data, MethodSettings(update_every=60)
    )


@pytest.mark.parametrize("value", [0.0, -1e-3, np.nan, np.inf])
def test_settings_that_cannot_be(value):
    for name in ("sigma_mag_gauss", "sigma_field_gauss"):
        with pytest.raises(MethodError, match=f"{name} is .*: it must be a positive number"):
            MethodSettings(**{name: value})


def test_other_settings_that_cannot_be():
    for wrong in ({"window": 1}, {"update_every": 0}, {"savgol_window": 4}):
        with pytest.raises(MethodError, match="at least"):
            MethodSettings(**wrong)
    with pytest.raises(MethodError, match="one of median, savgol"):
        MethodSettings(derivative="spline")
    with pytest.raises(MethodError, match="one of trace, fang"):
        MethodSettings(ellipsoid_constraint="unit")


@pytest.mark.parametrize("method", EVERY)
def test_units_wrong(method):
    data = clean(n=2000).data
    milligauss = replace(data, raw_b_gauss=1e3 * data.raw_b_gauss)
    assert "is the unit gauss?" in refused(method, milligauss)
    tesla = replace(data, raw_b_gauss=1e-4 * data.raw_b_gauss)
    assert "is the unit gauss?" in refused(method, tesla)
    milliradians = replace(data, gyro_b_rad_s=1e3 * data.gyro_b_rad_s)
    assert "is the unit rad/s?" in refused(method, milliradians)


GYRO = [m for m in EVERY if "gyro" in METHODS[m].needs]


@cache
def turning(kind):
    return simulate(kind, n=3000, faster=4.0).data


@cache
def answers(method, kind):
    """Whether the method has an answer where the gyroscope is right."""
    return run(method, turning(kind)).converged


@pytest.mark.parametrize("method", GYRO)
@pytest.mark.parametrize("kind", ["wam", pytest.param("lam", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e-3, "gauss for each radian of the gyroscope: is its unit rad/s?"),
        (0.0, "gauss for each radian of the gyroscope: is its unit rad/s?"),
        (np.pi / 180, "unit"),
        (180 / np.pi, "unit"),
        (-1.0, "% of how the field turns: are its unit, axes and the time right?"),
    ],
)
def test_a_gyroscope_that_does_not_turn_with_the_field(method, kind, factor, words):
    """Wrong by 1000, dead, in deg/s, divided twice, mirrored: sizes alone would pass."""
    data = turning(kind)
    assert answers(method, kind)
    reason = refused(method, replace(data, gyro_b_rad_s=factor * data.gyro_b_rad_s))
    assert words in reason or "determine" in reason or "positive definite" in reason or (
        "no end" in reason or "distorted" in reason or "diverged" in reason
    )  # fmt: skip


@pytest.mark.parametrize("method", GYRO)
def test_time_in_another_unit(method):
    data = simulate("wam", n=3000, faster=4.0).data
    for factor in (0.01, 10.0):
        slower = replace(data, time_s=factor * data.time_s, dt_s=factor * data.dt_s)
        assert refused(method, slower)


def test_one_run_in_twenty_may_be_spoilt():
    """A magnet passing by is no reason to call the gyroscope wrong."""
    data = simulate("wam", n=5000, faster=4.0).data
    raw = data.raw_b_gauss.copy()
    raw[1000:1060] += [0.4, -0.3, 0.2]
    assert run("magyc-bfg", replace(data, raw_b_gauss=raw)).converged


@pytest.mark.parametrize("method", EVERY)
def test_time_backwards(method):
    data = clean(n=2000).data
    assert "dt_s of row 500 is -0.01: time" in refused(method, changed(data, "dt_s", 500, -0.01))
    assert "dt_s of row 3 is 0.0: time" in refused(method, changed(data, "dt_s", 3, 0.0))


@pytest.mark.parametrize("method", EVERY)
def test_saturated_readings(method):
    data = clean(n=4000).data
    raw = data.raw_b_gauss.copy()
    raw[:, 0] = np.minimum(raw[:, 0], np.quantile(raw[:, 0], 0.9))
    assert "readings of x stick at" in refused(method, replace(data, raw_b_gauss=raw))


@pytest.mark.parametrize("method", ["twostep", "tls", "np", "fnp", "np-uncertain-field"])
def test_the_field_is_not_known(method):
    data = replace(clean(n=2000).data, field_n_gauss=None, field_norm_gauss=None)
    assert "needs the field's magnitude" in refused(method, data)
    short = replace(data, field_norm_gauss=np.full(1999, 0.4))
    assert "one or 2000" in refused(method, short)
    negative = replace(data, field_norm_gauss=-0.4)
    assert "must be a positive number" in refused(method, negative)


def test_magfactor3_needs_attitude_and_field():
    data = clean(n=2000).data
    for missing in ({"R_nb": None}, {"field_n_gauss": None}):
        assert "needs the attitude" in refused("magfactor3", replace(data, **missing))
    short = replace(data, R_nb=data.R_nb[:-1])
    assert "not one per sample" in refused("magfactor3", short)
    broken = changed(data, "R_nb", 5, np.nan)
    assert "not finite" in refused("magfactor3", broken)
    mirrored = replace(data, field_n_gauss=-data.field_n_gauss)
    assert "attitude or field are wrong" in refused("magfactor3", mirrored)


def test_an_unknown_method_is_the_callers_error():
    with pytest.raises(KeyError):
        run("magic", clean(n=100).data)


@settings(max_examples=60, deadline=None)
@given(
    method=st.sampled_from([m for m in EVERY if m != "magfactor3"]),
    scale=st.floats(0.02, 2.0),
    noise=st.floats(0.0, 0.05),
    seed=st.integers(0, 2**16),
)
def test_pure_noise_is_never_a_calibration_of_the_gyro(method, scale, noise, seed):
    """A constant field with noise says nothing: no method may call it determined."""
    rng = np.random.default_rng(seed)
    data = simulate("static", n=600, sigma_mag=0.0, seed=seed).data
    raw = scale * np.array([0.3, -0.5, 0.8]) + noise * scale * rng.normal(size=(600, 3))
    assert "hardly turned" in refused(method, replace(data, raw_b_gauss=raw))
