"""Descent of calibration and named terms to what explains a recording best, noise as it is.

Gauss-Newton on the whitened innovations, the gains held within a step.  The columns of terms are
built from the context of the point before; where nothing lower is found so, from the point's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ahrsd.diagnosis.calibration_fit.prior import Prior
from ahrsd.diagnosis.innovation_filter.context import Given, build_context
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    bearings,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Columns, Context, NullModel
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

_DONE = 0.05  # largest step in standard deviations
_NEAR = 3.0  # largest step in standard deviations behind which the gains are as before it
_STALE = 1.0  # nats that a point costs more with columns of its own context, to go on from there
_HALVINGS = 3
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


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """What a descent is of: a track, the terms beside the calibration, the prior of both.

    Terms begin at their values.
    """

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


def descended(problem: FitProblem, model: NullModel, steps: int) -> NullFit:
    """The fit after at most so many steps from a model, fewer where nothing is lower.

    The noise stays that of the model.
    """
    values = np.concatenate([np.zeros(0), *(term.value for term in problem.terms)])
    point = _at(problem, model, values, None)
    cost = _cost(problem, point)
    converged = False
    count = 0
    own: _Point | None = None
    covariance: Array = np.zeros((11 + len(values), 11 + len(values)))
    while count < steps and not converged:
        count += 1
        gradient, data, prior = _normal(problem, point)
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        if not np.all(np.diag(covariance) > 0.0):  # singular to rounding: no step is to be trusted
            break
        step = covariance @ gradient
        largest = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        new = _taken(problem, point, step, cost, largest < _NEAR)
        afresh = _with_own_columns(problem, point, cost, own) if new is None else None
        if afresh is not None:
            point = own = afresh
            cost = _cost(problem, afresh)
            continue
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


def _named(problem: FitProblem, point: _Point, covariance: Array) -> tuple[FittedTerm, ...]:
    sigma = np.sqrt(np.maximum(np.diag(covariance)[11:], 0.0))
    out, at = [], 0
    for term in problem.terms:
        part = slice(at, at + len(term.value))
        out.append(replace(term, value=point.values[part], deviation=sigma[part]))
        at = part.stop
    return tuple(out)


def _at(
    problem: FitProblem,
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


def _with_own_columns(
    problem: FitProblem, point: _Point, cost: float, last: _Point | None
) -> _Point | None:
    """The point with its terms' columns of its own context, where it can go on from there.

    Columns of the context before are much too cheap where a term has moved the calibration far.
    last: the point for which that was done before; where this one costs more the descent is over
    """
    if not problem.terms or point is last:
        return None
    afresh = _at(problem, point.model, point.values, point)
    lower = last is None or _cost(problem, afresh) < _cost(problem, last)
    return afresh if lower and _cost(problem, afresh) > cost + _STALE else None


def _contributions(
    problem: FitProblem, columns: tuple[Columns, ...], values: Array
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


def _normal(problem: FitProblem, point: _Point) -> tuple[Array, Array, Array]:
    """Gradient (11 + p,) downhill, information of the data (11 + p, 11 + p), of the prior."""
    X = sensitivities(point.filtered, nuisance_columns(point.filtered))
    parts = [X, *(sensitivities(point.filtered, mine) for mine in point.columns)]
    flat = np.concatenate(parts, axis=2).reshape(-1, 11 + len(point.values))
    prior = problem.weight
    gradient = flat.T @ point.filtered.whitened.ravel() - prior * _from_prior(problem, point)
    return gradient, flat.T @ flat, prior


def _from_prior(problem: FitProblem, point: _Point) -> Array:
    m = point.model
    off = np.asarray(m.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    here = np.concatenate([soft, m.hard_iron_gauss, m.gyro_bias_rad_s, point.values])
    return np.asarray(here - problem.mean)


def _cost(problem: FitProblem, point: _Point) -> float:
    prior = float(np.sum(problem.weight * _from_prior(problem, point) ** 2))
    return 0.5 * (float(np.sum(point.filtered.whitened**2)) + prior)


def _taken(
    problem: FitProblem, point: _Point, step: Array, cost: float, near: bool
) -> _Point | None:
    """The longest of step, step / 4 and step / 16 that lowers the cost; None where none does.

    near: the step is so short that the gains stay as they are
    """
    for halving in range(_HALVINGS):
        part = step / 4**halving
        model = moved(point.model, part)
        if not np.isfinite(part).all():
            continue
        if np.linalg.eigvalsh(model.soft_iron)[0] < _SMALLEST_EIGENVALUE:
            continue
        held = point.filtered if near else None
        try:
            new = _at(problem, model, point.values + part[11:], point, held)
        except np.linalg.LinAlgError:  # a step too far
            continue
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
