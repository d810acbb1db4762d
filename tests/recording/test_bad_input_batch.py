"""Recordings that no working sensor makes: a one-line error, or no answer with a reason.

For the project's own and every published method, through the files that `ahrsd calibrate` reads.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ahrsd.baselines import METHODS, MethodError, MethodSettings
from ahrsd.config.config import Config
from ahrsd.config.sections import LocationSection
from ahrsd.errors import RecordingError
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.compare_methods import describe_saturation, our_row, run_published
from ahrsd.report.summary import BatchResult

SOFT_IRON = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
HARD_IRON = np.array([0.04, 0.11, 0.11])
FIELD_N = np.array([0.227, 0.052, 0.412])
# Near Boston the field has about the size of FIELD_N: the methods that need it get it.
PLACE = Config(
    location=LocationSection(latitude_deg=42.3, longitude_deg=-71.1, date=date(2022, 10, 15))
)
GYRO = [name for name, method in METHODS.items() if "gyro" in method.needs]
HEADER = "time_s,mag_x_gauss,mag_y_gauss,mag_z_gauss,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
FEW = settings(
    max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
seeds = st.integers(0, 2**16)


def tumbling(seed: int, n: int = 1500, *, planar: bool = False) -> np.ndarray:
    """(n, 7) time, field, rate at 25 Hz: all attitudes, or a turn about the vertical."""
    rng = np.random.default_rng(seed)
    t = 10.0 + np.arange(n + 1) / 25.0
    f, phase = rng.uniform(0.02, 0.05, 3), rng.uniform(0, 2 * np.pi, 3)
    angles = np.radians([170, 80, 170]) * np.sin(2 * np.pi * f * t[:, None] + phase)
    if planar:
        angles = np.column_stack([0.4 * t, 0 * t + 0.02, 0 * t - 0.01])
    R = Rotation.from_euler("ZYX", angles)
    rate = (R[:-1].inv() * R[1:]).as_rotvec() * 25.0 + [4e-3, -5e-3, 2e-3]
    field = R[1:].inv().apply(FIELD_N) @ SOFT_IRON.T + HARD_IRON
    noise = rng.normal(size=(n, 6))
    return np.column_stack([t[1:], field + 1e-3 * noise[:, :3], rate + 3e-3 * noise[:, 3:]])


def written(folder: Path, rows: np.ndarray) -> Path:
    path = folder / "bad.csv"
    np.savetxt(path, rows, "%.9g", ",", header=HEADER, comments="")
    return path


def tried(folder: Path, rows: np.ndarray) -> BatchResult | str:
    """The result of `ahrsd calibrate` for these rows, or its one-line error."""
    try:
        return calibrate(written(folder, rows), PLACE)
    except RecordingError as error:
        assert "\n" not in str(error)
        assert "bad.csv: " in str(error)
        return str(error)


def refused_by_ours(result: BatchResult) -> None:
    """Not converged, with a reason, and without registers."""
    assert not result.converged
    assert result.reasons()
    body = result.json("magyc")
    assert body["converged"] is False
    assert body["registers"] == {}
    assert any(reason in body["warnings"] for reason in result.reasons())


def refused_by(result: BatchResult, methods: list[str]) -> None:
    for method in methods:
        found = run_published(result, method)
        assert not found.converged, (method, found.hard_iron_gauss)
        assert found.hard_iron_gauss is None
        assert found.soft_iron is None
        assert found.reason
        assert "\n" not in found.reason


def refused(folder: Path, rows: np.ndarray) -> None:
    """A one-line error, or no answer from any method."""
    result = tried(folder, rows)
    if not isinstance(result, str):
        refused_by_ours(result)
        refused_by(result, list(METHODS))


def test_good_recording_is_answered(tmp_path):
    """Otherwise the refusals below would prove nothing."""
    result = tried(tmp_path, tumbling(1))
    assert result.converged, result.reasons()
    for method in METHODS:
        if method != "magfactor3":  # nobody knows the attitude
            assert run_published(result, method).converged, method


@FEW
@given(seed=seeds, row=st.integers(0, 399), column=st.integers(0, 6),
       value=st.sampled_from([np.nan, np.inf, -np.inf]))  # fmt: skip
def test_not_a_number(tmp_path, seed, row, column, value):
    rows = tumbling(seed, 400)
    rows[row, column] = value
    said = tried(tmp_path, rows)
    assert isinstance(said, str)
    assert f"row {row + 2}, column {HEADER.split(',')[column]}" in said


@FEW
@given(seed=seeds, noise=st.sampled_from([0.0, 1e-4, 1e-3, 1e-2]), moving=st.booleans())
def test_a_constant_field(tmp_path, seed, noise, moving):
    rows = tumbling(seed)
    rng = np.random.default_rng(seed)
    rows[:, 1:4] = rng.uniform(-0.4, 0.4, 3) + noise * rng.normal(size=(len(rows), 3))
    if not moving:
        rows[:, 4:] = 1e-3 * rng.normal(size=(len(rows), 3))
    refused(tmp_path, rows)


@FEW
@given(seed=seeds, n=st.integers(0, 60))
def test_too_few_samples(tmp_path, seed, n):
    rows = tumbling(seed, 60)[:n]
    result = tried(tmp_path, rows)
    if isinstance(result, str):
        assert n < 20
        return
    refused_by_ours(result)
    refused_by(result, ["magical-bfg", "magical-ifg", "magyc-bfg", "magyc-ifg"])


@pytest.mark.slow
@settings(FEW, max_examples=2)
@given(seed=seeds)
def test_a_planar_turn(tmp_path, seed):
    result = tried(tmp_path, tumbling(seed, planar=True))
    assert not isinstance(result, str)
    body = result.json("magyc")
    if result.converged:  # then it says what it left at the device's present value
        assert body["observability"]["unobservable"]
    else:
        refused_by_ours(result)
    refused_by(result, list(METHODS))


@FEW
@given(seed=seeds, factor=st.sampled_from([1e3, 1e-3]))
def test_the_field_in_another_unit(tmp_path, seed, factor):
    rows = tumbling(seed)
    rows[:, 1:4] *= factor
    said = tried(tmp_path, rows)
    assert isinstance(said, str)
    assert "convert it to gauss" in said


@pytest.mark.slow
@FEW
@given(seed=seeds, factor=st.sampled_from([1e3, 1e-3, 180 / np.pi, np.pi / 180]))
def test_the_rate_in_another_unit(tmp_path, seed, factor):
    """The methods that do not use the gyro give the same answer as without the error."""
    rows = tumbling(seed)
    clean = tried(tmp_path, rows)
    rows[:, 4:] *= factor
    result = tried(tmp_path, rows)
    if isinstance(result, str):
        assert "convert it to rad/s" in result
        return
    refused_by_ours(result)
    refused_by(result, GYRO)
    for method in ("ellipsoid", "fnp"):
        one, other = (run_published(r, method).hard_iron_gauss for r in (clean, result))
        assert np.array_equal(one, other)


@FEW
@given(seed=seeds, factor=st.sampled_from([1e3, 1e-3]))
def test_the_time_in_another_unit(tmp_path, seed, factor):
    rows = tumbling(seed)
    rows[:, 0] *= factor
    said = tried(tmp_path, rows)
    assert isinstance(said, str)
    assert "give the time in seconds" in said


@FEW
@given(seed=seeds, row=st.integers(1, 399), back=st.floats(0.0, 100.0))
def test_time_going_backwards(tmp_path, seed, row, back):
    rows = tumbling(seed, 400)
    rows[row:, 0] -= rows[row, 0] - rows[row - 1, 0] + back
    result = tried(tmp_path, rows)
    if isinstance(result, str):  # so near the end that nothing tells a clock that was set
        assert row > 396
        assert f"row {row + 2}, column time_s: time goes back" in result
        return
    said = " ".join(result.all_warnings())
    assert f"at row {row + 2} (" in said or "time moved on after a row of the same time" in said


@FEW
@given(seed=seeds, axis=st.integers(0, 2), part=st.floats(0.7, 0.9))
def test_saturated_readings(tmp_path, seed, axis, part):
    rows = tumbling(seed)
    limit = np.quantile(rows[:, 1 + axis], part)
    rows[:, 1 + axis] = np.minimum(rows[:, 1 + axis], limit)
    result = tried(tmp_path, rows)
    assert not isinstance(result, str)
    assert not result.converged or "stick at" in describe_saturation(result)
    ours = our_row(result, held_out=False)
    assert not ours.converged
    refused_by(result, list(METHODS))
    assert "stick at" in run_published(result, "ellipsoid").reason


@given(value=st.one_of(st.floats(max_value=0.0), st.sampled_from([np.nan, np.inf])))
@settings(max_examples=30, deadline=None)
def test_a_sigma_that_cannot_be(value):
    for name in ("mag_noise_floor_gauss", "gyro_noise_floor_rad_s", "prior_soft_iron"):
        with pytest.raises(ValueError, match=f"{name} is .*: it must be a positive number"):
            EstimatorParameters(**{name: value})
    for name in ("sigma_mag_gauss", "sigma_field_gauss"):
        with pytest.raises(MethodError, match=f"{name} is .*: it must be a positive number"):
            MethodSettings(**{name: value})


@pytest.mark.parametrize(
    ("gyro", "words"),
    [
        (np.diag([1e-3] * 3), "they are divided by 1000 once too often"),
        (np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), "the gyro's x y z are the magnetometer's"),
    ],
)
def test_wrong_gyro_is_reported(tmp_path, gyro, words):
    rows = tumbling(4)
    assert not any(words in said for said in tried(tmp_path, rows).all_warnings())
    rows[:, 4:] = rows[:, 4:] @ gyro.T
    result = tried(tmp_path, rows)
    refused_by_ours(result)
    assert any(
        words in said and "put this right" in said for said in result.json("magyc")["warnings"]
    )


def test_constant_field_of_a_turning_sensor_is_reported(tmp_path):
    rows = tumbling(4)
    assert not any("repeats one reading" in said for said in tried(tmp_path, rows).all_warnings())
    rows[500:900, 1:4] = rows[500, 1:4]
    said = [text for text in tried(tmp_path, rows).all_warnings() if "repeats one reading" in text]
    assert len(said) == 1
    assert said[0].startswith("the magnetometer repeats one reading while the sensor turns, ")
