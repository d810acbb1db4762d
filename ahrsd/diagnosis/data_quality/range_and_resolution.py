"""Limits and steps of a sensor's numbers: saturated readings, and a comb in the histogram."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.data_quality.facts import Fact, row_intervals, whole_recording
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_AXES = ("x", "y", "z")
#: rows before and after readings at a limit: noise that is added behind the limit hides a few
_MARGIN_ROWS = 2


def find_clipping(track: Track) -> list[Fact]:
    """Saturation of either sensor."""
    mag_noise, gyro_noise = noise_of_differences(track)
    out = []
    for effect, values, noise, unit, frame in (
        ("mag_saturation", track.mag_b_gauss, mag_noise, "gauss", "sensor"),
        ("gyro_saturation", track.gyro_b_rad_s, gyro_noise, "rad/s", "gyro"),
    ):
        fresh = np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)]
        found = [
            _flat_tops(
                column, fresh, max(noise, priors.LIMIT_TOP_STEPS * quantisation_step(column))
            )
            for column in values.T
        ]
        if not any(rows.any() for rows, _ in found):
            found = _shared_limit(values, noise)
        if not any(rows.any() for rows, _ in found):
            continue
        limit = max(level for rows, level in found if rows.any())
        at_limit = np.abs(values) >= limit  # a few of the other axes, if they share the limit
        found = [(rows | at_limit[:, axis], level) for axis, (rows, level) in enumerate(found)]
        rows = np.any([rows for rows, _ in found], axis=0)
        # near the limit only readings that noise made small would remain: they are biased
        near = np.any(
            np.abs(values)
            > limit - min(priors.LIMIT_MARGIN_NOISE * noise, priors.LIMIT_MARGIN_SHARE * limit),
            axis=1,
        )
        near = np.convolve(near, np.ones(2 * _MARGIN_ROWS + 1), mode="same") > 0.5
        intervals = tuple(
            (float(track.time_s[a]), float(track.time_s[b - 1])) for a, b in row_intervals(rows, 5)
        )
        axes = tuple(name for name, (mine, _) in zip(_AXES, found, strict=True) if mine.any())
        sensor = "magnetometer" if unit == "gauss" else "gyro"
        words = (
            f"the {sensor} is at its limit of {limit:.4g} {unit} in "
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
    """Rows at a limit of one axis, and the size of that limit.

    At a limit, readings are equal bit by bit, several in a row, and accumulate.  Just inside it,
    within the noise and the steps of the numbers, each number occurs far less often, however long
    the sensor points there.  Where no axis changes (not `fresh`), the sensor repeats a reading.
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
        longest = max(b - a for a, b in row_intervals(at))
        width = noise or 1e-12
        inside = finite[(sign * finite < top) & (sign * finite > top - width)]
        usual = len(inside) / max(len(np.unique(inside)), 1)
        if longest >= 3 and np.count_nonzero(at) > priors.LIMIT_PILED * max(usual, 1.0):
            # coarse readings of a sensor at rest accumulate at the largest one
            coarse = len(np.unique(finite)) < priors.FINE_NUMBERS * len(finite)
            if coarse and float(finite.max() - finite.min()) < 20 * width:
                continue
            rows |= at
            size = max(size, top)
    return rows, size


def _shared_limit(values: Array, noise: float) -> list[tuple[NDArray[np.bool], float]]:
    """Rows at a limit that several axes share, and its size, if noise was added behind the limit.

    No two readings are equal then.  But every axis ends at one size, in both senses, with a cluster
    of readings as wide as their noise and next to none just inside.  A vehicle that always turns at
    one rate does so about one axis; what two axes and three sides have in common is the sensor's.
    """
    none = [(np.zeros(len(values), dtype=bool), 0.0) for _ in _AXES]
    heaps = [
        (axis, sign, level)
        for axis in range(3)
        for sign in (1.0, -1.0)
        if (level := _heap_level(sign * values[:, axis], noise)) > 0.0
    ]
    if len(heaps) < priors.LIMIT_SIDES:
        return none
    usual = float(np.median([level for _, _, level in heaps]))
    shared = [heap for heap in heaps if abs(heap[2] - usual) < priors.LIMIT_ALIKE * usual]
    if len(shared) < priors.LIMIT_SIDES or len({axis for axis, _, _ in shared}) < 2:
        return none
    # because of its bias, an axis reaches the limit at slightly different sizes on its two sides
    lowest = min(level for _, _, level in shared)
    reach = lowest - priors.LIMIT_HEAP_NOISE / 2 * noise
    return [(np.abs(values[:, axis]) > reach, lowest) for axis in range(3)]


def _heap_level(values: Array, noise: float) -> float:
    """Level at which the largest of (N,) values accumulate within their noise; 0 if they do not."""
    known = values[np.isfinite(values)]
    top, width = float(np.max(known, initial=0.0)), priors.LIMIT_HEAP_NOISE * noise
    inside = known > top - width
    heaped = int(np.count_nonzero(inside))
    below = int(np.count_nonzero(known > top - 2 * width)) - heaped
    if top < 4 * width or heaped < priors.LIMIT_PILED * max(below, 1):
        return 0.0
    longest = max((b - a for a, b in row_intervals(values > top - width)), default=0)
    return float(np.median(known[inside])) if longest >= priors.LIMIT_FEWEST else 0.0


def find_quantisation(track: Track) -> list[Fact]:
    """A quantisation step of the magnetometer that is coarse compared with its noise."""
    noise = noise_of_differences(track)[0]
    steps = np.array([quantisation_step(track.mag_b_gauss[:, axis]) for axis in range(3)])
    coarse = steps > priors.COARSE_STEPS * noise
    if noise == 0.0:  # in most seconds nothing changes: coarse, or stuck
        coarse &= [
            _changes_by_one_step(track.mag_b_gauss[:, axis], steps[axis]) for axis in range(3)
        ]
    if not coarse.any():
        return []
    step = float(steps.max())
    axes = tuple(name for name, yes in zip(_AXES, coarse, strict=True) if yes)
    words = f"the magnetometer's readings come in steps of {1e3 * step:.3g} mG, coarser than noise"
    where = Where(whole_recording(track), axes, "sensor")
    parameters = (Value("step", step, 1e-6, "gauss"),)
    return [Fact("mag_quantisation", words, where, priors.SURE_OF_READINGS, parameters)]


def _changes_by_one_step(values: Array, step: float) -> bool:
    """Whether readings that change mostly change by one step; readings of a stuck sensor jump."""
    change = np.abs(np.diff(values))
    change = change[np.isfinite(change) & (change > 0)]
    return bool(len(change) and np.median(change) < priors.LIMIT_TOP_STEPS * step)


def quantisation_step(values: Array) -> float:
    """The step of which all values are multiples, but for a common offset; 0 if there is none."""
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
