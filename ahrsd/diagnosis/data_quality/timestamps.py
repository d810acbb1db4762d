"""What the time stamps show: missing samples, jitter, clocks that disagree, clocks that jump.

The steps of a good clock are multiples of one step.  If a host stamps a regular stream, the stamps
scatter, and a late stamp makes one step longer and the next shorter: neighbouring steps have a
correlation of -1/2.  The same holds for samples that were taken early and late and stamped
correctly.  Then the field turns by the rate times the step as stamped; otherwise it turns by the
rate times the usual step.

A jump of a clock is no time that passed: it is replaced by a short break (`without_clock_jumps`).
If a host's clock is set while it records, from 1970 to today, an hour ahead, two seconds back, the
recording has two parts with decades between them, or one on top of the other.  Everything that is
divided by time (a drift, blocks, pieces of twenty seconds) would then see only these two parts, and
grids that grow with the duration would exhaust the memory.  So no break is longer than the
recording's own length, and time always increases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact, whole_recording
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array, in_periods

_PIECE_ROWS = 30  # rows over which a host's clock is linear in time
#: columns of other clocks that a recording may contain
CLOCKS = ("host_time_s", "host_s", "time_host_s", "device_time_s", "time_startup_s", "time_gps_s")


def find_clock_faults(track: Track) -> list[Fact]:
    """Facts about the time column."""
    return (
        _backward_steps(track)
        + _missing_samples(track)
        + _stamp_jitter(track)
        + _clock_rate_errors(track)
    )


def _backward_steps(track: Track) -> list[Fact]:
    """Steps by which time does not increase."""
    steps = np.diff(track.time_s)
    wrong = np.flatnonzero(~(steps > 0))
    if not len(wrong):
        return []
    times = tuple((float(track.time_s[k]), float(track.time_s[k + 1])) for k in wrong[:50])
    words = (
        f"time does not increase at {counted(len(wrong), 'sample')}, first at row {wrong[0] + 1}"
    )
    value = float(np.max(np.abs(steps[wrong])))
    parameters = (Value("jitter", value, 0.0, "s"),)
    where = Where(times, (), "link")
    sure = priors.SURE_BACKWARDS
    return [Fact("timestamp_jitter", words, where, sure, parameters, stops=True)]


def _missing_samples(track: Track) -> list[Fact]:
    """Missing samples: steps that are whole multiples of the usual one."""
    steps = np.diff(track.time_s)
    if len(steps) < 50 or np.any(steps <= 0):
        return []
    periods = in_periods(steps)
    if periods is None:
        return []
    whole = np.rint(periods)
    long = (whole >= 2) & (np.abs(periods - whole) < 0.25 + 0.02 * whole)
    lost = int(np.sum(whole[long] - 1))
    share = lost / (lost + len(track))
    if share < priors.MISSING_SHARE or np.count_nonzero(long) < 2:
        return []
    where = Where(
        tuple((float(track.time_s[k]), float(track.time_s[k + 1])) for k in np.flatnonzero(long)),
        (),
        "link",
    )
    words = f"missing: {counted(lost, 'sample')} at {counted(int(np.count_nonzero(long)), 'place')}"
    deviation = float(np.sqrt(share * (1 - share) / len(track)))
    parameters = (Value("part", share, deviation, "1"),)
    return [Fact("dropped_samples", words, where, priors.SURE_OF_READINGS, parameters)]


def _stamp_jitter(track: Track) -> list[Fact]:
    """Scatter of the stamps about a regular clock, if the samples were not taken as stamped."""
    steps = track.dt_s[np.isfinite(track.dt_s)]
    if len(steps) < 100:
        return []
    usual, jitter = _regular_clock(track)
    off = np.clip(steps - usual, -0.6 * usual, 0.6 * usual)
    off = off - off.mean()
    variance = float(np.mean(off**2))
    if variance == 0.0:
        return []
    opposed = float(np.mean(off[1:] * off[:-1])) / variance
    # scatter that is small for a clock matters if the sensor turns quickly
    threshold = (
        -priors.STAMPED_NATS if jitter < priors.JITTER_SHARE * usual else priors.STAMPED_NATS
    )
    if opposed > priors.JITTER_OPPOSED or _evidence_for_stamps(track) > threshold:
        return []
    where = Where(whole_recording(track), (), "link")
    words = f"the time stamps scatter by {1e3 * jitter:.2g} ms about a regular clock"
    deviation = jitter / float(np.sqrt(len(steps)))
    parameters = (Value("jitter", jitter, deviation, "s"),)
    sure = priors.SURE_OF_READINGS
    return [Fact("timestamp_jitter", words, where, sure, parameters, {"step_s": usual})]


def _regular_clock(track: Track) -> tuple[float, float]:
    """Step of the regular clock behind the stamps, and the usual scatter about it, seconds.

    Both are medians over pieces of `_PIECE_ROWS` rows, most of which have no sample missing.  If
    stamps come in bunches, the median step would be that within a bunch.
    """
    runs = [track.time_s[run] for run in track.runs or (slice(0, len(track)),)]
    length = min(_PIECE_ROWS, max(map(len, runs)))
    pieces = [time_s[: len(time_s) // length * length].reshape(-1, length) for time_s in runs]
    stamps_s = np.concatenate(pieces)
    stamps_s = stamps_s - stamps_s.mean(axis=1, keepdims=True)
    index = np.arange(length) - (length - 1) / 2
    step_s = stamps_s @ index / np.sum(index**2)
    off = stamps_s - step_s[:, None] * index
    scatter = np.sqrt(np.sum(off**2, axis=1) / max(length - 2, 1))
    return float(np.median(step_s)), float(np.median(scatter))


def _evidence_for_stamps(track: Track) -> float:
    """Nats for the field's changes over steps as stamped, relative to steps of a regular clock.

    A change is -A (w x h) dt, with h = C (m - b): linear in rate x reading, rate and reading, in
    any units and axes.
    """
    stamped = track.dt_s
    even = np.where(np.isnan(stamped), np.nan, np.diff(regular_stamps(track), prepend=np.nan))
    change = np.diff(track.mag_b_gauss, axis=0, prepend=np.nan)
    middle = track.mag_b_gauss - change / 2
    rate = track.gyro_b_rad_s
    both = (rate[:, :, None] * middle[:, None, :]).reshape(len(rate), 9)
    known = np.isfinite(change).all(axis=1) & np.isfinite(stamped)
    regressors = np.concatenate([both, rate, middle], axis=1)[known]

    def residual(step_s: Array) -> Array:
        columns = regressors * step_s[known, None]
        fitted = np.linalg.lstsq(columns, change[known], rcond=None)[0]
        return np.asarray(change[known] - columns @ fitted)

    first, second = residual(stamped), residual(even)
    size = np.maximum(np.abs(first), np.abs(second))
    usual = 1.4826 * np.median(np.abs(first), axis=0)
    inliers = (size <= priors.STAMPED_OUTLIER * usual).all(axis=1)
    if np.count_nonzero(inliers) < 100:
        return 0.0
    # neighbouring differences share a reading: half of their information counts twice
    ratio = np.sum(second[inliers] ** 2, axis=0) / np.maximum(
        np.sum(first[inliers] ** 2, axis=0), 1e-300
    )
    return float(np.count_nonzero(inliers) / 4 * np.sum(np.log(np.maximum(ratio, 1e-300))))


def regular_stamps(track: Track) -> Array:
    """(N,) stamps of the regular clock behind jittering ones: a straight line through each run."""
    out = track.time_s.copy()
    for run in track.runs or (slice(0, len(track)),):
        mine = track.time_s[run]
        if len(mine) > 20:
            index = np.arange(len(mine), dtype=float)
            out[run] = np.polynomial.polynomial.Polynomial.fit(index, mine, 1)(index)
    return out


def _clock_rate_errors(track: Track) -> list[Fact]:
    """The rate of the recording's clock relative to another clock that it contains."""
    out = []
    for name in CLOCKS:
        other = track.covariates.get(name)
        if other is None or not np.isfinite(other).all() or np.ptp(other) <= 0:
            continue
        mine = track.time_s - track.time_s[0]
        theirs = other - other[0]
        slope = float(np.polyfit(mine, theirs, 1)[0])
        if abs(slope - 1) > 0.1:
            continue  # another unit or another meaning
        residual = theirs - slope * mine
        deviation = float(np.std(residual) / np.std(mine) / np.sqrt(len(mine) / 10))
        error = slope - 1
        if abs(error) < max(priors.CLOCK_RATE, 5 * deviation):
            continue
        words = (
            f"time_s runs {1e6 * abs(error):.0f} ppm {'slow' if error > 0 else 'fast'} on {name}"
        )
        where = Where(whole_recording(track), (), "link")
        parameters = (Value("rate_error", error, deviation, "1"),)
        sure = priors.SURE_OF_CLOCK
        out.append(Fact("clock_rate", words, where, sure, parameters, {"clock": name}))
    return out


def without_clock_jumps(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track without the jumps of its clock, and a sentence on the first of them.

    The rows stay; the times after a jump are shifted.  Only where a run begins: a step back within
    a run is no break.
    """
    starts = np.array([run.start for run in track.runs[1:]], dtype=np.intp)
    if not len(starts):
        return track, ()
    breaks_s = track.time_s[starts] - track.time_s[starts - 1]
    passed_s = sum(float(track.time_s[r.stop - 1] - track.time_s[r.start]) for r in track.runs)
    jumps = (breaks_s <= 0.0) | (breaks_s > max(priors.BREAK_BELIEVED_S, passed_s))
    if not jumps.any():
        return track, ()
    shift_s = np.zeros(len(track))
    shift_s[starts[jumps]] = priors.BREAK_LEFT_S - breaks_s[jumps]
    first = int(np.argmax(jumps))
    others = f" (and {np.count_nonzero(jumps) - 1} more)" if np.count_nonzero(jumps) > 1 else ""
    at_s = float(track.time_s[starts[first] - 1])
    words = (
        f"the clock jumps by {breaks_s[first]:+.6g} s after {at_s:.13g} s{others}: "
        f"taken as a break of {priors.BREAK_LEFT_S:g} s, and later times are reported as if only "
        "that had passed"
    )
    return replace(track, time_s=track.time_s + np.cumsum(shift_s)), (words,)
