"""Stuck and dead sensors are recognised, and not attributed to the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from single_fact import only, value
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.data_quality.facts import is_finding
from ahrsd.diagnosis.data_quality.preparation import correct_track, find_facts
from ahrsd.diagnosis.data_quality.stuck import (
    dead_axis_notes,
    dead_sensor_reason,
    expected_change_gauss,
    find_stuck_axes,
    find_stuck_gyro,
    without_impossible_readings,
)
from ahrsd.diagnosis.track import Track


def _no_rows(track: Track) -> np.ndarray:
    return np.zeros(len(track), bool)


def test_constant_magnetometer_is_dead_when_the_gyro_turns(track: Track) -> None:
    still = replace(track, mag_b_gauss=np.full_like(track.mag_b_gauss, 0.2))
    why = dead_sensor_reason(still)
    assert why is not None
    assert "the magnetometer reads 0.2 0.2 0.2 gauss in every row while the gyro turns by" in why


def test_two_constant_sensors_are_reported_together(track: Track) -> None:
    same = np.ones_like(track.mag_b_gauss)
    why = dead_sensor_reason(replace(track, mag_b_gauss=0.2 * same, gyro_b_rad_s=0.0 * same))
    assert why is not None
    assert "reads 0.2 0.2 0.2 gauss and the gyro 0 0 0 rad/s in every row" in why


@pytest.mark.parametrize("scenario", ["mam", "wam", "lam"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_constant_axis_is_reported_when_the_other_sensor_turns_about_it(
    scenario: str, axis: int
) -> None:
    track = track_of(experiment(scenario, samples=6000, seed=axis))
    gyro, mag = track.gyro_b_rad_s.copy(), track.mag_b_gauss.copy()
    gyro[:, axis], mag[:, axis] = 0.0, 0.1
    why = dead_sensor_reason(replace(track, gyro_b_rad_s=gyro)) or ""
    assert why.startswith(f"the gyro's {'xyz'[axis]} reads 0 rad/s in every row while the field")
    why = dead_sensor_reason(replace(track, mag_b_gauss=mag)) or ""
    assert why.startswith(f"the magnetometer's {'xyz'[axis]} reads 0.1 gauss in every row")


@pytest.mark.parametrize("iron", [0.0, 0.1])
def test_axis_without_motion_may_be_constant(iron: float) -> None:
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
    assert dead_sensor_reason(still) is None


def test_field_of_impossible_size_is_refused(track: Track) -> None:
    why = dead_sensor_reason(replace(track, mag_b_gauss=1e30 * track.mag_b_gauss))
    assert why is not None
    assert "no magnetic field in any unit" in why


@pytest.mark.parametrize(
    "name",
    ["vn100/static_2025_kiran_5min", "vn100/F00379", "broad/01_undisturbed_slow_rotation_A",
     "broad/36_disturbed_attached_magnet_5cm", "arducopter/log171_MAG2_10hz",
     "vn100/drive_2022_rahul", "vn100/walk_square_2024_sazgar"],
)  # fmt: skip
@pytest.mark.recordings
def test_no_fault_is_reported_for_working_sensors(name: str) -> None:
    real = recorded(name)
    assert dead_sensor_reason(real) is None
    assert dead_axis_notes(real) == ()
    assert without_impossible_readings(real) == (real, ())
    assert find_stuck_gyro(real) == []
    assert find_stuck_axes(real, _no_rows(real)) == []


def test_dead_axis_is_reported_in_a_note(track: Track) -> None:
    gyro = track.gyro_b_rad_s * np.array([1.0, 1.0, 0.0])
    (line,) = dead_axis_notes(replace(track, gyro_b_rad_s=gyro))
    assert line.startswith("the gyro's z reads 0 in every row")


def test_readings_of_a_temporarily_stuck_axis_are_not_used(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[2000:3000, 1] = mag[2000, 1]
    (fact,) = find_facts(replace(track, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.where.axes == ("y",)
    assert fact.bad is not None
    assert np.array_equal(np.flatnonzero(fact.bad), np.arange(2001, 3000))


def test_temporarily_stuck_gyro_ends_the_run(track: Track) -> None:
    gyro = track.gyro_b_rad_s.copy()
    gyro[2000:3000] = gyro[2000]
    wrong = replace(track, gyro_b_rad_s=gyro)
    (fact,) = find_facts(wrong)
    assert not is_finding(fact)
    assert "the gyro repeats one reading while the field turns" in fact.words
    right = correct_track(wrong, (fact,))
    assert np.isnan(right.dt_s[2001:3000]).all()
    assert np.isfinite(right.dt_s[3000:]).all()


def test_zero_readings_count_as_missing(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[3000:] = 0.0
    (fact,) = find_facts(replace(track, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.bad is not None
    assert fact.bad[3000:].all()


def test_impossible_readings_are_left_out(track: Track) -> None:
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    mag[50, 0], gyro[70:72, 1] = 1e300, 1e9
    clean, notes = without_impossible_readings(replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro))
    assert [note.split(" beyond")[0] for note in notes] == [
        "1 reading of the magnetometer",
        "2 rates",
    ]
    assert np.flatnonzero(np.isnan(clean.mag_b_gauss).any(axis=1)).tolist() == [50]
    assert np.flatnonzero(np.isnan(clean.dt_s)).tolist() == [0, 70, 71]
    assert len(clean.runs) == 3


def test_stuck_magnetometer_is_found_and_its_readings_are_not_used(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[2000:2125] = mag[2000]
    stuck = replace(track, mag_b_gauss=mag)
    fact = only(find_facts(stuck))
    assert fact.effect == "stuck_magnetometer"
    assert abs(value(fact) - 124 * 0.04) < 0.05
    begin, end = fact.where.intervals_s[0]
    assert abs(begin - track.time_s[2000]) < 0.05
    assert abs(end - track.time_s[2124]) < 0.05
    right = correct_track(stuck, (fact,))
    assert np.isnan(right.mag_b_gauss[2001:2125]).all()
    assert np.isfinite(right.mag_b_gauss[2000]).all()


def test_held_readings_are_found_with_their_hold_length(track: Track) -> None:
    at = np.arange(len(track)) // 4 * 4
    fact = only(find_facts(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert fact.setting["hold"] == 4
    assert fact.bad is not None
    assert abs(np.mean(fact.bad) - 0.75) < 0.01


@pytest.mark.parametrize("rows", [1.34, 1.21, 2.7, 6.3])
def test_hold_length_is_found_when_it_is_not_a_whole_number_of_rows(
    track: Track, rows: float
) -> None:
    count = np.arange(len(track))
    at = np.ceil(np.floor(count / rows + 1e-9) * rows - 1e-9).astype(int)
    fact = only(find_facts(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert abs(fact.setting["hold"] - rows) < 0.01
    assert f"only every {fact.setting['hold']:.4g} samples" in fact.words
    assert fact.bad is not None
    assert abs(np.mean(fact.bad) - (1.0 - 1.0 / rows)) < 0.01


def test_random_repeats_are_not_held_readings(track: Track) -> None:
    """They repeat as often as those of a magnetometer that is held for 1.34 rows."""
    again = np.random.default_rng(3).random(len(track)) < 0.25
    at = np.maximum.accumulate(np.where(again, 0, np.arange(len(track))))
    assert not find_facts(replace(track, mag_b_gauss=track.mag_b_gauss[at]))


@pytest.mark.parametrize("share", [0.005, 0.01, 0.02, 0.05])
def test_rare_random_repeats_are_not_held_readings(track: Track, share: float) -> None:
    """Many draws with some tens of repeated readings: a drive of 26,857 rows has 46."""
    told = []
    for seed in range(25):
        again = np.random.default_rng(seed).random(len(track)) < share
        at = np.maximum.accumulate(np.where(again, 0, np.arange(len(track))))
        told += find_facts(replace(track, mag_b_gauss=track.mag_b_gauss[at]))
    assert [fact.words for fact in told] == []


def test_hold_of_1_02_samples_is_found(track: Track) -> None:
    """39.2 new readings per second in 40 rows."""
    count = np.arange(len(track))
    at = np.ceil(np.floor(count / 1.02 + 1e-9) * 1.02 - 1e-9).astype(int)
    fact = only(find_facts(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert "only every 1.02 samples" in fact.words


def test_held_readings_above_100_hz_are_no_fault(track: Track) -> None:
    """Rows at 400 Hz from a magnetometer with 200 new readings per second."""
    time_s = np.arange(len(track)) / 400.0
    dt_s = np.where(np.isfinite(track.dt_s), 1 / 400.0, np.nan)
    at = np.arange(len(track)) // 2 * 2
    fast = replace(
        track,
        time_s=time_s,
        dt_s=dt_s,
        gyro_b_rad_s=track.gyro_b_rad_s * 400.0 * float(np.nanmedian(track.dt_s)),
        mag_b_gauss=track.mag_b_gauss[at],
    )
    assert [fact.effect for fact in find_facts(fast)] == []


def test_doubled_samples_are_found(track: Track) -> None:
    order = np.sort(np.r_[np.arange(5900), np.arange(40, 5840, 58)])
    doubled = replace(
        track, mag_b_gauss=track.mag_b_gauss[order], gyro_b_rad_s=track.gyro_b_rad_s[order]
    )
    fact = only(find_facts(doubled))
    assert fact.effect == "dropped_samples"
    assert fact.setting == {"doubled": True}
    assert abs(value(fact) - 100 / 6000) < 2e-3


def test_coarse_values_in_a_turn_about_one_axis_are_not_doubled_samples() -> None:
    """About the other axes the values of each sensor repeat by chance, sometimes both at once."""
    rng = np.random.default_rng(12)
    time_s = np.arange(16000) / 80.0
    angle = np.cumsum(0.25 + 0.2 * np.sin(0.3 * time_s)) / 80.0
    h = np.column_stack([0.2 * np.cos(angle), -0.2 * np.sin(angle), np.full_like(angle, 0.4)])
    rate = np.column_stack([0 * angle, 0 * angle, np.gradient(angle, time_s)])
    noise_m, noise_g = 1.6e-3, 1.4e-4
    coarse_m, coarse_g = 2.1 * noise_m, 2.0 * noise_g
    mag = np.round((h + noise_m * rng.standard_normal(h.shape)) / coarse_m) * coarse_m
    gyro = np.round((rate + noise_g * rng.standard_normal(h.shape)) / coarse_g) * coarse_g
    dt_s = np.full(len(h), 1 / 80.0)
    dt_s[0] = np.nan
    spin = Track(time_s, dt_s, mag, gyro, None, {}, (slice(0, len(h)),))
    again = np.all(mag[1:] == mag[:-1], axis=1) & np.all(gyro[1:] == gyro[:-1], axis=1)
    assert np.count_nonzero(again) > 2e-3 * len(h)
    assert "dropped_samples" not in [fact.effect for fact in find_facts(spin)]


def test_short_stop_at_rest_is_found_if_another_stop_occurs_in_a_turn(track: Track) -> None:
    """Ten equal readings in a turn are not chance. They make a second stop, at rest, credible."""
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    mag[2000:2012], mag[3000:3012] = mag[2000], mag[3000]
    gyro[3000:3012] = np.median(gyro, axis=0)
    fact = only(find_facts(replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro)))
    assert fact.effect == "stuck_magnetometer"
    assert [begin for begin, _ in fact.where.intervals_s] == [
        track.time_s[2000],
        track.time_s[3000],
    ]
    at_rest = track.mag_b_gauss.copy()
    at_rest[3000:3012] = at_rest[3000]
    assert find_facts(replace(track, mag_b_gauss=at_rest, gyro_b_rad_s=gyro)) == ()


@pytest.mark.parametrize(("rate_hz", "rows", "found"), [(286.0, 9, False), (40.0, 12, True)])
def test_single_delayed_reading_is_a_note_and_no_finding(
    rate_hz: float, rows: int, found: bool
) -> None:
    """Eight rows at 286 Hz are 28 ms: they are not used, and noted."""
    made = track_of(experiment("wam", samples=4000, rate_hz=rate_hz, sigma_mag=5e-5))
    mag = made.mag_b_gauss.copy()
    mag[2000 : 2000 + rows] = mag[2000]
    facts = find_facts(replace(made, mag_b_gauss=mag))
    assert [fact.effect for fact in facts] == ["stuck_magnetometer"]
    assert is_finding(facts[0]) is found
    assert facts[0].bad is not None
    assert facts[0].bad[2001 : 2000 + rows].all()


def test_repeatedly_delayed_readings_are_a_finding() -> None:
    """Four times 95 ms at 200 Hz: each is short, 0.38 s in total."""
    made = track_of(experiment("wam", samples=8000, rate_hz=200.0, sigma_mag=5e-5))
    mag = made.mag_b_gauss.copy()
    for first in (1000, 3000, 5000, 7000):
        mag[first : first + 20] = mag[first]
    (fact,) = find_facts(replace(made, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.parameters[0].value == pytest.approx(0.38, abs=0.006)
    assert is_finding(fact)


def test_turn_about_the_field_changes_no_reading_at_any_hard_iron(track: Track) -> None:
    """A working sensor with steps of 8 mG then repeats its reading."""
    centre, field = np.array([0.0, 0.4, 0.0]), np.array([0.1, 0.0, 0.2])
    rate = np.zeros((len(track), 3))
    rate[100:200] = field / np.linalg.norm(field)  # 1 rad/s
    still = replace(
        track,
        mag_b_gauss=np.tile(centre + field, (len(track), 1)),
        gyro_b_rad_s=rate,
    )
    seconds = 100 * track.step_s
    assert expected_change_gauss(still, centre, 100, 200) == pytest.approx(0.0, abs=1e-12)
    assert expected_change_gauss(still, np.zeros(3), 100, 200) == pytest.approx(0.4 * seconds)
