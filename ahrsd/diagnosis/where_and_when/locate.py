"""Piecewise constant fields and rates in three frames, segment by segment: no effect is assumed.

    sensor   a field fixed to the vehicle                D = e_i 1[segment]
    world    a field fixed in the world                  D = A R_nb^T e_i 1[segment]
    gyro     an error of the rate                        W = e_i 1[segment]

A singular value decomposition of a frame's segments x axes says whether a single source of
constant direction is enough, and gives the time series of that source, to be compared with logged
columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

Frame = Literal["sensor", "world", "gyro"]
FRAMES: tuple[Frame, ...] = ("sensor", "world", "gyro")

SEGMENT_S = 20.0
SEGMENTS = (6, 24)
#: one in so many of a recording's segments is its beginning
FIRST_SHARE = 12


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """A recording cut into J segments.  edges_s: (J + 1,);  index: (N,) the segment of a sample."""

    edges_s: Array
    index: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.edges_s) - 1

    @property
    def length_s(self) -> float:
        """Mean length of a segment."""
        return float(self.edges_s[-1] - self.edges_s[0]) / max(len(self), 1)

    @property
    def middle_s(self) -> Array:
        """(J,) middle times."""
        return np.asarray((self.edges_s[1:] + self.edges_s[:-1]) / 2)


def equal_segments(time_s: Array, count: int) -> Segments:
    """`count` segments of equal length."""
    return segments_between(time_s, np.linspace(time_s[0], time_s[-1], count + 1))


def coarse_segments(track: Track) -> Segments:
    """Segments of about 20 s, shorter on short and longer on long recordings."""
    count = int(np.clip(round(track.duration_s / SEGMENT_S), *SEGMENTS))
    return equal_segments(track.time_s, count)


def segments_between(time_s: Array, edges_s: Array) -> Segments:
    """Segments between the given edges; samples outside belong to none (index -1)."""
    index = np.searchsorted(edges_s, time_s, side="right") - 1
    index[time_s == edges_s[-1]] = len(edges_s) - 2
    index[index >= len(edges_s) - 1] = -1
    return Segments(np.asarray(edges_s, float), index)


def unit_columns(context: Context, frame: Frame) -> Array:
    """(N, 3, 3) what a source of one unit along each axis of the frame adds, gauss or rad/s."""
    if frame == "world":
        return np.asarray(context.model.soft_iron @ np.swapaxes(context.R_nb, 1, 2))
    return np.broadcast_to(np.eye(3), (len(context.track), 3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Result of the segments of one frame.

    evidence: log Bayes factor, nats
    course:   (J, 3) posterior mean of the coefficients, gauss or rad/s, of zero weighted mean
    deviation: (J,) standard deviation of a coefficient
    direction: (3,) unit vector of the strongest single source
    """

    frame: Frame
    evidence: float
    cut: Segments
    course: Array
    deviation: Array
    direction: Array

    @property
    def source(self) -> Array:
        """(J,) time series of the single source."""
        return np.asarray(self.course @ self.direction)


def single_source_direction(series: Array, deviation: Array) -> tuple[Array, float]:
    """Unit vector (3,) along which a series (J, 3) varies most, and its share of the variance.

    Its sign is such that the series rises from its beginning: a device that runs later is seldom
    on at the start.
    """
    weight = 1.0 / np.maximum(deviation, 1e-12)
    centred = (series - np.average(series, axis=0, weights=weight**2)) * weight[:, None]
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    power = sizes**2
    along = series @ axes[0]
    first = max(1, len(along) // FIRST_SHARE)
    later = np.average(along, weights=weight**2) - np.average(
        along[:first], weights=weight[:first] ** 2
    )
    direction = axes[0] * np.copysign(1.0, later)
    return np.asarray(direction), float(power[0] / max(power.sum(), 1e-300))


def segment_means(covariate: Array, cut: Segments) -> Array:
    """(J,) mean of a logged column over each segment; nan where it has no value."""
    out = np.full(len(cut), np.nan)
    for j in range(len(cut)):
        values = covariate[cut.index == j]
        if np.isfinite(values).any():
            out[j] = float(np.nanmean(values))
    return out


@dataclass(frozen=True, slots=True)
class Match:
    """A logged channel that correlates with a source: correlation, and its p-value."""

    channel: str
    correlation: float
    p_value: float


def matching_channels(track: Track, located: Located) -> tuple[Match, ...]:
    """Logged channels by their correlation with the single source, largest first.

    The p-value is the share of circular shifts of the channel that correlate at least as well.
    """
    found = []
    for channel, values in track.covariates.items():
        logged = segment_means(values, located.cut)
        known = np.isfinite(logged)
        if known.sum() < 6 or np.ptp(logged[known]) == 0:
            continue
        weight = known / np.maximum(located.deviation, 1e-12) ** 2
        filled = np.where(known, logged, 0.0)
        size = [
            abs(_correlation(np.roll(filled, k), located.source, weight))
            for k in range(len(filled))
        ]
        p_value = float(np.mean(np.asarray(size) >= size[0]))
        found.append(Match(channel, _correlation(filled, located.source, weight), p_value))
    return tuple(sorted(found, key=lambda match: -abs(match.correlation)))


def _correlation(a: Array, b: Array, weight: Array) -> float:
    a = a - np.average(a, weights=weight)
    b = b - np.average(b, weights=weight)
    power = np.sum(weight * a * a) * np.sum(weight * b * b)
    return float(np.sum(weight * a * b) / np.sqrt(power)) if power > 0 else 0.0
