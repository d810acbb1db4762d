"""A Gaussian process in time, in a frame, as a sum of cosines.

    x(t) = sum_k w_k cos(pi k (t - t0) / T),    var w_k = size^2 c / (1 + (k / corner)^2)

c is such that the variance over the recording is size^2.  With a corner of one half wave the
process is a random walk; with a corner beyond all modes it is white.  The constant is left out, as
the calibration contains it.  Each axis of the frame has a process of its own, all of one size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import (
    Component,
    columns_in_frame,
    log_density,
    normal_curvature,
)
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

#: number of modes (half waves): one in so many seconds, and its lower and upper limit
_MODE_S, _FEWEST_MODES, _MOST_MODES = 5.0, 16, 28
#: the same for a process with short waves
_QUICK_MODE_S, _MOST_QUICK_MODES = 1.5, 80


@dataclass(frozen=True, slots=True, eq=False)
class GaussianProcessLaw:
    """psi: logarithms of the size, in units of `unit`, and of the corner, in half waves.

    order (q,): of each coefficient's mode;  mean, spread: normal prior of the log size; spread 0:
    uniform;  most: largest size, in units;  corners: bounds of the corner
    """

    order: Array
    unit: float
    mean: float = 0.0
    spread: float = 0.0
    most: float = priors.COURSE_SIZES[1]
    corners: tuple[float, float] = priors.COURSE_CORNERS

    @property
    def start(self) -> Array:
        """Start of a search."""
        return np.array([self.mean, np.log(4.0)])

    @property
    def low(self) -> Array:
        """Lower bounds of psi."""
        return np.log([priors.COURSE_SIZES[0], self.corners[0]])

    @property
    def high(self) -> Array:
        """Upper bounds of psi."""
        return np.log([self.most, self.corners[1]])

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""
        return np.array([normal_curvature(self.spread), 0.0])

    def _shape(self, psi: Array) -> tuple[Array, Array]:
        """Log of the unscaled variances (q,), and its slope in the log corner (q,)."""
        squared_ratio = (self.order * np.exp(-psi[1])) ** 2
        return -np.log1p(squared_ratio), 2.0 * squared_ratio / (1.0 + squared_ratio)

    def log_variance(self, psi: Array) -> Array:
        """(q,) log variances."""
        shape, _ = self._shape(psi)
        axes = len(shape) / len(np.unique(self.order))
        log_power = np.log(np.sum(np.exp(shape)) / axes / 2.0)  # a cosine has half of its square
        return np.asarray(2 * np.log(self.unit) + 2 * psi[0] + shape - log_power)

    def slope(self, psi: Array) -> Array:
        """(q, k) derivatives of the log variances with respect to psi."""
        shape, shape_slope = self._shape(psi)
        power_share = np.exp(shape) / np.sum(np.exp(shape))
        return np.column_stack([np.full(len(shape), 2.0), shape_slope - power_share @ shape_slope])

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density and gradient (k,)."""
        low, high = self.low, self.high
        size, slope = log_density(psi[0], self.mean, self.spread, low[0], high[0])
        corner, flat = log_density(psi[1], 0.0, 0.0, low[1], high[1])
        return size + corner, np.concatenate([slope, flat])


def gaussian_process(
    context: Context,
    frame: Frame,
    ordinary: priors.Size | None = None,
    like: Component | None = None,
    quick: str | None = None,
) -> Component:
    """A Gaussian process in one frame, of any size or, where `ordinary` is given, of ordinary size.

    like: a component of the same frame whose columns are shared;  quick: key of a process that has
    short waves as well
    """
    mode_count = np.clip(context.track.duration_s / _MODE_S, _FEWEST_MODES, _MOST_MODES)
    if quick is not None:
        mode_count = np.clip(
            context.track.duration_s / _QUICK_MODE_S, _FEWEST_MODES, _MOST_QUICK_MODES
        )
    order = np.arange(1, int(mode_count) + 1)
    cosines = partial(_cosine_modes, context.track.time_s, order)
    columns = (
        columns_in_frame(context, frame, cosines, len(order)) if like is None else like.columns
    )
    unit = priors.COURSE_UNIT[frame]
    law = GaussianProcessLaw(np.repeat(order, 3).astype(float), unit)
    key = quick or f"free {frame}"
    if ordinary is not None:
        log_median = float(np.log(ordinary.median / unit))
        law = GaussianProcessLaw(law.order, unit, log_median, ordinary.spread, ordinary.most / unit)
        key = f"{frame}_course"
    log_odds = 0.0 if ordinary is not None else float(np.log(priors.COURSE))
    return Component(key, frame, columns, law, log_odds)


def _cosine_modes(time_s: Array, order: NDArray[np.int_]) -> Array:
    """(N, k) half waves over the recording."""
    phase = np.pi * (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    return np.asarray(np.cos(phase[:, None] * order))
