"""The null model: the calibration and the noise that explain a recording best.

`descend` finds the lowest cost from a starting point, with the noise fixed, by Gauss-Newton on the
whitened innovations; the gains are held within a short step.  The cold start descends on a
decimated track from a sphere fit, from no iron and from a linear fit with the gyro.  It inflates
the gyro's noise 30, 10, 3, 1 times: a filter with a short memory tolerates a wrong bias and soft
iron.  If none of these starts explains the data and no two of them agree, it starts again at 100
times.  If the gyro's noise turns the field by more than the magnetometer's own noise, the size of
the field determines the iron, by a valley of the cost too narrow for straight steps.  Then the
ellipsoid through the readings is the start, without inflation.

A Gaussian prior (`CalibrationPrior`) fixes what the motion does not show.  It is a thousand times
too wide to matter where the motion shows anything.  Elsewhere it keeps the calibration from
following slow noise: at rest A and b would be arbitrary.

The noise is found by the likelihood of the innovations: the filter's gain is a function of
sigma_gyro / sigma_mag, and the scale follows from the mean square.  sigma_gyro is never more than
GYRO_NOISE_CAP times the noise that the differences of the gyro's readings show: without this limit
it absorbs every drift of the gyro.  For the same reason the bias is a random walk only if the
likelihood supports it, and not faster than WALK_CAP_RAD_S_SQRT_S.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Baseline
from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.resampling import decimate, decimation_factor, gyro_noise_ratio
from ahrsd.diagnosis.innovation_filter.context import build_context
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.model import Context, NullModel
from ahrsd.diagnosis.track import NothingToFit, Spec, Track
from ahrsd.estimator import chain
from ahrsd.estimator.chain import linear_start
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: inflations of the gyro's noise by which a cold start descends, and most steps at each; the second
#: set, with a shorter memory and more steps, if no start of the first explains the data
_INFLATIONS = (((30.0, 10.0, 3.0), 2), ((100.0, 30.0, 10.0, 3.0), 6))
_SHORTEST_RUN = 8  # samples of a run that the linear start can use
_MOST_STEPS = 60  # a fit ends earlier if it has converged
_REESTIMATE = 0.3  # |log| of the normalised innovation beyond which the noise is estimated anew
_GOOD_INNOVATION = 1.5  # normalised innovation of a start that is accepted without a further one
_CLEARLY_LOWER = 10.0  # by which the cost of a further start must be lower
_FARTHEST_GAUSS = 3.0  # hard iron of a start, at most
_BLOCKS = 40  # in which the scores are summed
_CONVERGED = 0.05  # largest step of a converged fit, in standard deviations
_GAINS_HELD = 3.0  # largest step, in standard deviations, for which the gains are held
_HALVINGS = 3
_SMALLEST_EIGENVALUE = 0.05  # of the soft iron: less is no calibration


def fit_null(
    track: Track,
    spec: Spec | None = None,
    start: NullModel | None = None,
    *,
    noise: bool = True,
    walk: bool = True,
) -> NullFit:
    """Fit calibration and noise to a track.

    start: starting point (a fit of nearly the same data); None for a cold start
    noise: estimate what the spec leaves open; otherwise keep the noise of `start`
    walk:  let the gyro's bias be a random walk if the data support it

    NothingToFit if there is nothing to fit to (`unusable_reason`).
    """
    reason = unusable_reason(track)
    if reason:
        raise NothingToFit(reason)
    known = spec or Spec()
    problem = FitProblem(track, calibration_prior(track))
    if start is None:
        start = noise_fit.estimate_noise(
            run_filter(track, cold_start(track, known), with_sensitivities=False), known, walk=walk
        )
    fit = descend(problem, start, _MOST_STEPS)
    prior = problem.prior.sharper(score_variance_ratio(fit.filtered))
    if prior is not problem.prior:
        problem = replace(problem, prior=prior)
        fit = descend(problem, start, _MOST_STEPS)
    if not noise:
        return fit
    if abs(np.log(fit.filtered.normalised_innovation)) > _REESTIMATE:
        estimated = noise_fit.estimate_noise(fit.filtered, known, walk=walk)
        fit = descend(problem, estimated, _MOST_STEPS)
    estimated = noise_fit.rescale_noise(fit.filtered, known)
    if noise_fit.same_noise(estimated, fit.model):
        return fit
    return descend(problem, estimated, _MOST_STEPS)


def unusable_reason(track: Track) -> str | None:
    """Why no calibration can be fitted; None if one can."""
    if track.usual_gauss == 0.0:
        return "the magnetometer has no readings: nothing can be said about the field"
    steps = np.isfinite(track.dt_s) & np.isfinite(track.mag_b_gauss).all(axis=1)
    count, least = np.count_nonzero(steps), priors.FIT_STEPS
    if count < least:
        return f"samples without a gap before them: {count}, {least} are needed"
    return None


def cold_start(track: Track, spec: Spec) -> NullModel:
    """A starting model from the track alone."""
    size = decimation_factor(track)
    coarse = decimate(track, size)
    first = noise_fit.first_guess(track, spec)
    # a row's rate is the mean of its samples' rates: their noise averages
    gyro_noise = first.sigma_gyro_rad_s / np.sqrt(size)
    problem = FitProblem(coarse, calibration_prior(track))
    best: NullFit | None = None
    base = replace(first, gyro_bias_rad_s=problem.prior.mean[8:])
    from_ellipsoid = _start_from_ellipsoid(coarse, replace(base, sigma_gyro_rad_s=gyro_noise))
    if from_ellipsoid is not None:
        best = descend(problem, from_ellipsoid, _MOST_STEPS)
        if best.filtered.normalised_innovation < _GOOD_INNOVATION:
            return _with_noise_of(best.model, first)
    starts = _calibration_starts(coarse, base)
    for ladder, model in itertools.product(_INFLATIONS, starts):
        fit = _descend_with_inflation(problem, model, gyro_noise, *ladder)
        agreed = best is not None and abs(fit.cost - best.cost) < _CLEARLY_LOWER
        if best is None or fit.cost < best.cost - _CLEARLY_LOWER:
            best = fit
        if agreed or fit.filtered.normalised_innovation < _GOOD_INNOVATION:
            break
    return _with_noise_of(first if best is None else best.model, first)


def _with_noise_of(model: NullModel, like: NullModel) -> NullModel:
    """A model with the noise of another one."""
    mag, gyro = like.sigma_mag_gauss, like.sigma_gyro_rad_s
    return replace(model, sigma_mag_gauss=mag, sigma_gyro_rad_s=gyro)


def _start_from_ellipsoid(track: Track, base: NullModel) -> NullModel | None:
    """If the field's size is more informative than its turns: the iron that keeps it constant."""
    mag = track.mag_b_gauss[np.isfinite(track.mag_b_gauss).all(axis=1)]
    found = fit_ellipsoid(mag) if gyro_noise_ratio(track, base) > 1.0 else None
    if found is None or not _is_plausible(*found):
        return None
    return replace(base, soft_iron=found[0], hard_iron_gauss=found[1])


def _descend_with_inflation(
    problem: FitProblem,
    model: NullModel,
    gyro_noise: float,
    inflations: Sequence[float],
    steps: int,
) -> NullFit:
    """Descend with decreasing inflation of the gyro's noise."""
    for inflation in inflations:
        inflated = replace(model, sigma_gyro_rad_s=gyro_noise * inflation)
        model = descend(problem, inflated, steps).model
    return descend(problem, replace(model, sigma_gyro_rad_s=gyro_noise), _MOST_STEPS)


def _calibration_starts(track: Track, base: NullModel) -> list[NullModel]:
    """Calibrations from which to descend, the most probable first."""
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    mag = track.mag_b_gauss[seen]
    out = []
    out.append(replace(base, hard_iron_gauss=fit_sphere_centre(mag)))
    out.append(base)
    well = field_scatter(mag) > priors.IRON_TURNED and seen.all()
    linear = linear_start(_estimator_epochs(track)) if well else None
    if linear is not None:
        A = chain.symmetric(linear[:6])
        A = A * 3 / np.trace(A)
        if _is_plausible(A, linear[6:]):
            out.append(replace(base, soft_iron=A, hard_iron_gauss=linear[6:]))
    return out


def _is_plausible(soft_iron: Array, hard_iron_gauss: Array) -> bool:
    """Whether an iron is near enough to none for a start."""
    near = np.linalg.norm(hard_iron_gauss) < _FARTHEST_GAUSS
    return bool(near and np.linalg.norm(soft_iron - np.eye(3)) < 1.0)


def _estimator_epochs(track: Track) -> list[chain.EpochData]:
    """The runs as the estimator's linear start takes them."""
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    return [
        chain.EpochData(
            track.mag_b_gauss[run],
            track.gyro_b_rad_s[run] * dt[run, None],
            dt[run],
            np.full((run.stop - run.start, 3), np.nan),
            track.time_s[run],
            measures_first=True,
        )
        for run in track.runs
        if run.stop - run.start > _SHORTEST_RUN
    ]


def baseline_of(start: NullFit) -> Baseline:
    """What the null model leaves unexplained, for a diagnosis."""
    done = start.filtered
    return Baseline(
        float(np.sqrt(np.mean(done.innovation[done.used] ** 2))),
        float(-np.mean(done.log_likelihood[done.used])),
        done.normalised_innovation,
    )


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPrior:
    """Gaussian prior: mean and standard deviation (11,), in the order of the fit's parameters.

    repetition: number of data per independent one, for which the deviations are scaled
    """

    mean: Array
    deviation: Array
    repetition: float = 1.0

    def sharper(self, repetition: float) -> CalibrationPrior:
        """The prior for data of which one in `repetition` is independent; itself if all are."""
        if repetition < priors.REPEATED:
            return self
        sharp = self.deviation / np.sqrt(repetition / self.repetition)
        return CalibrationPrior(self.mean, sharp, repetition)


def calibration_prior(track: Track) -> CalibrationPrior:
    """The usual prior; if the sensor rests for long, the gyro's reading there is its bias.

    Iron is visible only by turning.  Without turning, slow noise of the magnetometer would be
    attributed to it, so the prior of the iron is the narrower, the less the field turned.
    """
    mean, deviation = np.zeros(11), priors.CALIBRATION_DEVIATION.copy()
    deviation[:8] *= np.clip(field_scatter(track.mag_b_gauss) / priors.IRON_TURNED, 0.02, 1.0)
    at_rest = rate_at_rest(track)
    if at_rest is not None:
        mean[8:] = at_rest.rate_rad_s
        deviation[8:] = np.minimum(
            np.hypot(priors.STILL_BIAS_RAD_S, at_rest.unseen_rad_s),
            priors.CALIBRATION_DEVIATION[8:],
        )
    return CalibrationPrior(mean, deviation)


@dataclass(frozen=True, slots=True, eq=False)
class GyroAtRest:
    """The gyro in the still seconds.

    rate_rad_s: (3,) its mean reading;  unseen_rad_s: rate that the field does not exclude there
    """

    rate_rad_s: Array
    unseen_rad_s: float


def rate_at_rest(track: Track) -> GyroAtRest | None:
    """The gyro's reading in the still seconds, None if less than a fifth of the seconds are still.

    Still means: neither the scatter of the readings within a second nor the change of the
    magnetometer's mean since the second before exceeds the noise.  A slower turn is not visible in
    one second.  In all of them together, it is bounded by the excess of their changes over the
    noise plus two deviations.
    """
    mag_noise, gyro_noise = noise_of_differences(track)
    rows = max(8, round(1.0 / max(track.step_s, 1e-6)))
    whole = len(track) // rows * rows
    if whole < 5 * rows:
        return None
    mag = track.mag_b_gauss[:whole].reshape(-1, rows, 3)
    gyro = track.gyro_b_rad_s[:whole].reshape(-1, rows, 3)
    change_gauss = np.linalg.norm(np.diff(mag.mean(axis=1), axis=0, prepend=np.nan), axis=1)
    still = (
        (np.max(gyro.std(axis=1), axis=1) < 2 * gyro_noise)
        & (np.max(mag.std(axis=1), axis=1) < 2 * mag_noise)
        & (change_gauss < 6 * mag_noise / np.sqrt(rows) + 1e-4)
    )
    if np.count_nonzero(still) < 0.2 * len(still):
        return None
    steps = np.square(change_gauss[still & np.isfinite(change_gauss)])
    by_noise = 6.0 * mag_noise**2 / rows
    beyond = max(float(np.mean(steps)) - by_noise, 0.0)
    unseen_square = beyond + 2.0 * by_noise * np.sqrt(2.0 / (3.0 * len(steps)))
    rate = np.median(gyro[still].mean(axis=1), axis=0)
    size_gauss = max(track.usual_gauss, 1e-12)
    return GyroAtRest(
        np.asarray(rate), float(np.sqrt(unseen_square)) / (size_gauss * rows * track.step_s)
    )


def field_scatter(mag: Array) -> float:
    """Scatter of the field (N, 3) relative to its size; 0 if there is no field."""
    seen = mag[np.isfinite(mag).all(axis=1)]
    if not len(seen):
        return 0.0
    size = float(np.median(np.linalg.norm(seen, axis=1)))
    return float(np.linalg.norm(np.std(seen, axis=0))) / max(size, 1e-12)


def fit_sphere_centre(mag: Array) -> Array:
    """Centre of the sphere |m - b| = r, by |m|^2 = 2 m.b + c, shrunk to 0 if the motion is poor."""
    if not len(mag):
        return np.zeros(3)
    square = np.sum(mag**2, axis=1)
    off = 2 * (mag - mag.mean(axis=0))
    weight = priors.SPHERE_ROWS / len(mag) / (priors.SPHERE_OFF * float(np.mean(square))) ** 2
    gram = weight * off.T @ off + np.diag(1 / priors.CALIBRATION_DEVIATION[5:8] ** 2)
    return np.asarray(np.linalg.solve(gram, weight * off.T @ (square - square.mean())))


def fit_ellipsoid(mag: Array) -> tuple[Array, Array] | None:
    """Soft iron of trace 3 and hard iron (gauss) of the ellipsoid through the readings (N, 3).

    |m|^2 + q.(m^T T m) = 2 m.u + c with the traceless directions T of a quadric I + q.T, by least
    squares without a prior: exact if the magnetometer has no noise.  None if the quadric is open.
    """
    middle = mag.mean(axis=0)
    m = mag - middle
    squares = np.einsum("ni,aij,nj->na", m, TRACELESS, m)
    columns = np.column_stack([-squares, 2.0 * m, np.ones(len(m))])
    found = np.linalg.lstsq(columns, np.sum(m**2, axis=1), rcond=None)[0]
    quadric = np.eye(3) + np.einsum("a,aij->ij", found[:5], TRACELESS)
    values, vectors = np.linalg.eigh(quadric)
    if values[0] <= 0.0:
        return None
    A = (vectors / np.sqrt(values)) @ vectors.T
    return A * 3.0 / np.trace(A), middle + np.linalg.solve(quadric, found[5:8])


def score_variance_ratio(done: Filtered) -> float:
    """Ratio of the variance of the scores to that for white innovations.

    A misfit that lasts makes the data look more certain than they are.  For white innovations, the
    sum of the scores in a block has the information of the block as its variance.  1 for a null.
    """
    X = sensitivities(done, nuisance_columns(done))
    score = np.einsum("nia,ni->na", X, done.whitened)
    edges = np.linspace(0, len(score), _BLOCKS + 1).astype(int)[:-1]
    sums = np.add.reduceat(score, edges, axis=0)
    flat = X.reshape(-1, 11)
    ridge = np.diag(1.0 / priors.CALIBRATION_DEVIATION**2)
    ratio = np.trace(np.linalg.solve(flat.T @ flat + ridge, sums.T @ sums))
    return float(ratio / 11 / (1 - 11 / _BLOCKS))


@dataclass(frozen=True, slots=True, eq=False)
class NullFit:
    """A fitted calibration.

    covariance: (11, 11) of [soft iron (TRACELESS), hard iron, gyro bias], for the estimated noise
    terms_mag, terms_gyro: (N, 3) terms subtracted from the readings before the fit; None for none
    cost:       half the sum of squares at the end, including the prior
    made:       cache of what was built from the fit
    """

    model: NullModel
    filtered: Filtered
    converged: bool
    covariance: Array
    terms_mag: Array | None = None
    terms_gyro: Array | None = None
    cost: float = 0.0
    made: dict[str, Any] = field(default_factory=dict, init=False)

    def context(self) -> Context:
        """What effects build their columns from."""
        if "context" not in self.made:
            self.made["context"] = build_context(self.filtered.track, self)
        context: Context = self.made["context"]
        return context


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """What a descent fits: a track, and the prior of the calibration."""

    track: Track
    prior: CalibrationPrior

    @property
    def weight(self) -> Array:
        """(11,) inverse variances of the prior."""
        return np.asarray(1.0 / self.prior.deviation**2)


def descend(problem: FitProblem, model: NullModel, steps: int) -> NullFit:
    """The fit after at most `steps` steps from a model, fewer if no step lowers the cost.

    The noise stays that of the model.
    """
    point = run_filter(problem.track, model)
    cost = _cost(problem, point)
    converged = False
    count = 0
    covariance: Array = np.zeros((11, 11))
    while count < steps and not converged:
        count += 1
        gradient, data, prior = _normal_equations(problem, point)
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        if not np.all(np.diag(covariance) > 0.0):  # singular to rounding: no step can be trusted
            break
        step = covariance @ gradient
        largest = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        new = _take_step(problem, point, step, cost, largest < _GAINS_HELD)
        if new is None:
            converged = True  # no lower cost: the accuracy of the linearisation is reached
            break
        decrease = cost - _cost(problem, new)
        point, cost = new, cost - decrease
        repetition = problem.prior.repetition
        converged = bool(
            largest < _CONVERGED * np.sqrt(repetition) or decrease < _CONVERGED**2 * repetition
        )
    return NullFit(point.model, point, converged, covariance, cost=cost)


def _normal_equations(problem: FitProblem, point: Filtered) -> tuple[Array, Array, Array]:
    """Negative gradient (11,), information of the data (11, 11) and of the prior (11,)."""
    flat = sensitivities(point, nuisance_columns(point)).reshape(-1, 11)
    prior = problem.weight
    gradient = flat.T @ point.whitened.ravel() - prior * _offset_from_prior(problem, point.model)
    return gradient, flat.T @ flat, prior


def _offset_from_prior(problem: FitProblem, model: NullModel) -> Array:
    """(11,) parameters of a model less the mean of the prior."""
    off = np.asarray(model.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    here = np.concatenate([soft, model.hard_iron_gauss, model.gyro_bias_rad_s])
    return np.asarray(here - problem.prior.mean)


def _cost(problem: FitProblem, point: Filtered) -> float:
    """Half the sum of squares of the whitened innovations and of the prior."""
    prior = float(np.sum(problem.weight * _offset_from_prior(problem, point.model) ** 2))
    return 0.5 * (float(np.sum(point.whitened**2)) + prior)


def _take_step(
    problem: FitProblem, point: Filtered, step: Array, cost: float, near: bool
) -> Filtered | None:
    """The longest of step, step / 4 and step / 16 that lowers the cost; None if none does.

    near: the step is so short that the gains are held
    """
    for halving in range(_HALVINGS):
        part = step / 4**halving
        model = _add_step(point.model, part)
        if not np.isfinite(part).all():
            continue
        if np.linalg.eigvalsh(model.soft_iron)[0] < _SMALLEST_EIGENVALUE:
            continue
        try:
            new = run_filter(problem.track, model, gains_from=point if near else None)
        except np.linalg.LinAlgError:  # a step too far
            continue
        if _cost(problem, new) <= cost * (1 + 1e-9):
            return new
    return None


def _add_step(model: NullModel, step: Array) -> NullModel:
    """A model with a step (11,) added to its calibration."""
    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", step[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + step[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )
