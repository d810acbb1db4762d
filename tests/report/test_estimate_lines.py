"""Text of an estimate for a person."""

from __future__ import annotations

from dataclasses import replace

from cabled_run import estimate

from ahrsd.calibration_json import calibration_json
from ahrsd.report.summary import estimate_lines

ADVICE = "the gyro's scales may be off by a percent: turn about every axis, and back again"


def test_largest_contribution_to_sigma_is_reported_below_the_heading():
    found = estimate(heading_sigma_deg=1.7, widened_by=ADVICE)
    assert estimate_lines(found) == [
        "  hard iron  +50.00 +- 0.10, -30.00 +- 0.10, +40.00 +- 0.10 mG",
        "  gyro bias  +10.000 +- 0.100, -20.000 +- 0.100, +5.000 +- 0.100 mrad/s",
        "  heading    known to 1.70 deg (1 sigma, worst direction)",
        f"             most of it: {ADVICE}",
    ]
    assert len(estimate_lines(replace(found, widened_by=""))) == 3


def test_wrong_axes_or_units_are_the_only_advice():
    wrong = ("the magnetometer is turned against the gyro by 45.0 deg about its z",)
    found = estimate(heading_sigma_deg=41.0, widened_by=ADVICE, converged=False)
    lines = estimate_lines(found, wrong)
    assert lines[2:] == [
        "  heading    known to 41.00 deg (1 sigma, worst direction)",
        f"  not converged: {wrong[0]}: put this right and calibrate again",
    ]
    said = calibration_json(
        "x", found, {}, method="magyc", samples=1, gyro_is_raw=True, wrong=wrong
    )
    assert said["warnings"] == [lines[3].strip()]


def test_wrong_axes_or_units_are_a_warning_in_json():
    found = estimate(heading_sigma_deg=1.7, widened_by=ADVICE)
    said = calibration_json("x", found, {}, method="magyc", samples=1, gyro_is_raw=True)
    assert said["warnings"] == [f"most of the heading's sigma: {ADVICE}"]


def test_what_dominates_the_heading_is_named_in_json():
    found = estimate(heading_sigma_deg=1.7, widened_by=ADVICE)
    assert calibration_json("x", found, {})["observability"]["dominated_by"] == ADVICE
    small = calibration_json("x", replace(found, widened_by=""), {})
    assert small["observability"]["dominated_by"] is None
    wrong = calibration_json("x", found, {}, wrong=("the axes are swapped",))
    assert wrong["observability"]["dominated_by"] is None
