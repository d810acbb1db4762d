"""The recording under the present model: the motion and fields of which effects make columns.

Attitude: the integrated gyro U (body to carried frame, `Filtered.orientation`) drifts.  Without
drift, vectors that are fixed in the world would be constant in the carried frame: the field and, on
average, the specific force.  Smoothed there over DRIFT_S forwards and backwards, they give the
attitude of the carried frame: down from the accelerometer, magnetic north from the field.  Without
an accelerometer only the drift that turns the field is removed.  A reference attitude (`ref_qw`
... `ref_qz`) is not used: the filter turns its field by the gyro, and with another attitude a
field that is fixed in the world would turn against the filter's own by all of the gyro's noise,
which the innovations contain too.

Rates in regressors: the raw rate shares its noise with the innovation (errors in variables), so
all columns are made of rates smoothed with zero phase.  The bandwidth is that of the recording: up
to the frequency where its motion falls below SINK times the gyro's noise.  With a fixed smoothing
of one second and a motion over minutes, the columns of a lag were gyro noise, and a spurious lag
gained 15 nats.

Fields in regressors: a field smoothed forwards and backwards contains part of the row's own
reading noise, and more of it the poorer the gyro is.  A soft iron of 1.6 made of it explained a
quarter of white innovations.  A prediction from earlier readings contains none.

Changes of the field in regressors (of a lag, of a low-pass) are those of a field that is smooth,
in the frame carried by the smoothed rates, over the same time as these rates.  In the frame of a
noisy gyro the changes were its noise or that of the readings, and a spurious low-pass gained 1800
nats.

The specific force is used without the accelerometer's noise.  A mount that bends with a force, or
an error that follows it, follows the force and not the noise of the sensor that measured it.
A noisy regressor has its coefficient underestimated by the noise's share of its power (errors in
variables): a mount that bends by 22 mrad/g was estimated at 12, and other effects took the
remainder.  The expected force given the readings is their Wiener filter.  Shaking with a flat
spectrum counts as noise, so no effect that follows it can be seen.
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
    Filtered,
    NominalMotion,
    carried_orientation,
    predicted_field,
)
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.time_series import (
    SPECTRUM_ROWS,
    gaussian_smooth,
    two_sided_sums,
    wiener_filter,
)
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

DRIFT_S = 20.0
SINK = 4.0
_NARROWEST = 0.3  # samples: a narrower Gaussian changes nothing
#: width in samples from which the neighbours of a row determine its rate (its own share: a quarter)
_OWN_ROW_WIDTH = 2.0
_REACH = 8.0  # widths to either side, beyond which two such Gaussians are zero
#: probability that noise alone exceeds the floor at one frequency
FALSE_ALARM = 1e-5
_SLOWEST_HZ = 0.5  # the lowest bandwidth that segments of four seconds can show
#: bins over which the window spreads a slow motion; factor of longer segments; fewest of them
_WINDOW_BINS, _LONGER, _FEWEST_SEGMENTS = 2, 4, 8


class Fit(Protocol):
    """What `build_context` needs of a fit."""

    @property
    def filtered(self) -> Filtered | NominalMotion:
        """The last filter run, or the nominal motion."""

    @property
    def terms_gyro(self) -> Array | None:
        """(N, 3) contributions of the effects to the gyro, or None."""


@dataclass(frozen=True, slots=True, eq=False)
class UnfittedMotion:
    """What `build_context` needs, where nothing was fitted."""

    filtered: NominalMotion
    terms_gyro: Array | None = None


def build_context(track: Track, fit: Fit) -> Context:
    """The context of a fit; rows as in the track."""
    filtered = fit.filtered
    rate = track.gyro_b_rad_s - filtered.model.gyro_bias_rad_s
    if fit.terms_gyro is not None:
        rate = rate - fit.terms_gyro
    runs = track.runs or (slice(0, len(track)),)
    smooth = smoothed_rate(rate, runs, track.step_s, filtered.model.sigma_gyro_rad_s)
    R_nb, levelled = attitude(track, filtered)
    width = _smoothing_width(rate, runs, track.step_s, filtered.model.sigma_gyro_rad_s)
    smooth_b = smoothed_field(track, filtered.nominal_b, smooth, width)
    return Context(
        track=track,
        model=filtered.model,
        field_b=_predicted_or_nominal_field(filtered, smooth),
        smooth_b=smooth_b,
        rate_b_rad_s=smooth,
        others_rate_b_rad_s=rate_without_own_row(rate, smooth, width),
        field_dot_b=np.cross(smooth_b, _rate_at_samples(smooth, runs)),
        R_nb=R_nb,
        world_levelled=levelled,
        force_b_m_s2=_denoised_force_of(track),
    )


def _predicted_or_nominal_field(filtered: Filtered | NominalMotion, rate_b_rad_s: Array) -> Array:
    """(N, 3) the predicted field; the nominal one where no reading was used."""
    if isinstance(filtered, NominalMotion):
        return filtered.nominal_b
    return np.where(
        filtered.used[:, None], predicted_field(filtered, rate_b_rad_s), filtered.nominal_b
    )


@lru_cache(maxsize=2)
def _denoised_force_of(track: Track) -> Array | None:
    """(N, 3) specific force without the accelerometer's noise; cached, as it suits every fit."""
    runs = track.runs or (slice(0, len(track)),)
    return None if track.accel_b_m_s2 is None else denoised_force(track.accel_b_m_s2, runs)


def smoothed_rate(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> Array:
    """(N, 3) low-passed with zero phase, at the bandwidth of the recording's own motion.

    An axis whose rate is constant but for the gyro's noise gets its mean: columns made of that
    noise would be correlated with the effect of the same noise on the field.
    """
    width = _smoothing_width(rate, runs, dt_s, sigma)
    out = rate.copy()
    if width >= _NARROWEST:
        for run in runs:
            out[run] = _low_pass(rate[run], width)
    still = ~_changing_axes(rate, runs, dt_s, sigma)
    out[:, still] = rate[:, still].mean(axis=0)
    return out


def smoothed_field(track: Track, field_b: Array, smooth_rad_s: Array, width: float) -> Array:
    """(N, 3) a field low-passed in the frame that smoothed rates (N, 3) carry along."""
    if width < _NARROWEST:
        return field_b
    U = carried_orientation(track, smooth_rad_s)
    carried = np.einsum("nij,nj->ni", U, field_b)
    for run in track.runs or (slice(0, len(track)),):
        carried[run] = _low_pass(carried[run], width)
    return np.asarray(np.einsum("nji,nj->ni", U, carried))


def _smoothing_width(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> float:
    """Width in samples of the Gaussian that passes the recording's own motion."""
    return float(1.0 / (2 * np.pi * bandwidth_hz(rate, runs, dt_s, sigma) * dt_s))


def _changing_axes(
    rate: Array, runs: Sequence[slice], dt_s: float, sigma: float
) -> NDArray[np.bool]:
    """(3,) whether the rate of an axis changes, within segments of four seconds or between them.

    Within: `bandwidth_hz` would find a frequency in it.  Between: the segments' means scatter.
    """
    longest = max(runs, key=lambda run: int(run.stop - run.start))
    values = rate[longest]
    segment = _segment_rows(len(values), dt_s)
    if len(values) < 2 * segment:
        return np.ones(3, dtype=np.bool)
    within = (_power_density(values, segment) * dt_s > _motion_floor(sigma, dt_s))[:, 1:].any(
        axis=1
    )
    count = len(values) // segment
    means = values[: count * segment].reshape(count, segment, 3).mean(axis=1)
    return np.asarray(within | (means.var(axis=0, ddof=1) > SINK * sigma**2 / segment))


def _low_pass(values: Array, width: float) -> Array:
    """Gaussian of `width` samples, corrected for the curvature that it takes away.

    2 G - G G keeps slow signals to fourth order, which a plain Gaussian G does not.
    """
    if len(values) < 3:
        return values.copy()
    centre = values.mean(axis=0)
    once = gaussian_smooth(values - centre, width)
    twice = gaussian_smooth(once, width)
    return np.asarray(2 * once - twice + centre)


def rate_without_own_row(rate: Array, smooth: Array, width: float) -> Array:
    """(N, 3) smoothed rates without the contribution of each row to itself.

    For columns that are the rate itself, row by row.  If such a column contains the noise of its
    own row, it correlates with the effect of that noise on the field, and the fit finds a scale
    error that is not there (errors in variables; a hundredth and more where the gyro is by far the
    noisier sensor).  The differences of this rate are noise, so columns made of differences take
    the smooth rate.
    """
    if width < _OWN_ROW_WIDTH:
        return smooth
    impulse = np.zeros((2 * int(_REACH * width) + 3, 1))
    middle = len(impulse) // 2
    impulse[middle] = 1.0
    once = gaussian_smooth(impulse, width)
    own = float((2 * once - gaussian_smooth(once, width))[middle, 0])
    others = (smooth - own * rate) / (1.0 - own)
    # an axis that is its mean contains nothing of a single row
    return np.where(np.ptp(smooth, axis=0) > 0.0, others, smooth)


def bandwidth_hz(rate: Array, runs: Sequence[slice], dt_s: float, sigma: float) -> float:
    """Highest frequency at which the motion's power exceeds SINK times the gyro's noise.

    All runs of at least one segment are averaged, the segment's length being that of the longest
    run: where samples were lost a hundred times no run is long, and the spectrum of one alone
    scatters beyond any floor.
    """
    rows = max(int(run.stop - run.start) for run in runs)
    nyquist = 0.5 / dt_s
    if rows < 64:
        return nyquist
    segment, slowest_hz = _segment_rows(rows, dt_s), _SLOWEST_HZ
    top_hz = _highest_motion_hz(rate, runs, dt_s, sigma, segment)
    # a motion no wider than the window needs longer segments
    while (
        top_hz <= _WINDOW_BINS / (segment * dt_s) and _FEWEST_SEGMENTS * _LONGER * segment <= rows
    ):
        segment, slowest_hz = _LONGER * segment, slowest_hz / _LONGER
        top_hz = _highest_motion_hz(rate, runs, dt_s, sigma, segment)
    # the Gaussian pair is 3 dB down at about 1.3 times its nominal corner
    return float(np.clip(2.0 * top_hz, slowest_hz, nyquist))


def _highest_motion_hz(
    rate: Array, runs: Sequence[slice], dt_s: float, sigma: float, segment: int
) -> float:
    """Highest frequency above the floor, from segments of so many rows; 0 if there is none."""
    long = [rate[run] for run in runs if run.stop - run.start >= segment]
    count = np.array([len(part) // segment for part in long])  # of segments without overlap
    densities = np.array([_power_density(part, segment) for part in long])
    density = np.average(densities, axis=0, weights=count).max(axis=0) * dt_s
    by_chance = float(chdtri(2.0 * count.sum(), FALSE_ALARM)) / (
        2 * count.sum()
    )  # of the mean density
    above = np.flatnonzero(density > max(1.0, by_chance / SINK) * _motion_floor(sigma, dt_s))
    return float(above[-1]) / (segment * dt_s) if len(above) else 0.0


def _segment_rows(count: int, dt_s: float) -> int:
    """Rows of about four seconds."""
    return int(min(count, max(64, 2 ** round(np.log2(4.0 / dt_s)))))


def _motion_floor(sigma: float, dt_s: float) -> float:
    """One-sided power density above which a rate is motion, (rad/s)^2/Hz."""
    return SINK * 2 * sigma**2 * dt_s


def _power_density(values: Array, segment: int) -> Array:
    """(k, segment / 2 + 1) Welch's one-sided power density of (N, k), per sample."""
    cut = np.lib.stride_tricks.sliding_window_view(values, segment, axis=0)[
        :: segment - segment // 2
    ]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(segment) / segment)
    centred = cut - cut.mean(axis=2, keepdims=True)
    power = np.mean(np.abs(np.fft.rfft(centred * window, axis=2)) ** 2, axis=0)
    power[:, 1 : (segment + 1) // 2] *= 2.0
    return np.asarray(power / np.sum(window**2))


def attitude(track: Track, filtered: Filtered | NominalMotion) -> tuple[Array, bool]:
    """R_nb (N, 3, 3) and whether its z axis is down."""
    accel = track.accel_b_m_s2
    if accel is not None and not np.isfinite(accel).all():
        accel = None
    U = filtered.orientation
    runs = track.runs or (slice(0, len(track)),)
    width = DRIFT_S / track.step_s
    field = _smoothed_in_carried_frame(U, filtered.nominal_b, runs, width)
    if accel is None:
        return np.asarray(field_drift_rotations(field, runs) @ U), False
    down = _unit_vectors(_smoothed_in_carried_frame(U, -accel, runs, width))
    east = _unit_vectors(np.cross(down, field))
    return np.stack([np.cross(east, down), east, down], axis=1) @ U, True


def _smoothed_in_carried_frame(
    U: Array, vectors: Array, runs: Sequence[slice], width: float
) -> Array:
    """Vectors in the carried frame, smoothed by exp(-|k| / width) within each run."""
    moved = np.einsum("nij,nj->ni", U, vectors)
    keep = np.exp(-1.0 / width)
    out = np.empty_like(moved)
    for run in runs:
        out[run] = two_sided_sums(moved[run], keep)
    return np.asarray(out)


def field_drift_rotations(field: Array, runs: Sequence[slice]) -> Array:
    """Smallest rotations (N, 3, 3) that turn the carried field back to its first direction."""
    unit = _unit_vectors(field)
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


def _rate_at_samples(rate: Array, runs: Sequence[slice]) -> Array:
    """Rates at the sample times, from the mean rates over the steps that end at them."""
    out = rate.copy()
    for run in runs:
        rows = rate[run]
        out[run][:-1] = (rows[:-1] + rows[1:]) / 2
        out[run][0] = rows[min(1, len(rows) - 1)]
    return out


def _unit_vectors(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-300))


def denoised_force(accel_b_m_s2: Array, runs: Sequence[slice]) -> Array:
    """(N, 3) expected specific force given the readings (N, 3), run by run."""
    out = accel_b_m_s2.copy()
    for run in runs:
        if run.stop - run.start >= SPECTRUM_ROWS and np.isfinite(out[run]).all():
            out[run] = wiener_filter(accel_b_m_s2[run])
    return out
