"""Saturation and quantisation of a sensor, and noise that has neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from single_fact import only, value

from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.data_quality.preparation import correct_track, find_facts
from ahrsd.diagnosis.data_quality.range_and_resolution import (
    find_clipping,
    find_quantisation,
    quantisation_step,
)
from ahrsd.diagnosis.track import Track


def test_saturation_is_distinguished_from_slow_motion_near_the_maximum(track: Track) -> None:
    """A slow and small motion leaves many readings just below the maximum, each with another
    value.
    """
    rng = np.random.default_rng(5)
    mag = 0.3 + 0.02 * np.sin(0.02 * track.time_s)[:, None] * np.array([1.0, 0.6, -0.4])
    mag += 5e-4 * rng.standard_normal(mag.shape)
    slow = replace(track, mag_b_gauss=mag, gyro_b_rad_s=1e-4 * rng.standard_normal(mag.shape))
    assert find_clipping(slow) == []
    ends = mag.copy()
    ends[:, 0] = np.minimum(mag[:, 0], np.quantile(mag[:, 0], 0.97))
    (fact,) = find_clipping(replace(slow, mag_b_gauss=ends))
    assert fact.effect == "mag_saturation"
    assert value(fact) == ends[:, 0].max()
    assert fact.where.axes == ("x",)
    stuck = mag.copy()
    at = int(np.argmax(mag[:, 0]))
    stuck[at : at + 40] = mag[at]
    assert find_clipping(replace(slow, mag_b_gauss=stuck)) == []


def test_saturated_readings_are_marked_when_noise_is_added_after_the_limit(track: Track) -> None:
    """The sensor is at its limit and its converter adds noise, so some readings are well below
    it.
    """
    rng = np.random.default_rng(6)
    clean = np.clip(track.mag_b_gauss, -0.3, 0.3)
    mag = np.clip(clean + 8e-4 * rng.standard_normal(clean.shape), -0.3, 0.3)
    (fact,) = find_clipping(replace(track, mag_b_gauss=mag))
    at_limit = (np.abs(clean) == 0.3).any(axis=1)
    assert np.count_nonzero(at_limit) > 500
    assert fact.bad is not None
    assert fact.bad[at_limit].all()
    assert not fact.bad[(np.abs(clean) < 0.28).all(axis=1)].any()


def test_saturation_of_either_sensor_is_found_and_its_rows_are_not_used(track: Track) -> None:
    mag = np.clip(track.mag_b_gauss, -np.inf, 0.3)
    fact = only(find_facts(replace(track, mag_b_gauss=mag)))
    assert fact.effect == "mag_saturation"
    assert value(fact) == 0.3
    assert fact.bad is not None
    assert fact.bad[(mag == 0.3).any(axis=1)].all()
    assert not fact.bad[(np.abs(mag) < 0.29).all(axis=1)].any()
    top = 0.7 * float(np.abs(track.gyro_b_rad_s).max())
    fact = only(find_facts(replace(track, gyro_b_rad_s=np.clip(track.gyro_b_rad_s, -top, top))))
    assert fact.effect == "gyro_saturation"
    assert fact.turned is not None
    clipped = np.max(np.abs(track.gyro_b_rad_s), axis=1) >= top
    assert np.isnan(fact.turned[clipped]).all()
    right = correct_track(track, (fact,))
    assert np.isnan(right.dt_s[clipped]).all()
    assert sum(run.stop - run.start for run in right.runs) == len(track)
    assert len(right.runs) > 2
    assert value(fact) == top


def test_quantisation_step_is_found(track: Track) -> None:
    coarse = replace(track, mag_b_gauss=np.round(track.mag_b_gauss / 0.01) * 0.01)
    fact = only(find_facts(coarse))  # neither a limit nor a stuck sensor, though readings repeat
    assert fact.effect == "mag_quantisation"
    assert abs(value(fact) / 0.01 - 1) < 1e-6
    fine = replace(track, mag_b_gauss=np.round(track.mag_b_gauss / 1e-4) * 1e-4)
    assert find_facts(fine) == ()


def test_quantisation_step_is_found_when_most_seconds_show_no_change(track: Track) -> None:
    turn = 0.01 * (track.time_s - track.time_s[0])
    slow = 0.3 * np.column_stack([np.cos(turn), np.sin(turn), np.cos(turn + 1)])
    slow += np.random.default_rng(6).normal(0, 5e-4, slow.shape)
    coarse = replace(track, mag_b_gauss=np.round(slow / 0.02) * 0.02)
    assert noise_of_differences(coarse)[0] == 0.0
    [fact] = find_quantisation(coarse)
    assert abs(value(fact) / 0.02 - 1) < 1e-6
    # a sensor stuck for three seconds at a time has no changes either, but then it jumps
    stood = np.random.default_rng(7).integers(100, 200, (len(track) // 120 + 1, 3))
    stuck = replace(track, mag_b_gauss=np.repeat(1e-3 * stood, 120, axis=0)[: len(track)])
    assert noise_of_differences(stuck)[0] == 0.0
    assert abs(quantisation_step(stuck.mag_b_gauss[:, 1]) / 1e-3 - 1) < 1e-6
    assert find_quantisation(stuck) == []


def test_gyro_limit_near_its_noise_level_is_found(track: Track) -> None:
    """Finely resolved values repeat only at a limit."""
    rate = 0.02 * np.sin(track.time_s)[:, None] * np.array([1.0, 0.5, 0.2])
    noisy = rate + 0.005 * np.random.default_rng(4).standard_normal(rate.shape)
    fact = only(find_clipping(replace(track, gyro_b_rad_s=np.clip(noisy, -0.024, 0.024))))
    assert fact.effect == "gyro_saturation"
    assert value(fact) == 0.024
    assert find_clipping(replace(track, gyro_b_rad_s=noisy)) == []


def test_gyro_limit_is_found_when_noise_is_added_after_it(track: Track) -> None:
    """No two readings are equal. Two axes that end at one magnitude show the limit; one axis
    does not.
    """
    rng = np.random.default_rng(5)
    rate = track.gyro_b_rad_s
    top = 0.6 * float(np.min(np.abs(rate).max(axis=0)))
    noise = 3e-4 * rng.standard_normal(rate.shape)
    bias = np.array([1e-3, -5e-4, 2e-4])
    clipped = np.clip(rate, -top, top) + bias + noise
    fact = only(find_clipping(replace(track, gyro_b_rad_s=clipped)))
    assert fact.effect == "gyro_saturation"
    assert value(fact) == pytest.approx(top, abs=2e-3)
    assert fact.turned is not None
    at_limit = np.any(np.abs(rate) > top, axis=1)
    assert np.isnan(fact.turned[at_limit]).mean() > 0.99
    assert np.isfinite(fact.turned[np.all(np.abs(rate) < 0.8 * top, axis=1)]).all()
    # a vehicle that always turns at one rate, in both directions
    turning = rate + bias + noise
    turning[:, 2] = np.clip(rate[:, 2], -top, top) + noise[:, 2]
    assert find_clipping(replace(track, gyro_b_rad_s=turning)) == []
