"""Bursts that have no mean: what rings for a second or two, again and again.

A crane's chain or a shaken bracket swings to and fro, and a mean over a second (`bursts`) is next
to nothing.  So the mean squares of four half seconds in a row are held against what is usual in
this recording, which slow noise has in every such window, and against the scatter within the half
seconds, which noise that is louder for a while has as much more of.  Looked for only where nothing
else is left: a course that changes, a jump that is a little off, a turn that was lost have such
windows too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ahrsd.diagnosis.answer.diagnosis import Unexplained
from ahrsd.diagnosis.data_quality.facts import spans_of
from ahrsd.diagnosis.innovation_filter.noise import louder
from ahrsd.diagnosis.rules.bursts import FEWEST, MOST_SHARE, moving_sum, told
from ahrsd.diagnosis.rules.regression import Base, residual
from ahrsd.diagnosis.where_and_when.locate import FRAMES
from ahrsd.samples import Array

_PART_S, _PARTS = 0.5, 4
#: probabilities of a window by chance, and of one as loud by noise alone
_LOUD = (1e-9, 1e-5)
_ALONG = 1e-6
_BESIDE = (1e-5, 1e-2)  # of further ones beside these
_SEPARATE_S = 1.0
#: stretches with a vector each that tell the frame: a gyro's error is a field's slope
_PIECE_S = 0.2
_PIECES = 100  # at most so many, spread over all: each has columns of its own


def ringing(basis: Base) -> Unexplained | None:
    """What the names leave, if it rings now and then; None where it does not do so twice."""
    left = residual(basis.known, basis.innovation)
    gap = round(_SEPARATE_S * basis.rate_hz)
    if len(spans_of(ringing_rows(left, basis.rate_hz), gap)) < FEWEST:
        return None
    rows = ringing_rows(left, basis.rate_hz, _BESIDE)
    if np.mean(rows) > MOST_SHARE or louder(basis.filtered) is not None:
        return None
    spans, piece = spans_of(rows, gap), _rows(_PIECE_S, basis.rate_hz)
    pieces = [(k, k + piece) for first, end in spans for k in range(first, end - piece + 1, piece)]
    pieces = pieces[:: 1 + len(pieces) // _PIECES]
    frames = FRAMES[:2] if _along_the_field(basis, left, rows) else FRAMES
    found = told(basis, spans, pieces, frames)
    windows = len(left) / _rows(_PART_S, basis.rate_hz)
    by_chance = -float(np.log(windows * _LOUD[0]))
    return replace(found, evidence_nats=max(found.evidence_nats, by_chance))


def _along_the_field(basis: Base, left: Array, rows: NDArray[np.bool]) -> bool:
    """Whether it rings along the field, too, whose size no error of the gyro changes."""
    unit = basis.context.field_b @ basis.context.model.soft_iron
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    part = _rows(_PART_S, basis.rate_hz)
    power = moving_sum(np.sum(left * unit, axis=1)[:, None], part)[:, 0] ** 2
    inside = moving_sum(rows[:, None].astype(float), part)[:, 0] > part - 0.5
    usual = float(np.median(power)) / float(special.chdtri(1, 0.5))
    size, count = float(np.sum(power[inside])) / part, int(np.count_nonzero(inside)) / part
    return bool(special.chdtrc(count, size / max(usual, 1e-300)) < _ALONG)


def ringing_rows(
    left: Array, rate_hz: float, most: tuple[float, float] = _LOUD
) -> NDArray[np.bool]:
    """(N,) rows of windows in which (N, 3) is loud and slower than noise is.

    most: probabilities of a window, of its size and of its size over its own scatter
    """
    part = _rows(_PART_S, rate_hz)
    width, rows = _PARTS * part, np.zeros(len(left), dtype=bool)
    count = len(left) - width + 1
    if len(left) < 4 * width:
        return rows
    halves = np.sum(moving_sum(left, part) ** 2, axis=1) / part
    between = np.sum([halves[k * part : k * part + count] for k in range(_PARTS)], axis=0)
    freedom, other = 3 * _PARTS, 3 * (width - _PARTS)
    within = (np.sum(moving_sum(left**2, width), axis=1) - between) / other
    usual = float(np.median(between)) / float(special.chdtri(freedom, 0.5))
    quiet = float(np.median(within))
    if usual <= 0.0 or quiet <= 0.0:
        return rows
    size = between / usual
    ratio = size / freedom * quiet / np.maximum(within, 1e-12 * quiet)
    found = special.chdtrc(freedom, size) < most[0]
    found &= special.fdtrc(freedom, other, ratio) < most[1]
    for first in np.flatnonzero(found):
        rows[first : first + width] = True
    return rows


def _rows(length_s: float, rate_hz: float) -> int:
    return max(2, round(length_s * rate_hz))
