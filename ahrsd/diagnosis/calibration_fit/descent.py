"""Descent of a calibration to what explains a recording best, noise as it is.

Gauss-Newton on the whitened innovations, the gains held within a step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ahrsd.diagnosis.calibration_fit.prior import Prior
from ahrsd.diagnosis.innovation_filter.context import build_context
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.model import Context, NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

_DONE = 0.05  # largest step in standard deviations
_NEAR = 3.0  # largest step in standard deviations behind which the gains are as before it
_HALVINGS = 3
_SMALLEST_EIGENVALUE = 0.05  # of the soft iron: beyond, no calibration


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
            new = run_filter(problem.track, model, held=point if near else None)
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
