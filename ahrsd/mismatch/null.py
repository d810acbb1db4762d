"""The null: calibration and noise that explain a recording best, alone or with named terms.

Gauss-Newton on the whitened innovations, the gains held within a step.  The cold start descends on
a thinned track (`coarse`) from two starts, a sphere and a linear fit with the gyro, with the
gyro's noise inflated 30, 10, 3, 1 times: a short memory forgives a wrong bias and soft iron.

A Gaussian prior (`prior`) keeps what the motion does not show.

Noise by innovation likelihood: the filter's gain is a function of sigma_gyro / sigma_mag, the
scale follows from the mean square.  sigma_gyro is never more than CAP times what the gyro's own
differences say: free, it swallows every drift of the gyro.  For the same reason the bias wanders
only when the likelihood says so, and not faster than WALK_CAP.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.start import linear_start
from ahrsd.mismatch import noise_fit
from ahrsd.mismatch.coarse import group_size, thinned
from ahrsd.mismatch.context import Given, build_context
from ahrsd.mismatch.innovation import (
    TRACELESS,
    Filtered,
    bearings,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.mismatch.prior import (
    TURNED,
    Prior,
    prior_of,
    repetition_of,
    sphere_centre,
    turned,
)
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import Columns, Context, NullModel
from ahrsd.samples import Array

_INFLATIONS = (30.0, 10.0, 3.0, 1.0)
_FEWEST = 15  # steps that a fit needs
_SHORTEST_RUN = 8  # samples of a run that the linear start can use
_DONE = 0.05  # largest step in standard deviations
_NEAR = 3.0  # largest step in standard deviations behind which the gains are as before it
_STEPS = 6
_HALVINGS = 3
_REESTIMATE = 0.3  # normalised innovation (log) beyond which the noise is found from the beginning
_GOOD = 1.5  # normalised innovation of a start that needs no rival
_WORTH = 10.0  # by which a further start's cost must be lower
_FARTHEST_GAUSS = 3.0  # hard iron of a start: beyond, the start is nonsense
_SMALLEST_EIGENVALUE = 0.05  # of the soft iron: beyond, no calibration


@dataclass(frozen=True, slots=True, eq=False)
class FittedTerm:
    """A named term in the fit.

    columns: derivatives of the readings by its parameters, of the context of the present fit
    value, deviation (p,): parameters;  scale (p,): prior deviations about zero
    """

    identifier: str
    columns: Callable[[Context], Columns]
    value: Array
    scale: Array
    deviation: Array | None = None
    setting: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class NullFit:
    """A fitted model.

    covariance: (11 + p, 11 + p) of [soft iron (TRACELESS), hard iron, gyro bias, terms in order],
                for noise as estimated
    terms:      with their values and deviations
    terms_mag, terms_gyro: (N, 3) what the terms contribute to the readings, None without terms;
                the Earth's rotation, where it is known, is in the second
    cost:       half the sum of squares, priors included, at the end
    made:       what was built from the fit, once
    """

    model: NullModel
    filtered: Filtered
    converged: bool
    covariance: Array
    terms: tuple[FittedTerm, ...] = ()
    terms_mag: Array | None = None
    terms_gyro: Array | None = None
    cost: float = 0.0
    iterations: int = 0
    made: dict[str, Any] = field(default_factory=dict, init=False)

    @property
    def log_likelihood(self) -> float:
        """Of the innovations."""
        return float(np.sum(self.filtered.log_likelihood))

    def context(self) -> Context:
        """What effects build their columns from."""
        if "context" not in self.made:
            self.made["context"] = build_context(self.filtered.track, self)
        context: Context = self.made["context"]
        return context


def fit_null(
    track: Track,
    spec: Spec | None = None,
    start: NullModel | None = None,
    terms: Sequence[FittedTerm] = (),
    *,
    noise: bool = True,
    walk: bool = True,
) -> NullFit:
    """Fit calibration, noise and terms to a track.

    start: begin there (a fit of nearly the same data) instead of cold
    noise: estimate what the spec leaves open; else keep the noise of `start`
    walk:  let the gyro's bias wander where the data say so

    ValueError where there is nothing to fit to (`unusable`).
    """
    reason = unusable(track)
    if reason:
        raise ValueError(reason)
    known = spec or Spec()
    problem = _Problem(track, tuple(terms), prior_of(track))
    if start is None:
        start = noise_fit.estimated(
            run_filter(track, cold_start(track, known), sensitive=False), known, walk=walk
        )
    fit = _descended(problem, start, _STEPS)
    prior = problem.prior.sharper(repetition_of(fit.filtered))
    if prior is not problem.prior:
        problem = replace(problem, terms=fit.terms, prior=prior)
        fit = _descended(problem, start, _STEPS)
    if not noise:
        return fit
    if abs(np.log(fit.filtered.normalised_innovation)) > _REESTIMATE:
        again = noise_fit.estimated(fit.filtered, known, fit.terms_mag, fit.terms_gyro, walk=walk)
        fit = _descended(replace(problem, terms=fit.terms), again, _STEPS)
    again = noise_fit.rescaled(fit.filtered, known)
    if noise_fit.alike(again, fit.model):
        return fit
    return _descended(replace(problem, terms=fit.terms), again, 2)


def at_model(track: Track, model: NullModel, terms: Sequence[FittedTerm]) -> NullFit:
    """The filter at a model and terms of the same data cut otherwise; nothing is fitted."""
    return _descended(_Problem(track, tuple(terms), prior_of(track)), model, 0)


def unusable(track: Track) -> str | None:
    """Why there is nothing that a calibration could be fitted to; None where there is."""
    if track.usual_gauss == 0.0:
        return "the magnetometer has no readings: nothing can be said about the field"
    steps = np.isfinite(track.dt_s) & np.isfinite(track.mag_b_gauss).all(axis=1)
    if np.count_nonzero(steps) < _FEWEST:
        return f"{np.count_nonzero(steps)} samples follow another one, {_FEWEST} are needed"
    return None


def cold_start(track: Track, spec: Spec) -> NullModel:
    """A model to begin from, without knowing anything but the track."""
    size = group_size(track)
    coarse = thinned(track, size)
    first = noise_fit.first_guess(track, spec)
    # a row's rate is the mean of its samples': their noise averages
    quiet = first.sigma_gyro_rad_s / np.sqrt(size)
    problem = _Problem(coarse, (), prior_of(track))
    best: NullFit | None = None
    for model in _starts(coarse, replace(first, gyro_bias_rad_s=problem.prior.mean[8:])):
        fit = _loosely(problem, model, quiet)
        agreed = best is not None and abs(fit.cost - best.cost) < _WORTH
        if best is None or fit.cost < best.cost - _WORTH:
            best = fit
        if agreed or fit.filtered.normalised_innovation < _GOOD:
            break
    found = first if best is None else best.model
    return replace(
        found,
        sigma_mag_gauss=first.sigma_mag_gauss,
        sigma_gyro_rad_s=first.sigma_gyro_rad_s,
    )


def _loosely(problem: _Problem, model: NullModel, quiet: float) -> NullFit:
    """Descend with less and less inflation of the gyro's noise."""
    for inflation in _INFLATIONS[:-1]:
        loose = replace(model, sigma_gyro_rad_s=quiet * inflation)
        model = _descended(problem, loose, 2).model
    return _descended(problem, replace(model, sigma_gyro_rad_s=quiet), _STEPS)


def _starts(track: Track, base: NullModel) -> list[NullModel]:
    """Calibrations to descend from, the most likely first."""
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    mag = track.mag_b_gauss[seen]
    out = []
    out.append(replace(base, hard_iron_gauss=sphere_centre(mag)))
    out.append(base)
    well = turned(mag) > TURNED and seen.all()
    linear = linear_start(_epochs(track)) if well else None
    if linear is not None and np.linalg.norm(linear[6:]) < _FARTHEST_GAUSS:
        A = chain.symmetric(linear[:6])
        A = A * 3 / np.trace(A)
        if np.linalg.norm(A - np.eye(3)) < 1.0:
            out.append(replace(base, soft_iron=A, hard_iron_gauss=linear[6:]))
    return out


def _epochs(track: Track) -> list[chain.Data]:
    """Runs as the estimator's linear start takes them."""
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    return [
        chain.Data(
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


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    track: Track
    terms: tuple[FittedTerm, ...]
    prior: Prior

    @property
    def mean(self) -> Array:
        """(11 + p,) of the prior."""
        return np.concatenate([self.prior.mean, *(np.zeros(len(t.value)) for t in self.terms)])

    @property
    def weight(self) -> Array:
        """(11 + p,) inverse variances of the prior."""
        scales = [self.prior.deviation, *(term.scale for term in self.terms)]
        return np.asarray(1.0 / np.concatenate(scales) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A model with its terms' values, and what the filter makes of it."""

    model: NullModel
    values: Array
    filtered: Filtered
    terms_mag: Array | None
    terms_gyro: Array | None
    columns: tuple[Columns, ...]


def _descended(problem: _Problem, model: NullModel, steps: int) -> NullFit:
    values = np.concatenate([np.zeros(0), *(term.value for term in problem.terms)])
    point = _at(problem, model, values, None)
    cost = _cost(problem, point)
    converged = False
    count = 0
    covariance: Array = np.zeros((11 + len(values), 11 + len(values)))
    while count < steps and not converged:
        count += 1
        gradient, data, prior = _normal(problem, point)
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
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
    return NullFit(
        model=point.model,
        filtered=point.filtered,
        converged=converged,
        covariance=covariance,
        terms=_named(problem, point, covariance),
        terms_mag=point.terms_mag,
        terms_gyro=point.terms_gyro,
        cost=cost,
        iterations=count,
    )


def _named(problem: _Problem, point: _Point, covariance: Array) -> tuple[FittedTerm, ...]:
    sigma = np.sqrt(np.maximum(np.diag(covariance)[11:], 0.0))
    out, at = [], 0
    for term in problem.terms:
        part = slice(at, at + len(term.value))
        out.append(replace(term, value=point.values[part], deviation=sigma[part]))
        at = part.stop
    return tuple(out)


def _at(
    problem: _Problem,
    model: NullModel,
    values: Array,
    last: _Point | None,
    held: Filtered | None = None,
) -> _Point:
    """Filter at these parameters; the terms' columns are those of the context before.

    held: whose gains to take, the model being next to the same
    """
    mag: Array | None = None
    gyro: Array | None = None
    columns: tuple[Columns, ...] = ()
    if problem.terms:
        basis = last or Given(bearings(problem.track, model))
        context = build_context(problem.track, basis)
        columns = tuple(term.columns(context) for term in problem.terms)
        mag, gyro = _contributions(problem, columns, values)
    filtered = run_filter(problem.track, model, mag, gyro, held=held)
    return _Point(model, values, filtered, mag, gyro, columns)


def _contributions(
    problem: _Problem, columns: tuple[Columns, ...], values: Array
) -> tuple[Array | None, Array | None]:
    count = len(problem.track)
    mag, gyro = np.zeros((count, 3)), np.zeros((count, 3))
    at = 0
    for term, mine in zip(problem.terms, columns, strict=True):
        theta = values[at : at + len(term.value)]
        at += len(term.value)
        if mine.mag is not None:
            mag += mine.mag @ theta
        if mine.gyro is not None:
            gyro += mine.gyro @ theta
    return mag, gyro


def _normal(problem: _Problem, point: _Point) -> tuple[Array, Array, Array]:
    """Gradient (11 + p,) downhill, information of the data (11 + p, 11 + p), of the prior."""
    X = sensitivities(point.filtered, nuisance_columns(point.filtered))
    parts = [X, *(sensitivities(point.filtered, mine) for mine in point.columns)]
    flat = np.concatenate(parts, axis=2).reshape(-1, 11 + len(point.values))
    prior = problem.weight
    gradient = flat.T @ point.filtered.whitened.ravel() - prior * _from_prior(problem, point)
    return gradient, flat.T @ flat, prior


def _from_prior(problem: _Problem, point: _Point) -> Array:
    m = point.model
    off = np.asarray(m.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    here = np.concatenate([soft, m.hard_iron_gauss, m.gyro_bias_rad_s, point.values])
    return np.asarray(here - problem.mean)


def _cost(problem: _Problem, point: _Point) -> float:
    prior = float(np.sum(problem.weight * _from_prior(problem, point) ** 2))
    return 0.5 * (float(np.sum(point.filtered.whitened**2)) + prior)


def _taken(problem: _Problem, point: _Point, step: Array, cost: float, near: bool) -> _Point | None:
    """The longest of step, step / 4 and step / 16 that lowers the cost; None where none does.

    near: the step is so short that the gains stay as they are
    """
    for halving in range(_HALVINGS):
        part = step / 4**halving
        model = moved(point.model, part)
        if np.linalg.eigvalsh(model.soft_iron)[0] < _SMALLEST_EIGENVALUE:
            continue
        held = point.filtered if near else None
        new = _at(problem, model, point.values + part[11:], point, held)
        if _cost(problem, new) <= cost * (1 + 1e-9):
            return new
    return None


def moved(model: NullModel, step: Array) -> NullModel:
    """A model with its 11 numbers of the calibration changed by step (11,) or more."""
    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", step[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + step[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )
