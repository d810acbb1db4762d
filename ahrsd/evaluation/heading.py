"""Heading errors against a reference, one constant removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.evaluation.references import HeadingReference
from ahrsd.evaluation.track import EvaluationError
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.samples import Array

FOLDS = 5
_LEVEL_ENOUGH = 0.3  # horizontal part of the x axis below which there is no heading
_LEAST = 10
_BLOCK_S, _LEAST_BLOCKS = 20.0, 5  # errors further apart are taken to be independent
_DRAWS = 2000


@dataclass(frozen=True, slots=True, eq=False)
class HeadingFigures:
    """Errors of one calibration at M instants.

    offset_deg:  the constant that was removed: heading minus reference
    fold_rms_deg: RMS in each fifth of the instants, in order of time
    fold_spread_deg: their standard deviation
    time_s, reference_deg, error_deg: (M,)
    """

    rms_deg: float
    worst_deg: float
    offset_deg: float
    fold_rms_deg: tuple[float, ...]
    fold_spread_deg: float
    time_s: Array
    reference_deg: Array
    error_deg: Array


def compare(
    time_s: Array,
    field_b: Array,
    up_b: Array,
    reference: HeadingReference,
    declination_rad: float = 0.0,
) -> HeadingFigures:
    """Errors of corrected fields (N, 3) at (N,) instants, levelled by up_b (N, 3).

    Samples without a direction are left out. Raises EvaluationError where the reference and the
    recording hardly overlap.
    """
    with np.errstate(invalid="ignore", divide="ignore"):  # what has no direction is left out
        heading = tilt_compensated_heading(field_b, up_b) + declination_rad
        usable = np.isfinite(heading)
        if reference.up_b is None:  # else the error is that of the field's azimuth, whatever x does
            level = np.linalg.norm(up_b[:, 1:], axis=1) / np.linalg.norm(up_b, axis=1)
            usable &= level > _LEVEL_ENOUGH
    found, seen = _mean_at(time_s[usable], heading[usable], reference)
    if np.count_nonzero(seen) < _LEAST:
        raise EvaluationError(
            f"{reference.name}: {np.count_nonzero(seen)} instants within the recording, {_LEAST} "
            "are needed; are both on the same clock?"
        )
    raw = found[seen] - reference.heading_rad[seen]
    offset = float(np.angle(np.mean(np.exp(1j * raw))))
    error_deg = np.degrees(wrapped(raw - offset))
    folds = tuple(_rms(part) for part in np.array_split(error_deg, FOLDS))
    return HeadingFigures(
        rms_deg=_rms(error_deg),
        worst_deg=float(np.max(np.abs(error_deg))),
        offset_deg=float(np.degrees(offset)),
        fold_rms_deg=folds,
        fold_spread_deg=float(np.std(folds)),
        time_s=reference.time_s[seen],
        reference_deg=np.mod(np.degrees(reference.heading_rad[seen]), 360.0),
        error_deg=error_deg,
    )


def rms_difference(one: HeadingFigures, other: HeadingFigures) -> tuple[float, float] | None:
    """95 % interval of the RMS of one less that of the other, deg; at the same instants.

    Their squares in stretches of 20 s are drawn again and again, both in the same ones: what the
    recording's places and turns do to both is no difference. None where the instants are others
    or cover too little.
    """
    if not np.array_equal(one.time_s, other.time_s):
        return None
    _, block = np.unique(np.floor(one.time_s / _BLOCK_S), return_inverse=True)
    blocks = int(block.max()) + 1
    if blocks < _LEAST_BLOCKS:
        return None
    count, *sums = (np.bincount(block, v) for v in (None, one.error_deg**2, other.error_deg**2))
    drawn = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), _DRAWS)
    first, second = (np.sqrt((drawn @ total) / (drawn @ count)) for total in sums)
    low, high = np.quantile(first - second, [0.025, 0.975])
    return float(low), float(high)


def _mean_at(
    time_s: Array, heading_rad: Array, reference: HeadingReference
) -> tuple[Array, NDArray[np.bool_]]:
    """Circular mean heading (M,) around each instant, and which of them have samples there."""
    if not len(time_s):
        return np.zeros(len(reference.time_s)), np.zeros(len(reference.time_s), dtype=bool)
    half = max(reference.half_width_s, 0.51 * float(np.median(np.diff(time_s, append=np.inf))))
    sums = np.concatenate([[0.0], np.cumsum(np.exp(1j * heading_rad))])
    if reference.half_width_s == 0.0:  # the nearest sample
        right = np.clip(np.searchsorted(time_s, reference.time_s), 1, max(len(time_s) - 1, 1))
        left = np.clip(right - 1, 0, len(time_s) - 1)
        right = np.clip(right, 0, len(time_s) - 1)
        before, after = reference.time_s - time_s[left], time_s[right] - reference.time_s
        nearest = np.where(before <= after, left, right)
        return heading_rad[nearest], np.abs(time_s[nearest] - reference.time_s) <= half
    first = np.searchsorted(time_s, reference.time_s - half)
    last = np.searchsorted(time_s, reference.time_s + half, side="right")
    usual = np.median(last - first)
    return np.angle(sums[last] - sums[first]), np.asarray(last - first > 0.5 * usual)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
