"""Hygiene: each fault is found with its numbers, and nothing on clean recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from tracks import experiment, recorded, track_of, true_model

from ahrsd import so3
from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.data_quality.axes_and_units import as_recorded, ranked, windows
from ahrsd.diagnosis.data_quality.dropped_samples import missing_turns, whole_nats
from ahrsd.diagnosis.data_quality.facts import Fact, around, lost_at, matters, spans_of
from ahrsd.diagnosis.data_quality.preparation import facts_of, put_right, would_have_shown
from ahrsd.diagnosis.data_quality.range_and_resolution import clipping, quantisation, step_of
from ahrsd.diagnosis.data_quality.stuck import turned_gauss
from ahrsd.diagnosis.data_quality.timestamps import regular
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

CLEAN = (
    "broad/01_undisturbed_slow_rotation_A",
    "broad/02_undisturbed_slow_rotation_B",
    "broad/21_undisturbed_fast_combined",
    "vn100/hand_2023_thumatti",
    "repoimu/TStick_Test11_Trial1",
    "vn100/drive_2022_rahul",
    "vn100/static_2025_kiran_5min",
)


def _only(facts: tuple[Fact, ...]) -> Fact:
    assert len(facts) == 1, [fact.words for fact in facts]
    return facts[0]


def _value(fact: Fact) -> float:
    return fact.parameters[0].value


@pytest.fixture(scope="module")
def track() -> Track:
    return track_of(experiment("mam", samples=6000, seed=3))


@pytest.mark.parametrize(
    ("scenario", "motion", "sigma"),
    [("wam", "rov", 5e-4), ("mam", "slow", 5e-3), ("lam", "slow", 5e-3), ("lam", "rov", 5e-4)],
)
def test_nothing_on_simulated_nulls(scenario: str, motion: str, sigma: float) -> None:
    for seed in range(6):
        made = experiment(scenario, motion=motion, seed=seed, samples=5000, sigma_gyro=sigma)
        assert facts_of(track_of(made)) == ()


@pytest.mark.parametrize("name", CLEAN)
@pytest.mark.recordings
def test_nothing_that_matters_on_clean_recordings(name: str) -> None:
    assert [fact.words for fact in facts_of(recorded(name)) if matters(fact)] == []


@pytest.mark.parametrize(
    ("axes", "signs"),
    [
        ([0, 2, 1], [-1, 1, 1]),
        ([1, 0, 2], [1, 1, -1]),
        ([0, 1, 2], [1, 1, -1]),
        ([2, 0, 1], [1, 1, 1]),
    ],
)
def test_a_wrong_frame_is_named_and_undone(track: Track, axes: list[int], signs: list[int]) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s[:, axes] * np.array(signs))
    fact = _only(facts_of(wrong))
    assert fact.effect == "frame_error"
    assert fact.stops
    assert fact.confidence > 0.9
    assert np.array_equal(put_right(wrong, (fact,)).gyro_b_rad_s, track.gyro_b_rad_s)


def test_a_turn_at_a_constant_rate_says_nothing_of_axes_and_unit() -> None:
    """Soft iron bends its circle to an ellipse, and any frame explains that a little."""
    rng = np.random.default_rng(8)
    time_s = np.arange(8000) / 40.0
    angle = 0.4 * time_s
    h = 0.45 * np.column_stack([0.5 * np.cos(angle), -0.5 * np.sin(angle), 0.8 + 0 * angle])
    iron = np.array([[1.06, 0.04, 0.0], [0.04, 0.95, -0.03], [0.0, -0.03, 0.99]])
    mag = h @ iron + np.array([0.1, -0.05, 0.12]) + 6e-4 * rng.standard_normal(h.shape)
    gyro = np.array([0.003, -0.002, 0.404]) + 3e-4 * rng.standard_normal(h.shape)
    dt_s = np.full(len(h), 1 / 40.0)
    dt_s[0] = np.nan
    spin = Track(time_s, dt_s, mag, gyro, None, {}, (slice(0, len(h)),))
    assert [fact.words for fact in facts_of(spin)] == []
    assert any("would not have been seen" in line for line in would_have_shown(spin))


def test_left_handed_axes_are_called_so(track: Track) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s * np.array([1.0, 1.0, -1.0]))
    assert "left-handed" in _only(facts_of(wrong)).words


MIRRORED = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]
TURNED = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
SWAPPED = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]
QUARTER = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (MIRRORED, "is left-handed: negate its y (where"),
        (TURNED, "is turned against the gyro: negate its x and z (where"),
        (SWAPPED, "is left-handed: its right x y z are its y x z as read"),
        (QUARTER, "is turned against the gyro: its right x y z are its -y x z as read"),
    ],
)
def test_a_mirrored_magnetometer_is_no_turned_gyro(read: list[list[int]], words: str) -> None:
    """By gyro and field alone m and -m are the same; gravity tells, or every heading is off."""
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, mag_b_gauss=made.mag_b_gauss @ np.array(read, float).T)
    fact = _only(facts_of(wrong))
    assert fact.effect == "frame_error"
    assert words in fact.words
    assert fact.where.frame == "sensor"
    if read is MIRRORED:
        assert "negate its x and z" in fact.words.partition("south of the magnetic equator")[2]


def test_without_gravity_nobody_is_told_to_turn_a_sensor() -> None:
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, mag_b_gauss=made.mag_b_gauss * np.array([1.0, -1.0, 1.0]))
    words = _only(facts_of(replace(wrong, accel_b_m_s2=None))).words
    assert "or the magnetometer is left-handed (negate its y)" in words
    assert "180 deg" in words


def test_a_turned_gyro_is_told_by_the_accelerometer() -> None:
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, gyro_b_rad_s=made.gyro_b_rad_s * np.array([-1.0, 1.0, -1.0]))
    fact = _only(facts_of(wrong))
    assert fact.words == "the gyro's x y z are the magnetometer's -x y -z and the accelerometer's"
    assert fact.where.frame == "gyro"


@pytest.mark.parametrize(
    ("turn_deg", "about"),
    [
        ((0.0, 0.0, 45.0), "45.0 deg about its z"),
        ((-20.0, 0.0, 0.0), "20.0 deg about its x"),
        ((0.0, 140.0, 0.0), "140.0 deg about its y"),
        ((30.0, -30.0, 30.0), "52.0 deg ("),
    ],
)
def test_a_magnetometer_that_is_askew_is_told_with_its_angle(
    turn_deg: tuple[float, float, float], about: str
) -> None:
    """R_mg from the gyro's axes to the magnetometer's; the advice puts its readings right."""
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([turn_deg]))[0]
    turned = replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T)
    fact = _only(facts_of(turned))
    assert fact.effect == "mag_gyro_misalignment"
    assert fact.stops
    found = np.degrees([value.value for value in fact.parameters])
    assert np.abs(found - turn_deg).max() < 0.6
    by = f"{np.linalg.norm(found):.1f} deg"
    assert fact.words.startswith(f"the magnetometer is turned against the gyro by {by}")
    assert about.partition(" deg")[2] in fact.words
    assert "times its readings" in fact.words
    assert ("out of the ground" in fact.words) == (
        np.mean(np.sum(turned.mag_b_gauss @ R_mg * -whole.accel_b_m_s2, axis=1)) < 0
    )


def test_without_gravity_either_sensor_may_be_askew() -> None:
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([[0.0, 0.0, 45.0]]))[0]
    turned = replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T, accel_b_m_s2=None)
    assert "or the gyro is the one that is turned" in _only(facts_of(turned)).words


def test_a_crooked_mount_of_five_degrees_is_no_wrong_frame() -> None:
    """The search names it with its deviation, and what is fitted beside it means something."""
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([[0.0, 5.0, 0.0]]))[0]
    assert as_recorded(replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T)) == []


def test_iron_that_deforms_favours_no_other_frame() -> None:
    """A slow turn of half a period; the frames' fit leaves out iron that deforms by a fifth."""
    made = experiment("wam", motion="slow", seed=0, samples=10_000, rate_hz=100.0, sigma_gyro=5e-3)
    assert facts_of(track_of(made)) == ()


def test_degrees_and_swapped_axes_together(track: Track) -> None:
    wrong = replace(track, gyro_b_rad_s=np.degrees(track.gyro_b_rad_s[:, [1, 0, 2]]))
    facts = facts_of(wrong)
    assert {fact.effect for fact in facts} == {"frame_error", "unit_error"}
    unit = next(fact for fact in facts if fact.effect == "unit_error")
    assert abs(_value(unit) / (180 / np.pi - 1) - 1) < 1e-9
    assert "deg/s" in unit.words
    assert np.abs(put_right(wrong, facts).gyro_b_rad_s - track.gyro_b_rad_s).max() < 1e-12


@pytest.mark.parametrize(("unit", "factor"), [("uT", 100.0), ("mG", 1e3), ("nT", 1e5), ("T", 1e-4)])
def test_the_magnetometers_unit_by_the_earths_field(track: Track, unit: str, factor: float) -> None:
    wrong = replace(track, mag_b_gauss=track.mag_b_gauss * factor)
    facts = [fact for fact in facts_of(wrong) if fact.effect == "unit_error"]
    fact = _only(tuple(facts))
    assert fact.setting == {"sensor": "mag", "unit": unit}
    right = put_right(wrong, facts).mag_b_gauss
    assert np.abs(right / track.mag_b_gauss - 1).max() < 1e-12


def test_a_quiet_motion_does_not_tell_the_frame() -> None:
    """At rest every frame fits: nothing is said, and the sensitivity says why."""
    made = experiment("lam", samples=2000)
    rng = np.random.default_rng(1)
    at_rest = replace(
        track_of(made),
        mag_b_gauss=np.array([0.2, 0.1, 0.4]) + 1e-3 * rng.standard_normal((2000, 3)),
        gyro_b_rad_s=1e-3 * rng.standard_normal((2000, 3)),
    )
    assert facts_of(at_rest) == ()
    assert "hardly turned" in would_have_shown(at_rest)[-1]
    assert "left-handed" in would_have_shown(track_of(made))[-1]


def test_a_stuck_magnetometer(track: Track) -> None:
    mag = track.mag_b_gauss.copy()
    mag[2000:2125] = mag[2000]
    stuck = replace(track, mag_b_gauss=mag)
    fact = _only(facts_of(stuck))
    assert fact.effect == "stuck_magnetometer"
    assert abs(_value(fact) - 124 * 0.04) < 0.05
    begin, end = fact.where.intervals_s[0]
    assert abs(begin - track.time_s[2000]) < 0.05
    assert abs(end - track.time_s[2124]) < 0.05
    right = put_right(stuck, (fact,))
    assert np.isnan(right.mag_b_gauss[2001:2125]).all()
    assert np.isfinite(right.mag_b_gauss[2000]).all()


def test_a_held_magnetometer(track: Track) -> None:
    at = np.arange(len(track)) // 4 * 4
    fact = _only(facts_of(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert fact.setting["hold"] == 4
    assert fact.bad is not None
    assert abs(np.mean(fact.bad) - 0.75) < 0.01


@pytest.mark.parametrize("rows", [1.34, 1.21, 2.7, 6.3])
def test_a_magnetometer_that_is_read_a_little_more_often_than_it_measures(
    track: Track, rows: float
) -> None:
    count = np.arange(len(track))
    at = np.ceil(np.floor(count / rows + 1e-9) * rows - 1e-9).astype(int)
    fact = _only(facts_of(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert abs(fact.setting["hold"] - rows) < 0.01
    assert f"only every {fact.setting['hold']:.4g} samples" in fact.words
    assert fact.bad is not None
    assert abs(np.mean(fact.bad) - (1.0 - 1.0 / rows)) < 0.01


def test_numbers_that_repeat_by_chance_are_not_held(track: Track) -> None:
    """As often as of a magnetometer that is held for 1.34 rows."""
    again = np.random.default_rng(3).random(len(track)) < 0.25
    at = np.maximum.accumulate(np.where(again, 0, np.arange(len(track))))
    assert not facts_of(replace(track, mag_b_gauss=track.mag_b_gauss[at]))


@pytest.mark.parametrize("share", [0.005, 0.01, 0.02, 0.05])
def test_the_few_that_repeat_by_chance_are_no_clock(track: Track, share: float) -> None:
    """Some tens of repeated readings, of many draws: a drive of 26,857 rows has 46."""
    told = []
    for seed in range(25):
        again = np.random.default_rng(seed).random(len(track)) < share
        at = np.maximum.accumulate(np.where(again, 0, np.arange(len(track))))
        told += facts_of(replace(track, mag_b_gauss=track.mag_b_gauss[at]))
    assert [fact.words for fact in told] == []


def test_a_clock_that_repeats_seldom_is_told(track: Track) -> None:
    """39.2 readings a second in 40 rows."""
    count = np.arange(len(track))
    at = np.ceil(np.floor(count / 1.02 + 1e-9) * 1.02 - 1e-9).astype(int)
    fact = _only(facts_of(replace(track, mag_b_gauss=track.mag_b_gauss[at])))
    assert fact.effect == "mag_sample_hold"
    assert "only every 1.02 samples" in fact.words


def test_a_rate_of_its_own_above_100_hz_is_ordinary(track: Track) -> None:
    """Rows at 400 Hz of a magnetometer that has 200 new readings a second."""
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
    assert [fact.effect for fact in facts_of(fast)] == []


def test_doubled_samples(track: Track) -> None:
    order = np.sort(np.r_[np.arange(5900), np.arange(40, 5840, 58)])
    doubled = replace(
        track, mag_b_gauss=track.mag_b_gauss[order], gyro_b_rad_s=track.gyro_b_rad_s[order]
    )
    fact = _only(facts_of(doubled))
    assert fact.effect == "dropped_samples"
    assert fact.setting == {"doubled": True}
    assert abs(_value(fact) - 100 / 6000) < 2e-3


def test_coarse_numbers_of_a_vehicle_that_turns_about_one_axis_came_once() -> None:
    """About the others each sensor's numbers repeat by chance, and now and then at once."""
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
    assert "dropped_samples" not in [fact.effect for fact in facts_of(spin)]


def test_a_limit_that_the_sensor_stays_near_for_long(track: Track) -> None:
    """A slow and small motion leaves many readings just below the limit, each of another number."""
    rng = np.random.default_rng(5)
    mag = 0.3 + 0.02 * np.sin(0.02 * track.time_s)[:, None] * np.array([1.0, 0.6, -0.4])
    mag += 5e-4 * rng.standard_normal(mag.shape)
    slow = replace(track, mag_b_gauss=mag, gyro_b_rad_s=1e-4 * rng.standard_normal(mag.shape))
    assert clipping(slow) == []
    ends = mag.copy()
    ends[:, 0] = np.minimum(mag[:, 0], np.quantile(mag[:, 0], 0.97))
    (fact,) = clipping(replace(slow, mag_b_gauss=ends))
    assert fact.effect == "mag_saturation"
    assert _value(fact) == ends[:, 0].max()
    assert fact.where.axes == ("x",)
    stuck = mag.copy()
    at = int(np.argmax(mag[:, 0]))
    stuck[at : at + 40] = mag[at]
    assert clipping(replace(slow, mag_b_gauss=stuck)) == []


def test_the_tail_of_noise_is_no_whole_step() -> None:
    rng = np.random.default_rng(3)
    scatter = np.full(9, 0.18)
    whole = 1.0 + 0.18 * rng.standard_normal(9)
    noise = 0.18 * rng.standard_normal(400_000)
    tail = noise[noise > 0.7][:9]
    assert len(tail) == 9
    assert whole_nats(whole, scatter) > 12.0
    assert whole_nats(tail, scatter) < 0.0
    assert whole_nats(np.array([2.0, 1.0]), np.full(2, 0.1)) > whole_nats(
        np.array([0.75, 0.8]), np.full(2, 0.1)
    )


def test_noise_that_is_added_behind_a_limit_hides_none_of_what_stands_there(track: Track) -> None:
    """A sensor at its limit whose converter adds noise: some readings are well below the limit."""
    rng = np.random.default_rng(6)
    clean = np.clip(track.mag_b_gauss, -0.3, 0.3)
    mag = np.clip(clean + 8e-4 * rng.standard_normal(clean.shape), -0.3, 0.3)
    (fact,) = clipping(replace(track, mag_b_gauss=mag))
    at_limit = (np.abs(clean) == 0.3).any(axis=1)
    assert np.count_nonzero(at_limit) > 500
    assert fact.bad is not None
    assert fact.bad[at_limit].all()
    assert not fact.bad[(np.abs(clean) < 0.28).all(axis=1)].any()


def test_saturation_of_both_sensors(track: Track) -> None:
    mag = np.clip(track.mag_b_gauss, -np.inf, 0.3)
    fact = _only(facts_of(replace(track, mag_b_gauss=mag)))
    assert fact.effect == "mag_saturation"
    assert _value(fact) == 0.3
    assert fact.bad is not None
    assert fact.bad[(mag == 0.3).any(axis=1)].all()
    assert not fact.bad[(np.abs(mag) < 0.29).all(axis=1)].any()
    top = 0.7 * float(np.abs(track.gyro_b_rad_s).max())
    fact = _only(facts_of(replace(track, gyro_b_rad_s=np.clip(track.gyro_b_rad_s, -top, top))))
    assert fact.effect == "gyro_saturation"
    assert fact.turned is not None
    clipped = np.max(np.abs(track.gyro_b_rad_s), axis=1) >= top
    assert np.isnan(fact.turned[clipped]).all()
    right = put_right(track, (fact,))
    assert np.isnan(right.dt_s[clipped]).all()
    assert sum(run.stop - run.start for run in right.runs) == len(track)
    assert len(right.runs) > 2
    assert _value(fact) == top


def test_coarse_steps(track: Track) -> None:
    coarse = replace(track, mag_b_gauss=np.round(track.mag_b_gauss / 0.01) * 0.01)
    fact = _only(facts_of(coarse))  # neither a limit nor a stuck sensor, though readings repeat
    assert fact.effect == "mag_quantisation"
    assert abs(_value(fact) / 0.01 - 1) < 1e-6
    fine = replace(track, mag_b_gauss=np.round(track.mag_b_gauss / 1e-4) * 1e-4)
    assert facts_of(fine) == ()


def test_steps_so_coarse_that_most_seconds_show_no_change(track: Track) -> None:
    turn = 0.01 * (track.time_s - track.time_s[0])
    slow = 0.3 * np.column_stack([np.cos(turn), np.sin(turn), np.cos(turn + 1)])
    slow += np.random.default_rng(6).normal(0, 5e-4, slow.shape)
    coarse = replace(track, mag_b_gauss=np.round(slow / 0.02) * 0.02)
    assert noise_of_differences(coarse)[0] == 0.0
    [fact] = quantisation(coarse)
    assert abs(_value(fact) / 0.02 - 1) < 1e-6
    # a sensor that stands for three seconds each has no change either, but then it jumps
    stood = np.random.default_rng(7).integers(100, 200, (len(track) // 120 + 1, 3))
    stuck = replace(track, mag_b_gauss=np.repeat(1e-3 * stood, 120, axis=0)[: len(track)])
    assert noise_of_differences(stuck)[0] == 0.0
    assert abs(step_of(stuck.mag_b_gauss[:, 1]) / 1e-3 - 1) < 1e-6
    assert quantisation(stuck) == []


def _without(track: Track, keep: np.ndarray, *, restamp: bool) -> Track:
    """The track without rows; restamped: the time stamps do not show it."""
    time_s = track.time_s[: len(keep)] if restamp else track.time_s[keep]
    assert track.accel_b_m_s2 is not None
    return Track(
        time_s,
        np.diff(time_s, prepend=np.nan),
        track.mag_b_gauss[keep],
        track.gyro_b_rad_s[keep],
        track.accel_b_m_s2[keep],
        {},
        (slice(0, len(keep)),),
    )


@pytest.mark.parametrize("missing", [0.02, 0.3])
def test_missing_samples_by_their_stamps(track: Track, missing: float) -> None:
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > missing)
    fact = _only(facts_of(_without(track, keep, restamp=False)))
    assert fact.effect == "dropped_samples"
    assert abs(_value(fact) - (1 - len(keep) / len(track))) < 1e-3


def test_missing_samples_without_a_gap_in_the_stamps() -> None:
    made = experiment("mam", samples=6000, seed=3, sigma_mag=5e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=5e-4)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > 0.01)
    cut = _without(track, keep, restamp=True)
    facts = missing_turns(run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = _only(tuple(facts))
    assert fact.effect == "dropped_samples"
    assert 0.004 < _value(fact) < 0.02
    right = put_right(cut, (fact,))
    turned = np.linalg.norm(right.gyro_b_rad_s, axis=1) / np.linalg.norm(cut.gyro_b_rad_s, axis=1)
    assert np.count_nonzero(turned > 1.9) == len(fact.where.intervals_s)
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    assert missing_turns(run_filter(track, model), rate) == []


def test_missing_samples_of_a_slow_motion_are_seen_over_more_samples() -> None:
    made = experiment("lam", samples=9000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > 0.015)
    cut = _without(track, keep, restamp=True)
    facts = missing_turns(run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    assert abs(_value(_only(tuple(facts))) - 0.015) < 0.008


def test_missing_samples_are_seen_where_whole_seconds_are_missing_too() -> None:
    """On its way back from a large jump the filter makes many that no lost turn makes."""
    made = experiment("mam", samples=6000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    rng = np.random.default_rng(5)
    kept = rng.random(len(track)) > 0.008
    for first in rng.integers(300, 5600, 8):
        kept[first : first + 40] = False
    cut = _without(track, np.flatnonzero(kept), restamp=True)
    # as slow as a filter is that believes its gyro
    slow = replace(model, sigma_gyro_rad_s=1e-4)
    facts = missing_turns(run_filter(cut, slow), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = _only(tuple(facts))
    assert fact.effect == "dropped_samples"
    assert 4 <= fact.setting["long"] <= 10


def test_jittering_stamps_and_their_regular_clock(track: Track) -> None:
    rng = np.random.default_rng(2)
    stamped = track.time_s + 3e-3 * rng.standard_normal(len(track))
    jittered = replace(track, time_s=stamped, dt_s=np.diff(stamped, prepend=np.nan))
    fact = _only(facts_of(jittered))
    assert fact.effect == "timestamp_jitter"
    assert abs(_value(fact) / 3e-3 - 1) < 0.1
    assert np.abs(regular(jittered) - track.time_s).max() < 3e-4
    assert np.abs(np.diff(put_right(jittered, (fact,)).time_s) - 0.04).max() < 1e-4


def test_stamps_in_bunches_scatter_about_the_clock_and_not_within_a_bunch() -> None:
    """Three samples a packet of a USB adapter: the median step is that of its driver's loop."""
    track = track_of(experiment("wam", samples=6000, rate_hz=200.0))
    rows = np.arange(6000)
    stamps_s = 0.015 * (rows // 3 + 1) + 3e-5 * (rows % 3)
    dt_s = np.diff(stamps_s, prepend=np.nan)
    fact = next(
        one
        for one in facts_of(replace(track, time_s=stamps_s, dt_s=dt_s))
        if one.effect == "timestamp_jitter"
    )
    assert _value(fact) == pytest.approx(np.sqrt(2 / 3) * 0.005, rel=0.1)
    assert fact.setting["step_s"] == pytest.approx(0.005, rel=0.01)
    assert matters(fact)


def test_time_that_goes_back_stops_everything(track: Track) -> None:
    stamped = track.time_s.copy()
    stamped[700] -= 1.0
    facts = facts_of(replace(track, time_s=stamped))
    assert facts[0].stops
    assert "row 700" in facts[0].words


def test_two_clocks(track: Track) -> None:
    other = 5.0 + track.time_s * 1.002
    fact = _only(facts_of(replace(track, covariates={"host_time_s": other})))
    assert fact.effect == "clock_rate"
    assert abs(_value(fact) - 2e-3) < 1e-6
    same = replace(track, covariates={"host_time_s": track.time_s + 3.0})
    assert facts_of(same) == ()


def test_frames_are_ranked_with_their_scale(track: Track) -> None:
    found = windows(track)
    assert found is not None
    order = ranked(found)
    assert len(order) == 24  # of each frame and its negative one has a positive scale
    assert order[0].is_identity
    assert 0.7 < order[0].scale < 1.3
    assert order[0].cost < order[1].cost / 3


def test_spans() -> None:
    rows = np.array([0, 1, 1, 0, 1, 0, 0, 1], dtype=bool)
    assert spans_of(rows) == [(1, 3), (4, 5), (7, 8)]
    assert spans_of(rows, 1) == [(1, 5), (7, 8)]
    assert spans_of(rows[:1]) == []


def test_a_short_stop_of_the_magnetometer_and_another_one_that_no_turn_shows(track: Track) -> None:
    """Ten readings alike are no chance; a second stop at rest is told by the first."""
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    mag[2000:2012], mag[3000:3012] = mag[2000], mag[3000]
    gyro[3000:3012] = np.median(gyro, axis=0)
    fact = _only(facts_of(replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro)))
    assert fact.effect == "stuck_magnetometer"
    assert [begin for begin, _ in fact.where.intervals_s] == [
        track.time_s[2000],
        track.time_s[3000],
    ]
    at_rest = track.mag_b_gauss.copy()
    at_rest[3000:3012] = at_rest[3000]
    assert facts_of(replace(track, mag_b_gauss=at_rest, gyro_b_rad_s=gyro)) == ()


@pytest.mark.parametrize(("rate_hz", "rows", "found"), [(286.0, 9, False), (40.0, 12, True)])
def test_a_reading_that_came_late_is_no_stuck_magnetometer(
    rate_hz: float, rows: int, found: bool
) -> None:
    """Eight rows are 28 ms at 286 Hz: not used, and worth a note."""
    made = track_of(experiment("wam", samples=4000, rate_hz=rate_hz, sigma_mag=5e-5))
    mag = made.mag_b_gauss.copy()
    mag[2000 : 2000 + rows] = mag[2000]
    facts = facts_of(replace(made, mag_b_gauss=mag))
    assert [fact.effect for fact in facts] == ["stuck_magnetometer"]
    assert matters(facts[0]) is found
    assert facts[0].bad is not None
    assert facts[0].bad[2001 : 2000 + rows].all()


def test_readings_that_came_late_again_and_again_are_a_stuck_magnetometer() -> None:
    """Four times 95 ms at 200 Hz: none of them long, .38 s in all."""
    made = track_of(experiment("wam", samples=8000, rate_hz=200.0, sigma_mag=5e-5))
    mag = made.mag_b_gauss.copy()
    for first in (1000, 3000, 5000, 7000):
        mag[first : first + 20] = mag[first]
    (fact,) = facts_of(replace(made, mag_b_gauss=mag))
    assert fact.effect == "stuck_magnetometer"
    assert fact.parameters[0].value == pytest.approx(0.38, abs=0.006)
    assert matters(fact)


def test_a_gyro_s_limit_near_its_noise(track: Track) -> None:
    """Fine numbers repeat at a limit only."""
    rate = 0.02 * np.sin(track.time_s)[:, None] * np.array([1.0, 0.5, 0.2])
    noisy = rate + 0.005 * np.random.default_rng(4).standard_normal(rate.shape)
    fact = _only(clipping(replace(track, gyro_b_rad_s=np.clip(noisy, -0.024, 0.024))))
    assert fact.effect == "gyro_saturation"
    assert _value(fact) == 0.024
    assert clipping(replace(track, gyro_b_rad_s=noisy)) == []


def test_a_burst_around_a_lost_turn_is_what_that_leaves() -> None:
    def told(effect: str, *spans: tuple[float, float], turned: Array | None = None) -> Fact:
        return Fact(effect, "", Where(spans, ("x",), "link"), 1.0, turned=turned)

    lost = told("dropped_samples", (20.0, 20.04), (313.1, 313.14), turned=np.ones(3))
    moments = lost_at([lost])
    assert moments == [(20.0, 20.04), (313.1, 313.14)]
    assert around(told("noise_burst", (313.0, 314.0)), moments)
    assert not around(told("noise_burst", (313.0, 314.0), (400.0, 402.0)), moments)
    assert not around(told("noise_level", (0.0, 400.0)), moments)
    stuck = told("stuck_magnetometer", (313.0, 314.0))
    assert not around(told("noise_burst", (313.0, 314.0)), lost_at([stuck]))


def test_degrees_are_told_where_noise_hides_most_of_the_turns() -> None:
    """And radians are none, however loud the noise is."""
    track = made(Trial(seed=5, samples=8000, rate_hz=40.0, scenario="wam")).track
    noise = 0.06 * np.random.default_rng(1).standard_normal((len(track), 3))
    loud = replace(track, mag_b_gauss=track.mag_b_gauss + noise)
    degrees = replace(loud, gyro_b_rad_s=np.degrees(loud.gyro_b_rad_s))
    assert 0.6 < ranked(windows(degrees))[0].cost < 0.95
    found = [fact for fact in as_recorded(degrees) if fact.effect == "unit_error"]
    assert [fact.setting for fact in found] == [{"sensor": "gyro", "unit": "deg/s"}]
    assert as_recorded(loud) == []


@pytest.mark.parametrize("factor", [25.0, 1 / 25.0, 3.0])
def test_rates_that_are_off_by_the_factor_of_no_unit_may_be_the_time(
    track: Track, factor: float
) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s * factor)
    fact = _only(tuple(facts_of(wrong)))
    assert fact.effect == "unit_error"
    assert "in another unit, or the time is" in fact.words
    right = put_right(wrong, [fact]).gyro_b_rad_s
    assert np.abs(right / track.gyro_b_rad_s - 1).max() < 0.1


def test_a_magnet_that_is_put_on_and_off_is_no_unit_of_the_gyro(track: Track) -> None:
    """While a hand moves it the field changes by more than any turn: rates look too large."""
    t = track.time_s - track.time_s[0]
    middle, end = 0.4 * t[-1], 0.7 * t[-1]
    put = np.clip((t - middle) / 2.0, 0.0, 1.0) - np.clip((t - end) / 2.0, 0.0, 1.0)
    near = replace(track, mag_b_gauss=track.mag_b_gauss + 3.0 * put[:, None] * [0.6, -0.64, 0.48])
    assert not 0.5 < ranked(windows(near))[0].scale < 2.0
    assert [one for one in facts_of(near) if one.effect == "unit_error"] == []


def test_a_turn_about_one_axis_tells_that_axes_are_wrong_and_not_which() -> None:
    """A finding all the same: that none of the axes is as recorded is sure."""
    t = np.arange(2400) / 20.0
    rate = np.column_stack([0 * t, 0 * t, 0.2 + 0.1 * np.sin(0.3 * t)])
    R = so3.products(so3.exp(rate / 20.0))
    draw = np.random.default_rng(1)
    noise = 1e-3 * draw.standard_normal((2400, 3))
    field = np.einsum("nji,j->ni", R, [0.25, 0.0, 0.43]) + noise
    usual = track_of(experiment("wam", samples=2400))
    dt_s = np.concatenate([[np.nan], np.diff(t)])
    gyro = rate + 7e-4 * draw.standard_normal((2400, 3))
    plain = replace(
        usual, time_s=t, dt_s=dt_s, mag_b_gauss=field, gyro_b_rad_s=gyro, accel_b_m_s2=None,
        covariates={}, runs=(slice(0, 2400),),
    )  # fmt: skip
    assert as_recorded(plain) == []
    fact = _only(tuple(as_recorded(replace(plain, mag_b_gauss=field[:, [1, 0, 2]]))))
    assert fact.effect == "frame_error"
    assert fact.confidence == 0.99
    assert fact.words.startswith("the gyro's x y z are the magnetometer's x y -z (left-handed)")
    assert "other ways of axes and signs" in fact.words


def test_a_limit_with_noise_behind_it(track: Track) -> None:
    """No two readings are equal: two axes that end at one size tell it, one axis does not."""
    rng = np.random.default_rng(5)
    rate = track.gyro_b_rad_s
    top = 0.6 * float(np.min(np.abs(rate).max(axis=0)))
    noise = 3e-4 * rng.standard_normal(rate.shape)
    bias = np.array([1e-3, -5e-4, 2e-4])
    clipped = np.clip(rate, -top, top) + bias + noise
    fact = _only(clipping(replace(track, gyro_b_rad_s=clipped)))
    assert fact.effect == "gyro_saturation"
    assert _value(fact) == pytest.approx(top, abs=2e-3)
    assert fact.turned is not None
    at_limit = np.any(np.abs(rate) > top, axis=1)
    assert np.isnan(fact.turned[at_limit]).mean() > 0.99
    assert np.isfinite(fact.turned[np.all(np.abs(rate) < 0.8 * top, axis=1)]).all()
    # a vehicle that always turns at one rate, to either side
    turning = rate + bias + noise
    turning[:, 2] = np.clip(rate[:, 2], -top, top) + noise[:, 2]
    assert clipping(replace(track, gyro_b_rad_s=turning)) == []


def test_a_turn_about_the_field_moves_no_reading_however_large_the_hard_iron(track: Track) -> None:
    """In steps of 8 mG a sensor then repeats itself honestly."""
    centre, field = np.array([0.0, 0.4, 0.0]), np.array([0.1, 0.0, 0.2])
    rate = np.zeros((len(track), 3))
    rate[100:200] = field / np.linalg.norm(field)  # 1 rad/s
    still = replace(
        track,
        mag_b_gauss=np.tile(centre + field, (len(track), 1)),
        gyro_b_rad_s=rate,
    )
    seconds = 100 * track.step_s
    assert turned_gauss(still, centre, 100, 200) == pytest.approx(0.0, abs=1e-12)
    assert turned_gauss(still, np.zeros(3), 100, 200) == pytest.approx(0.4 * seconds)
