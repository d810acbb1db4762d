"""Forward model: what magnetometer and gyro would have read along the motion of a recording.

    noise_free_readings(context)   the motion, made consistent: a body turns in a constant field
    simulate_readings(truth, ...)  its readings: calibration, effects, noise, gaps as recorded

The motion is the attitude of the context, turned such that its field, smoothed over DRIFT_S, has
one constant direction in the world.  Headings are those of the recording, and each step turns the
field exactly by the true rate.  What gyro noise did to that attitude counts as motion: a body may
shake.

The inverse is `remove_terms`: the recording without what given effects added to it, so that they
do not bias its calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects.effect import Effect, Readings, readings_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.context import UnfittedMotion, build_context
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, nominal_motion
from ahrsd.diagnosis.innovation_filter.noise import fit_colour
from ahrsd.diagnosis.model import Context, Noise, NullModel, Term
from ahrsd.diagnosis.time_series import autoregression, two_sided_sums
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

DRIFT_S = 3.0  # shorter follows the field, longer the gyro; a gyro sampled at 10 Hz needs 3 s
_RESPONSE_ROWS = 4000  # after so many rows the response of a colour has decayed


def model_noise(model: NullModel, filtered: Filtered | None = None) -> Noise:
    """The model's noise; with a filter run, also the colour of its innovations.

    Where the filter's memory is longer than a sample or two, its innovations are nearly the
    magnetometer's noise, so their colour is taken for that noise.
    """
    colour = () if filtered is None else tuple(fit_colour(filtered).coefficients.tolist())
    return Noise(
        model.sigma_mag_gauss, model.sigma_gyro_rad_s, model.gyro_walk_rad_s_sqrt_s, colour
    )


def context_along(
    track: Track,
    model: NullModel,
    terms: Sequence[Term] = (),
    library: Mapping[str, Effect] = EFFECTS,
) -> Context:
    """The context of a track under a known model, with its effects removed; nothing is fitted.

    Built twice: the contributions of the effects need a context, which is better without the
    effects. Raises ValueError where an effect needs a covariate that the track lacks.
    """
    for term in terms:
        missing = term.setting.get("covariate")
        if missing not in (None, "accel", *track.covariates):
            raise ValueError(f"{term.identifier} needs the column {missing}")
    context = build_context(track, UnfittedMotion(nominal_motion(track, model)))
    added = [term for term in terms if library[term.identifier].kind == "mean"]
    if not added:
        return context
    mag, gyro = terms_contribution(context, added, library)
    return build_context(track, UnfittedMotion(nominal_motion(track, model, mag, gyro), gyro))


def terms_contribution(
    context: Context, terms: Sequence[Term], library: Mapping[str, Effect] = EFFECTS
) -> tuple[Array, Array]:
    """What effects of those values add to the magnetometer and the gyro, exactly: (N, 3) each.

    For effects that keep the number of rows, which is all but dropped samples.
    """
    clean = readings_of(context)
    made = simulate_readings(clean, terms, library=library)
    return made.mag_b_gauss - clean.mag_b_gauss, made.gyro_b_rad_s - clean.gyro_b_rad_s


def noise_free_readings(context: Context) -> Readings:
    """Noise-free readings along the motion of the recording, without any effect.

    field_b has a constant size, and h_k = Exp(-w_k dt_k) h_(k-1) holds exactly within runs.
    """
    start, model = readings_of(context), context.model
    size = float(np.mean(np.linalg.norm(start.field_b, axis=1)))
    field_n = np.einsum("nij,nj->ni", start.R_nb, start.field_b)
    direction = field_n.mean(axis=0) / np.linalg.norm(field_n.mean(axis=0))
    R_nb, rate = start.R_nb.copy(), start.rate_b_rad_s.copy()
    for run in time_series.gap_free_runs(start.dt_s):
        slow = _two_sided_mean(field_n[run], DRIFT_S, start.time_s[run])
        R_nb[run] = _smallest_rotations(slow, direction) @ start.R_nb[run]
        rate[run] = _mean_rate(R_nb[run], start.time_s[run], rate[run])
    field_b = size * np.einsum("nji,j->ni", R_nb, direction)
    return replace(
        start,
        R_nb=R_nb,
        rate_b_rad_s=rate,
        field_b=field_b,
        mag_b_gauss=field_b @ model.soft_iron.T + model.hard_iron_gauss,
        gyro_b_rad_s=rate + model.gyro_bias_rad_s,
    )


def simulate_readings(
    truth: Readings,
    terms: Sequence[Term] = (),
    noise: Noise | None = None,
    seed: int = 0,
    library: Mapping[str, Effect] = EFFECTS,
) -> Readings:
    """Readings of a truth with effects and noise; the same seed gives the same readings.

    Effects that act on the finished reading are applied after the noise, and effects on all that a
    sensor measures after the others.  KeyError for an unknown effect.
    """
    effects = [(library[term.identifier], term) for term in terms]
    effects.sort(key=lambda one: one[0].of_whole)
    readings = truth
    for effect, term in effects:
        if not effect.after_noise:
            readings = effect.simulate(readings, term.value, term.setting)
    if noise is not None:
        readings = _add_noise(readings, noise, seed)
    for effect, term in effects:
        if effect.after_noise:
            readings = effect.simulate(readings, term.value, term.setting)
    return readings


def track_from_readings(readings: Readings, like: Track | None = None) -> Track:
    """The readings as a track; covariates of `like` that no effect knows are kept."""
    accel = readings.accel_b_m_s2 if np.isfinite(readings.accel_b_m_s2).all() else None
    same = like is not None and len(like) == len(readings.time_s)
    covariates = like.covariates if like is not None and same else {}
    return Track(
        time_s=readings.time_s,
        dt_s=readings.dt_s,
        mag_b_gauss=readings.mag_b_gauss,
        gyro_b_rad_s=readings.gyro_b_rad_s,
        accel_b_m_s2=accel,
        covariates={**covariates, **readings.covariates},
        runs=tuple(time_series.gap_free_runs(readings.dt_s)),
    )


def _mean_rate(R_nb: Array, time_s: Array, otherwise: Array) -> Array:
    """Mean rate (N, 3) over the steps of one run; its first row repeats the second."""
    if len(R_nb) < 2:
        return otherwise
    turned = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    rate = turned / np.diff(time_s)[:, None]
    return np.vstack([rate[:1], rate])


def _two_sided_mean(values: Array, width_s: float, time_s: Array) -> Array:
    """(N, 3) smoothed by exp(-|t| / width), normalised so that the ends are not drawn to zero."""
    if len(values) < 2:
        return values
    keep = np.exp(-float(np.median(np.diff(time_s))) / width_s)
    stacked = np.column_stack([values, np.ones(len(values))])
    total = two_sided_sums(stacked, keep)
    return np.asarray(total[:, :3] / total[:, 3:])


def _smallest_rotations(vectors: Array, onto: Array) -> Array:
    """The smallest rotations (N, 3, 3) that turn each of the vectors (N, 3) onto one direction."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit = np.where(size > 0.0, vectors / np.where(size > 0.0, size, 1.0), onto)
    axis = np.cross(unit, onto)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, unit @ onto)
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 1.0)
    return so3.exp(axis * scale[:, None])


def _add_noise(readings: Readings, noise: Noise, seed: int) -> Readings:
    """Coloured noise on the magnetometer, white noise and a random walk of the bias on the gyro."""
    shape = readings.mag_b_gauss.shape
    mag, gyro, walk = (
        np.random.default_rng([seed, stream]).standard_normal(shape) for stream in range(3)
    )
    if np.isfinite(noise.freedom):
        square = np.random.default_rng([seed, 3]).chisquare(noise.freedom, shape)
        mag = mag * np.sqrt((noise.freedom - 2) / square)
    mag = _colour_noise(mag, noise.colour)
    if noise.level is not None:
        mag = mag * noise.level[:, None]
    root_step = np.sqrt(np.concatenate([[0.0], np.diff(readings.time_s)]))[:, None]
    bias = noise.gyro_walk_rad_s_sqrt_s * np.cumsum(root_step * walk, axis=0)
    return replace(
        readings,
        mag_b_gauss=readings.mag_b_gauss + noise.mag_gauss * mag,
        gyro_b_rad_s=readings.gyro_b_rad_s + noise.gyro_rad_s * gyro + bias,
    )


def _colour_noise(white: Array, colour: tuple[float, ...]) -> Array:
    """White noise (N, 3) of variance 1, coloured and scaled to variance 1."""
    if not colour:
        return white
    taps = np.array(colour)[:, None]
    response = autoregression(np.eye(_RESPONSE_ROWS, 1), taps)
    # rows ahead of the first, so that the noise is stationary there
    ahead = np.vstack([white[:_RESPONSE_ROWS][::-1], white])
    return autoregression(ahead, taps)[-len(white) :] / float(np.linalg.norm(response))


def remove_terms(
    track: Track,
    model: NullModel,
    terms: Sequence[Term],
    library: Mapping[str, Effect] = EFFECTS,
) -> tuple[Track, tuple[str, ...]]:
    """The track without the contributions of the terms, and the effects that cannot be subtracted.

    The contributions follow from the model with which the effects were fitted: motion, field and
    the columns of this track.  Noise, coarse steps and lost samples cannot be subtracted; the
    identifiers of such effects are returned. Raises ValueError where a term needs a column that
    the track lacks.
    """
    removable = [term for term in terms if library[term.identifier].kind == "mean"]
    left = tuple(term.identifier for term in terms if library[term.identifier].kind != "mean")
    if not removable:
        return track, left
    context = context_along(track, model, removable, library)
    mag, gyro = terms_contribution(context, removable, library)
    return (
        replace(track, mag_b_gauss=track.mag_b_gauss - mag, gyro_b_rad_s=track.gyro_b_rad_s - gyro),
        left,
    )
