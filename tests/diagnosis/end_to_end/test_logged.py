"""Columns with gaps, or with a clock of their own, are used, and the fault is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.inference.diagnose import diagnose_logged
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

FIELD_PER_AMPERE = np.array([1.5e-3, -1e-3, 1e-3])


def levels(time_s: Array, seed: int) -> Array:
    """A current whose levels last 8 to 30 s."""
    rng = np.random.default_rng(seed)
    edges = np.cumsum(rng.uniform(8.0, 30.0, 60))
    return np.asarray(rng.uniform(0.5, 12.0, 61)[np.searchsorted(edges, time_s)])


@pytest.fixture(scope="module")
def driven() -> tuple[Track, Array]:
    """300 s at 12.5 Hz next to a motor, and the motor's current."""
    return next_to_a_motor(3750)


def next_to_a_motor(samples: int) -> tuple[Track, Array]:
    track = track_of(experiment("wam", motion="rov", seed=4, samples=samples, rate_hz=12.5))
    current = levels(track.time_s - track.time_s[0], 7)
    mag = track.mag_b_gauss + current[:, None] * FIELD_PER_AMPERE
    return replace(track, mag_b_gauss=mag), current


def logged(track: Track, name: str, values: Array) -> Track:
    return track.with_columns({**track.covariates, name: values})


@pytest.mark.slow
def test_delayed_column_clock_is_found_with_a_delayed_magnetometer(driven) -> None:
    """The residual of a delay of 100 ms is larger than the field of the current, so the delay is
    removed first.
    """
    track, _ = driven
    t = track.time_s - track.time_s[0]
    late = np.column_stack([np.interp(t - 0.1, t, axis) for axis in track.mag_b_gauss.T])
    column = levels(t - 3.0, 7)
    found = diagnose_logged(logged(replace(track, mag_b_gauss=late), "motor_current_a", column))
    named = {one.effect: one for one in found.findings}
    assert sorted(named) == ["mag_time_lag", "motor_current_field"]
    assert named["mag_time_lag"].parameters[0].value == pytest.approx(0.1, abs=2e-3)
    assert found.notes[0].startswith("column motor_current_a is 3 s late against the sensor")
    assert not found.unexplained.detected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (lambda t: t - 3.0, "is 3 s late against the sensor:"),
        (lambda t: t + 20.0, "is 20 s early against the sensor:"),
        (lambda t: 0.98 * t, "and its clock drifts by 2"),
    ],
    ids=["late", "early", "drift"],
)
def test_wrong_column_clock_is_reported_and_its_current_found(driven, clock, words) -> None:
    track, _ = driven
    at_s = clock(track.time_s - track.time_s[0])
    found = diagnose_logged(logged(track, "motor_current_a", levels(at_s, 7)))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    assert "column motor_current_a is " in found.notes[0]
    assert words in found.notes[0]
    for value, truth in zip(found.findings[0].parameters, FIELD_PER_AMPERE, strict=True):
        assert value.value == pytest.approx(truth, abs=max(5 * value.std, 1e-4))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_unrelated_column_is_no_cause_at_any_time_shift(driven, seed: int) -> None:
    track, _ = driven
    other = levels(track.time_s - track.time_s[0], seed)
    found = diagnose_logged(logged(track, "shaft_rpm", 100 * other))
    assert found.findings == ()
    assert found.unexplained.detected
    assert not any("against the sensor" in note for note in found.notes)


@pytest.mark.slow
def test_current_is_found_from_a_column_with_a_gap() -> None:
    track, current = next_to_a_motor(2000)
    holed = np.where((track.time_s > 60.0) & (track.time_s < 85.0), np.nan, current)
    found = diagnose_logged(logged(track, "motor_current_a", holed))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    assert not found.unexplained.detected
    assert "column motor_current_a has no values in 25.0 s, first at 60.1 s" in found.notes[0]


@pytest.mark.slow
def test_unrelated_column_with_a_gap_is_left_out(driven) -> None:
    track, current = driven
    holed = np.where((track.time_s > 100.0) & (track.time_s < 140.0), np.nan, 0.3 * current)
    other = logged(track, "motor_current_a", current)
    found = diagnose_logged(logged(other, "speed_m_s", np.roll(holed, 900)))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    assert any("column speed_m_s was left out: no values from" in note for note in found.notes)


def test_usable_columns_with_gaps_are_selected(driven) -> None:
    track, current = driven
    nothing, short, long = (current.copy() for _ in range(3))
    nothing[100:] = np.nan
    short[100:110] = np.nan
    long[500:1000] = np.nan
    columns = {"a_a": nothing, "b_a": short, "c_a": long, "hdop": long}
    found = roles.find_columns_with_gaps(track.with_columns(columns))
    assert list(found) == ["c_a"]
    assert np.array_equal(np.flatnonzero(found["c_a"].missing), np.arange(500, 1000))


@pytest.mark.slow
@pytest.mark.parametrize("own", [True, False])
def test_current_is_found_at_rest_if_the_field_follows_it(own: bool) -> None:
    """Pulses at rest are the manoeuvre that separates a current from effects of the motion."""
    rng = np.random.default_rng(5)
    time_s = np.arange(1500) / 10.0
    current, other = levels(time_s, 3), levels(time_s, 9)
    mag = np.array([0.2, -0.1, 0.4]) + 1e-3 * rng.standard_normal((1500, 3))
    mag += 1e-3 * current[:, None] * np.array([1.0, -0.5, 0.8])
    gyro = 1e-3 * rng.standard_normal((1500, 3))
    dt_s = np.full(1500, 0.1)
    dt_s[0] = np.nan
    columns = {"motor_current_a": current if own else other}
    still = Track(time_s, dt_s, mag, gyro, None, columns, (slice(0, 1500),))
    found = diagnose_logged(still)
    names = [one.effect for one in found.findings]
    assert names == (["motor_current_field"] if own else [])
    assert any("hardly turned" in note for note in found.notes)
