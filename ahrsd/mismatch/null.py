"""The null: calibration and noise that explain a recording best, alone or with named terms.

Gauss-Newton on the whitened innovations, the gains held within a step.  The cold start descends on
a thinned track (`coarse`) from two starts, a sphere and a linear fit with the gyro, with the
gyro's noise inflated 30, 10, 3, 1 times: a short memory forgives a wrong bias and soft iron.

Gaussian priors keep what the motion does not show (at rest A and b would run away); where it shows
anything they are a thousand times too wide to matter.

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
from numpy.typing import NDArray

from ahrsd.estimator import chain
from ahrsd.estimator.start import linear_start, sphere_start
from ahrsd.mismatch import noise_fit
from ahrsd.mismatch.coarse import group_size, thinned
from ahrsd.mismatch.context import build_context
from ahrsd.mismatch.innovation import (
    TRACELESS,
    Filtered,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import Columns, Context, NullModel
from ahrsd.samples import Array

#: prior deviations of the 11: soft iron about I, hard iron (gauss) about 0, gyro bias (rad/s)
PRIOR = np.array([0.15] * 5 + [0.5] * 3 + [0.03] * 3)
_INFLATIONS = (30.0, 10.0, 3.0, 1.0)
_DONE = 0.05  # largest step in standard deviations
_STEPS = 6
_HALVINGS = 6
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
                for noise as estimated;  informed: (11,) false where the prior decided
    terms:      with their values and deviations
    terms_mag, terms_gyro: (N, 3) what the terms contribute to the readings, None without terms
    cost:       half the sum of squares, priors included, at the end
    """

    model: NullModel
    filtered: Filtered
    converged: bool
    covariance: Array
    informed: NDArray[np.bool]
    terms: tuple[FittedTerm, ...] = ()
    terms_mag: Array | None = None
    terms_gyro: Array | None = None
    cost: float = 0.0
    iterations: int = 0

    @property
    def log_likelihood(self) -> float:
        """Of the innovations."""
        return float(np.sum(self.filtered.log_likelihood))

    def context(self) -> Context:
        """What effects build their columns from."""
        return build_context(self.filtered.track, self)


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
    """
    known = spec or Spec()
    model = cold_start(track, known) if start is None else start
    fit = _descended(_Problem(track, tuple(terms)), model)
    for _ in range(2 if noise else 0):
        before = fit.model
        model = noise_fit.estimated(fit.filtered, known, fit.terms_mag, fit.terms_gyro, walk=walk)
        fit = _descended(_Problem(track, fit.terms), model)
        if noise_fit.alike(before, model):
            break
    return fit


def cold_start(track: Track, spec: Spec) -> NullModel:
    """A model to begin from, without knowing anything but the track."""
    coarse = thinned(track, group_size(track))
    first, size = noise_fit.first_guess(track, spec), group_size(track)
    # a row's rate is the mean of its samples': their noise averages
    base = replace(first, sigma_gyro_rad_s=first.sigma_gyro_rad_s / np.sqrt(size))
    found: list[NullFit] = []
    for model in _starts(coarse, base):
        fit = None
        for inflation in _INFLATIONS:
            loose = replace(model, sigma_gyro_rad_s=base.sigma_gyro_rad_s * inflation)
            fit = _descended(_Problem(coarse, ()), loose)
            model = fit.model
        if fit is not None:
            found.append(fit)
    best = min(found, key=lambda fit: fit.cost).model
    return replace(
        best,
        sigma_mag_gauss=first.sigma_mag_gauss,
        sigma_gyro_rad_s=first.sigma_gyro_rad_s,
    )


def _starts(track: Track, base: NullModel) -> list[NullModel]:
    """Calibrations to descend from."""
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    mag = track.mag_b_gauss[seen]
    centred = replace(base, hard_iron_gauss=mag.mean(axis=0) * 0.0)
    out = [centred]
    sphere = sphere_start(mag)
    if sphere is not None and np.linalg.norm(sphere[6:]) < 3.0:
        out.append(replace(base, hard_iron_gauss=sphere[6:]))
    linear = linear_start(_epochs(track)) if seen.all() else None
    if linear is not None and np.linalg.norm(linear[6:]) < 3.0:
        A = chain.symmetric(linear[:6])
        out.append(replace(base, soft_iron=A * 3 / np.trace(A), hard_iron_gauss=linear[6:]))
    return out[-2:]


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
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    track: Track
    terms: tuple[FittedTerm, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A model with its terms' values, and what the filter makes of it."""

    model: NullModel
    values: Array
    filtered: Filtered
    terms_mag: Array | None
    terms_gyro: Array | None
    columns: tuple[Columns, ...]


def _descended(problem: _Problem, model: NullModel) -> NullFit:
    values = np.concatenate([np.zeros(0), *(term.value for term in problem.terms)])
    point = _at(problem, model, values, None)
    cost = _cost(problem, point)
    converged = False
    count = 0
    covariance: Array = np.zeros((11 + len(values), 11 + len(values)))
    information = np.zeros(11)
    while count < _STEPS and not converged:
        count += 1
        gradient, data, prior = _normal(problem, point)
        information = np.diag(data)[:11]
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        step = covariance @ gradient
        new = _taken(problem, point, step, cost)
        if new is None:
            converged = True  # nothing lower: the noise of the linearisation is reached
            break
        point = new
        cost = _cost(problem, point)
        converged = bool(np.max(np.abs(step) / np.sqrt(np.diag(covariance))) < _DONE)
    return NullFit(
        model=point.model,
        filtered=point.filtered,
        converged=converged,
        covariance=covariance,
        informed=(np.diag(covariance)[:11] < 0.25 * PRIOR**2) & (information > 0),
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


def _at(problem: _Problem, model: NullModel, values: Array, last: _Point | None) -> _Point:
    """Filter at these parameters; the terms' columns are those of the context before."""
    mag, gyro = last.terms_mag if last else None, last.terms_gyro if last else None
    columns: tuple[Columns, ...] = ()
    if problem.terms:
        basis = last or _Point(model, values, run_filter(problem.track, model), None, None, ())
        context = build_context(problem.track, basis)
        columns = tuple(term.columns(context) for term in problem.terms)
        mag, gyro = _contributions(problem, columns, values)
    filtered = run_filter(problem.track, model, mag, gyro)
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
    scale = np.concatenate([PRIOR, *(term.scale for term in problem.terms)])
    prior = 1.0 / scale**2
    gradient = flat.T @ point.filtered.whitened.ravel() - prior * _from_prior(point)
    return gradient, flat.T @ flat, prior


def _from_prior(point: _Point) -> Array:
    m = point.model
    off = np.asarray(m.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    return np.concatenate([soft, m.hard_iron_gauss, m.gyro_bias_rad_s, point.values])


def _cost(problem: _Problem, point: _Point) -> float:
    scale = np.concatenate([PRIOR, *(term.scale for term in problem.terms)])
    prior = float(np.sum(np.square(_from_prior(point) / scale)))
    return 0.5 * (float(np.sum(point.filtered.whitened**2)) + prior)


def _taken(problem: _Problem, point: _Point, step: Array, cost: float) -> _Point | None:
    """The longest halving of the step that does not raise the cost; None where none does."""
    for halving in range(_HALVINGS):
        part = step / 2**halving
        model = _moved(point.model, part)
        if np.linalg.eigvalsh(model.soft_iron)[0] < _SMALLEST_EIGENVALUE:
            continue
        new = _at(problem, model, point.values + part[11:], point)
        if _cost(problem, new) <= cost * (1 + 1e-9):
            return new
    return None


def _moved(model: NullModel, step: Array) -> NullModel:
    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", step[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + step[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )
