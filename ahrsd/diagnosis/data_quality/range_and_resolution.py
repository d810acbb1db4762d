"""Limits and steps of a sensor's numbers: flat tops, and a comb in the histogram."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.data_quality.facts import Fact, spans_of
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_AXES = ("x", "y", "z")
_BESIDE = 2  # rows before and after such readings: noise that is added behind the limit hides a few


def clipping(track: Track) -> list[Fact]:
    """Saturation of either sensor."""
    mag_noise, gyro_noise = noise_of_differences(track)
    out = []
    for effect, values, noise, unit, frame in (
        ("mag_saturation", track.mag_b_gauss, mag_noise, "gauss", "sensor"),
        ("gyro_saturation", track.gyro_b_rad_s, gyro_noise, "rad/s", "gyro"),
    ):
        fresh = np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)]
        found = [
            _flat_tops(column, fresh, max(noise, priors.LIMIT_TOP_STEPS * step_of(column)))
            for column in values.T
        ]
        if not any(rows.any() for rows, _ in found):
            found = _one_limit(values, noise)
        if not any(rows.any() for rows, _ in found):
            continue
        limit = max(level for rows, level in found if rows.any())
        at_limit = np.abs(values) >= limit  # the other axes' few, where the limit is theirs too
        found = [(rows | at_limit[:, axis], level) for axis, (rows, level) in enumerate(found)]
        rows = np.any([rows for rows, _ in found], axis=0)
        # of readings at the limit only those that noise made small are left: they are biased
        near = np.any(
            np.abs(values)
            > limit - min(priors.LIMIT_MARGIN_NOISE * noise, priors.LIMIT_MARGIN_SHARE * limit),
            axis=1,
        )
        near = np.convolve(near, np.ones(2 * _BESIDE + 1), mode="same") > 0.5
        intervals = tuple(
            (float(track.time_s[a]), float(track.time_s[b - 1])) for a, b in spans_of(rows, 5)
        )
        axes = tuple(name for name, (mine, _) in zip(_AXES, found, strict=True) if mine.any())
        sensor = "magnetometer" if unit == "gauss" else "gyro"
        words = (
            f"the {sensor} stands at its limit of {limit:.4g} {unit} in "
            f"{counted(int(np.count_nonzero(rows)), 'sample')} ({', '.join(axes)})"
        )
        out.append(
            Fact(
                effect,
                words,
                Where(intervals, axes, frame),
                priors.SURE_OF_READINGS,
                (Value("limit", limit, max(noise, 1e-9), unit),),
                {},
                near if unit == "gauss" else None,
                None if unit == "gauss" else np.where(near, np.nan, 1.0),
            )
        )
    return out


def _flat_tops(
    values: Array, fresh: NDArray[np.bool], noise: float
) -> tuple[NDArray[np.bool], float]:
    """Rows at a limit of one axis, and that limit's size.

    At a limit readings are equal bit by bit, several in a row, and pile up: just inside it,
    within the noise and the steps of the numbers, each number has far fewer, however long the
    sensor points there.  Where no axis changes (not `fresh`) it is the sensor that repeats itself.
    """
    rows = np.zeros(len(values), dtype=bool)
    size = 0.0
    finite = values[np.isfinite(values)]
    for sign in (1.0, -1.0):
        top = float(np.max(sign * finite)) if len(finite) else 0.0
        at = (sign * values == top) & fresh
        if top <= 0 or np.count_nonzero(at) < max(
            priors.LIMIT_FEWEST, priors.LIMIT_SHARE * len(values)
        ):
            continue
        longest = max(b - a for a, b in spans_of(at))
        width = noise or 1e-12
        inside = finite[(sign * finite < top) & (sign * finite > top - width)]
        usual = len(inside) / max(len(np.unique(inside)), 1)
        if longest >= 3 and np.count_nonzero(at) > priors.LIMIT_PILED * max(usual, 1.0):
            # coarse numbers of a sensor that lies still pile up at its largest reading
            coarse = len(np.unique(finite)) < priors.FINE_NUMBERS * len(finite)
            if coarse and float(finite.max() - finite.min()) < 20 * width:
                continue
            rows |= at
            size = max(size, top)
    return rows, size


def _one_limit(values: Array, noise: float) -> list[tuple[NDArray[np.bool], float]]:
    """Rows at a limit that axes share, and its size, where noise was added behind the limit.

    No two readings are equal then, but every axis ends at one size, in both senses, with a heap of
    readings as wide as their noise and next to none just inside.  A vehicle that always turns at
    one rate does so about one axis; what two axes and three sides have in common is the sensor's.
    """
    none = [(np.zeros(len(values), dtype=bool), 0.0) for _ in _AXES]
    heaps = [
        (axis, sign, level)
        for axis in range(3)
        for sign in (1.0, -1.0)
        if (level := _heap(sign * values[:, axis], noise)) > 0.0
    ]
    if len(heaps) < priors.LIMIT_SIDES:
        return none
    usual = float(np.median([level for _, _, level in heaps]))
    shared = [heap for heap in heaps if abs(heap[2] - usual) < priors.LIMIT_ALIKE * usual]
    if len(shared) < priors.LIMIT_SIDES or len({axis for axis, _, _ in shared}) < 2:
        return none
    # by its bias an axis reaches the limit at a little more on one side than on the other
    lowest = min(level for _, _, level in shared)
    reach = lowest - priors.LIMIT_HEAP_NOISE / 2 * noise
    return [(np.abs(values[:, axis]) > reach, lowest) for axis in range(3)]


def _heap(values: Array, noise: float) -> float:
    """Where the largest of (N,) values pile up within their noise; 0 where they do not."""
    known = values[np.isfinite(values)]
    top, width = float(np.max(known, initial=0.0)), priors.LIMIT_HEAP_NOISE * noise
    inside = known > top - width
    heaped = int(np.count_nonzero(inside))
    below = int(np.count_nonzero(known > top - 2 * width)) - heaped
    if top < 4 * width or heaped < priors.LIMIT_PILED * max(below, 1):
        return 0.0
    longest = max((b - a for a, b in spans_of(values > top - width)), default=0)
    return float(np.median(known[inside])) if longest >= priors.LIMIT_FEWEST else 0.0


def quantisation(track: Track) -> list[Fact]:
    """A step of the magnetometer's numbers that is coarse against its noise."""
    noise = noise_of_differences(track)[0]
    steps = np.array([step_of(track.mag_b_gauss[:, axis]) for axis in range(3)])
    coarse = steps > priors.COARSE_STEPS * noise
    if noise == 0.0:  # most seconds show no change at all: coarse, or stuck
        coarse &= [_one_by_one(track.mag_b_gauss[:, axis], steps[axis]) for axis in range(3)]
    if not coarse.any():
        return []
    step = float(steps.max())
    axes = tuple(name for name, yes in zip(_AXES, coarse, strict=True) if yes)
    words = f"the magnetometer's readings come in steps of {1e3 * step:.3g} mG, coarser than noise"
    where = Where(((float(track.time_s[0]), float(track.time_s[-1])),), axes, "sensor")
    parameters = (Value("step", step, 1e-6, "gauss"),)
    return [Fact("mag_quantisation", words, where, priors.SURE_OF_READINGS, parameters)]


def _one_by_one(values: Array, step: float) -> bool:
    """Whether readings that change mostly change by one step; those that were stuck jump."""
    change = np.abs(np.diff(values))
    change = change[np.isfinite(change) & (change > 0)]
    return bool(len(change) and np.median(change) < priors.LIMIT_TOP_STEPS * step)


def step_of(values: Array) -> float:
    """The step that all values are multiples of, but for one offset; 0 where there is none."""
    unique = np.unique(values[np.isfinite(values)])
    if len(unique) < 4 or len(unique) > 0.5 * len(values):
        return 0.0
    gaps = np.diff(unique)
    gaps = gaps[gaps > 1e-9]
    if len(gaps) < 3:
        return 0.0
    step = float(np.quantile(gaps, 0.1))
    off = gaps / step - np.round(gaps / step)
    return step if np.mean(np.abs(off) < 0.05) > 0.95 else 0.0
