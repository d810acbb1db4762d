"""Bursts of a second or so that come and go: too short for the segments of the agnostic frames.

The mean of what is left over a second is held against its own scatter there, so that noise that is
louder for a while is no burst.  Where a burst begins and ends is where a box or half a wave
explains most of it.  Two bursts at least: beside a step whose time is a little off there
is one.  Their frame is the one in which a constant per burst explains most.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ahrsd.diagnosis.answer.diagnosis import Unexplained, Where
from ahrsd.diagnosis.data_quality.facts import spans_of
from ahrsd.diagnosis.rules import locate
from ahrsd.diagnosis.rules.regression import Base, group_gram, residual
from ahrsd.diagnosis.where_and_when.locate import FRAMES, Frame, Located, Segments, frame_columns
from ahrsd.samples import Array

_WINDOW_S = 1.0
_WIDTHS_S = (0.5, 1.0, 2.0)  # in which further ones are sought
_LOUD = 44.0  # chi-squared of three: 1 in 1e9 windows by chance
_BESIDE = 25.0  # of further ones beside these: 1 in 60000 windows by chance, of any width
FEWEST = 2
_TIE_NATS = 3.0  # frames that no turn tells apart: most of what comes and goes is on the vehicle
MOST_SHARE = 0.3  # of the recording; beyond, it is no burst
_LEAST_ROWS = 3
_LONG = 10  # windows; what lasts longer has no shape of its own
_AXES = ("x", "y", "z")


def bursts(basis: Base) -> Unexplained | None:
    """What the names leave, if it is bursts; None where there are fewer than two."""
    left = residual(basis.known, basis.innovation)
    rows = loud_rows(left, basis.rate_hz, basis.colour)
    gap = round(_WINDOW_S * basis.rate_hz)
    spans = spans_of(rows, gap)
    if len(spans) < FEWEST or np.mean(rows) > MOST_SHARE:
        return None
    near = [loud_rows(left, basis.rate_hz, basis.colour, _BESIDE, width) for width in _WIDTHS_S]
    spans = spans_of(np.any(near, axis=0), gap)
    spans = [closest(left, a, b) if b - a < _LONG * gap else (a, b) for a, b in spans]
    return told(basis, spans, spans)


def told(
    basis: Base,
    spans: list[tuple[int, int]],
    pieces: list[tuple[int, int]],
    frames: Sequence[Frame] = FRAMES,
) -> Unexplained:
    """Bursts over these rows in the frame in which a constant per piece explains most."""
    time_s = basis.context.track.time_s
    cut = _cut(time_s, pieces)
    columns = {
        locate.group_name(frame): frame_columns(basis.context, frame, cut) for frame in frames
    }
    gram = group_gram(basis, columns)
    best = max(
        (locate.locate(gram, frame, cut, basis.colour) for frame in frames),
        key=lambda one: one.evidence + (_TIE_NATS if one.frame == "sensor" else 0.0),
    )
    return _described(best, [(float(time_s[a]), float(time_s[b - 1])) for a, b in spans])


def loud_rows(
    left: Array, rate_hz: float, colour: float, least: float = _LOUD, window_s: float = _WINDOW_S
) -> NDArray[np.bool]:
    """(N,) rows of windows in which the mean of (N, 3) is away from zero, by default beyond doubt.

    least: statistic of a window, chi-squared of three
    """
    width = max(4, round(window_s * rate_hz))
    if len(left) < 4 * width:
        return np.zeros(len(left), dtype=bool)
    sums = moving_sum(left, width)
    scatter = np.sum(moving_sum(left**2, width) - sums**2 / width, axis=1) / (3 * (width - 1))
    statistic = np.sum(sums**2, axis=1) / width / np.maximum(scatter, colour)
    rows = np.zeros(len(left), dtype=bool)
    for first in np.flatnonzero(statistic > least):
        rows[first : first + width] = True
    return rows


def closest(left: Array, start: int, end: int) -> tuple[int, int]:
    """Rows between `start` and `end` that a box or half a wave covers when it explains most.

    left (N, 3); never fewer than `_LEAST_ROWS`.
    """
    best, found = 0.0, (start, end)
    for width in range(_LEAST_ROWS, end - start + 1):
        windows = sliding_window_view(left[start:end], width, axis=0)
        wave = np.sin(np.pi * (np.arange(width) + 0.5) / width)
        for shape in (np.ones(width), wave):
            explained = np.sum((windows @ shape) ** 2, axis=1) / np.sum(shape**2)
            first = int(np.argmax(explained))
            if explained[first] > best:
                best, found = float(explained[first]), (start + first, start + first + width)
    return found


def moving_sum(values: Array, width: int) -> Array:
    """(N - width + 1, k) of (N, k)."""
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    return np.asarray(total[width:] - total[:-width])


def _cut(time_s: Array, spans: list[tuple[int, int]]) -> Segments:
    """A segment per burst, and between them segments that no row belongs to."""
    edges = [edge for a, b in spans for edge in (time_s[a], time_s[b - 1])]
    index = np.full(len(time_s), -1, dtype=np.intp)
    for number, (a, b) in enumerate(spans):
        index[a:b] = 2 * number
    return Segments(np.asarray(edges, float), index)


def _described(best: Located, spans: list[tuple[float, float]]) -> Unexplained:
    spread = np.sqrt(np.mean(best.course[::2] ** 2, axis=0))
    x, y, z = (float(part) for part in best.direction)
    return Unexplained(
        detected=True,
        where=Where(
            tuple(spans),
            tuple(_AXES[k] for k in range(3) if spread[k] > 0.3 * spread.max()),
            best.frame,
            f"{len(spans)} bursts",
            None,
            (x, y, z),
        ),
        size=float(np.max(np.abs(best.course))),
        unit="rad/s" if best.frame == "gyro" else "gauss",
        single_source_share=best.single_share,
        evidence_nats=best.evidence,
    )
