"""A recording without the delay between its magnetometer and its gyro.

A magnetometer that is late by tau shows at t all that it measures as it was at t - tau: the Earth's
field, that of a current, a place, a joint.  So everything else, whatever it was logged by, is moved
to where the magnetometer is.  Where the gyro is late, it alone is moved; so it is by half a step,
by which a gyro's value is early that is the rate at the instant and not the mean over the step.

The gyro is moved exactly.  Its columns are linear only for
a lag that is short against the motion, so a lag that has been found is taken out by giving each
magnetometer sample the rotation between t_(k-1) - tau and t_k - tau.  Between samples the rate is
straight in time with the mean that the step has and the slope of its neighbours (a constant one
would be off by the acceleration times a quarter of a step squared, half of what a hand's turns show
of a lag of some milliseconds); only the gyro's small noise is mixed.

Where the gyro's values are rates at instants (`instants`) the rate is straight from value to value,
and half of a step of the lag is theirs.  Drawn through means it would be off by as much
as the rate changes within a step, which at 10 Hz on a flight is far more than its noise.

A low-pass is such a delay and, in quick turns, more (`beyond_the_lag`).
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
    """The track with a lag of the magnetometer against all else taken out; negative: the gyro's.

    instants: the gyro's values are rates at instants and not means, which is part of the lag
    """
    moved = delayed_gyro(track, lag_s, instants=instants)
    if not of_magnetometer(track, lag_s):
        return moved
    accel = track.accel_b_m_s2
    return replace(
        moved,
        accel_b_m_s2=None if accel is None else earlier(track, accel, lag_s),
        covariates={name: earlier(track, row, lag_s) for name, row in track.covariates.items()},
    )


def after_columns_begin(track: Track) -> Track:
    """Without a run's first readings, which a late magnetometer took before columns were logged.

    The same for every lag: models at different lags are compared by the same readings.  A run so
    short that they are much of it keeps them.
    """
    if not track.covariates:
        return track
    mag = track.mag_b_gauss.copy()
    for run in time_series.gap_free_runs(track.dt_s):
        before = track.time_s[run] - track.time_s[run.start] < priors.BEGIN_S
        if np.mean(before) < priors.BEGIN_SHARE:
            mag[run][before] = np.nan
    return replace(track, mag_b_gauss=mag)


def of_magnetometer(track: Track, lag_s: float) -> bool:
    """Whether a lag is one of all that the magnetometer measures, and not of the gyro alone."""
    step_s = usual_step(track.dt_s)
    half = step_s is not None and abs(lag_s / (step_s / 2) - 1.0) < priors.HALF_STEP_WITHIN
    return lag_s > 0.0 and not half


def usual_step(dt_s: Array) -> float | None:
    """The step that nearly all rows (N,) have, seconds; None where there is none."""
    middle = float(np.nanmedian(dt_s))
    alike = np.abs(np.nan_to_num(dt_s, nan=0.0) / middle - 1.0) < priors.STEPS_ALIKE
    return middle if np.mean(alike) > priors.STEPS_ALIKE_SHARE else None


def earlier(track: Track, values: Array, ago_s: float) -> Array:
    """What was logged beside a track's samples, (N,) or (N, k), as it was `ago_s` before."""
    return time_series.delayed_values(values, track.time_s, track.dt_s, ago_s)


def delayed_gyro(track: Track, tau_s: float, *, instants: bool = False) -> Track:
    """The track with the rates of tau_s earlier; beyond the ends of a run they stay as they are."""
    if tau_s == 0.0 and not instants:
        return track
    gyro = track.gyro_b_rad_s.copy()
    move = _delayed_instants if instants else _delayed_run
    for run in track.runs or (slice(0, len(track)),):
        if run.stop - run.start > 2:
            gyro[run] = move(track.time_s[run], track.gyro_b_rad_s[run], tau_s)
    return replace(track, gyro_b_rad_s=gyro)


def _delayed_run(time_s: Array, rate: Array, tau_s: float) -> Array:
    """Means over the steps, of means."""
    step_s = np.diff(time_s)
    before, since, inside = _within(time_s, time_s - tau_s)
    turn = rate[before + 1] * since[:, None] + _slope(rate[1:], step_s)[before] * inside[:, None]
    return _means(rate[1:], step_s, before, turn)


def _delayed_instants(time_s: Array, rate: Array, tau_s: float) -> Array:
    """Means over the steps, of rates at instants, which are early by half of a step."""
    step_s = np.diff(time_s)
    before, since, inside = _within(time_s, time_s - tau_s + np.median(step_s) / 2)
    middle, slope = (rate[:-1] + rate[1:]) / 2, np.diff(rate, axis=0) / step_s[:, None]
    turn = middle[before] * since[:, None] + slope[before] * inside[:, None]
    return _means(middle, step_s, before, turn)


def _within(time_s: Array, wanted_s: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Of each time the step that it is in, s since that began, and s^2 of the slope till there."""
    before = np.clip(np.searchsorted(time_s, wanted_s, side="right") - 1, 0, len(time_s) - 2)
    since = wanted_s - time_s[before]
    inside = since * (since - np.diff(time_s)[before]) / 2  # none beyond the ends
    inside = np.where((wanted_s < time_s[0]) | (wanted_s > time_s[-1]), 0.0, inside)
    return before, since, inside


def _means(mean: Array, step_s: Array, before: NDArray[np.intp], turn: Array) -> Array:
    """(N, 3) rates between attitudes that are `turn` (N, 3) on from the begin of a step.

    mean (N - 1, 3): rates of the steps
    """
    R = np.empty((len(mean) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, one in enumerate(so3.exp(mean * step_s[:, None])):
        R[k + 1] = R[k] @ one
    at = R[before] @ so3.exp(turn)
    moved = so3.log(np.swapaxes(at[:-1], 1, 2) @ at[1:]) / step_s[:, None]
    return np.vstack([moved[:1], moved])


def _slope(rate: Array, step_s: Array) -> Array:
    """(N - 1, 3) d rate / dt within each step, from the mean rates before and behind; 0 at ends."""
    slope = np.zeros_like(rate)
    between_s = step_s[1:-1] + (step_s[:-2] + step_s[2:]) / 2
    slope[1:-1] = (rate[2:] - rate[:-2]) / between_s[:, None]
    return slope


def beyond_the_lag(context: Context, lag_s: float) -> Columns:
    """What a low-pass of time constant tau does beyond a delay by tau, gauss (N, 3, 1).

    g(t) = h(t - tau) is the field of a track whose delay is taken out, D its derivative by time:
    LP_tau[h] - g = tau^2/2 D^2 g - tau^3/3 D^3 g + ..., half of what a filter of g has at D^2.
    """
    readings = readings_of(context)
    time_s, dt_s = readings.time_s, readings.dt_s
    second = time_series.derivative(time_series.field_dot(readings), time_s, dt_s)
    third = time_series.derivative(second, time_s, dt_s)
    change = lag_s**2 / 2 * second - lag_s**3 / 3 * third
    return Columns(mag=(change @ readings.soft_iron.T)[:, :, None])
