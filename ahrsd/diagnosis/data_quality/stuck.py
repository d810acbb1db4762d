"""Readings that never change, stop changing or repeat, while the other sensor moves.

Real readings scatter.  A sensor, or one of its axes, that repeats a number bit by bit is stuck, was
switched off or was not logged.  That is said of what is stuck and never of the motion: to a filter
with a dead gyro the field only wanders, and to one with a dead magnetometer all is well.

A magnetometer may be stuck for a while, or updated too slowly, or samples come twice (`repeats`).
Equal bit by bit on all three axes is the sign, and only where the gyro says that the sensor
turned by more than the readings' resolution: a quiet sensor at rest repeats itself honestly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import sphere_centre
from ahrsd.diagnosis.data_quality.facts import Fact, spans_of
from ahrsd.diagnosis.data_quality.range_and_resolution import step_of
from ahrsd.diagnosis.time_series import gap_free_runs
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_AXES = ("x", "y", "z")
_BLOCK = 10  # rows whose mean is one reading, to be above the noise
_SUMS = 20  # of times between new readings, where there are as many


def dead(track: Track) -> str | None:
    """Why nothing can be fitted: a sensor, or one of its axes, never changes and should; else None.

    An axis that has nothing to say, as of a simulation without noise that turns about another one,
    may be constant.
    """
    mag, gyro = track.mag_b_gauss, track.gyro_b_rad_s
    seen = np.isfinite(mag).all(axis=1)
    size = track.usual_gauss
    if not priors.FIELD_READINGS[0] < size < priors.FIELD_READINGS[1]:
        return f"the magnetometer reads {size:.3g} in the middle: that is a field in no unit"
    if _constant(gyro) and np.ptp(mag[seen], axis=0).max() > _least_gauss(track):
        return (
            f"the gyro reads {_words(gyro[0])} rad/s in every row while the field turns by "
            f"{np.degrees(_swing_rad(mag[seen])):.0f} deg: it is stuck or was not logged"
        )
    turned = _turned_rad(track)
    if _constant(mag[seen]) and _constant(gyro):
        return (
            f"the magnetometer reads {_words(mag[seen][0])} gauss and the gyro {_words(gyro[0])} "
            "rad/s in every row: no sensor is so still, even at rest it scatters"
        )
    if _constant(mag[seen]) and turned > priors.STUCK_TURNED_RAD:
        return (
            f"the magnetometer reads {_words(mag[seen][0])} gauss in every row while the gyro "
            f"turns by {np.degrees(turned):.0f} deg: it is stuck or was not logged"
        )
    return _dead_axis(track)


def _dead_axis(track: Track) -> str | None:
    """Why one axis cannot be right: it reads one number where the other five say that it turned."""
    mag, gyro = track.mag_b_gauss, track.gyro_b_rad_s
    course = _course(track)
    for k, axis in enumerate(_AXES):
        column = mag[np.isfinite(mag[:, k]), k]
        moved = float(np.ptp(course[:, k]))
        if _constant(column) and moved > _least_gauss(track):
            return (
                f"the magnetometer's {axis} reads {column[0] + 0.0:.4g} gauss in every row while "
                f"the field on it changes by {moved:.2g} gauss: it is stuck or was not logged"
            )
        if (
            _constant(gyro[:, k])
            and (turned := _turned_by_field(track, k)) > priors.DEAD_AXIS_TURNED_RAD
        ):
            return (
                f"the gyro's {axis} reads {gyro[0, k] + 0.0:.4g} rad/s in every row while the "
                f"field turns by {np.degrees(turned):.0f} deg about it: it is stuck or was not "
                "logged"
            )
    return None


def _course(track: Track) -> Array:
    """(N, 3) gauss: what the magnetometer should have changed by since the start, by the gyro."""
    step = np.nan_to_num(track.dt_s, nan=0.0)[:, None]
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turn: Array = np.cumsum(np.nan_to_num(np.cross(track.mag_b_gauss, rate * step)), axis=0)
    return turn


def _turned_by_field(track: Track, k: int) -> float:
    """Range in rad of the turn about axis k that the field shows and the rates about others do not.

    0 where iron explains as much of it: m = (I + S) b + h, so that to first order
    dm = w x h + w x (S m) - S (w x m) beside the turn itself, with S symmetric.
    """
    rows = _BLOCK * (len(track) // _BLOCK)
    mag = np.nan_to_num(track.mag_b_gauss[:rows]).reshape(-1, _BLOCK, 3).mean(axis=1)
    angle = np.nan_to_num(track.gyro_b_rad_s * track.dt_s[:, None])[:rows]
    angle = angle.reshape(-1, _BLOCK, 3).sum(axis=1)
    w, m, moved = (angle[1:] + angle[:-1]) / 2, (mag[1:] + mag[:-1]) / 2, np.diff(mag, axis=0)
    unit = np.eye(3)
    iron = [np.cross(w, h) for h in unit]
    for i, j in zip(*np.triu_indices(3), strict=True):
        S = (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / 2
        iron.append(np.cross(w, m @ S) - np.cross(w, m) @ S)
    design = np.stack([column.ravel() for column in iron], axis=1)
    target = (moved + np.cross(w, m)).ravel()
    rest = (target - design @ np.linalg.lstsq(design, target)[0]).reshape(-1, 3)
    across = -np.cross(unit[k], m)
    turn = np.sum(rest * across, axis=1) / np.maximum(np.sum(across**2, axis=1), 1e-300)
    left = rest - turn[:, None] * across
    noise = noise_of_differences(track)[0] * np.sqrt(2.0 / _BLOCK)
    shown = 1.0 - np.sum(left**2) / max(float(np.sum(rest**2)), 1e-300)
    if shown < priors.DEAD_AXIS_SHOWN or rest.std() < priors.DEAD_AXIS_NOISE * noise:
        return 0.0
    return float(np.ptp(np.cumsum(turn)))


def without_impossible(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track without single readings that no sensor gives, and a sentence on each kind.

    A wrong reading of the magnetometer becomes nan, behind a wrong rate a new run begins.
    """
    notes = []
    # in units of the largest number, so that no square overflows
    size = np.max(np.abs(np.nan_to_num(track.mag_b_gauss, posinf=1e308, neginf=-1e308)), axis=1)
    usual = float(np.median(size[size > 0.0])) if (size > 0.0).any() else 0.0
    far = size > priors.IMPOSSIBLE_FIELD * usual
    if far.any():
        track = replace(track, mag_b_gauss=np.where(far[:, None], np.nan, track.mag_b_gauss))
        notes.append(
            _left_out(
                "reading", "of the magnetometer ", far, track, f"{priors.IMPOSSIBLE_FIELD:g} fields"
            )
        )
    rate = np.max(np.abs(track.gyro_b_rad_s), axis=1)
    limit = max(priors.IMPOSSIBLE_RATE * float(np.quantile(rate, 0.999)), priors.IMPOSSIBLE_RAD_S)
    fast = rate > limit
    if fast.any():
        dt_s = np.where(fast, np.nan, track.dt_s)
        gyro = np.where(fast[:, None], 0.0, track.gyro_b_rad_s)
        track = replace(track, gyro_b_rad_s=gyro, dt_s=dt_s, runs=tuple(gap_free_runs(dt_s)))
        notes.append(_left_out("rate", "", fast, track, f"{limit:.3g} rad/s"))
    return track, tuple(notes)


def _left_out(what: str, of: str, rows: NDArray[np.bool], track: Track, beyond: str) -> str:
    first = float(track.time_s[int(np.argmax(rows))])
    number = counted(int(np.count_nonzero(rows)), what)
    return f"{number} {of}beyond {beyond}, first at {first:.1f} s: no sensor gives that, left out"


def dead_axes(track: Track) -> tuple[str, ...]:
    """A sentence for each axis that reads one number throughout while the others do not."""
    out = []
    for sensor, values in (("magnetometer", track.mag_b_gauss), ("gyro", track.gyro_b_rad_s)):
        still = np.ptp(values[np.isfinite(values).all(axis=1)], axis=0) == 0.0
        if still.all():
            continue
        out += [
            f"the {sensor}'s {_AXES[k]} reads {values[0, k] + 0.0:.6g} in every row: a real axis "
            "scatters, it is dead or was not logged"
            for k in np.flatnonzero(still)
        ]
    return tuple(out)


def stuck_axes(track: Track, bad: NDArray[np.bool]) -> list[Fact]:
    """Single axes of the magnetometer that repeat one number while the others turn.

    bad: (N,) rows that are known not to be readings.  An axis changes by the turn times the other
    two, whatever it says itself, so what it should have said is known.
    """
    mag = track.mag_b_gauss
    course = _course(track)
    rows: dict[str, NDArray[np.bool]] = {}
    for k, axis in enumerate(_AXES):
        again = _again(track, mag[:, k : k + 1]) & ~bad
        least = max(_least_gauss(track), priors.STUCK_MOVED_STEPS * _coarseness(mag[:, k]))
        spans = [(a, b) for a, b in _long(again) if np.ptp(course[a - 1 : b, k]) > least]
        if spans and sum(b - a for a, b in spans) < len(track) - 1:
            rows[axis] = _marked(spans, len(track))
    if not rows:
        return []
    whole = np.any(list(rows.values()), axis=0)
    total = float(np.count_nonzero(whole) * track.step_s)
    names = ", ".join(rows)
    words = (
        f"the magnetometer's {names} repeats one number while the sensor turns, {total:.1f} s in "
        "all: those readings are not used"
    )
    spans_s = _spans_s(track, spans_of(whole))
    return [
        Fact(
            "stuck_magnetometer",
            words,
            Where(spans_s, tuple(rows), "sensor"),
            1.0,
            (Value("length", total, track.step_s, "s"),),
            {"onset_s": spans_s[0][0]},
            whole,
        )
    ]


def stuck_gyro(track: Track) -> list[Fact]:
    """Stretches in which the gyro repeats one reading while the field moves; a run ends there."""
    mag, again = track.mag_b_gauss, _again(track, track.gyro_b_rad_s)
    least = _least_gauss(track)
    spans = []
    for a, b in _long(again):
        part = mag[a - 1 : b]
        part = part[np.isfinite(part).all(axis=1)]
        if len(part) and np.ptp(part, axis=0).max() > least:
            spans.append((a, b))
    if not spans:
        return []
    rows = _marked(spans, len(track))
    total = float(np.count_nonzero(rows) * track.step_s)
    spans_s = _spans_s(track, spans)
    first = f"{spans_s[0][0]:.1f} to {spans_s[0][1]:.1f} s"
    words = (
        f"the gyro repeats one reading while the field turns, {total:.1f} s in all, first from "
        f"{first}: it is stuck there, and nothing is said of that time"
    )
    return [
        Fact(
            "stuck_gyro",
            words,
            Where(spans_s, _AXES, "gyro"),
            1.0,
            (Value("length", total, track.step_s, "s"),),
            turned=np.where(rows, np.nan, 1.0),
            bad=rows,
        )
    ]


def _coarseness(values: Array) -> float:
    """The usual step between the numbers that readings (N,) take: what is finer does not show."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    return float(np.median(steps)) if len(steps) else 0.0


def _constant(values: Array) -> bool:
    return bool(np.all(values == values[0]))


def _words(vector: Array) -> str:
    return " ".join(f"{part + 0.0:.4g}" for part in vector)


def _least_gauss(track: Track) -> float:
    """By how much a reading must move to have moved for certain."""
    return max(
        priors.STUCK_MOVED_SHARE * track.usual_gauss,
        priors.STUCK_MOVED_NOISE * noise_of_differences(track)[0],
        1e-6,
    )


def _swing_rad(mag: Array) -> float:
    """The largest angle between the first reading and another one."""
    unit = mag / np.maximum(np.linalg.norm(mag, axis=1, keepdims=True), 1e-300)
    return float(np.arccos(np.clip(unit @ unit[0], -1.0, 1.0)).max())


def _turned_rad(track: Track) -> float:
    """The largest range of the angle about one axis, the gyro's middle taken as its bias."""
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    angle = np.cumsum(rate * np.nan_to_num(track.dt_s, nan=0.0)[:, None], axis=0)
    return float(np.ptp(angle, axis=0).max())


def _again(track: Track, values: Array) -> NDArray[np.bool]:
    """(N,) rows equal to the row before, within a run."""
    out = np.zeros(len(values), dtype=bool)
    out[1:] = np.all(values[1:] == values[:-1], axis=1)
    for run in track.runs:
        out[run.start] = False
    return out


def _long(again: NDArray[np.bool]) -> list[tuple[int, int]]:
    """Repetitions that are long in themselves, of numbers that usually do not repeat."""
    usual = float(np.median(np.diff(np.flatnonzero(~again), append=len(again))))
    if usual > 1.0:
        return []
    return [(a, b) for a, b in spans_of(again) if b - a >= priors.AXIS_STUCK_ROWS]


def _marked(spans: Sequence[tuple[int, int]], count: int) -> NDArray[np.bool]:
    out = np.zeros(count, dtype=bool)
    for a, b in spans:
        out[a:b] = True
    return out


def _spans_s(track: Track, spans: Sequence[tuple[int, int]]) -> tuple[tuple[float, float], ...]:
    return tuple((float(track.time_s[a - 1]), float(track.time_s[b - 1])) for a, b in spans)


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


def _expected_change(track: Track) -> Array:
    """(N,) gauss by which a step turns the field at most, the gyro's middle taken as its bias."""
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    size = track.usual_gauss
    step = np.linalg.norm(rate, axis=1) * np.nan_to_num(track.dt_s, nan=0.0)
    return np.asarray(step * size)


def turned_gauss(track: Track, centre: Array, first: int, last: int) -> float:
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
    least = max(priors.STUCK_ROWS, priors.STUCK_LONGER * usual)
    long = [(first, last) for first, last in spans_of(again) if last - first >= least]
    mag = track.mag_b_gauss
    centre = sphere_centre(mag[np.isfinite(mag).all(axis=1) & mag.any(axis=1)])
    turned = [
        turned_gauss(track, centre, *span) >= priors.STUCK_TURNED_NOISE * _resolution(track)
        for span in long
    ]
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
    moving = expected > max(float(np.quantile(expected, 0.5)), priors.HELD_STEPS * _step(track))
    fresh = np.flatnonzero(~again)
    repeated = int(np.count_nonzero(again))
    if np.count_nonzero(moving) < 50 or len(fresh) < 10 or repeated < priors.HELD_REPEATS:
        return []
    usual = len(again) / len(fresh)
    if usual * track.step_s < priors.HELD_ORDINARY_S:
        return []
    if np.mean(again[moving]) < priors.HELD_MOVING_SHARE * repeated / len(again):
        return []
    if _irregularity(np.diff(fresh)) > priors.HELD_CLOCKWORK:
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
    if len(sums) < priors.HELD_FEWEST_SUMS:
        return 1.0
    variance = together * chance
    off = (sums - np.median(sums)) ** 2  # a gap, or a span without a new reading, is one sum
    return float(np.mean(np.minimum(off, priors.HELD_MOST_VARIANCES * variance))) / variance


def _doubled(track: Track, again: NDArray[np.bool]) -> list[Fact]:
    """Rows that repeat magnetometer and gyro: a sample that was sent or stored twice.

    Only while the sensor turns: at rest coarse numbers repeat by chance. So they do about axes that
    it does not turn about, each sensor's for itself: a sample that came twice repeats both.
    """
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turning = (
        np.max(np.abs(rate), axis=1) > priors.DOUBLED_TURNING_NOISE * noise_of_differences(track)[1]
    )
    mag, gyro = again & turning, _again(track, track.gyro_b_rad_s) & turning
    both = mag & gyro
    count, fresh = int(np.count_nonzero(both)), turning & ~mag
    alone = np.count_nonzero(gyro & fresh) / max(int(np.count_nonzero(fresh)), 1)
    chance = alone * np.count_nonzero(mag)
    if count < max(3, priors.DOUBLED_SHARE * len(track), priors.DOUBLED_BEYOND_CHANCE * chance):
        return []
    share = count / len(track)
    step = track.step_s
    times = tuple((float(t) - step, float(t)) for t in track.time_s[both][:50])
    return [
        Fact(
            "dropped_samples",
            f"{counted(count, 'sample')} as the one before, gyro and magnetometer: they came twice",
            Where(times, _AXES, "link"),
            priors.SURE_OF_DOUBLED,
            (Value("part", share, float(np.sqrt(share / len(track))), "1"),),
            {"doubled": True},
            both,
        )
    ]


def _whole(track: Track) -> tuple[tuple[float, float], ...]:
    return ((float(track.time_s[0]), float(track.time_s[-1])),)
