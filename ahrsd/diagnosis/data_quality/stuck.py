"""Readings that never change, stop changing or repeat while the other sensor moves.

Real readings scatter.  A sensor, or one of its axes, that repeats a number bit by bit is stuck, was
switched off or was not logged.  The fault is reported for that sensor and never attributed to the
motion: to a filter with a dead gyro the field only drifts, and to one with a dead magnetometer
everything looks right.

A magnetometer may be stuck for a while, or updated too slowly, or samples may come twice
(`find_repeated_readings`).  The criterion is equality bit by bit on all three axes, and only where
the gyro shows that the sensor turned by more than the resolution of the readings: a sensor with low
noise at rest repeats itself correctly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import fit_sphere_centre
from ahrsd.diagnosis.data_quality.facts import Fact, row_intervals, whole_recording
from ahrsd.diagnosis.data_quality.range_and_resolution import quantisation_step
from ahrsd.diagnosis.time_series import gap_free_runs
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_AXES = ("x", "y", "z")
_BLOCK_ROWS = 10  # rows that are averaged, to reduce the noise
_FEWEST_SUMS = 20  # sums of times between new readings, if there are as many


def dead_sensor_reason(track: Track) -> str | None:
    """Why no fit is possible: a sensor, or one of its axes, never changes although it should.

    None if there is no such reason.  An axis may be constant if nothing is expected on it, as in a
    simulation without noise that turns about another axis.
    """
    mag, gyro = track.mag_b_gauss, track.gyro_b_rad_s
    seen = np.isfinite(mag).all(axis=1)
    size = track.usual_gauss
    if not priors.FIELD_READINGS[0] < size < priors.FIELD_READINGS[1]:
        return f"the median field is {size:.3g}: that is no magnetic field in any unit"
    if _is_constant(gyro) and np.ptp(mag[seen], axis=0).max() > _least_certain_change_gauss(track):
        return (
            f"the gyro reads {_vector_words(gyro[0])} rad/s in every row while the field turns by "
            f"{np.degrees(_largest_angle_rad(mag[seen])):.0f} deg: it is stuck or was not logged"
        )
    turned = _largest_turn_rad(track)
    if _is_constant(mag[seen]) and _is_constant(gyro):
        return (
            f"the magnetometer reads {_vector_words(mag[seen][0])} gauss and the gyro "
            f"{_vector_words(gyro[0])} rad/s in every row: both are stuck or were "
            "not logged, for even at rest readings scatter"
        )
    if _is_constant(mag[seen]) and turned > priors.STUCK_TURNED_RAD:
        return (
            f"the magnetometer reads {_vector_words(mag[seen][0])} gauss in every row while the "
            f"gyro turns by {np.degrees(turned):.0f} deg: it is stuck or was not logged"
        )
    return _dead_axis_reason(track)


def _dead_axis_reason(track: Track) -> str | None:
    """Why one axis is wrong: it is constant although the other five show that it turned."""
    mag, gyro = track.mag_b_gauss, track.gyro_b_rad_s
    expected = _expected_field_change(track)
    for k, axis in enumerate(_AXES):
        column = mag[np.isfinite(mag[:, k]), k]
        change_gauss = float(np.ptp(expected[:, k]))
        if _is_constant(column) and change_gauss > _least_certain_change_gauss(track):
            return (
                f"the magnetometer's {axis} reads {column[0] + 0.0:.4g} gauss in every row while "
                f"the field on it changes by {change_gauss:.2g} gauss: it is stuck or "
                "was not logged"
            )
        if (
            _is_constant(gyro[:, k])
            and (turned := _turn_shown_by_field(track, k)) > priors.DEAD_AXIS_TURNED_RAD
        ):
            return (
                f"the gyro's {axis} reads {gyro[0, k] + 0.0:.4g} rad/s in every row while the "
                f"field turns by {np.degrees(turned):.0f} deg about it: it is stuck or was not "
                "logged"
            )
    return None


def _expected_field_change(track: Track) -> Array:
    """(N, 3) gauss: change of the reading since the start that the gyro predicts."""
    step = np.nan_to_num(track.dt_s, nan=0.0)[:, None]
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turn: Array = np.cumsum(np.nan_to_num(np.cross(track.mag_b_gauss, rate * step)), axis=0)
    return turn


def _turn_shown_by_field(track: Track, k: int) -> float:
    """Range in rad of the turn about axis k that only the field shows, not the rates about others.

    0 if soft and hard iron explain as much: m = (I + S) b + h, so to first order
    dm = w x h + w x (S m) - S (w x m) in addition to the turn itself, with S symmetric.
    """
    rows = _BLOCK_ROWS * (len(track) // _BLOCK_ROWS)
    mag = np.nan_to_num(track.mag_b_gauss[:rows]).reshape(-1, _BLOCK_ROWS, 3).mean(axis=1)
    angle = np.nan_to_num(track.gyro_b_rad_s * track.dt_s[:, None])[:rows]
    angle = angle.reshape(-1, _BLOCK_ROWS, 3).sum(axis=1)
    w, m, change = (angle[1:] + angle[:-1]) / 2, (mag[1:] + mag[:-1]) / 2, np.diff(mag, axis=0)
    unit = np.eye(3)
    iron = [np.cross(w, h) for h in unit]
    for i, j in zip(*np.triu_indices(3), strict=True):
        S = (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / 2
        iron.append(np.cross(w, m @ S) - np.cross(w, m) @ S)
    design = np.stack([column.ravel() for column in iron], axis=1)
    target = (change + np.cross(w, m)).ravel()
    residual = (target - design @ np.linalg.lstsq(design, target)[0]).reshape(-1, 3)
    across = -np.cross(unit[k], m)
    turn = np.sum(residual * across, axis=1) / np.maximum(np.sum(across**2, axis=1), 1e-300)
    remaining = residual - turn[:, None] * across
    noise = noise_of_differences(track)[0] * np.sqrt(2.0 / _BLOCK_ROWS)
    explained = 1.0 - np.sum(remaining**2) / max(float(np.sum(residual**2)), 1e-300)
    if explained < priors.DEAD_AXIS_SHOWN or residual.std() < priors.DEAD_AXIS_NOISE * noise:
        return 0.0
    return float(np.ptp(np.cumsum(turn)))


def without_impossible_readings(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track without single readings that no sensor gives, and a sentence on each kind.

    An impossible reading of the magnetometer becomes nan; after an impossible rate a new run
    begins.
    """
    notes = []
    # the largest component, not the norm: no square overflows
    size = np.max(np.abs(np.nan_to_num(track.mag_b_gauss, posinf=1e308, neginf=-1e308)), axis=1)
    usual = float(np.median(size[size > 0.0])) if (size > 0.0).any() else 0.0
    far = size > priors.IMPOSSIBLE_FIELD * usual
    if far.any():
        track = replace(track, mag_b_gauss=np.where(far[:, None], np.nan, track.mag_b_gauss))
        notes.append(
            _left_out_note(
                "reading",
                "of the magnetometer ",
                far,
                track,
                f"{priors.IMPOSSIBLE_FIELD:g} times the usual field",
            )
        )
    rate = np.max(np.abs(track.gyro_b_rad_s), axis=1)
    limit = max(priors.IMPOSSIBLE_RATE * float(np.quantile(rate, 0.999)), priors.IMPOSSIBLE_RAD_S)
    fast = rate > limit
    if fast.any():
        dt_s = np.where(fast, np.nan, track.dt_s)
        gyro = np.where(fast[:, None], 0.0, track.gyro_b_rad_s)
        track = replace(track, gyro_b_rad_s=gyro, dt_s=dt_s, runs=tuple(gap_free_runs(dt_s)))
        notes.append(_left_out_note("rate", "", fast, track, f"{limit:.3g} rad/s"))
    return track, tuple(notes)


def _left_out_note(what: str, of: str, rows: NDArray[np.bool], track: Track, beyond: str) -> str:
    """The sentence on readings that were left out."""
    first = float(track.time_s[int(np.argmax(rows))])
    number = counted(int(np.count_nonzero(rows)), what)
    return f"{number} {of}beyond {beyond}, first at {first:.1f} s: impossible, left out"


def dead_axis_notes(track: Track) -> tuple[str, ...]:
    """A sentence for each axis that is constant throughout while the others are not."""
    out = []
    for sensor, values in (("magnetometer", track.mag_b_gauss), ("gyro", track.gyro_b_rad_s)):
        still = np.ptp(values[np.isfinite(values).all(axis=1)], axis=0) == 0.0
        if still.all():
            continue
        out += [
            f"the {sensor}'s {_AXES[k]} reads {values[0, k] + 0.0:.6g} in every row: it is dead or "
            "was not logged, for a real axis scatters"
            for k in np.flatnonzero(still)
        ]
    return tuple(out)


def find_stuck_axes(track: Track, bad: NDArray[np.bool]) -> list[Fact]:
    """Single axes of the magnetometer that repeat one number while the others turn.

    bad: (N,) rows that are known to be invalid.  The change of an axis is the turn times the other
    two axes, whatever the axis itself reads, so its expected change is known.
    """
    mag = track.mag_b_gauss
    expected = _expected_field_change(track)
    rows: dict[str, NDArray[np.bool]] = {}
    for k, axis in enumerate(_AXES):
        repeated = _repeated_rows(track, mag[:, k : k + 1]) & ~bad
        least = max(
            _least_certain_change_gauss(track),
            priors.STUCK_MOVED_STEPS * _usual_number_step(mag[:, k]),
        )
        spans = [
            (a, b) for a, b in _long_repetitions(repeated) if np.ptp(expected[a - 1 : b, k]) > least
        ]
        if spans and sum(b - a for a, b in spans) < len(track) - 1:
            rows[axis] = _row_mask(spans, len(track))
    if not rows:
        return []
    whole = np.any(list(rows.values()), axis=0)
    total = float(np.count_nonzero(whole) * track.step_s)
    names = ", ".join(rows)
    words = (
        f"the magnetometer's {names} repeats one number while the sensor turns, {total:.1f} s in "
        "all: these readings are not used"
    )
    spans_s = _intervals_s(track, row_intervals(whole))
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


def find_stuck_gyro(track: Track) -> list[Fact]:
    """Intervals in which the gyro repeats one reading while the field moves; a run ends there."""
    mag, repeated = track.mag_b_gauss, _repeated_rows(track, track.gyro_b_rad_s)
    least = _least_certain_change_gauss(track)
    spans = []
    for a, b in _long_repetitions(repeated):
        part = mag[a - 1 : b]
        part = part[np.isfinite(part).all(axis=1)]
        if len(part) and np.ptp(part, axis=0).max() > least:
            spans.append((a, b))
    if not spans:
        return []
    rows = _row_mask(spans, len(track))
    total = float(np.count_nonzero(rows) * track.step_s)
    spans_s = _intervals_s(track, spans)
    first = f"{spans_s[0][0]:.1f} to {spans_s[0][1]:.1f} s"
    words = (
        f"the gyro repeats one reading while the field turns, {total:.1f} s in all, first from "
        f"{first}: it is stuck there, and these intervals are not diagnosed"
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


def _usual_number_step(values: Array) -> float:
    """Median step between the distinct numbers of readings (N,): finer changes do not show."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    return float(np.median(steps)) if len(steps) else 0.0


def _is_constant(values: Array) -> bool:
    """Whether all rows are equal."""
    return bool(np.all(values == values[0]))


def _vector_words(vector: Array) -> str:
    """A vector in words: its components with four digits."""
    return " ".join(f"{part + 0.0:.4g}" for part in vector)


def _least_certain_change_gauss(track: Track) -> float:
    """The change of a reading from which on it has certainly moved."""
    return max(
        priors.STUCK_MOVED_SHARE * track.usual_gauss,
        priors.STUCK_MOVED_NOISE * noise_of_differences(track)[0],
        1e-6,
    )


def _largest_angle_rad(mag: Array) -> float:
    """The largest angle between the first reading and another one."""
    unit = mag / np.maximum(np.linalg.norm(mag, axis=1, keepdims=True), 1e-300)
    return float(np.arccos(np.clip(unit @ unit[0], -1.0, 1.0)).max())


def _largest_turn_rad(track: Track) -> float:
    """The largest range of the angle about one axis, with the gyro's median as its bias."""
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    angle = np.cumsum(rate * np.nan_to_num(track.dt_s, nan=0.0)[:, None], axis=0)
    return float(np.ptp(angle, axis=0).max())


def _repeated_rows(track: Track, values: Array) -> NDArray[np.bool]:
    """(N,) rows that equal the row before, within a run."""
    out = np.zeros(len(values), dtype=bool)
    out[1:] = np.all(values[1:] == values[:-1], axis=1)
    for run in track.runs:
        out[run.start] = False
    return out


def _long_repetitions(repeated: NDArray[np.bool]) -> list[tuple[int, int]]:
    """Long intervals of repetitions, if most numbers do not repeat."""
    usual = float(np.median(np.diff(np.flatnonzero(~repeated), append=len(repeated))))
    if usual > 1.0:
        return []
    return [(a, b) for a, b in row_intervals(repeated) if b - a >= priors.AXIS_STUCK_ROWS]


def _row_mask(spans: Sequence[tuple[int, int]], count: int) -> NDArray[np.bool]:
    """(N,) rows that are in one of the intervals."""
    out = np.zeros(count, dtype=bool)
    for a, b in spans:
        out[a:b] = True
    return out


def _intervals_s(track: Track, spans: Sequence[tuple[int, int]]) -> tuple[tuple[float, float], ...]:
    """Begin and end of the intervals, seconds; they begin with the reading that is repeated."""
    return tuple((float(track.time_s[a - 1]), float(track.time_s[b - 1])) for a, b in spans)


def find_repeated_readings(track: Track, clipped: NDArray[np.bool] | None = None) -> list[Fact]:
    """Stuck, held and doubled samples.

    clipped: (N,) readings at a limit, which repeat anyway
    """
    repeated = _repeated_rows(track, track.mag_b_gauss)
    if clipped is not None:
        repeated &= ~clipped
    expected = _largest_expected_change(track)
    stuck, bad = _find_stuck(track, repeated)
    alone = (
        repeated & ~bad & ~_repeated_rows(track, track.gyro_b_rad_s)
    )  # otherwise the whole sample came twice
    held = _find_sample_hold(track, alone, expected)
    doubled = [] if held else _find_doubled(track, repeated & ~bad)
    return stuck + held + doubled


def _largest_expected_change(track: Track) -> Array:
    """(N,) gauss by which a step turns the field at most, with the gyro's median as its bias."""
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    size = track.usual_gauss
    step = np.linalg.norm(rate, axis=1) * np.nan_to_num(track.dt_s, nan=0.0)
    return np.asarray(step * size)


def expected_change_gauss(track: Track, centre: Array, first: int, last: int) -> float:
    """Gauss by which the whole turn over these rows moves the reading that they repeat.

    centre: (3,) of the sphere through the readings, which does not turn
    """
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turn = rate[first:last].T @ np.nan_to_num(track.dt_s[first:last], nan=0.0)
    reading = track.mag_b_gauss[first]
    if not reading.any():  # 0 0 0 is no field that a turn could move
        return float(np.linalg.norm(turn)) * track.usual_gauss
    return float(np.linalg.norm(np.cross(turn, reading - centre)))


def _resolution(track: Track) -> float:
    """The noise, or the quantisation step if that is coarser: within it readings repeat."""
    return max(noise_of_differences(track)[0], _coarsest_step(track), 1e-6)


def _coarsest_step(track: Track) -> float:
    """The coarsest quantisation step of the three axes, 0 if there is none."""
    return max(quantisation_step(column) for column in track.mag_b_gauss.T)


def _find_stuck(track: Track, repeated: NDArray[np.bool]) -> tuple[list[Fact], NDArray[np.bool]]:
    """Repetitions that are too long, as a fact and as rows (N,).

    If the sensor was stuck during some turn, long repetitions without a turn count as well,
    provided that the numbers are fine enough to show the noise of a sensor at rest.
    """
    bad = np.zeros(len(track), dtype=bool)
    intervals: list[tuple[float, float]] = []
    usual = float(np.median(np.diff(np.flatnonzero(~repeated), append=len(repeated))))
    least = max(priors.STUCK_ROWS, priors.STUCK_LONGER * usual)
    long = [(first, last) for first, last in row_intervals(repeated) if last - first >= least]
    mag = track.mag_b_gauss
    centre = fit_sphere_centre(mag[np.isfinite(mag).all(axis=1) & mag.any(axis=1)])
    turned = [
        expected_change_gauss(track, centre, *span)
        >= priors.STUCK_TURNED_NOISE * _resolution(track)
        for span in long
    ]
    fine = any(turned) and _coarsest_step(track) == 0.0
    for (first, last), has_turned in zip(long, turned, strict=True):
        if has_turned or fine:
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


def _find_sample_hold(track: Track, repeated: NDArray[np.bool], expected: Array) -> list[Fact]:
    """A magnetometer that is read more often than it measures, at any ratio of the two rates.

    Its readings repeat while the sensor turns as well, and new ones come at regular intervals.
    """
    moving = expected > max(
        float(np.quantile(expected, 0.5)), priors.HELD_STEPS * _coarsest_step(track)
    )
    fresh = np.flatnonzero(~repeated)
    repeat_count = int(np.count_nonzero(repeated))
    if np.count_nonzero(moving) < 50 or len(fresh) < 10 or repeat_count < priors.HELD_REPEATS:
        return []
    usual = len(repeated) / len(fresh)
    if usual * track.step_s < priors.HELD_ORDINARY_S:
        return []
    if np.mean(repeated[moving]) < priors.HELD_MOVING_SHARE * repeat_count / len(repeated):
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
            Where(whole_recording(track), _AXES, "sensor"),
            1.0,
            (Value("held_part", 1.0, 0.0, "1"),),
            {"hold": usual, "period_s": usual * step},
            repeated.copy(),
        )
    ]


def _irregularity(rows: Array) -> float:
    """Variance of the rows from one new reading to the next, relative to repetition by chance.

    By chance means that each row repeats independently.  The variance is that of sums over as many
    rows as have a variance of ten then, or over fewer if too few sums were left to tell a clock
    from chance.
    """
    mean = float(np.mean(rows))
    chance = mean * (mean - 1.0)
    together = max(1, int(np.ceil(10.0 / chance)))
    together = min(together, max(int(np.ceil(1.0 / chance)), len(rows) // _FEWEST_SUMS))
    sums = np.add.reduceat(rows, np.arange(0, len(rows) - together + 1, together))[:-1]
    if len(sums) < priors.HELD_FEWEST_SUMS:
        return 1.0
    variance = together * chance
    off = (sums - np.median(sums)) ** 2  # a gap, or a span without a new reading, is one sum
    return float(np.mean(np.minimum(off, priors.HELD_MOST_VARIANCES * variance))) / variance


def _find_doubled(track: Track, repeated: NDArray[np.bool]) -> list[Fact]:
    """Rows that repeat magnetometer and gyro: a sample that was sent or stored twice.

    Only while the sensor turns: at rest, coarse numbers repeat by chance.  So they do on axes about
    which it does not turn, in each sensor independently; a doubled sample repeats both sensors.
    """
    rate = track.gyro_b_rad_s - np.median(track.gyro_b_rad_s, axis=0)
    turning = (
        np.max(np.abs(rate), axis=1) > priors.DOUBLED_TURNING_NOISE * noise_of_differences(track)[1]
    )
    mag, gyro = repeated & turning, _repeated_rows(track, track.gyro_b_rad_s) & turning
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
            f"{counted(count, 'sample')} equal to the one before, gyro and magnetometer: doubled",
            Where(times, _AXES, "link"),
            priors.SURE_OF_DOUBLED,
            (Value("part", share, float(np.sqrt(share / len(track))), "1"),),
            {"doubled": True},
            both,
        )
    ]
