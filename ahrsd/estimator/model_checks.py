"""Checks of a settled window against the model: changed iron, turned axes, structured residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.estimator import chain, locked
from ahrsd.estimator.epoch import (
    GYRO_AMONG_IMPERFECTIONS,
    LOCKED,
    TURN,
    InformationStack,
    InstrumentCorrection,
    LockedInformation,
    WindowEpoch,
    disagreement,
    estimate_instrument,
    prior_quadratic,
)
from ahrsd.estimator.graph import Graph, retract
from ahrsd.samples import Array

# -- A change of the iron --------------------------------------------------------------------------
#
# The iron has changed if an epoch contradicts a well-known calibration, or if two parts of the data
# do.
#
# A passing magnet disturbs some rows. A magnet that stays with the sensor disturbs all of them, and
# another hard iron explains the residuals. A field that differs from place to place does neither.
#
# A change before the answer was well known leaves a mixture with which no epoch agrees. There, a
# second hard iron from some epoch on must remove most of the disagreement, more than the
# imperfections of an instrument can (`epoch.estimate_instrument`): over few epochs a lag of the
# field looks like a change.
#
# Otherwise, earlier and later data may still require different irons by more than the covariance
# allows (a drift, a change with other errors, two places). The answer then lies in between, and its
# covariance is widened accordingly.

_HARD = slice(6, 9)
# of a second hard iron; factor by which the misfit must fall
_CHI2, _MISFIT_RATIO = 100.0, 3.0
_LEAST_EPOCHS = 2  # before and after: a single epoch may have been at another place
_LEAST_CHANGE = 0.03  # of the field: a smaller change may be due to place
_CHANCE = 12.0  # chi squared of the best time by chance, in units of the misfit


def change_message(at_s: float) -> str:
    """The line for the log about a change of the iron at that time."""
    return f"the iron changed at about {at_s:.0f} s: calibrated anew from there"


@dataclass(frozen=True, slots=True)
class IronChange:
    """Comparison of the earlier with the later epochs.

    first: index of the first epoch after the change; None if there is none. variance_factor: factor
    by which their difference widens the variance of the answer, at least 1.
    """

    first: int | None
    variance_factor: float


def find_iron_change(
    epochs: InformationStack, graph: Graph, sigma_bias: float, sigma_b: float
) -> IronChange | None:
    """Test for a second hard iron from some epoch on; None if there are too few epochs.

    epochs: their quadratics (`epoch.instrument_quadratics`) at a settled calibration. sigma_bias
    (rad/s) and sigma_b (gauss): prior sigmas of the gyro bias and of a change.
    """
    Hs, gs = epochs
    if len(Hs) < 2 * _LEAST_EPOCHS:
        return None
    H, g = prior_quadratic(graph, sigma_bias)
    H, g = H + Hs.sum(axis=0), g + gs.sum(axis=0)
    steps, chi2 = _second_iron_steps(H, g, Hs, gs, np.eye(3) * graph.temper / sigma_b**2)
    first = int(np.argmax(chi2[_LEAST_EPOCHS - 1 : len(Hs) - _LEAST_EPOCHS])) + _LEAST_EPOCHS
    step, change = steps[first - 1, :-3], steps[first - 1, -3:]
    steps_by_epoch = np.tile(step, (len(Hs), 1))
    steps_by_epoch[first:, _HARD] += change
    misfit_single = disagreement(Hs, gs, -np.linalg.solve(H, g))
    misfit_second = max(1.0, disagreement(Hs, gs, steps_by_epoch))
    size = float(np.cbrt(np.linalg.det(chain.symmetric(graph.c[:6]))))
    is_change = (
        chi2[first - 1] > _CHI2 * misfit_second and misfit_single > _MISFIT_RATIO * misfit_second
    )
    is_change = is_change and bool(np.linalg.norm(change) > _LEAST_CHANGE * size)
    variance_factor = max(1.0, float(np.max(chi2)) / (graph.temper * _CHANCE))
    return IronChange(first if is_change else None, variance_factor)


def _second_iron_steps(
    H: Array, g: Array, Hs: Array, gs: Array, prior: Array
) -> tuple[Array, Array]:
    """Steps (N - 1, 20) and chi squared (N - 1,) of a second hard iron from each epoch on."""
    late_H = np.cumsum(Hs[:0:-1], axis=0)[::-1]
    late_g = np.cumsum(gs[:0:-1], axis=0)[::-1]
    n = len(g)
    both = np.empty((len(late_H), n + 3, n + 3))
    both[:, :n, :n] = H
    both[:, :n, n:], both[:, n:, :n] = late_H[:, :, _HARD], late_H[:, _HARD]
    both[:, n:, n:] = late_H[:, _HARD, _HARD] + prior
    gradient = np.column_stack([np.broadcast_to(g, (len(late_g), n)), late_g[:, _HARD]])
    covariance = np.linalg.inv(both)
    steps = -(covariance @ gradient[:, :, None])[:, :, 0]
    change = steps[:, n:, None]
    return steps, np.sum(change * np.linalg.solve(covariance[:, n:, n:], change), axis=(1, 2))


# -- Turned axes -----------------------------------------------------------------------------------
#
# Is the magnetometer turned against the gyro? This is the antisymmetric part of a 3x3 correction.
#
# The estimator's A is symmetric: it assumes that the magnetometer's axes are those of the gyro. The
# evidence against this is the rotation that the epochs require (`epoch.estimate_instrument`), in
# sigmas.

_EVIDENCE = 30.0  # chi squared with 3 degrees of freedom: one in a million by chance
_MISFIT = 5.0
_WORTH_RAD = 0.002  # a smaller rotation is not worth a correction


@dataclass(frozen=True, slots=True, eq=False)
class Misalignment:
    """Rotation vector theta (3,) in rad from the gyro's to the magnetometer's axes.

    covariance (3, 3); chi2: theta in sigmas, squared; misfit: remaining disagreement of the epochs,
    since a lag or a field that is not uniform can look like a rotation; correction: C (3, 3), det C
    = 1, and b that include theta and give the field in the gyro's axes.
    """

    rotation_rad: Array
    covariance: Array
    chi2: float
    misfit: float
    correction: Affine

    @property
    def significant(self) -> bool:
        """Whether the full correction is preferable to the symmetric one."""
        worth = float(np.linalg.norm(self.rotation_rad)) > _WORTH_RAD
        return worth and self.chi2 > _EVIDENCE and self.misfit < _MISFIT


def estimate_misalignment(
    epochs: InformationStack, graph: Graph, sigma_bias: float, corrected_rad: Array
) -> Misalignment:
    """From the quadratics of a settled window. LinAlgError if the motion does not determine it.

    corrected_rad (3,): turn that is removed from the gyro's angles already.
    """
    found = estimate_instrument(epochs, graph, sigma_bias)
    theta, spread = corrected_rad + found.step[TURN], found.covariance[TURN, TURN]
    c = retract(graph.c, found.step[:9], graph.moments)
    C = so3.exp(-theta[None])[0] @ np.linalg.inv(chain.symmetric(c[:6]))
    full = Affine(C / np.cbrt(np.linalg.det(C)), c[6:9].copy())
    chi2 = float(theta @ np.linalg.solve(spread, theta))
    return Misalignment(theta, spread, chi2, found.misfit, full)


# -- Residuals that follow attitude, rate or time --------------------------------------------------
#
# A score test for each component of `locked`, the columns that `diagnose` uses for the ordinary
# residuals of real recordings. It is made in the directions that the motion determines, given iron,
# bias and all imperfections of instrument and place.
#
# Chance: under the null hypothesis the whitened scores z at the answer have the variance `chance`
# each. It is the disagreement of the epochs once the component is in the model, in all of its
# directions or in a single one, whichever is larger: slow noise, and a field that differs at each
# visit, make epochs disagree; an effect locked to the attitude does not. The variance is known with
# the remaining degrees of freedom, so the likelihood is Student's. If these are fewer than the
# tested directions, there is no test.
#
# Size: each coefficient has the deviation t times the ordinary one, with t lognormal as in real
# recordings, or the component is absent (`_PRIOR_PROBABILITY`). In a direction with information l,
# in units of the ordinary deviation, the score has the variance chance + t^2 l. The posterior mean
# and covariance of the most probable component are an error of the answer, like the imperfections
# of an instrument. They count only as far as they exceed the widening by misfit.

_MODES = 3  # half waves over the window: slow compared with an epoch
_SIZES = np.exp(np.arange(-4.0, 3.0))  # t
_LOG_SPREAD = 2.0  # of log t: `diagnosis/priors.py`, 1.5 to 2.2
_LEAST_INFORMATION = 1e-6  # of a determined direction, over that of the best one
_PRIOR_PROBABILITY = 1.0 / 20.0  # `diagnosis/priors.py: COURSE`
_REPORT_NATS = 12.0  # `diagnosis/priors.py: ODDS_REAL`: the likelihood is not exact
_FOLLOWS = {"attitude": "the attitude", "rate": "the rate of turn", "time": "the time"}


@dataclass(frozen=True, slots=True, eq=False)
class ResidualComponent:
    """The most probable component of the residuals.

    key: of `LOCKED`; nats: log odds against the null; size_gauss: rms of its effect on the field in
    the determined directions; added: to the covariance (12, 12) of [M, b, w_b].
    """

    key: str
    nats: float
    size_gauss: float
    added: Array

    @property
    def words(self) -> str:
        """What it is and what to do; empty if it may be chance."""
        if not self.nats > _REPORT_NATS:
            return ""
        return (
            f"the residual follows {_FOLLOWS[self.key]}: {1e3 * self.size_gauss:.2g} mG; run "
            "`ahrsd diagnose` on the recording"
        )

    @property
    def cause(self) -> str:
        """The same as the main cause of a large sigma."""
        return (
            f"the residual follows {_FOLLOWS[self.key]}: run `ahrsd diagnose` on the recording to "
            "find the cause"
        )


def widen_covariance(
    covariance: Array, explained: Array, component: ResidualComponent | None
) -> Array:
    """The answer's covariance (12, 12), widened so that it includes the error by `component`.

    explained (12, 12): the covariance if the model explained the data. What misfit adds to it
    already counts as part of that error.
    """
    if component is None:
        return covariance
    scale = np.sqrt(np.diag(covariance))
    size = np.outer(scale, scale)
    additional = (component.added - (covariance - explained)) / size
    values, vectors = np.linalg.eigh((additional + additional.T) / 2)
    return np.asarray(covariance + size * ((vectors * np.clip(values, 0.0, None)) @ vectors.T))


def find_residual_component(
    epochs: Sequence[WindowEpoch],
    graph: Graph,
    prior_sigmas: tuple[float, Array],
    correction: InstrumentCorrection,
    noise_gauss: float,
) -> ResidualComponent | None:
    """The most probable component in the epochs that `linearise_locked` linearised.

    None if no component has positive log odds, or if there are too few epochs.

    prior_sigmas: of the gyro bias (rad/s), and (16,) of the instrument's imperfections and the
    place, each the largest one that is possible; noise_gauss: of one reading. LinAlgError: the
    motion determines too little.
    """
    moving = [epoch for epoch in epochs if epoch.locked is not None]
    if len(moving) < 2:
        return None
    moving_locked = [(epoch, epoch.locked) for epoch in moving if epoch.locked is not None]
    known = [one for _, one in moving_locked]
    H = np.array([one.information.H for one in known])
    g = np.array(
        [one.information.at(graph.c, graph.nodes[epoch.a].bias) for epoch, one in moving_locked]
    )
    sigma_bias, sigmas = prior_sigmas
    n = 12 + len(sigmas)
    prior, pull = np.zeros((n, n)), np.zeros(n)
    prior_H, prior_g = prior_quadratic(graph, sigma_bias)
    prior[:12, :12], pull[:12] = prior_H[:12, :12], prior_g[:12]
    prior[12:, 12:] = np.diag(graph.temper / np.square(sigmas))
    pull[12 + GYRO_AMONG_IMPERFECTIONS] = (
        graph.temper / np.square(sigmas[GYRO_AMONG_IMPERFECTIONS]) * correction.gyro_parameters
    )
    rows = sum(epoch.data.steps for epoch in moving)
    time_s = np.array([float(epoch.data.time_s[[0, -1]].mean()) for epoch in moving])
    modes = locked.COURSE * locked.cosine_modes(time_s, _MODES)
    found = []
    for key in LOCKED:
        column = modes if key == "time" else np.ones((len(moving), 1))
        scores = _ComponentScores.of(key, (H, g), known, column, (prior, pull))
        if scores is not None:
            found.append(scores.posterior(key, noise_gauss / np.sqrt(rows)))
    best = max(found, key=lambda one: one.nats, default=None)
    return best if best is not None and best.nats > 0.0 else None


@dataclass(frozen=True, slots=True, eq=False)
class _ComponentScores:
    """Score test of a component, in the k directions that the epochs determine.

    scores (k,): whitened, marginalised over all other parameters; information (k,): in units of the
    ordinary size; chance (k,): variance of the scores under the null, known with `freedom` degrees
    of freedom; by_one (12, k): change of [M, b, w_b] per unit of each.
    """

    scores: Array
    information: Array
    chance: Array
    freedom: float
    by_one: Array

    @staticmethod
    def of(
        key: str,
        epochs: InformationStack,
        known: Sequence[LockedInformation],
        weights: Array,
        before: tuple[Array, Array],
    ) -> _ComponentScores | None:
        """The scores of a component of `LOCKED`. None if the epochs leave too few degrees of
        freedom.

        weights (N, m): those of the coefficients in each epoch, m modes in time; before: quadratic
        of the prior.
        """
        (H, g), at, others = epochs, LOCKED[key], slice(0, len(before[1]))
        own_H, own_g = H[:, at[:, None], at], g[:, at]
        to_others, modes = H[:, at, others], weights.shape[1]
        cross = np.tensordot(weights, to_others, (0, 0)).reshape(modes * len(at), -1).T
        pairs = weights[:, :, None] * weights[:, None]
        own = np.tensordot(pairs, own_H, (0, 0)).transpose(0, 2, 1, 3).reshape(cross.shape[1], -1)
        gradient = (weights.T @ own_g).ravel()
        others_H, others_g = H[:, others, others].sum(axis=0) + before[0], g[:, others].sum(axis=0)
        others_g = others_g + before[1]
        scale = 1.0 / np.sqrt(np.diag(others_H))
        solved = partial(np.linalg.solve, others_H * np.outer(scale, scale))
        gain = scale[:, None] * solved(scale[:, None] * cross)
        values, vectors = np.linalg.eigh(own - cross.T @ gain)
        determined = values > _LEAST_INFORMATION * max(float(values[-1]), 1e-30)
        values, vectors = values[determined], vectors[:, determined]
        score = vectors.T @ (gradient - gain.T @ others_g)
        step = -vectors @ (score / values)
        others_step = -scale * solved(scale * (others_g + cross @ step))
        each = weights @ step.reshape(modes, -1)
        residual_g = own_g + to_others @ others_step + chain.matrix_vector(own_H, each)
        roots = np.array([one.roots[key] for one in known])
        by_others = (roots @ to_others).reshape(-1, len(scale)) * scale
        fitted = float(np.sum(by_others.T * solved(by_others.T)))
        freedom = float(sum(one.freedom[key] for one in known)) - len(values) - fitted
        if freedom < len(values):
            return None
        pooled_variance = float(np.sum(chain.matrix_vector(roots, residual_g) ** 2)) / freedom
        epoch_vectors = np.tensordot(weights, vectors.reshape(modes, len(at), -1), (1, 0))
        squared_by_direction = (
            chain.matrix_vector(np.swapaxes(epoch_vectors, 1, 2), residual_g) ** 2
        )
        direction_information = np.sum(epoch_vectors * (own_H @ epoch_vectors), axis=(0, 1))
        variance_by_direction = (
            squared_by_direction.sum(axis=0)
            / direction_information
            * len(known)
            / max(len(known) - 1, 1)
        )
        chance = np.maximum(pooled_variance, variance_by_direction)
        return _ComponentScores(
            score / np.sqrt(values), values, chance, freedom, -(gain[:12] @ vectors)
        )

    def posterior(self, key: str, of_one: float) -> ResidualComponent:
        """The component with its log odds and its effect; of_one (gauss): rms of a component of
        unit size.
        """
        variance = _SIZES[:, None] ** 2
        size_prior = np.exp(-0.5 * (np.log(_SIZES) / _LOG_SPREAD) ** 2)
        size_prior /= size_prior.sum()
        signal_to_chance = variance * self.information / self.chance
        squares = self.scores**2 / self.chance
        known = self.freedom + len(squares)
        null_log = np.log1p(squares.sum() / self.freedom)
        component_log = np.log1p(np.sum(squares / (1.0 + signal_to_chance), axis=1) / self.freedom)
        nats = 0.5 * (
            known * (null_log - component_log) - np.sum(np.log1p(signal_to_chance), axis=1)
        )
        most = float(nats.max())
        weights = size_prior * np.exp(nats - most)
        odds = most + float(np.log(weights.sum()))
        null_odds = (1.0 / _PRIOR_PROBABILITY - 1.0) * float(np.exp(-np.clip(odds, -50.0, 50.0)))
        weights *= 1.0 / weights.sum() / (1.0 + null_odds)
        mean = (
            -np.sqrt(self.information)
            * self.scores
            * variance
            / (self.chance * (1.0 + signal_to_chance))
        )
        spread = (
            np.diag(weights @ (variance / (1.0 + signal_to_chance))) + (weights * mean.T) @ mean
        )
        added = self.by_one @ spread @ self.by_one.T
        excess = max(float(np.sum(self.scores**2 - self.chance)), 0.0)
        return ResidualComponent(key, odds, of_one * float(np.sqrt(excess)), (added + added.T) / 2)
