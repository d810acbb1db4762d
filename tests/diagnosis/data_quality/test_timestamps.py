"""Irregular samples with correct stamps, regular samples with jittering stamps, and clock jumps.

A clock jump is no elapsed time, and no array may grow with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import without_rows
from single_fact import only, value
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis import priors
from ahrsd.diagnosis.data_quality.facts import is_finding
from ahrsd.diagnosis.data_quality.preparation import correct_track, find_facts
from ahrsd.diagnosis.data_quality.timestamps import (
    find_clock_faults,
    regular_stamps,
    without_clock_jumps,
)
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_STEP_S = 0.025
_SAMPLES = 4000


def _uneven(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.arange(_SAMPLES, dtype=np.float64) * _STEP_S + rng.normal(0, 0.1 * _STEP_S, _SAMPLES)


def _track(
    taken_s: Array, stamped_s: Array, *, unit: float = 1.0, most_rad_s: float = 0.5,
    sigma_gauss: float = 1e-3,
) -> Track:  # fmt: skip
    """A sensor that turns by its rate times the steps between its samples."""
    steps = np.diff(taken_s, prepend=taken_s[0])
    phases = np.stack([0.7 * taken_s, 1.0 + 0.9 * taken_s, 2.0 + 0.4 * taken_s], axis=1)
    rate = most_rad_s * np.sin(phases)
    h = np.array([0.2, 0.1, 0.4])
    field = np.empty((_SAMPLES, 3))
    for k, turn in enumerate(so3.exp(rate * steps[:, None])):
        h = turn.T @ h
        field[k] = h
    rng = np.random.default_rng(9)
    mag = field + 0.05 + rng.normal(0, sigma_gauss, field.shape)
    gyro = unit * (rate + rng.normal(0, 5e-4, rate.shape))
    dt = np.diff(stamped_s, prepend=np.nan)
    return Track(stamped_s, dt, mag, gyro, None, {}, (slice(0, _SAMPLES),))


@pytest.mark.parametrize("unit", [1.0, 57.29578])
def test_irregular_samples_with_correct_stamps_have_no_jitter(unit: float) -> None:
    taken = _uneven(1)
    assert find_clock_faults(_track(taken, taken, unit=unit)) == []


@pytest.mark.parametrize("unit", [1.0, 57.29578])
def test_regular_samples_with_irregular_stamps_have_jitter(unit: float) -> None:
    (fact,) = find_clock_faults(
        _track(np.arange(_SAMPLES, dtype=np.float64) * _STEP_S, _uneven(1), unit=unit)
    )
    assert fact.effect == "timestamp_jitter"
    assert fact.parameters[0].value == pytest.approx(0.1 * _STEP_S, rel=0.05)


def test_jitter_too_small_to_report_is_corrected_when_the_field_shows_it() -> None:
    # a hundredth of a step: at turns of 4 rad/s this is 40 mrad/s of the rate
    quick = {"most_rad_s": 4.0, "sigma_gauss": 2e-4}
    even = np.arange(_SAMPLES, dtype=np.float64) * _STEP_S
    stamped = even + np.random.default_rng(1).normal(0, 0.01 * _STEP_S, _SAMPLES)
    track = _track(even, stamped, **quick)
    (fact,) = find_clock_faults(track)
    assert fact.parameters[0].value == pytest.approx(0.01 * _STEP_S, rel=0.05)
    assert not is_finding(fact)
    right = correct_track(track, (fact,)).dt_s[1:]
    assert np.max(np.abs(right - _STEP_S)) < 1e-4 * _STEP_S
    # sampled at those times with correct stamps: unchanged
    assert find_clock_faults(_track(stamped, stamped, **quick)) == []


def _jumping(by_s: float, samples: int = 1000) -> Track:
    """A recording in two runs; the clock of the second is shifted by `by_s`."""
    track = track_of(experiment("wam", samples=samples))
    row = samples // 2
    time_s, dt_s = track.time_s.copy(), track.dt_s.copy()
    time_s[row:] += by_s
    dt_s[row] = np.nan
    return replace(track, time_s=time_s, dt_s=dt_s, runs=(slice(0, row), slice(row, samples)))


@pytest.mark.parametrize("by_s", [1.7471e9, 3600.0, -2.0, -1e6])
def test_clock_jump_is_replaced_by_a_short_break(by_s: float) -> None:
    track = _jumping(by_s)
    done, (words,) = without_clock_jumps(track)
    assert done.time_s[500] - done.time_s[499] == pytest.approx(priors.BREAK_LEFT_S)
    assert np.diff(done.time_s).min() > 0.0
    assert words.startswith(f"the clock jumps by {by_s + 0.04:+.6g} s after 20 s")
    assert without_clock_jumps(done) == (done, ())
    epoch = replace(track, time_s=track.time_s + 1.7e9 + 0.125)
    assert "after 1700000020.125 s" in without_clock_jumps(epoch)[1][0]


def test_plausible_break_is_kept() -> None:
    track = _jumping(30.0)
    assert without_clock_jumps(track) == (track, ())
    whole = replace(track, runs=track.runs[:1])
    assert without_clock_jumps(whole) == (whole, ())


@pytest.mark.slow
def test_recording_whose_clock_is_set_is_diagnosed() -> None:
    """From 1970 to 2025: this once needed more than a terabyte."""
    found = diagnose(_jumping(1.7471e9, samples=2500))
    assert not found.mismatch
    assert found.notes[0].startswith("the clock jumps by +1.7471e+09 s")


@pytest.mark.parametrize("missing", [0.02, 0.3])
def test_missing_samples_are_counted_from_the_time_stamps(track: Track, missing: float) -> None:
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > missing)
    fact = only(find_facts(without_rows(track, keep, restamp=False)))
    assert fact.effect == "dropped_samples"
    assert abs(value(fact) - (1 - len(keep) / len(track))) < 1e-3


def test_regular_clock_is_recovered_from_jittering_stamps(track: Track) -> None:
    rng = np.random.default_rng(2)
    stamped = track.time_s + 3e-3 * rng.standard_normal(len(track))
    jittered = replace(track, time_s=stamped, dt_s=np.diff(stamped, prepend=np.nan))
    fact = only(find_facts(jittered))
    assert fact.effect == "timestamp_jitter"
    assert abs(value(fact) / 3e-3 - 1) < 0.1
    assert np.abs(regular_stamps(jittered) - track.time_s).max() < 3e-4
    assert np.abs(np.diff(correct_track(jittered, (fact,)).time_s) - 0.04).max() < 1e-4


def test_jitter_of_bunched_stamps_is_measured_from_the_regular_clock() -> None:
    """A USB adapter delivers three samples per packet, so the median step is that of its
    driver's loop.
    """
    track = track_of(experiment("wam", samples=6000, rate_hz=200.0))
    rows = np.arange(6000)
    stamps_s = 0.015 * (rows // 3 + 1) + 3e-5 * (rows % 3)
    dt_s = np.diff(stamps_s, prepend=np.nan)
    fact = next(
        one
        for one in find_facts(replace(track, time_s=stamps_s, dt_s=dt_s))
        if one.effect == "timestamp_jitter"
    )
    assert value(fact) == pytest.approx(np.sqrt(2 / 3) * 0.005, rel=0.1)
    assert fact.setting["step_s"] == pytest.approx(0.005, rel=0.01)
    assert is_finding(fact)


def test_backward_time_step_stops_the_diagnosis(track: Track) -> None:
    stamped = track.time_s.copy()
    stamped[700] -= 1.0
    facts = find_facts(replace(track, time_s=stamped))
    assert facts[0].stops
    assert "row 700" in facts[0].words


def test_rate_difference_of_two_logged_clocks_is_found(track: Track) -> None:
    other = 5.0 + track.time_s * 1.002
    fact = only(find_facts(replace(track, covariates={"host_time_s": other})))
    assert fact.effect == "clock_rate"
    assert abs(value(fact) - 2e-3) < 1e-6
    same = replace(track, covariates={"host_time_s": track.time_s + 3.0})
    assert find_facts(same) == ()
