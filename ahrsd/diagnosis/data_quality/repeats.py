"""Readings that repeat: a stuck magnetometer, one that is updated too slowly, doubled samples.

Equal bit by bit on all three axes is the sign, and only where the gyro says that the sensor
turned by more than the readings' resolution: a quiet sensor at rest repeats itself honestly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import sphere_centre
from ahrsd.diagnosis.data_quality.clipping import step_of
from ahrsd.diagnosis.data_quality.facts import Fact, spans_of
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_AXES = ("x", "y", "z")
#: rows that a stuck reading lasts at least, and so many times as long as a reading usually does
_STUCK_ROWS, _LONGER = 8, 5.0
_MOVED = 8.0  # noise levels by which the field must have turned during the repetition
_STEPS = 3.0  # steps of coarse numbers by which the field must turn to have a new reading
_FEWEST_REPEATS = 20
_MOVING_SHARE = 0.7  # of the share that repeats in all: where the sensor turns, numbers that are
# coarse change, and a reading that is held does not
#: s; magnetometers have rates of their own: 202 a second in all recordings of BROAD, rows at 286
_ORDINARY_PERIOD_S = 0.01
_CLOCKWORK = 0.3  # variance of the time from one new reading to the next, in that of chance
#: sums by which that is told, where there are as many, and at least;  variances that one counts
_SUMS, _FEWEST_SUMS, _FAR = 20, 15, 4.0
_DOUBLED_SHARE = 2e-3
#: times as many as if each sensor repeated for itself: a slow turn makes it nearly two
_BEYOND_CHANCE = 5.0
_TURNING = 5.0  # gyro noise levels


def repeats(track: Track, clipped: NDArray[np.bool] | None = None) -> list[Fact]:
    """Stuck, held and doubled samples.  clipped: (N,) readings at a limit: they repeat."""
    again = _again(track, track.mag_b_gauss)
    if clipped is not None:
        again &= ~clipped
    expected = _expected_change(track)
    stuck, bad = _stuck(track, again)
    alone = again & ~bad & ~_again(track, track.gyro_b_rad_s)  # else the whole sample came twice
    held = _held(track, alone, expected)
    doubled = [] if held else _doubled(track, again & ~bad)
    return stuck + held + doubled


def _again(track: Track, values: Array) -> NDArray[np.bool]:
    """(N,) rows equal to the row before, within a run."""
    out = np.zeros(len(values), dtype=bool)
    out[1:] = np.all(values[1:] == values[:-1], axis=1)
    for run in track.runs:
        out[run.start] = False
    return out


def _expected_change(track: Track) -> Array:
    """(N,) gauss by which a step turns the field at most, the gyro's middle taken as its bias."""
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    size = track.usual_gauss
    step = np.linalg.norm(rate, axis=1) * np.nan_to_num(track.dt_s, nan=0.0)
    return np.asarray(step * size)


def _turned(track: Track, centre: Array, first: int, last: int) -> float:
    """Gauss by which the whole turn over these rows moves the reading that they repeat.

    centre (3,): of the readings' sphere, which does not turn
    """
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turn = rate[first:last].T @ np.nan_to_num(track.dt_s[first:last], nan=0.0)
    said = track.mag_b_gauss[first]
    if not said.any():  # 0 0 0 is no field that could have been turned
        return float(np.linalg.norm(turn)) * track.usual_gauss
    return float(np.linalg.norm(np.cross(turn, said - centre)))


def _resolution(track: Track) -> float:
    """The noise, or the step of the numbers where that is coarser: within it readings repeat."""
    return max(noise_of_differences(track)[0], _step(track), 1e-6)


def _step(track: Track) -> float:
    """The coarsest step of the three axes' numbers, 0 where there is none."""
    return max(step_of(column) for column in track.mag_b_gauss.T)


def _stuck(track: Track, again: NDArray[np.bool]) -> tuple[list[Fact], NDArray[np.bool]]:
    """What repeats too long.  Where it was stuck while it turned, so it was where it did not, if
    the numbers are fine enough to show the noise of a sensor at rest."""
    bad = np.zeros(len(track), dtype=bool)
    intervals: list[tuple[float, float]] = []
    usual = float(np.median(np.diff(np.flatnonzero(~again), append=len(again))))
    least = max(_STUCK_ROWS, _LONGER * usual)
    long = [(first, last) for first, last in spans_of(again) if last - first >= least]
    mag = track.mag_b_gauss
    centre = sphere_centre(mag[np.isfinite(mag).all(axis=1) & mag.any(axis=1)])
    turned = [_turned(track, centre, *span) >= _MOVED * _resolution(track) for span in long]
    fine = any(turned) and _step(track) == 0.0
    for (first, last), moved in zip(long, turned, strict=True):
        if moved or fine:
            bad[first - (not track.mag_b_gauss[first].any()) : last] = True
            intervals.append((float(track.time_s[first - 1]), float(track.time_s[last - 1])))
    if not intervals:
        return [], bad
    total = sum(b - a for a, b in intervals)
    step = track.step_s
    words = f"the magnetometer repeats one reading while the sensor turns, {total:.1f} s in all"
    return [
        Fact(
            "stuck_magnetometer",
            words,
            Where(tuple(intervals), _AXES, "sensor"),
            1.0,
            (Value("length", total, step, "s"),),
            {"onset_s": intervals[0][0]},
            bad,
        )
    ], bad


def _held(track: Track, again: NDArray[np.bool], expected: Array) -> list[Fact]:
    """A magnetometer that is read more often than it measures, at any ratio of the two rates.

    It repeats while the sensor turns as well, and new readings come as regularly as a clock.
    """
    moving = expected > max(float(np.quantile(expected, 0.5)), _STEPS * _step(track))
    fresh = np.flatnonzero(~again)
    repeated = int(np.count_nonzero(again))
    if np.count_nonzero(moving) < 50 or len(fresh) < 10 or repeated < _FEWEST_REPEATS:
        return []
    usual = len(again) / len(fresh)
    if usual * track.step_s < _ORDINARY_PERIOD_S:
        return []
    if np.mean(again[moving]) < _MOVING_SHARE * repeated / len(again):
        return []
    if _irregularity(np.diff(fresh)) > _CLOCKWORK:
        return []
    step = track.step_s
    words = (
        f"the magnetometer has a new reading only every {usual:.4g} samples "
        f"({1 / (usual * step):.4g} Hz)"
    )
    return [
        Fact(
            "mag_sample_hold",
            words,
            Where(_whole(track), _AXES, "sensor"),
            1.0,
            (Value("held_part", 1.0, 0.0, "1"),),
            {"hold": usual, "period_s": usual * step},
            again.copy(),
        )
    ]


def _irregularity(rows: Array) -> float:
    """How the rows from one new reading to the next vary, in what they vary by where each row
    repeats by chance (variances of sums over as many as have a variance of ten then, or of fewer
    where that left too few sums to tell a clock from chance)."""
    mean = float(np.mean(rows))
    chance = mean * (mean - 1.0)
    together = max(1, int(np.ceil(10.0 / chance)))
    together = min(together, max(int(np.ceil(1.0 / chance)), len(rows) // _SUMS))
    sums = np.add.reduceat(rows, np.arange(0, len(rows) - together + 1, together))[:-1]
    if len(sums) < _FEWEST_SUMS:
        return 1.0
    variance = together * chance
    off = (sums - np.median(sums)) ** 2  # a gap, or a span without a new reading, is one sum
    return float(np.mean(np.minimum(off, _FAR * variance))) / variance


def _doubled(track: Track, again: NDArray[np.bool]) -> list[Fact]:
    """Rows that repeat magnetometer and gyro: a sample that was sent or stored twice.

    Only while the sensor turns: at rest coarse numbers repeat by chance. So they do about axes that
    it does not turn about, each sensor's for itself: a sample that came twice repeats both.
    """
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turning = np.max(np.abs(rate), axis=1) > _TURNING * noise_of_differences(track)[1]
    mag, gyro = again & turning, _again(track, track.gyro_b_rad_s) & turning
    both = mag & gyro
    count, fresh = int(np.count_nonzero(both)), turning & ~mag
    alone = np.count_nonzero(gyro & fresh) / max(int(np.count_nonzero(fresh)), 1)
    chance = alone * np.count_nonzero(mag)
    if count < max(3, _DOUBLED_SHARE * len(track), _BEYOND_CHANCE * chance):
        return []
    share = count / len(track)
    step = track.step_s
    times = tuple((float(t) - step, float(t)) for t in track.time_s[both][:50])
    return [
        Fact(
            "dropped_samples",
            f"{counted(count, 'sample')} as the one before, gyro and magnetometer: they came twice",
            Where(times, _AXES, "link"),
            0.95,
            (Value("part", share, float(np.sqrt(share / len(track))), "1"),),
            {"doubled": True},
            both,
        )
    ]


def _whole(track: Track) -> tuple[tuple[float, float], ...]:
    return ((float(track.time_s[0]), float(track.time_s[-1])),)
