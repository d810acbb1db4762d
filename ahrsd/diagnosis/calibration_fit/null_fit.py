"""The null: calibration and noise that explain a recording best.

`descended` finds the lowest cost from where it is set down, noise as it is, by Gauss-Newton on the
whitened innovations, the gains held within a step.  The cold start descends on a decimated track
from a sphere, from no iron and from a linear fit with the gyro, with the gyro's
noise inflated 30, 10, 3, 1 times: a short memory forgives a wrong bias and soft iron.  Where none
of these explains the data nor two agree, it begins anew at 100 times.  Where that noise
turns up more field than the magnetometer's own, the size of the field says where the iron is, by a
valley too narrow to be followed in straight steps: there it begins at the ellipsoid of the
readings, as it is.

A Gaussian prior (`Prior`) keeps what the motion does not show.  It is a thousand times too wide to
matter where the motion shows anything.  Where it does not, it keeps the calibration from running
after slow noise: at rest A and b would go anywhere.

Noise by innovation likelihood: the filter's gain is a function of sigma_gyro / sigma_mag, the
scale follows from the mean square.  sigma_gyro is never more than GYRO_NOISE_CAP times what the
gyro's own differences say: free, it swallows every drift of the gyro.  For the same reason the bias
wanders only when the likelihood says so, and not faster than WALK_CAP_RAD_S_SQRT_S.
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
from ahrsd.diagnosis.calibration_fit.resampling import decimated, decimation, turned_up
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

#: inflations of the gyro's noise by which a cold start descends, and most steps at each; where no
#: start of the first comes to what explains the data, from a shorter memory and with more steps
_LADDERS = (((30.0, 10.0, 3.0), 2), ((100.0, 30.0, 10.0, 3.0), 6))
_SHORTEST_RUN = 8  # samples of a run that the linear start can use
_STEPS = 60  # most; a fit ends where it has converged
_REESTIMATE = 0.3  # normalised innovation (log) beyond which the noise is found from the beginning
_GOOD = 1.5  # normalised innovation of a start that needs no rival
_WORTH = 10.0  # by which a further start's cost must be lower
_FARTHEST_GAUSS = 3.0  # hard iron of a start: beyond, the start is nonsense
_BLOCKS = 40  # in which the scores are summed
_DONE = 0.05  # largest step in standard deviations
_NEAR = 3.0  # largest step in standard deviations behind which the gains are as before it
_HALVINGS = 3
_SMALLEST_EIGENVALUE = 0.05  # of the soft iron: beyond, no calibration


def fit_null(
    track: Track,
    spec: Spec | None = None,
    start: NullModel | None = None,
    *,
    noise: bool = True,
    walk: bool = True,
) -> NullFit:
    """Fit calibration and noise to a track.

    start: begin there (a fit of nearly the same data) instead of cold
    noise: estimate what the spec leaves open; else keep the noise of `start`
    walk:  let the gyro's bias wander where the data say so

    NothingToFit where there is nothing to fit to (`unusable`).
    """
    reason = unusable(track)
    if reason:
        raise NothingToFit(reason)
    known = spec or Spec()
    problem = FitProblem(track, prior_of(track))
    if start is None:
        start = noise_fit.estimated(
            run_filter(track, cold_start(track, known), with_sensitivities=False), known, walk=walk
        )
    fit = descended(problem, start, _STEPS)
    prior = problem.prior.sharper(repetition_of(fit.filtered))
    if prior is not problem.prior:
        problem = replace(problem, prior=prior)
        fit = descended(problem, start, _STEPS)
    if not noise:
        return fit
    if abs(np.log(fit.filtered.normalised_innovation)) > _REESTIMATE:
        again = noise_fit.estimated(fit.filtered, known, walk=walk)
        fit = descended(problem, again, _STEPS)
    again = noise_fit.rescaled(fit.filtered, known)
    if noise_fit.alike(again, fit.model):
        return fit
    return descended(problem, again, _STEPS)


def unusable(track: Track) -> str | None:
    """Why there is nothing that a calibration could be fitted to; None where there is."""
    if track.usual_gauss == 0.0:
        return "the magnetometer has no readings: nothing can be said about the field"
    steps = np.isfinite(track.dt_s) & np.isfinite(track.mag_b_gauss).all(axis=1)
    count, least = np.count_nonzero(steps), priors.FIT_STEPS
    if count < least:
        return f"samples that follow another one: {count}, {least} are needed"
    return None


def cold_start(track: Track, spec: Spec) -> NullModel:
    """A model to begin from, without knowing anything but the track."""
    size = decimation(track)
    coarse = decimated(track, size)
    first = noise_fit.first_guess(track, spec)
    # a row's rate is the mean of its samples': their noise averages
    quiet = first.sigma_gyro_rad_s / np.sqrt(size)
    problem = FitProblem(coarse, prior_of(track))
    best: NullFit | None = None
    base = replace(first, gyro_bias_rad_s=problem.prior.mean[8:])
    by_size = _by_size(coarse, replace(base, sigma_gyro_rad_s=quiet))
    if by_size is not None:
        best = descended(problem, by_size, _STEPS)
        if best.filtered.normalised_innovation < _GOOD:
            return _of_noise(best.model, first)
    starts = _starts(coarse, base)
    for ladder, model in itertools.product(_LADDERS, starts):
        fit = _loosely(problem, model, quiet, *ladder)
        agreed = best is not None and abs(fit.cost - best.cost) < _WORTH
        if best is None or fit.cost < best.cost - _WORTH:
            best = fit
        if agreed or fit.filtered.normalised_innovation < _GOOD:
            break
    return _of_noise(first if best is None else best.model, first)


def _of_noise(model: NullModel, like: NullModel) -> NullModel:
    """A model with the noise of another one."""
    mag, gyro = like.sigma_mag_gauss, like.sigma_gyro_rad_s
    return replace(model, sigma_mag_gauss=mag, sigma_gyro_rad_s=gyro)


def _by_size(track: Track, base: NullModel) -> NullModel | None:
    """Where the field's size says more than its turns do, the iron that keeps it constant."""
    mag = track.mag_b_gauss[np.isfinite(track.mag_b_gauss).all(axis=1)]
    found = ellipsoid(mag) if turned_up(track, base) > 1.0 else None
    if found is None or not _believable(*found):
        return None
    return replace(base, soft_iron=found[0], hard_iron_gauss=found[1])


def _loosely(
    problem: FitProblem, model: NullModel, quiet: float, inflations: Sequence[float], steps: int
) -> NullFit:
    """Descend with less and less inflation of the gyro's noise."""
    for inflation in inflations:
        loose = replace(model, sigma_gyro_rad_s=quiet * inflation)
        model = descended(problem, loose, steps).model
    return descended(problem, replace(model, sigma_gyro_rad_s=quiet), _STEPS)


def _starts(track: Track, base: NullModel) -> list[NullModel]:
    """Calibrations to descend from, the most likely first."""
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    mag = track.mag_b_gauss[seen]
    out = []
    out.append(replace(base, hard_iron_gauss=sphere_centre(mag)))
    out.append(base)
    well = turned(mag) > priors.IRON_TURNED and seen.all()
    linear = linear_start(_epochs(track)) if well else None
    if linear is not None:
        A = chain.symmetric(linear[:6])
        A = A * 3 / np.trace(A)
        if _believable(A, linear[6:]):
            out.append(replace(base, soft_iron=A, hard_iron_gauss=linear[6:]))
    return out


def _believable(soft_iron: Array, hard_iron_gauss: Array) -> bool:
    near = np.linalg.norm(hard_iron_gauss) < _FARTHEST_GAUSS
    return bool(near and np.linalg.norm(soft_iron - np.eye(3)) < 1.0)


def _epochs(track: Track) -> list[chain.EpochData]:
    """Runs as the estimator's linear start takes them."""
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


def baseline(start: NullFit) -> Baseline:
    """What the null model leaves, for an answer."""
    done = start.filtered
    return Baseline(
        float(np.sqrt(np.mean(done.innovation[done.used] ** 2))),
        float(-np.mean(done.log_likelihood[done.used])),
        done.normalised_innovation,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is believed before the data: mean and deviation (11,), in the order of the fit.

    repetition: of how many data one says something new: the deviations are for that many
    """

    mean: Array
    deviation: Array
    repetition: float = 1.0

    def sharper(self, repetition: float) -> Prior:
        """For data of which only one in `repetition` says anything new; itself where all do."""
        if repetition < priors.REPEATED:
            return self
        sharp = self.deviation / np.sqrt(repetition / self.repetition)
        return Prior(self.mean, sharp, repetition)


def prior_of(track: Track) -> Prior:
    """The usual one; where the sensor rests for long, its gyro reads its bias.

    Iron shows itself by turning only.  Without turning, slow noise of the magnetometer would be
    laid at its door, so the less the field turned, the closer the iron is held.
    """
    mean, deviation = np.zeros(11), priors.CALIBRATION_DEVIATION.copy()
    deviation[:8] *= np.clip(turned(track.mag_b_gauss) / priors.IRON_TURNED, 0.02, 1.0)
    rest = rate_at_rest(track)
    if rest is not None:
        mean[8:] = rest.rate_rad_s
        deviation[8:] = np.minimum(
            np.hypot(priors.STILL_BIAS_RAD_S, rest.unseen_rad_s), priors.CALIBRATION_DEVIATION[8:]
        )
    return Prior(mean, deviation)


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Still seconds: the gyro's mean reading (3,), and the rate that the field may hide there."""

    rate_rad_s: Array
    unseen_rad_s: float


def rate_at_rest(track: Track) -> Rest | None:
    """What the gyro reads in the still seconds, None where fewer than a fifth are still.

    Still: neither the readings' scatter within the second nor the magnetometer's mean against the
    second before is more than their noise.  What turns slower than that is unseen in one second;
    in all of them together it is what their steps have beyond the noise, and twice its deviation.
    """
    mag_noise, gyro_noise = noise_of_differences(track)
    rows = max(8, round(1.0 / max(track.step_s, 1e-6)))
    whole = len(track) // rows * rows
    if whole < 5 * rows:
        return None
    mag = track.mag_b_gauss[:whole].reshape(-1, rows, 3)
    gyro = track.gyro_b_rad_s[:whole].reshape(-1, rows, 3)
    moved = np.linalg.norm(np.diff(mag.mean(axis=1), axis=0, prepend=np.nan), axis=1)
    still = (
        (np.max(gyro.std(axis=1), axis=1) < 2 * gyro_noise)
        & (np.max(mag.std(axis=1), axis=1) < 2 * mag_noise)
        & (moved < 6 * mag_noise / np.sqrt(rows) + 1e-4)
    )
    if np.count_nonzero(still) < 0.2 * len(still):
        return None
    steps = np.square(moved[still & np.isfinite(moved)])
    by_noise = 6.0 * mag_noise**2 / rows
    beyond = max(float(np.mean(steps)) - by_noise, 0.0)
    unseen = beyond + 2.0 * by_noise * np.sqrt(2.0 / (3.0 * len(steps)))
    rate = np.median(gyro[still].mean(axis=1), axis=0)
    size_gauss = max(track.usual_gauss, 1e-12)
    return Rest(np.asarray(rate), float(np.sqrt(unseen)) / (size_gauss * rows * track.step_s))


def turned(mag: Array) -> float:
    """Scatter of the field (N, 3) over its size; 0 where there is no field."""
    seen = mag[np.isfinite(mag).all(axis=1)]
    if not len(seen):
        return 0.0
    size = float(np.median(np.linalg.norm(seen, axis=1)))
    return float(np.linalg.norm(np.std(seen, axis=0))) / max(size, 1e-12)


def sphere_centre(mag: Array) -> Array:
    """Centre of the sphere |m - b| = r, |m|^2 = 2 m.b + c, drawn to 0 where the motion is poor."""
    if not len(mag):
        return np.zeros(3)
    square = np.sum(mag**2, axis=1)
    off = 2 * (mag - mag.mean(axis=0))
    weight = priors.SPHERE_ROWS / len(mag) / (priors.SPHERE_OFF * float(np.mean(square))) ** 2
    gram = weight * off.T @ off + np.diag(1 / priors.CALIBRATION_DEVIATION[5:8] ** 2)
    return np.asarray(np.linalg.solve(gram, weight * off.T @ (square - square.mean())))


def ellipsoid(mag: Array) -> tuple[Array, Array] | None:
    """Soft iron of trace 3 and hard iron (gauss) of the ellipsoid through the readings (N, 3).

    |m|^2 + q.(m^T T m) = 2 m.u + c with the traceless directions T of a quadric I + q.T, least
    squares: exact where the magnetometer has no noise, drawn to nothing.  None where it is open.
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


def repetition_of(done: Filtered) -> float:
    """How many times larger the variance of the scores is than if the innovations were white.

    A misfit that lasts makes the data look surer than they are: of the sum of a block's scores
    white innovations have the block's information as variance.  1 on a null.
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

    covariance: (11, 11) of [soft iron (TRACELESS), hard iron, gyro bias], for noise as estimated
    terms_mag, terms_gyro: (N, 3) what was taken out of the readings before it; None for nothing
    cost:       half the sum of squares, priors included, at the end
    made:       what was built from the fit, once
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
    """What a descent is of: a track, and the prior of the calibration."""

    track: Track
    prior: Prior

    @property
    def weight(self) -> Array:
        """(11,) inverse variances of the prior."""
        return np.asarray(1.0 / self.prior.deviation**2)


def descended(problem: FitProblem, model: NullModel, steps: int) -> NullFit:
    """The fit after at most so many steps from a model, fewer where nothing is lower.

    The noise stays that of the model.
    """
    point = run_filter(problem.track, model)
    cost = _cost(problem, point)
    converged = False
    count = 0
    covariance: Array = np.zeros((11, 11))
    while count < steps and not converged:
        count += 1
        gradient, data, prior = _normal(problem, point)
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        if not np.all(np.diag(covariance) > 0.0):  # singular to rounding: no step is to be trusted
            break
        step = covariance @ gradient
        largest = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        new = _taken(problem, point, step, cost, largest < _NEAR)
        if new is None:
            converged = True  # nothing lower: the noise of the linearisation is reached
            break
        gained = cost - _cost(problem, new)
        point, cost = new, cost - gained
        repetition = problem.prior.repetition
        converged = bool(largest < _DONE * np.sqrt(repetition) or gained < _DONE**2 * repetition)
    return NullFit(point.model, point, converged, covariance, cost=cost)


def _normal(problem: FitProblem, point: Filtered) -> tuple[Array, Array, Array]:
    """Gradient (11,) downhill, information of the data (11, 11), of the prior (11,)."""
    flat = sensitivities(point, nuisance_columns(point)).reshape(-1, 11)
    prior = problem.weight
    gradient = flat.T @ point.whitened.ravel() - prior * _from_prior(problem, point.model)
    return gradient, flat.T @ flat, prior


def _from_prior(problem: FitProblem, model: NullModel) -> Array:
    off = np.asarray(model.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    here = np.concatenate([soft, model.hard_iron_gauss, model.gyro_bias_rad_s])
    return np.asarray(here - problem.prior.mean)


def _cost(problem: FitProblem, point: Filtered) -> float:
    prior = float(np.sum(problem.weight * _from_prior(problem, point.model) ** 2))
    return 0.5 * (float(np.sum(point.whitened**2)) + prior)


def _taken(
    problem: FitProblem, point: Filtered, step: Array, cost: float, near: bool
) -> Filtered | None:
    """The longest of step, step / 4 and step / 16 that lowers the cost; None where none does.

    near: the step is so short that the gains stay as they are
    """
    for halving in range(_HALVINGS):
        part = step / 4**halving
        model = _moved(point.model, part)
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


def _moved(model: NullModel, step: Array) -> NullModel:
    """A model with the 11 numbers of its calibration changed by step (11,)."""
    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", step[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + step[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )
