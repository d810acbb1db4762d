"""The recording as the present model sees it: what the effects build their columns from.

Attitude: the gyro's integral U (body to a carried frame, `Filtered.orientation`) drifts.  What is
fixed in the world stands still in the carried frame but for that drift: the field and, on average,
the specific force.  Smoothed there over DRIFT_S both ways, they give the carried frame's attitude:
down from the accelerometer, magnetic north from the field.  Without an accelerometer only the
drift that turns the field is taken out.  A reference attitude (`ref_qw` ... `ref_qz`) is not asked:
the filter turns its field by the gyro, and by another attitude a field that stays in the world
would turn against the filter's own by all of the gyro's noise, which is in the innovations too.

Rates in regressors: the raw rate shares its noise with the innovation (errors in variables), so
everything here is made of rates smoothed without phase.  The bandwidth is the recording's own: up
to where its motion sinks into SINK times the gyro's noise.  Of a motion over minutes, smoothed over
a second, the columns of a lag were the gyro's own noise: a lag of 15 nats in nothing.

Fields in regressors: one that is smoothed both ways has a part of the reading's own noise in it,
more of it the poorer the gyro is.  A soft iron of 1.6 made of that explained a quarter of white
innovations.  What is foretold from the readings before has none.

Changes of the field in regressors (a lag's, a low-pass's) are of a field that is smooth in the
frame that the smoothed rates carry along, over as much time as these.  In the frame of a loud gyro
the changes were its noise or the readings' own: a low-pass of 1800 nats in nothing.

The specific force is without the accelerometer's noise.  What bends with a force, or errs with it,
follows the force and not the noise of the sensor that measured it.  A regressor with noise in it is
told too small, by the noise's share of its power (errors in variables): a mount that bends by 22
mrad/g was 12, and the rest had other names.  What the force is expected to be, given the readings,
is Wiener's filter of them.  What shakes all frequencies alike counts as noise: nothing that follows
it can be seen in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ahrsd.diagnosis.innovation_filter.innovation import (
    Bearings,
    Filtered,
    carried_along,
    foretold,
)
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.time_series import SPECTRUM_ROWS, both_ways, denoised, gaussian
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

DRIFT_S = 20.0
SINK = 4.0
_NARROWEST = 0.3  # samples: what is narrower changes nothing
#: samples of the width from which a row's neighbours say its rate well (its own part is a quarter)
_OTHERS_FROM = 2.0
_REACH = 8.0  # widths to either side, beyond which two such Gaussians have nothing
#: chance with which noise alone may stand above the floor at one frequency
BY_CHANCE = 1e-5
_SLOWEST_HZ = 0.5  # by segments of four seconds, no motion is told to be slower
#: bins that a slow motion reaches by the window; longer segments, as long as there are so many
_WINDOW_BINS, _LONGER, _FEWEST = 2, 4, 8


class Fit(Protocol):
    """What a context is made of."""

    @property
    def filtered(self) -> Filtered | Bearings:
        """The filter's last pass, or what it would say of the motion."""

    @property
    def terms_gyro(self) -> Array | None:
        """(N, 3) contributions of the named terms to the gyro, or None."""


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """What a context is made of where nothing was fitted."""

    filtered: Bearings
    terms_gyro: Array | None = None


def build_context(track: Track, fit: Fit) -> Context:
    """The context of a fit; rows as in the track."""
    done = fit.filtered
    rate = track.gyro_b_rad_s - done.model.gyro_bias_rad_s
    if fit.terms_gyro is not None:
        rate = rate - fit.terms_gyro
    runs = track.runs or (slice(0, len(track)),)
    smooth = smoothed_rate(rate, runs, track.step_s, done.model.sigma_gyro_rad_s)
    R_nb, levelled = attitude(track, done)
    width = _width(rate, runs, track.step_s, done.model.sigma_gyro_rad_s)
    smooth_b = smoothed_field(track, done.nominal_b, smooth, width)
    return Context(
        track=track,
        model=done.model,
        field_b=_foretold(done, smooth),
        smooth_b=smooth_b,
        rate_b_rad_s=smooth,
        others_rate_b_rad_s=rate_by_others(rate, smooth, width),
        field_dot_b=np.cross(smooth_b, _at_the_sample(smooth, runs)),
        R_nb=R_nb,
        world_levelled=levelled,
        force_b_m_s2=_force(track),
    )


def _foretold(done: Filtered | Bearings, rate_b_rad_s: Array) -> Array:
    """(N, 3) the field as foretold; where no reading was held against it, the smooth one."""
    if isinstance(done, Bearings):
        return done.nominal_b
    return np.where(done.used[:, None], foretold(done, rate_b_rad_s), done.nominal_b)


@lru_cache(maxsize=2)
def _force(track: Track) -> Array | None:
    """(N, 3) specific force without the accelerometer's noise, the same for every fit."""
    runs = track.runs or (slice(0, len(track)),)
    return None if track.accel_b_m_s2 is None else force_without_noise(track.accel_b_m_s2, runs)


def smoothed_rate(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> Array:
    """(N, 3) low-passed without phase, at the bandwidth of the recording's own motion.

    An axis whose rate is the same all along but for the gyro's noise keeps its mean: columns made
    of the noise would be held against what that very noise did to the field.
    """
    width = _width(rate, runs, dt_s, sigma)
    out = rate.copy()
    if width >= _NARROWEST:
        for run in runs:
            out[run] = _low_passed(rate[run], width)
    still = ~_changes(rate, runs, dt_s, sigma)
    out[:, still] = rate[:, still].mean(axis=0)
    return out


def smoothed_field(track: Track, field_b: Array, smooth_rad_s: Array, width: float) -> Array:
    """(N, 3) a field low-passed in the frame that smoothed rates (N, 3) carry along."""
    if width < _NARROWEST:
        return field_b
    U = carried_along(track, smooth_rad_s)
    carried = np.einsum("nij,nj->ni", U, field_b)
    for run in track.runs or (slice(0, len(track)),):
        carried[run] = _low_passed(carried[run], width)
    return np.asarray(np.einsum("nji,nj->ni", U, carried))


def _width(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> float:
    """Samples of the Gaussian that passes the recording's own motion."""
    return float(1.0 / (2 * np.pi * bandwidth_hz(rate, runs, dt_s, sigma) * dt_s))


def _changes(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> NDArray[np.bool]:
    """(3,) whether an axis' rate changes: within segments of four seconds, or from one to another.

    Within: `bandwidth_hz` would find a frequency in it.  From one to another: their means scatter.
    """
    longest = max(runs, key=lambda run: int(run.stop - run.start))
    values = rate[longest]
    segment = _segment(len(values), dt_s)
    if len(values) < 2 * segment:
        return np.ones(3, dtype=np.bool)
    within = (_density(values, segment) * dt_s > _floor(sigma, dt_s))[:, 1:].any(axis=1)
    count = len(values) // segment
    means = values[: count * segment].reshape(count, segment, 3).mean(axis=1)
    return np.asarray(within | (means.var(axis=0, ddof=1) > SINK * sigma**2 / segment))


def _low_passed(values: Array, width: float) -> Array:
    """Gaussian of `width` samples, corrected for the curvature that it takes away.

    2 G - G G keeps what is slow to fourth order, which a plain Gaussian G does not.
    """
    if len(values) < 3:
        return values.copy()
    centre = values.mean(axis=0)
    once = gaussian(values - centre, width)
    twice = gaussian(once, width)
    return np.asarray(2 * once - twice + centre)


def rate_by_others(rate: Array, smooth: Array, width: float) -> Array:
    """(N, 3) smoothed rates without what each row adds to itself.

    For columns that are the rate, row by row: one that has its row's own noise in it, held against
    what that very noise did to the field, is a scale that is not there (a regression on a noisy
    regressor; a hundredth and more where the gyro is by far the louder sensor).  Its differences
    are noise, so what is made of differences takes the smooth one.
    """
    if width < _OTHERS_FROM:
        return smooth
    impulse = np.zeros((2 * int(_REACH * width) + 3, 1))
    middle = len(impulse) // 2
    impulse[middle] = 1.0
    once = gaussian(impulse, width)
    own = float((2 * once - gaussian(once, width))[middle, 0])
    others = (smooth - own * rate) / (1.0 - own)
    # an axis that keeps its mean has no part of a row in it
    return np.where(np.ptp(smooth, axis=0) > 0.0, others, smooth)


def bandwidth_hz(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> float:
    """Highest frequency at which the motion stands above SINK times the gyro's noise.

    Of all runs that are as long as the segments of the longest: where samples were lost a hundred
    times no run is long, and the spectrum of one alone scatters beyond any floor.
    """
    rows = max(int(run.stop - run.start) for run in runs)
    nyquist = 0.5 / dt_s
    if rows < 64:
        return nyquist
    segment, slowest_hz = _segment(rows, dt_s), _SLOWEST_HZ
    top_hz = _top_hz(rate, runs, dt_s, sigma, segment)
    # what ends in the window's own width is slower than these segments tell
    while top_hz <= _WINDOW_BINS / (segment * dt_s) and _FEWEST * _LONGER * segment <= rows:
        segment, slowest_hz = _LONGER * segment, slowest_hz / _LONGER
        top_hz = _top_hz(rate, runs, dt_s, sigma, segment)
    # the Gaussian pair is 3 dB down at about 1.3 times its nominal corner
    return float(np.clip(2.0 * top_hz, slowest_hz, nyquist))


def _top_hz(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float, segment: int) -> float:
    """Highest frequency above the floor, by segments of so many rows; 0 where none is."""
    long = [rate[run] for run in runs if run.stop - run.start >= segment]
    count = np.array([len(part) // segment for part in long])  # of segments, overlaps apart
    densities = np.array([_density(part, segment) for part in long])
    density = np.average(densities, axis=0, weights=count).max(axis=0) * dt_s
    by_chance = float(chdtri(2.0 * count.sum(), BY_CHANCE)) / (2 * count.sum())  # of its mean
    above = np.flatnonzero(density > max(1.0, by_chance / SINK) * _floor(sigma, dt_s))
    return float(above[-1]) / (segment * dt_s) if len(above) else 0.0


def _segment(count: int, dt_s: float) -> int:
    """Rows of some four seconds."""
    return int(min(count, max(64, 2 ** round(np.log2(4.0 / dt_s)))))


def _floor(sigma: float, dt_s: float) -> float:
    """One-sided power density above which a rate is motion, (rad/s)^2/Hz."""
    return SINK * 2 * sigma**2 * dt_s


def _density(values: Array, segment: int) -> Array:
    """(k, segment / 2 + 1) Welch's one-sided power density of (N, k), per sample."""
    cut = np.lib.stride_tricks.sliding_window_view(values, segment, axis=0)[
        :: segment - segment // 2
    ]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(segment) / segment)
    centred = cut - cut.mean(axis=2, keepdims=True)
    power = np.mean(np.abs(np.fft.rfft(centred * window, axis=2)) ** 2, axis=0)
    power[:, 1 : (segment + 1) // 2] *= 2.0
    return np.asarray(power / np.sum(window**2))


def attitude(track: Track, done: Filtered | Bearings) -> tuple[Array, bool]:
    """R_nb (N, 3, 3) and whether its z axis is down."""
    accel = track.accel_b_m_s2
    if accel is not None and not np.isfinite(accel).all():
        accel = None
    U = done.orientation
    runs = track.runs or (slice(0, len(track)),)
    width = DRIFT_S / track.step_s
    field = _carried(U, done.nominal_b, runs, width)
    if accel is None:
        return np.asarray(held_by_field(field, runs) @ U), False
    down = _unit(_carried(U, -accel, runs, width))
    east = _unit(np.cross(down, field))
    return np.stack([np.cross(east, down), east, down], axis=1) @ U, True


def _carried(U: Array, vectors: Array, runs: Sequence[slice], width: float) -> Array:
    """Vectors in the carried frame, smoothed by exp(-|k| / width) within each run."""
    moved = np.einsum("nij,nj->ni", U, vectors)
    keep = np.exp(-1.0 / width)
    out = np.empty_like(moved)
    for run in runs:
        out[run] = both_ways(moved[run], keep)
    return np.asarray(out)


def held_by_field(field: Array, runs: Sequence[slice]) -> Array:
    """Smallest rotations (N, 3, 3) that bring the carried field to where it was at first."""
    unit = _unit(field)
    out = np.empty((len(field), 3, 3))
    for run in runs:
        first = unit[run][0]
        axis = np.cross(unit[run], first)
        cosine = unit[run] @ first
        K = np.zeros((len(axis), 3, 3))
        K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
        K -= np.swapaxes(K, 1, 2)
        factor = 1.0 / np.maximum(1.0 + cosine, 1e-6)
        out[run] = np.eye(3) + K + K @ K * factor[:, None, None]
    return out


def _at_the_sample(rate: Array, runs: Sequence[slice]) -> Array:
    """Rate at the samples' instants, of the means over the steps that end at them."""
    out = rate.copy()
    for run in runs:
        rows = rate[run]
        out[run][:-1] = (rows[:-1] + rows[1:]) / 2
        out[run][0] = rows[min(1, len(rows) - 1)]
    return out


def _unit(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-300))


def force_without_noise(accel_b_m_s2: Array, runs: Sequence[slice]) -> Array:
    """(N, 3) specific force as it is expected to be, given the readings (N, 3), run by run."""
    out = accel_b_m_s2.copy()
    for run in runs:
        if run.stop - run.start >= SPECTRUM_ROWS and np.isfinite(out[run]).all():
            out[run] = denoised(accel_b_m_s2[run])
    return out
