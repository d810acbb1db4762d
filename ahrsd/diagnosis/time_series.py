"""Linear-algebra operations on sampled time series: rates, delays, filters, hysteresis, smoothing.

They respect gap-free runs: a run begins where `dt_s` is nan, and nothing here reaches across a
gap.

A recursive filter

    y_k = keep_k y_(k-1) + x_k

is a triangular system with one band.  (Importing scipy.signal takes more time than all filters of
a short recording's diagnosis.)

The expected values of a time series that was observed with white noise are its Wiener filter
(`wiener_filter`): of a power S at a frequency the part S - N is kept, with the noise power N
estimated from the upper half of the frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from ahrsd import so3
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.samples import Array

_TRUNCATED = 4.0  # standard deviations at which a Gaussian is cut off
#: fewest rows of which a spectrum is taken
SPECTRUM_ROWS = 200
#: frequencies over which the power is averaged, half a cycle per recording apart
SPECTRUM_WIDTH = 40
#: power below this many times the noise's counts as noise alone
SPECTRUM_SINK = 2.0
#: median of the square of a standard normal number
_MEDIAN_SQUARE = 0.4549


def gap_free_runs(dt_s: Array) -> list[slice]:
    """The gap-free runs, in order."""
    starts = [0, *(np.flatnonzero(np.isnan(dt_s[1:])) + 1).tolist()]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(dt_s)], strict=True)]


def derivative(values: Array, time_s: Array, dt_s: Array) -> Array:
    """d values / dt by central differences, one-sided at the ends of runs; (N,) or (N, k)."""
    out = np.zeros_like(values)
    for run in gap_free_runs(dt_s):
        if run.stop - run.start > 1:
            out[run] = np.gradient(values[run], time_s[run], axis=0)
    return out


def instant_rate(readings: Readings) -> Array:
    """True rate (N, 3) at the sample times: the mean of the steps before and after."""
    out = readings.rate_b_rad_s.copy()
    for run in gap_free_runs(readings.dt_s):
        rate = readings.rate_b_rad_s[run]
        if len(rate) > 1:
            out[run][:-1] = (rate[:-1] + rate[1:]) / 2
            out[run][0] = rate[1]
    return out


def field_dot(readings: Readings) -> Array:
    """d field_b / dt (N, 3) gauss/s at the sample times: h x w."""
    return np.cross(readings.field_b, instant_rate(readings))


def delayed_field(readings: Readings, delay_s: Array) -> Array:
    """The true field (N, 3) `delay_s` (N,) ago in the body frame of that time.

    Between samples the body turns at the rate of the step.  Before the first sample of a run it is
    taken to have turned at the rate of the first step, after the last at that of the last step.
    """
    out = np.empty_like(readings.field_b)
    for run in gap_free_runs(readings.dt_s):
        time_s, rate = readings.time_s[run], readings.rate_b_rad_s[run].copy()
        rate[:1] = rate[1:2] if len(rate) > 1 else rate[:1]
        wanted = time_s - delay_s[run]
        end = np.clip(np.searchsorted(time_s, wanted), 0, len(time_s) - 1)  # the step's last sample
        turn = so3.exp(rate[end] * (time_s[end] - wanted)[:, None])
        out[run] = np.einsum("nij,nj->ni", turn, readings.field_b[run][end])
    return out


def delayed_rate(readings: Readings, delay_s: float) -> Array:
    """The mean rate (N, 3) over the step that ended `delay_s` ago; extrapolated at a run's ends."""
    out = readings.rate_b_rad_s.copy()
    for run in gap_free_runs(readings.dt_s):
        time_s, rate = readings.time_s[run], readings.rate_b_rad_s[run]
        if len(rate) < 2:
            continue
        wanted = time_s - delay_s
        end = np.clip(np.searchsorted(time_s, wanted), 1, len(time_s) - 1)
        back = (time_s[end] - wanted) / (time_s[end] - time_s[end - 1])
        out[run] = rate[end] - back[:, None] * (rate[end] - rate[end - 1])
    return out


def delayed_values(values: Array, time_s: Array, dt_s: Array, ago_s: float) -> Array:
    """(N,) or (N, k) `ago_s` earlier, interpolated linearly; constant before a run's first row.

    A series of 0 and 1 only is interpolated to the nearest sample.
    """
    switched = values.ndim == 1 and bool(np.isin(values, (0.0, 1.0)).all())
    out = np.array(values, dtype=np.float64)
    for run in gap_free_runs(dt_s):
        at_s, then = time_s[run], out[run]
        if len(at_s) < 2:
            continue
        wanted = np.clip(at_s - ago_s, at_s[0], at_s[-1])
        after = np.clip(np.searchsorted(at_s, wanted), 1, len(at_s) - 1)
        share = (wanted - at_s[after - 1]) / (at_s[after] - at_s[after - 1])
        share = np.round(share) if switched else share
        share = share.reshape(-1, *(1,) * (values.ndim - 1))
        out[run] = then[after - 1] * (1.0 - share) + then[after] * share
    return out


def low_pass(
    values: Array, dt_s: Array, time_constant_s: float, memory: Sequence[float] | None = None
) -> Array:
    """First-order low-pass of (N, k), exact for values that are linear between samples.

    Each run starts in the steady state of its first value; memory (k,), if given, is added to the
    state of the first run.
    """
    out = np.empty_like(values)
    for run in gap_free_runs(dt_s):
        out[run] = _low_pass(values[run], dt_s[run][1:], time_constant_s)
    if memory is not None:
        out += np.asarray(memory) * initial_state_decay(dt_s, time_constant_s)[:, None]
    return out


def initial_state_decay(dt_s: Array, time_constant_s: float) -> Array:
    """(N,) decay of a unit initial state in the first run; 0 in the others."""
    out = np.zeros(len(dt_s))
    first = next(iter(gap_free_runs(dt_s)))
    out[first] = np.exp(-np.concatenate([[0.0], np.cumsum(dt_s[first][1:])]) / time_constant_s)
    return out


def _low_pass(x: Array, step_s: Array, time_constant_s: float) -> Array:
    if len(x) < 2:
        return x.copy()
    keep = np.exp(-step_s / time_constant_s)
    ratio = time_constant_s / step_s * (1 - keep)
    new, old = 1 - ratio, ratio - keep
    driven = np.vstack([x[:1], new[:, None] * x[1:] + old[:, None] * x[:-1]])
    return first_order_recursion(driven, keep)


def low_pass_cubic(values: Array, time_s: Array, dt_s: Array, time_constant_s: float) -> Array:
    """First-order low-pass of (N, k), exact for cubic curves through the samples and their slopes.

    With linear interpolation a filter faster than the samples has next to no effect: the curvature
    within a step contributes tau dt / 2, as much as its own tau^2.
    """
    slope = derivative(values, time_s, dt_s)
    out = np.empty_like(values)
    for run in gap_free_runs(dt_s):
        out[run] = _low_pass_cubic(values[run], slope[run], dt_s[run][1:], time_constant_s)
    return out


def _low_pass_cubic(x: Array, slope: Array, step_s: Array, time_constant_s: float) -> Array:
    if len(x) < 2:
        return x.copy()
    a = step_s / time_constant_s
    keep = np.exp(-a)
    # integrals of a exp(-a u) u^n over the step, u from its end back to its start
    I0 = 1 - keep
    I1 = I0 / a - keep
    I2 = 2 * I1 / a - keep
    I3 = 3 * I2 / a - keep
    early, late = -step_s[:, None] * slope[:-1], -step_s[:, None] * slope[1:]
    change = x[:-1] - x[1:]
    new = (
        I0[:, None] * x[1:]
        + I1[:, None] * late
        + I2[:, None] * (3 * change - 2 * late - early)
        + I3[:, None] * (late + early - 2 * change)
    )
    first = x[:1] - time_constant_s * slope[:1]  # steady state of a ramp of that slope
    return first_order_recursion(np.vstack([first, new]), keep)


def play_operator(values: Array, radius: float, memory: Sequence[float] | None = None) -> Array:
    """The play operator (N, k): centre of a slot of half-width `radius` that `values` drags along.

    memory (k,): position of the first value in the slot, -1 to 1; its centre if None
    """
    low, high = values - radius, values + radius
    start = values[0] + radius * np.asarray(memory or (0.0,) * values.shape[1])
    # the composition of two clamps is a clamp: pairs of rows first, then pairs of those
    reach = 1
    while reach < len(values):
        before, after = (slice(None, -reach), slice(reach, None))
        low[after], high[after] = (
            np.minimum(np.maximum(end[before], low[after]), high[after]) for end in (low, high)
        )
        reach *= 2
    return np.asarray(np.minimum(np.maximum(start, low), high))


def moving_mean(values: Array, dt_s: Array, rows: int) -> Array:
    """Centred mean of (N,) over about `rows` rows of the same run."""
    out = np.empty_like(values)
    half = max(rows // 2, 0)
    for run in gap_free_runs(dt_s):
        total = np.concatenate([[0.0], np.cumsum(values[run])])
        index = np.arange(run.stop - run.start)
        first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, len(index))
        out[run] = (total[last] - total[first]) / (last - first)
    return out


def median_step(dt_s: Array) -> float:
    """The median step, seconds."""
    known = dt_s[np.isfinite(dt_s)]
    return float(np.median(known)) if len(known) else 1.0


def select_rows(readings: Readings, rows: NDArray[np.bool]) -> Readings:
    """The rows (N,) bool that are true; steps span the rows left out, gaps remain gaps."""
    index = np.flatnonzero(rows)
    run = np.cumsum(np.isnan(readings.dt_s))[index]
    time_s = readings.time_s[index]
    step = np.concatenate([[np.nan], np.where(np.diff(run) > 0, np.nan, np.diff(time_s))])
    force = readings.force_b_m_s2
    return replace(
        readings,
        time_s=time_s,
        dt_s=step,
        mag_b_gauss=readings.mag_b_gauss[index],
        gyro_b_rad_s=readings.gyro_b_rad_s[index],
        accel_b_m_s2=readings.accel_b_m_s2[index],
        rate_b_rad_s=readings.rate_b_rad_s[index],
        field_b=readings.field_b[index],
        R_nb=readings.R_nb[index],
        covariates={name: values[index] for name, values in readings.covariates.items()},
        force_b_m_s2=None if force is None else force[index],
    )


def parabola_peak_offset(power: Array, best: int) -> float:
    """Offset of the vertex of the parabola through a maximum and its two neighbours, in samples."""
    if not 0 < best < len(power) - 1:
        return 0.0
    left, middle, right = (float(p) for p in power[best - 1 : best + 2])
    bend = left - 2 * middle + right
    return 0.5 * (left - right) / bend if bend < 0 else 0.0


def first_order_recursion(values: Array, keep: float | Array) -> Array:
    """(N, k) of (N, k): each row plus `keep`, one number or (N - 1,), times the previous result."""
    return autoregression(values, np.atleast_1d(np.asarray(keep, float))[None])


def autoregression(values: Array, coefficients: Array) -> Array:
    """(N, k): y_k = sum_j coefficients_j y_(k-j) + values_k, from zero.

    coefficients: (p, 1), or (p, N - 1) where they change from row to row
    """
    count = len(values)
    band = np.ones((len(coefficients) + 1, count))
    band[1:, : count - 1] = -coefficients
    out, _ = dtbtrs(band, values.reshape(count, -1), uplo="L", diag="U")
    return np.asarray(out).reshape(values.shape)


def two_sided_sums(values: Array, keep: float) -> Array:
    """(N, k) sums over all rows, weighted by keep^|distance|."""
    back = first_order_recursion(values[::-1], keep)[::-1]
    return np.asarray(first_order_recursion(values, keep) + back - values)


def gaussian_smooth(values: Array, width: float) -> Array:
    """(N, k) smoothed by a Gaussian of `width` rows, mirrored at the ends."""
    reach = int(_TRUNCATED * width + 0.5)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    weight /= weight.sum()
    mirrored = np.pad(values, [(reach, reach), (0, 0)], mode="symmetric")
    columns = [np.convolve(column, weight, mode="valid") for column in mirrored.T]
    return np.column_stack(columns)


def wiener_filter(values: Array) -> Array:
    """(N, k) expected values of time series that were observed as (N, k) with white noise.

    By a cosine transform, so that there is no step from the end to the beginning.
    """
    from scipy import fft  # 5 MB, which a daemon that removes effects from readings never needs

    mean = values.mean(axis=0)
    cosines = fft.dct(values - mean, axis=0, norm="ortho")
    power = cosines**2
    noise = np.median(power[len(power) // 2 :], axis=0) / _MEDIAN_SQUARE
    one_run = np.concatenate([[np.nan], np.ones(len(power) - 1)])
    smooth = np.column_stack([moving_mean(column, one_run, SPECTRUM_WIDTH) for column in power.T])
    part = np.where(smooth > SPECTRUM_SINK * noise, 1.0 - noise / np.maximum(smooth, 1e-300), 0.0)
    return np.asarray(fft.idct(cosines * part, axis=0, norm="ortho") + mean)
