"""Any recording, columns and calibration give a one-line error or finite JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ahrsd.calibration import Affine
from ahrsd.evaluation import EvaluationError, EvaluationTrack, StoredCalibration, build_track, judge
from ahrsd.evaluation.heading import (
    Fixes,
    course_reference,
    device_heading,
    fixes_of_track,
    optical_reference,
)
from ahrsd.evaluation.judging import evaluation_json, evaluation_lines
from ahrsd.samples import SampleBlock

COLUMNS = (
    "ref_qw", "ref_qx", "ref_qy", "ref_qz", "vn_yaw_deg", "vn_pitch_deg", "vn_roll_deg",
    "position_north_m", "position_east_m", "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s",
    "speed_m_s",
)  # fmt: skip


def values(rng, n, kind, scale):
    """Zeros, noise, a ramp, only nan, or noise with missing values."""
    noise = scale * rng.normal(size=n)
    return {
        "zero": np.zeros(n), "noise": noise, "ramp": scale * np.arange(n),
        "nan": np.full(n, np.nan), "holes": np.where(rng.random(n) < 0.4, np.nan, noise),
    }[kind]  # fmt: skip


kinds = st.sampled_from(["zero", "noise", "ramp", "nan", "holes"])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    n=st.integers(20, 600),
    columns=st.dictionaries(st.sampled_from(COLUMNS), kinds),
    accel=kinds,
    gyro=st.sampled_from(["zero", "noise"]),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
    gap=st.booleans(),
)
def test_random_columns_give_a_one_line_error_or_finite_figures(
    seed, n, columns, accel, gyro, scale, gap
):
    rng = np.random.default_rng(seed)
    t = 0.02 * np.arange(n) + (30.0 * (np.arange(n) > n // 2) if gap else 0.0)
    raw = rng.normal(size=(n, 3))
    track = EvaluationTrack(
        t, raw, raw,
        np.column_stack([values(rng, n, gyro, 1.0) for _ in "xyz"]),
        np.column_stack([values(rng, n, accel, scale) for _ in "xyz"]),
        (0, n // 2 + 1) if gap and n // 2 + 1 < n else (0,),
        {name: values(rng, n, kind, scale) for name, kind in columns.items()},
    )  # fmt: skip
    calibration = StoredCalibration(
        "c",
        "m",
        "other",
        True,
        Affine(np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3)),
    )
    fixes = fixes_of_track(track)
    references = [
        one for one in (optical_reference(track), device_heading(track)) if one is not None
    ]
    if fixes is not None:
        try:
            references.append(course_reference(fixes, 0.5))
        except EvaluationError as error:
            assert "\n" not in str(error)
    found = judge("r", track, calibration, references, fixes=fixes)
    json.dumps(evaluation_json(found), allow_nan=False)
    assert all("\n" not in line for line in evaluation_lines(found))


def test_too_few_samples_and_time_backwards_are_refused(vehicle):
    track = vehicle.track
    block = SampleBlock(
        track.time_s, np.full(len(track), 0.02), track.time_s, track.raw_b_gauss,
        track.gyro_b_rad_s, track.accel_b_m_s2, track.covariates,
    )  # fmt: skip
    present = Affine(np.eye(3), np.array([0.1, 0.0, 0.0]))
    whole = build_track([(block, present)])
    assert np.allclose(whole.before_b_gauss, track.raw_b_gauss - [0.1, 0.0, 0.0])
    with pytest.raises(EvaluationError, match="0 samples, 20 are needed"):
        build_track([])
    with pytest.raises(EvaluationError, match="goes backwards"):
        build_track([(block, present), (replace(block, gap_before=True), present)])


def test_isolated_fixes_give_no_course():
    fixes = Fixes(np.arange(12.0), np.zeros(12), np.zeros(12), "GPS")
    with pytest.raises(EvaluationError, match="GPS: 0 fixes faster"):
        course_reference(fixes, 4.0)
