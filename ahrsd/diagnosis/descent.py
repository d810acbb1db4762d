"""Descent of calibration and named terms to what explains a recording best, noise as it is.

Gauss-Newton on the whitened innovations.  The columns of terms are built from the context of the
point before; where nothing lower is found so, from the point's own.

What the gyro's noise turns up lies across the field of the model, whatever that is: iron that moves
takes it along, and the gains and the frame of the whitening with it.  With the gains held it would
stand out of that frame: the iron looks much better known than it is (five times and more where the
sensor hardly tilts), and the descent goes, and stops, beside the lowest point.  So the derivatives
by the iron are of what the filter whitens with the gains of its own, as differences.

Where the gyro turns up next to nothing the gains stay within a step: there the squares alone, with
gains of their own, would favour whatever makes the innovations' covariance large.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ahrsd.diagnosis.context import Given, build_context
from ahrsd.diagnosis.innovation import (
    TRACELESS,
    Filtered,
    bearings,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.prior import PRIOR, Prior
from ahrsd.diagnosis.thin import turned_up
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Columns, Context, NullModel
from ahrsd.samples import Array

_DONE = 0.05  # largest step in standard deviations
_NEAR = 3.0  # largest step in standard deviations behind which the gains move as before it
#: field that the gyro's noise of a step turns up over the magnetometer's, from which gains move
_TURNED_UP = 0.1
_BESIDE = 1e-3  # standard deviations by which the iron is moved to see how
_STALE = 1.0  # nats that a point costs more with columns of its own context, to go on from there
_HALVINGS = 3
_IRON = 8  # of the calibration's columns: soft and hard iron
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
    lever: Array | None = None
    loud = turned_up(problem.track, model) > _TURNED_UP
    covariance: Array = np.zeros((11 + len(values), 11 + len(values)))
    while count < steps and not converged:
        count += 1
        if loud and lever is None:
            lever = _of_gains(point.filtered, point.terms_mag, point.terms_gyro)
        gradient, data, prior = _normal(problem, point, lever)
        covariance = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        if not np.all(np.diag(covariance) > 0.0):  # singular to rounding: no step is to be trusted
            break
        step = covariance @ gradient
        largest = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        new = _taken(problem, point, step, cost, near=largest < _NEAR, loud=loud)
        afresh = _with_own_columns(problem, point, cost, own) if new is None else None
        if afresh is not None:
            point = own = afresh
            lever = None
            cost = _cost(problem, afresh)
            continue
        if new is None:
            converged = True  # nothing lower: the noise of the linearisation is reached
            break
        gained = cost - _cost(problem, new)
        point, cost = new, cost - gained
        lever = lever if largest < _NEAR else None
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


def _normal(problem: FitProblem, point: _Point, lever: Array | None) -> tuple[Array, Array, Array]:
    """Gradient (11 + p,) downhill, information of the data (11 + p, 11 + p), of the prior.

    lever: of `_of_gains`, here or near; None where the gains stay
    """
    X = sensitivities(point.filtered, nuisance_columns(point.filtered))
    if lever is not None:
        X[:, :, :_IRON] += lever
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
    problem: FitProblem, point: _Point, step: Array, cost: float, *, near: bool, loud: bool
) -> _Point | None:
    """The longest of step, step / 4 and step / 16 that lowers the cost; None where none does.

    near: the step is so short that the gains stay as they are, but where the gyro is `loud`
    """
    gains = point.filtered if near and not loud else None
    for halving in range(_HALVINGS):
        part = step / 4**halving
        if not np.isfinite(part).all():
            continue
        try:
            model = (moved_along if loud else moved)(point.model, part)
            if np.linalg.eigvalsh(model.soft_iron)[0] < _SMALLEST_EIGENVALUE:
                continue
            new = _at(problem, model, point.values + part[11:], point, gains)
        except np.linalg.LinAlgError:  # a step too far
            continue
        if _cost(problem, new) <= cost * (1 + 1e-9):
            return new
    return None


def _of_gains(
    filtered: Filtered, terms_mag: Array | None = None, terms_gyro: Array | None = None
) -> Array:
    """(N, 3, 8) what gains that move with the iron add to the sensitivities by it.

    terms_*: that the run was made with
    """
    X = sensitivities(filtered, nuisance_columns(filtered))[:, :, :_IRON]
    known = np.maximum(np.sum(X**2, axis=(0, 1)), PRIOR[:_IRON] ** -2.0)
    out = np.empty_like(X)
    for k, size in enumerate(_BESIDE / np.sqrt(known)):
        model = moved_along(filtered.model, size * np.eye(11)[k])
        beside = run_filter(filtered.track, model, terms_mag, terms_gyro, sensitive=False)
        out[:, :, k] = (filtered.whitened - beside.whitened) / size
    return out - X


def moved(model: NullModel, step: Array) -> NullModel:
    """A model with its 11 numbers of the calibration changed by step (11,) or more."""
    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", step[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + step[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )


def moved_along(model: NullModel, step: Array) -> NullModel:
    """The same to first order, on a straight line of the iron's quadric.

    (I + q.T, u) = (A^-2, A^-2 b) of trace 3: there the size of the field, |m|^2 + q.(m^T T m) -
    2 m.u, is linear, and a long step stays in the valley of calibrations under which it is the same
    all along.  Where that line leaves the ellipsoids, iron moves straight itself.
    """
    C = np.linalg.inv(model.soft_iron)
    quadric = C @ C
    more = np.einsum("a,aij->ij", step[:5], TRACELESS)
    bent = -C @ more @ quadric
    bent = bent + bent.T
    scale = 3.0 / np.trace(quadric)
    change = scale * (bent - quadric * np.trace(bent) / np.trace(quadric))
    quadric = scale * quadric
    centre = quadric @ (model.hard_iron_gauss + step[5:8]) + change @ model.hard_iron_gauss
    values, vectors = np.linalg.eigh(quadric + change)
    if values[0] <= 0.0:
        return moved(model, step)
    root = (vectors / np.sqrt(values)) @ vectors.T
    return replace(
        model,
        soft_iron=root * 3.0 / np.trace(root),
        hard_iron_gauss=np.linalg.solve(quadric + change, centre),
        gyro_bias_rad_s=model.gyro_bias_rad_s + step[8:11],
    )
