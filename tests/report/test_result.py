"""calibration.json of an estimate, key by key."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from contract import CALIBRATION, faults

from ahrsd.calibration import Estimate, Observability
from ahrsd.calibration_json import HeadingErrors, calibration_json, why_not_converged

A = np.array([[1.05, 0.02, -0.01], [0.02, 0.97, 0.03], [-0.01, 0.03, 0.99]])
A = A / np.cbrt(np.linalg.det(A))
B = np.array([0.05, -0.12, 0.2])
BIAS = np.array([0.003, -0.004, 0.001])
ESTIMATE = Estimate(
    soft_iron=A,
    hard_iron_gauss=B,
    gyro_bias_rad_s=BIAS,
    field_gauss=0.47,
    field_known=False,
    covariance=np.diag(np.arange(1.0, 13.0) ** 2) * 1e-8,
    noise_mag_gauss=0.002,
    noise_gyro_rad_s=0.001,
    misfit=1.1,
    heading_sigma_deg=0.4,
    observability=Observability(np.linspace(0.01, 0.1, 12), (), 2.0),
    samples=10000,
    duration_s=400.0,
    converged=True,
)
C23 = (1.1, 0.0, 0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0, 0.1, 0.0, 0.0)
C84 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def blind(*names: str) -> Estimate:
    observed = replace(ESTIMATE.observability, unobservable=names)
    return replace(ESTIMATE, observability=observed, converged=False)


def test_all_documented_keys_are_present_and_finite():
    found = calibration_json("a.vnraw", ESTIMATE, {}, heading=HeadingErrors(8.0, 0.5))
    assert faults(found, CALIBRATION) == []
    json.dumps(found, allow_nan=False)
    assert np.array(found["correction_matrix"]) @ A == pytest.approx(np.eye(3))
    assert found["soft_iron"] == A.tolist()
    assert found["hard_iron_gauss"] == B.tolist()
    assert found["gyro_bias_rad_s"] == BIAS.tolist()
    assert (found["samples"], found["duration_s"], found["field_gauss"]) == (10000, 400.0, 0.47)
    sigma = found["standard_deviation"]
    assert sigma["soft_iron"] == pytest.approx([1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4])
    assert sigma["hard_iron_gauss"] == pytest.approx([7e-4, 8e-4, 9e-4])
    assert sigma["gyro_bias_rad_s"] == pytest.approx([1e-3, 1.1e-3, 1.2e-3])
    assert found["heading_error_deg"] == {
        "expected_worst": 0.4, "before_rms": 8.0, "after_rms": 0.5,
    }  # fmt: skip


def test_registers_are_those_in_force_and_the_estimate():
    found = calibration_json("a", ESTIMATE, {23: C23, 84: C84})["registers"]
    assert set(found) == {"23", "84"}
    scale = np.cbrt(np.linalg.det(np.reshape(C23[:9], (3, 3))))  # the user's
    expected = scale * np.linalg.inv(A)
    assert np.reshape(found["23"][:9], (3, 3)) == pytest.approx(expected, abs=1e-5)
    assert found["23"][9:] == pytest.approx(B.tolist(), abs=1e-6)
    assert found["84"][9:] == pytest.approx(BIAS.tolist(), abs=1e-8)


def test_a_compensated_rate_is_not_written():
    found = calibration_json("a", ESTIMATE, {23: C23, 84: C84}, gyro_is_raw=False)
    assert set(found["registers"]) == {"23"}


def test_unwritable_registers_are_reported_and_left_out():
    strong = replace(ESTIMATE, hard_iron_gauss=np.array([2.0, 0.0, 0.0]))
    found = calibration_json("a", strong, {})
    assert found["registers"] == {}
    assert "hard iron 2 gauss, limit 1.3 gauss" in found["warnings"]


@pytest.mark.parametrize(
    ("estimate", "reason"),
    [
        (None, "too few samples for an estimate"),
        (blind("hard iron z", "soft iron zz"),
         "this motion does not determine: hard iron z; soft iron zz"),
        (replace(ESTIMATE, converged=False, heading_sigma_deg=7.3),
         "not converged: headings would be known to 7.3 deg only (limit 5)"),
        (replace(ESTIMATE, converged=False), "not converged: the data still allow more than one"),
    ],
)  # fmt: skip
def test_unconverged_estimate_has_a_reason_and_no_registers(estimate, reason):
    found = calibration_json("a", estimate, {23: C23}, warnings=["first"])
    assert found["converged"] is False
    assert found["registers"] == {}
    assert found["warnings"][0] == "first"
    assert found["warnings"][-1].startswith(reason)
    assert set(CALIBRATION) <= set(found)
    assert why_not_converged(estimate) == [found["warnings"][-1]]


def test_converged_estimate_has_no_reason():
    assert why_not_converged(ESTIMATE) == []


def test_no_number_is_null_and_never_nan():
    unknown = replace(ESTIMATE, heading_sigma_deg=float("nan"), misfit=float("inf"))
    found = calibration_json("a", unknown, {})
    json.dumps(found, allow_nan=False)
    assert found["heading_error_deg"]["expected_worst"] is None
    assert found["noise"]["misfit"] is None
