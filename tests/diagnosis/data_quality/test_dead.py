"""Sensors that say nothing are called so, and the motion is not blamed for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.data_quality.facts import matters
from ahrsd.diagnosis.data_quality.preparation import facts_of, put_right
from ahrsd.diagnosis.data_quality.stuck import (
    dead,
    dead_axes,
    possible,
    stuck_axes,
    stuck_gyro,
)
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return track_of(experiment("mam", samples=6000, seed=3))


def _no_rows(track: Track) -> np.ndarray:
    return np.zeros(len(track), bool)


def test_a_magnetometer_that_never_changes_while_the_gyro_turns(track: Track) -> None:
    still = replace(track, mag_b_gauss=np.full_like(track.mag_b_gauss, 0.2))
    why = dead(still)
    assert why is not None
    assert "the magnetometer reads 0.2 0.2 0.2 gauss in every row while the gyro turns by" in why


def test_neither_ever_changes(track: Track) -> None:
    same = np.ones_like(track.mag_b_gauss)
    why = dead(replace(track, mag_b_gauss=0.2 * same, gyro_b_rad_s=0.0 * same))
    assert why is not None
    assert "reads 0.2 0.2 0.2 gauss and the gyro 0 0 0 rad/s in every row" in why


@pytest.mark.parametrize("scenario", ["mam", "wam", "lam"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_axis_that_never_changes_while_it_turns_is_said(scenario: str, axis: int) -> None:
    track = track_of(experiment(scenario, samples=6000, seed=axis))
    gyro, mag = track.gyro_b_rad_s.copy(), track.mag_b_gauss.copy()
    gyro[:, axis], mag[:, axis] = 0.0, 0.1
    why = dead(replace(track, gyro_b_rad_s=gyro)) or ""
    assert why.startswith(f"the gyro's {'xyz'[axis]} reads 0 rad/s in every row while the field")
    why = dead(replace(track, mag_b_gauss=mag)) or ""
    assert why.startswith(f"the magnetometer's {'xyz'[axis]} reads 0.1 gauss in every row")


@pytest.mark.parametrize("iron", [0.0, 0.1])
def test_an_axis_that_has_nothing_to_say_may_be_still(iron: float) -> None:
    """A simulation without noise that turns about one axis only, with iron."""
    t = np.arange(4000) / 25.0
    rate = 0.2 + 0.1 * np.sin(0.1 * t)
    angle = np.cumsum(rate) / 25.0
    S = np.eye(3) + iron * np.array([[0.5, 1.0, 0.3], [1.0, -0.5, 0.2], [0.3, 0.2, 0.0]])
    field = np.column_stack([0.2 * np.cos(angle), -0.2 * np.sin(angle), np.full(len(t), 0.4)])
    still = Track(
        time_s=t,
        dt_s=np.concatenate([[np.nan], np.diff(t)]),
        mag_b_gauss=field @ S.T + iron * np.array([1.0, -2.0, 0.5]),
        gyro_b_rad_s=np.column_stack([0.0 * t, 0.0 * t, rate]),
        accel_b_m_s2=None,
    )
    assert dead(still) is None


def test_a_field_in_no_unit(track: Track) -> None:
    why = dead(replace(track, mag_b_gauss=1e30 * track.mag_b_gauss))
    assert why is not None
    assert "a field in no unit" in why


@pytest.mark.parametrize(
    "name",
    ["vn100/static_2025_kiran_5min", "vn100/F00379", "broad/01_undisturbed_slow_rotation_A",
     "broad/36_disturbed_attached_magnet_5cm", "arducopter/log171_MAG2_10hz",
     "vn100/drive_2022_rahul", "vn100/walk_square_2024_sazgar"],
)  # fmt: skip
@pytest.mark.recordings
def test_nothing_is_said_of_sensors_that_work(name: str) -> None:
    real = recorded(name)
    assert dead(real) is None
    assert dead_axes(real) == ()
    assert possible(real) == (real, ())
    assert stuck_gyro(real) == []
    assert stuck_axes(real, _no_rows(real)) == []


def test_a_dead_axis_is_said(track: Track) -> None:
    gyro = track.gyro_b_rad_s * np.array([1.0, 1.0, 0.0])
    (line,) = dead_axes(replace(track, gyro_b_rad_s=gyro))
    assert line.startswith("the gyro's z reads 0 in every row")


def test_an_axis_that_is_stuck_for_a_while_is_not_used(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[2000:3000, 1] = mag[2000, 1]
    (fact,) = facts_of(replace(track, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.where.axes == ("y",)
    assert fact.bad is not None
    assert np.array_equal(np.flatnonzero(fact.bad), np.arange(2001, 3000))


def test_a_gyro_that_is_stuck_for_a_while_ends_the_run(track: Track) -> None:
    gyro = track.gyro_b_rad_s.copy()
    gyro[2000:3000] = gyro[2000]
    wrong = replace(track, gyro_b_rad_s=gyro)
    (fact,) = facts_of(wrong)
    assert not matters(fact)
    assert "the gyro repeats one reading while the field turns" in fact.words
    right = put_right(wrong, (fact,))
    assert np.isnan(right.dt_s[2001:3000]).all()
    assert np.isfinite(right.dt_s[3000:]).all()


def test_readings_of_zero_are_none(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[3000:] = 0.0
    (fact,) = facts_of(replace(track, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.bad is not None
    assert fact.bad[3000:].all()


def test_readings_that_no_sensor_gives_are_left_out(track: Track) -> None:
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    mag[50, 0], gyro[70:72, 1] = 1e300, 1e9
    clean, notes = possible(replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro))
    assert [note.split(" beyond")[0] for note in notes] == [
        "1 reading of the magnetometer",
        "2 rates",
    ]
    assert np.flatnonzero(np.isnan(clean.mag_b_gauss).any(axis=1)).tolist() == [50]
    assert np.flatnonzero(np.isnan(clean.dt_s)).tolist() == [0, 70, 71]
    assert len(clean.runs) == 3
