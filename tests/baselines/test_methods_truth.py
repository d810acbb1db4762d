"""Rich motion: the truth without noise, the published accuracy with it."""

from __future__ import annotations

import numpy as np
import pytest
from simulation import (
    FIELD,
    GYRO_BIAS,
    HARD_IRON,
    SOFT_IRON,
    UNIT_SOFT_IRON,
    clean,
    simulate,
)  # fmt: skip

from ahrsd.baselines import METHODS, MethodSettings, run

KINEMATIC = [name for name, row in METHODS.items() if "gyro" in row.needs]
HARD_ONLY = [name for name, row in METHODS.items() if row.estimates == ("hard iron",)]
KNOWN = {"known_gyro_bias_rad_s": GYRO_BIAS}


def errors(result):
    """Hard iron in mG, soft iron, gyro bias in mrad/s."""
    assert result.converged, result.reason
    b = 1e3 * np.linalg.norm(result.hard_iron_gauss - HARD_IRON)
    A, w = result.soft_iron, result.gyro_bias_rad_s
    return (
        b,
        None if A is None else np.linalg.norm(A - UNIT_SOFT_IRON),
        None if w is None else 1e3 * np.linalg.norm(w - GYRO_BIAS),
    )


def test_ids_are_the_contracts():
    assert list(METHODS) == [
        "magical-ls", "magical-nls", "magical-bfg", "magical-ifg", "magyc-bfg", "magyc-ifg",
        "twostep", "ellipsoid", "magfactor3", "tls", "np", "fnp", "np-uncertain-field",
    ]  # fmt: skip


# What differencing at 100 Hz leaves: the derivative is half a sample late in the seeds' way, and
# the mean of a window of 25 of a turning field is a little short in the other.
@pytest.mark.parametrize("derivative", ["median", "savgol"])
@pytest.mark.parametrize("method", KINEMATIC)
def test_kinematic_methods_without_noise(method, derivative):
    settings = MethodSettings(derivative=derivative, relinearize=1e-6, **KNOWN)
    b, A, w = errors(run(method, clean().data, settings))
    assert b < 0.6
    assert A < 1.5e-3
    if method == "magical-ls":
        assert w is None
    else:
        assert w < 0.4


@pytest.mark.parametrize("method", ["magical-ls", "magical-nls"])
def test_denser_sampling_leaves_less(method):
    coarse = errors(run(method, clean(rate_hz=50.0, n=4000).data, MethodSettings(**KNOWN)))
    fine = errors(run(method, clean(rate_hz=400.0, n=32_000).data, MethodSettings(**KNOWN)))
    assert fine[0] < coarse[0] / 6
    assert fine[1] < coarse[1] / 6


@pytest.mark.parametrize("method", ["twostep", "ellipsoid"])
def test_quadric_methods_without_noise(method):
    result = run(method, clean(soft_iron=UNIT_SOFT_IRON).data)
    b, A, _ = errors(result)
    assert b < 1e-9
    assert A < 1e-11


def test_twostep_knows_the_size_of_the_soft_iron():
    result = run("twostep", clean(soft_iron=SOFT_IRON).data)
    assert np.allclose(result.soft_iron, SOFT_IRON, atol=1e-11)
    ellipsoid = run("ellipsoid", clean(soft_iron=SOFT_IRON).data)
    assert np.allclose(ellipsoid.soft_iron, UNIT_SOFT_IRON, atol=1e-11)


def test_twostep_with_a_field_that_varies():
    run_ = clean(soft_iron=np.eye(3))
    sizes = 1.0 + 0.2 * np.sin(0.1 * run_.data.time_s)
    from dataclasses import replace

    data = replace(
        run_.data,
        raw_b_gauss=(run_.field_b * sizes[:, None]) @ SOFT_IRON + HARD_IRON,
        field_n_gauss=None,
        field_norm_gauss=sizes * np.linalg.norm(FIELD),
    )
    result = run("twostep", data)
    assert np.allclose(result.soft_iron, SOFT_IRON, atol=1e-10)
    assert np.allclose(result.hard_iron_gauss, HARD_IRON, atol=1e-11)


@pytest.mark.parametrize("method", HARD_ONLY)
def test_hard_iron_methods_without_noise(method):
    result = run(method, clean(soft_iron=np.eye(3)).data)
    assert errors(result)[0] < 1e-8
    assert result.soft_iron is None
    assert result.gyro_bias_rad_s is None


def test_magfactor3_without_noise_finds_scale_and_hard_iron():
    result = run("magfactor3", clean(soft_iron=1.07 * np.eye(3)).data)
    assert np.allclose(result.soft_iron, 1.07 * np.eye(3), atol=1e-12)
    assert np.allclose(result.hard_iron_gauss, HARD_IRON, atol=1e-12)
    planar = run("magfactor3", clean("planar", soft_iron=1.07 * np.eye(3)).data)
    assert np.allclose(planar.hard_iron_gauss, HARD_IRON, atol=1e-9)


# Mean over four runs of the thesis' experiment, WAM, slow, 1 mG and 5 mrad/s: hard iron in mG,
# soft iron, gyro bias in mrad/s may lie between these. The published means over more runs are, in
# hard iron, NLS 7.9 and .33 with the filter, TWOSTEP .038, ellipsoid .035, sphere 24, MagFactor3
# 63; corrected graphs with the filter .40 and .46.
WAM = {
    ("magical-ls", "median"): ((2, 12), (0.05, 0.3), None),
    ("magical-ls", "savgol"): ((0.05, 0.6), (1e-4, 3e-3), None),
    ("magical-nls", "median"): ((3, 13), (0.05, 0.3), (0.3, 3)),
    ("magical-nls", "savgol"): ((0.05, 0.6), (1e-4, 3e-3), (0.03, 0.3)),
    ("magical-bfg", "median"): ((1.5, 9), (0.003, 0.04), (0.3, 2.5)),
    ("magical-bfg", "savgol"): ((0.04, 0.6), (1e-4, 3e-3), (0.03, 0.3)),
    ("magical-ifg", "median"): ((1.5, 9), (0.003, 0.04), (3, 4.5)),
    ("magical-ifg", "savgol"): ((0.3, 3), (1e-3, 0.01), (3, 4.5)),
    ("magyc-bfg", "median"): ((1.5, 9), (0.003, 0.04), (0.3, 2.5)),
    ("magyc-bfg", "savgol"): ((0.04, 0.6), (1e-4, 3e-3), (0.03, 0.3)),
    ("magyc-ifg", "median"): ((1.5, 9), (0.003, 0.04), (0.3, 2.5)),
    ("magyc-ifg", "savgol"): ((0.04, 0.6), (1e-4, 3e-3), (0.03, 0.3)),
    ("twostep", "median"): ((0.005, 0.08), (5e-5, 5e-4), None),
    ("ellipsoid", "median"): ((0.005, 0.08), (5e-5, 5e-4), None),
    ("magfactor3", "median"): ((8, 80), (0.2, 0.4), None),
    ("tls", "median"): ((8, 60), None, None),
    ("np", "median"): ((8, 60), None, None),
    ("fnp", "median"): ((8, 60), None, None),
    ("np-uncertain-field", "median"): ((8, 60), None, None),
}


#: the incremental graphs, which take long: magyc's with the filter is quick enough, and magical's
#: without it is what the thesis' gyro bias is asked of below
LONG = (("magical-ifg", "median"), ("magical-ifg", "savgol"), ("magyc-ifg", "median"))


@pytest.fixture(scope="module")
def wam_runs():
    return [simulate("wam", seed).data for seed in range(4)]


@pytest.mark.parametrize(
    ("method", "derivative"),
    [pytest.param(*one, marks=pytest.mark.slow if one in LONG else ()) for one in WAM],
)
def test_noisy_wam_is_as_published(method, derivative, wam_runs):
    settings = MethodSettings(derivative=derivative, **KNOWN)
    found = [errors(run(method, data, settings)) for data in wam_runs]
    for limits, column in zip(WAM[method, derivative], zip(*found, strict=True), strict=True):
        if limits is None:
            assert set(column) == {None}
        else:
            assert limits[0] < np.mean(column) < limits[1]


@pytest.mark.slow
def test_the_thesis_incremental_gyro_bias_is_half_of_the_truth(wam_runs):
    """[R] Table 5.1: (1.775, -2.136, 0.852) mrad/s of a true (4, -5, 2)."""
    found = [1e3 * run("magical-ifg", data).gyro_bias_rad_s for data in wam_runs]
    assert np.allclose(np.mean(found, axis=0), [1.775, -2.136, 0.852], atol=0.25)
    mended = MethodSettings(relinearize=1e-6, derivative="savgol")
    assert errors(run("magical-ifg", wam_runs[0], mended))[2] < 0.3


@pytest.mark.parametrize("method", ["magyc-bfg", "magyc-ifg", "magical-bfg"])
def test_soft_irons_are_positive_definite_and_of_unit_volume(method, wam_runs):
    A = run(method, wam_runs[0]).soft_iron
    assert np.linalg.eigvalsh(A)[0] > 0
    assert np.linalg.det(A) == pytest.approx(1.0, abs=2e-4)  # the mean of estimates, for -ifg
