"""Wrong units, axes and signs are found with their numbers, and none in a correct recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from single_fact import only, value
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.data_quality.axes_and_units import (
    axis_and_unit_errors,
    rank_frames,
    window_equations,
)
from ahrsd.diagnosis.data_quality.preparation import correct_track, detectable_faults, find_facts
from ahrsd.diagnosis.track import Track

MIRRORED = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]
TURNED = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
SWAPPED = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]
QUARTER = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("axes", "signs"),
    [
        ([0, 2, 1], [-1, 1, 1]),
        ([1, 0, 2], [1, 1, -1]),
        ([0, 1, 2], [1, 1, -1]),
        ([2, 0, 1], [1, 1, 1]),
    ],
)
def test_wrong_gyro_axes_are_found_and_corrected(
    track: Track, axes: list[int], signs: list[int]
) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s[:, axes] * np.array(signs))
    fact = only(find_facts(wrong))
    assert fact.effect == "frame_error"
    assert fact.stops
    assert fact.confidence > 0.9
    assert np.array_equal(correct_track(wrong, (fact,)).gyro_b_rad_s, track.gyro_b_rad_s)


def test_turn_at_a_constant_rate_does_not_determine_axes_or_unit() -> None:
    """Soft iron deforms the circle to an ellipse, and any frame explains that a little."""
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
    assert [fact.words for fact in find_facts(spin)] == []
    assert any("would not have been seen" in line for line in detectable_faults(spin))


def test_left_handed_axes_are_reported_as_left_handed(track: Track) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s * np.array([1.0, 1.0, -1.0]))
    assert "left-handed" in only(find_facts(wrong)).words


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (MIRRORED, "is left-handed: negate its y (south"),
        (TURNED, "is turned against the gyro: negate its x and z (south"),
        (SWAPPED, "is left-handed: its correct x y z are its y x z as read"),
        (QUARTER, "is turned against the gyro: its correct x y z are its -y x z as read"),
    ],
)
def test_wrong_magnetometer_axes_are_attributed_to_the_magnetometer(
    read: list[list[int]], words: str
) -> None:
    """Gyro and field alone do not separate m and -m. Gravity does, and otherwise every heading
    is wrong.
    """
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, mag_b_gauss=made.mag_b_gauss @ np.array(read, float).T)
    fact = only(find_facts(wrong))
    assert fact.effect == "frame_error"
    assert words in fact.words
    assert fact.where.frame == "sensor"
    if read is MIRRORED:
        assert "negate its x and z" in fact.words.partition("south of the magnetic equator")[2]


def test_both_sensors_are_named_as_possible_when_gravity_is_missing() -> None:
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, mag_b_gauss=made.mag_b_gauss * np.array([1.0, -1.0, 1.0]))
    words = only(find_facts(replace(wrong, accel_b_m_s2=None))).words
    assert "or the magnetometer is left-handed (negate its y)" in words
    assert "180 deg" in words


def test_rotated_gyro_is_identified_by_the_accelerometer() -> None:
    made = track_of(experiment("wam", samples=3000))
    wrong = replace(made, gyro_b_rad_s=made.gyro_b_rad_s * np.array([-1.0, 1.0, -1.0]))
    fact = only(find_facts(wrong))
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
def test_rotated_magnetometer_is_reported_with_its_angle(
    turn_deg: tuple[float, float, float], about: str
) -> None:
    """R_mg maps the gyro's axes to the magnetometer's. The advice corrects the readings."""
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([turn_deg]))[0]
    turned = replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T)
    fact = only(find_facts(turned))
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


def test_either_sensor_may_be_rotated_when_gravity_is_missing() -> None:
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([[0.0, 0.0, 45.0]]))[0]
    turned = replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T, accel_b_m_s2=None)
    assert "or the gyro is the one that is turned" in only(find_facts(turned)).words


def test_misalignment_of_five_degrees_is_not_a_wrong_frame() -> None:
    """The search finds it with its standard deviation, and other effects can be fitted with it."""
    whole = track_of(experiment("mam", samples=6000, seed=3))
    R_mg = so3.exp(np.radians([[0.0, 5.0, 0.0]]))[0]
    assert axis_and_unit_errors(replace(whole, mag_b_gauss=whole.mag_b_gauss @ R_mg.T)) == []


def test_soft_iron_does_not_favour_another_frame() -> None:
    """A slow turn of half a period. The frame fit neglects soft iron that deforms by a fifth."""
    made = experiment("wam", motion="slow", seed=0, samples=10_000, rate_hz=100.0, sigma_gyro=5e-3)
    assert find_facts(track_of(made)) == ()


def test_degrees_and_swapped_axes_are_found_together(track: Track) -> None:
    wrong = replace(track, gyro_b_rad_s=np.degrees(track.gyro_b_rad_s[:, [1, 0, 2]]))
    facts = find_facts(wrong)
    assert {fact.effect for fact in facts} == {"frame_error", "unit_error"}
    unit = next(fact for fact in facts if fact.effect == "unit_error")
    assert abs(value(unit) / (180 / np.pi - 1) - 1) < 1e-9
    assert "deg/s" in unit.words
    assert np.abs(correct_track(wrong, facts).gyro_b_rad_s - track.gyro_b_rad_s).max() < 1e-12


@pytest.mark.parametrize(("unit", "factor"), [("uT", 100.0), ("mG", 1e3), ("nT", 1e5), ("T", 1e-4)])
def test_magnetometer_unit_is_found_from_the_size_of_the_earth_field(
    track: Track, unit: str, factor: float
) -> None:
    wrong = replace(track, mag_b_gauss=track.mag_b_gauss * factor)
    facts = [fact for fact in find_facts(wrong) if fact.effect == "unit_error"]
    fact = only(tuple(facts))
    assert fact.setting == {"sensor": "mag", "unit": unit}
    right = correct_track(wrong, facts).mag_b_gauss
    assert np.abs(right / track.mag_b_gauss - 1).max() < 1e-12


def test_no_frame_error_is_reported_at_rest() -> None:
    """Every frame fits at rest. Nothing is reported, and the sensitivity gives the reason."""
    made = experiment("lam", samples=2000)
    rng = np.random.default_rng(1)
    at_rest = replace(
        track_of(made),
        mag_b_gauss=np.array([0.2, 0.1, 0.4]) + 1e-3 * rng.standard_normal((2000, 3)),
        gyro_b_rad_s=1e-3 * rng.standard_normal((2000, 3)),
    )
    assert find_facts(at_rest) == ()
    assert "hardly turned" in detectable_faults(at_rest)[-1]
    assert "left-handed" in detectable_faults(track_of(made))[-1]


def test_frames_are_ranked_with_their_scale(track: Track) -> None:
    found = window_equations(track)
    assert found is not None
    order = rank_frames(found)
    assert len(order) == 24  # of each frame and its negative, one has a positive scale
    assert order[0].is_identity
    assert 0.7 < order[0].scale < 1.3
    assert order[0].cost < order[1].cost / 3


def test_degrees_are_found_when_noise_hides_most_turns() -> None:
    """No unit error is reported for radians at the same noise level."""
    track = made(Trial(seed=5, samples=8000, rate_hz=40.0, scenario="wam")).track
    noise = 0.06 * np.random.default_rng(1).standard_normal((len(track), 3))
    loud = replace(track, mag_b_gauss=track.mag_b_gauss + noise)
    degrees = replace(loud, gyro_b_rad_s=np.degrees(loud.gyro_b_rad_s))
    assert 0.6 < rank_frames(window_equations(degrees))[0].cost < 0.95
    found = [fact for fact in axis_and_unit_errors(degrees) if fact.effect == "unit_error"]
    assert [fact.setting for fact in found] == [{"sensor": "gyro", "unit": "deg/s"}]
    assert axis_and_unit_errors(loud) == []


@pytest.mark.parametrize("factor", [25.0, 1 / 25.0, 3.0])
def test_rate_factor_of_no_known_unit_is_attributed_to_unit_or_time(
    track: Track, factor: float
) -> None:
    wrong = replace(track, gyro_b_rad_s=track.gyro_b_rad_s * factor)
    fact = only(tuple(find_facts(wrong)))
    assert fact.effect == "unit_error"
    assert "the rates or the time stamps are in another unit" in fact.words
    right = correct_track(wrong, [fact]).gyro_b_rad_s
    assert np.abs(right / track.gyro_b_rad_s - 1).max() < 0.1


def test_magnet_put_on_and_taken_off_is_not_a_unit_error_of_the_gyro(track: Track) -> None:
    """While a hand moves the magnet the field changes by more than any turn, and rates look too
    large.
    """
    t = track.time_s - track.time_s[0]
    middle, end = 0.4 * t[-1], 0.7 * t[-1]
    put = np.clip((t - middle) / 2.0, 0.0, 1.0) - np.clip((t - end) / 2.0, 0.0, 1.0)
    near = replace(track, mag_b_gauss=track.mag_b_gauss + 3.0 * put[:, None] * [0.6, -0.64, 0.48])
    assert not 0.5 < rank_frames(window_equations(near))[0].scale < 2.0
    assert [one for one in find_facts(near) if one.effect == "unit_error"] == []


def test_turn_about_one_axis_shows_a_frame_error_but_not_which() -> None:
    """It is a finding, because it is certain that the axes are not as recorded."""
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
    assert axis_and_unit_errors(plain) == []
    fact = only(tuple(axis_and_unit_errors(replace(plain, mag_b_gauss=field[:, [1, 0, 2]]))))
    assert fact.effect == "frame_error"
    assert fact.confidence == 0.99
    assert fact.words.startswith("the gyro's x y z are the magnetometer's x y -z (left-handed)")
    assert "other assignments of axes and signs" in fact.words
