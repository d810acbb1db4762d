"""A recording without the delay between its magnetometer and its gyro.

A magnetometer with a delay of tau shows at time t all that it measures as it was at t - tau: the
field of the Earth, of a current, of a place, of a joint.  So all other columns are shifted to the
magnetometer's time.  If the gyro is late, it alone is shifted.  The same holds for half a step: a
gyro value that is the rate at an instant, not the mean over the step, is early by that.

The gyro is shifted exactly.  Its columns are linear only for a delay that is short compared with
the motion, so an estimated delay is removed by giving each magnetometer sample the rotation between
t_(k-1) - tau and t_k - tau.  Between samples the rate is linear in time, with the mean of the step
and the slope of its neighbours.  (A constant rate would be wrong by the acceleration times a
quarter of a step squared, half of what the turns of a hand show of a delay of some milliseconds.)
Only the gyro's small noise is mixed.

If the gyro's values are rates at instants (`instants`), the rate is linear from value to value, and
half a step of the delay is due to them.  For values that are means, this interpolation would be
wrong by the change of the rate within a step, which at 10 Hz on a flight is far more than the
noise.

A low-pass acts as such a delay and, in quick turns, as more (`low_pass_beyond_delay`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.effects.effect import readings_of
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array


def without_lag(track: Track, lag_s: float, *, instants: bool = False) -> Track:
    """The track without a lag of the magnetometer; negative: a lag of the gyro.

    instants: the gyro's values are rates at instants and not means, which is part of the lag
    """
    delayed = delayed_gyro(track, lag_s, instants=instants)
    if not is_magnetometer_lag(track, lag_s):
        return delayed
    accel = track.accel_b_m_s2
    return replace(
        delayed,
        accel_b_m_s2=None if accel is None else delayed_values(track, accel, lag_s),
        covariates={
            name: delayed_values(track, row, lag_s) for name, row in track.covariates.items()
        },
    )


def without_early_readings(track: Track) -> Track:
    """The track without the first readings of each run.

    A late magnetometer took them before the columns were logged.  They are the same for every lag:
    models with different lags are compared by the same readings.  A short run, of which they are a
    large part, keeps them.
    """
    if not track.covariates:
        return track
    mag = track.mag_b_gauss.copy()
    for run in time_series.gap_free_runs(track.dt_s):
        before = track.time_s[run] - track.time_s[run.start] < priors.BEGIN_S
        if np.mean(before) < priors.BEGIN_SHARE:
            mag[run][before] = np.nan
    return replace(track, mag_b_gauss=mag)


def is_magnetometer_lag(track: Track, lag_s: float) -> bool:
    """Whether a lag concerns all that the magnetometer measures, and not the gyro alone."""
    step_s = regular_step(track.dt_s)
    half = step_s is not None and abs(lag_s / (step_s / 2) - 1.0) < priors.HALF_STEP_WITHIN
    return lag_s > 0.0 and not half


def regular_step(dt_s: Array) -> float | None:
    """The step that nearly all rows (N,) have, seconds; None if there is none."""
    middle = float(np.nanmedian(dt_s))
    alike = np.abs(np.nan_to_num(dt_s, nan=0.0) / middle - 1.0) < priors.STEPS_ALIKE
    return middle if np.mean(alike) > priors.STEPS_ALIKE_SHARE else None


def delayed_values(track: Track, values: Array, ago_s: float) -> Array:
    """Values logged with the track's samples, (N,) or (N, k), as they were `ago_s` before."""
    return time_series.delayed_values(values, track.time_s, track.dt_s, ago_s)


def delayed_gyro(track: Track, tau_s: float, *, instants: bool = False) -> Track:
    """The track with the rates of tau_s earlier; those beyond the ends of a run do not change."""
    if tau_s == 0.0 and not instants:
        return track
    gyro = track.gyro_b_rad_s.copy()
    move = _delayed_instants if instants else _delayed_means
    for run in track.runs or (slice(0, len(track)),):
        if run.stop - run.start > 2:
            gyro[run] = move(track.time_s[run], track.gyro_b_rad_s[run], tau_s)
    return replace(track, gyro_b_rad_s=gyro)


def _delayed_means(time_s: Array, rate: Array, tau_s: float) -> Array:
    """Mean rates over the steps, from mean rates."""
    step_s = np.diff(time_s)
    before, since, inside = _locate_in_steps(time_s, time_s - tau_s)
    turn = (
        rate[before + 1] * since[:, None] + _rate_slope(rate[1:], step_s)[before] * inside[:, None]
    )
    return _mean_rates(rate[1:], step_s, before, turn)


def _delayed_instants(time_s: Array, rate: Array, tau_s: float) -> Array:
    """Mean rates over the steps, from rates at instants, which are early by half a step."""
    step_s = np.diff(time_s)
    before, since, inside = _locate_in_steps(time_s, time_s - tau_s + np.median(step_s) / 2)
    middle, slope = (rate[:-1] + rate[1:]) / 2, np.diff(rate, axis=0) / step_s[:, None]
    turn = middle[before] * since[:, None] + slope[before] * inside[:, None]
    return _mean_rates(middle, step_s, before, turn)


def _locate_in_steps(time_s: Array, wanted_s: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Position of each time in the steps.

    Returns the index of its step, the seconds since that began, and the integral, s^2, of the
    step's centred time up to there, which multiplies the slope of the rate.
    """
    before = np.clip(np.searchsorted(time_s, wanted_s, side="right") - 1, 0, len(time_s) - 2)
    since = wanted_s - time_s[before]
    inside = since * (since - np.diff(time_s)[before]) / 2  # 0 beyond the ends
    inside = np.where((wanted_s < time_s[0]) | (wanted_s > time_s[-1]), 0.0, inside)
    return before, since, inside


def _mean_rates(mean: Array, step_s: Array, before: NDArray[np.intp], turn: Array) -> Array:
    """(N, 3) rates between attitudes that are `turn` (N, 3) after the begin of a step.

    mean: (N - 1, 3) rates of the steps;  before: index of the step
    """
    R = np.empty((len(mean) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, one in enumerate(so3.exp(mean * step_s[:, None])):
        R[k + 1] = R[k] @ one
    at = R[before] @ so3.exp(turn)
    rates = so3.log(np.swapaxes(at[:-1], 1, 2) @ at[1:]) / step_s[:, None]
    return np.vstack([rates[:1], rates])


def _rate_slope(rate: Array, step_s: Array) -> Array:
    """(N - 1, 3) d rate / dt within each step, from the mean rates before and after; 0 at ends."""
    slope = np.zeros_like(rate)
    between_s = step_s[1:-1] + (step_s[:-2] + step_s[2:]) / 2
    slope[1:-1] = (rate[2:] - rate[:-2]) / between_s[:, None]
    return slope


def low_pass_beyond_delay(context: Context, lag_s: float) -> Columns:
    """What a low-pass of time constant tau does beyond a delay by tau, gauss (N, 3, 1).

    g(t) = h(t - tau) is the field of a track without its delay, D its derivative in time:
    LP_tau[h] - g = tau^2/2 D^2 g - tau^3/3 D^3 g + ..., half of the D^2 term of a filter of g.
    """
    readings = readings_of(context)
    time_s, dt_s = readings.time_s, readings.dt_s
    second = time_series.derivative(time_series.field_dot(readings), time_s, dt_s)
    third = time_series.derivative(second, time_s, dt_s)
    change = lag_s**2 / 2 * second - lag_s**3 / 3 * third
    return Columns(mag=(change @ readings.soft_iron.T)[:, :, None])
