"""Whether a settled window contradicts the model: an iron that changed, axes that are turned, or
something that is left over and locked to attitude, rate or time."""

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
# Whether the iron has changed: an epoch contradicts a sure calibration, or two parts of all do.
#
# A magnet that passes disturbs some rows; one that stays with the sensor disturbs them all, and
# another hard iron explains what it does. A field that differs from place to place does neither.
#
# A change before the answer was sure leaves a mixture that no epoch agrees with. There, a second
# hard iron from some epoch on must take most of the disagreement away, more than what an instrument
# may have besides iron and bias (`epoch.instrument`): a lag of the field looks like a change to few
# epochs.
#
# Where it does not, but earlier and later data still ask for different irons by more than the
# covariance allows (a drift, a change amid other trouble, two places), the answer is in between,
# and known no better than that.

_HARD = slice(6, 9)
_CHI2, _MISFIT_RATIO = (
    100.0,
    3.0,
)  # of a second hard iron; times by which the disagreement must fall
_LEAST_EPOCHS = 2  # epochs before and behind: a single one may have been somewhere else
_LEAST_CHANGE = 0.03  # of the field: a smaller change may be a place
_CHANCE = 12.0  # chi squared of the best of all times, in units of the misfit, that chance makes


def change_message(at_s: float) -> str:
    """The line for the log about a change of the iron at that time."""
    return f"the iron changed at about {at_s:.0f} s: calibrated anew from there"


@dataclass(frozen=True, slots=True)
class IronChange:
    """What two parts of the data say of each other.

    first: which of the epochs is the first of those that another hard iron explains; None if none
        is
    parted: by how much the variance of the answer is larger for what they differ, at least 1
    """

    first: int | None
    variance_factor: float


def find_iron_change(
    epochs: InformationStack, graph: Graph, sigma_bias: float, sigma_b: float
) -> IronChange | None:
    """Whether a second hard iron is asked for from some epoch on; None for too few epochs.

    epochs: what they say (`epoch.informations`) at a settled calibration, linear around it.
    sigma_bias (rad/s) and sigma_b (gauss): what is believed of gyro bias and of a change
    without data.
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
# Is the magnetometer turned against the gyro?  The antisymmetric part of a 3x3 correction.
#
# The estimator's A is symmetric: the magnetometer's axes are taken to be the gyro's. What the
# epochs ask for beyond that (`epoch.instrument`), in sigmas, is the evidence.

_EVIDENCE = 30.0  # chi squared with 3 degrees of freedom: once in a million where there is none
_MISFIT = 5.0
_WORTH_RAD = 0.002  # less is not worth a correction of its own


@dataclass(frozen=True, slots=True, eq=False)
class Misalignment:
    """Rotation vector theta (3,) in rad from the gyro's to the magnetometer's axes.

    covariance (3, 3), chi2: theta in sigmas, squared; misfit: how much the epochs still disagree,
    because a lag or a wandering field can look like a rotation; correction: C (3, 3) and b that
    include it, det C = 1, and give the field in the gyro's axes.
    """

    rotation_rad: Array
    covariance: Array
    chi2: float
    misfit: float
    correction: Affine

    @property
    def significant(self) -> bool:
        """Whether the full correction should be preferred to the symmetric one."""
        worth = float(np.linalg.norm(self.rotation_rad)) > _WORTH_RAD
        return worth and self.chi2 > _EVIDENCE and self.misfit < _MISFIT


def estimate_misalignment(
    epochs: InformationStack, graph: Graph, sigma_bias: float, corrected_rad: Array
) -> Misalignment:
    """From what the epochs of a settled window say.  LinAlgError where the motion does not tell.

    taken_rad (3,): turn that is taken out of the gyro's angles already
    """
    found = estimate_instrument(epochs, graph, sigma_bias)
    theta, spread = corrected_rad + found.step[TURN], found.covariance[TURN, TURN]
    c = retract(graph.c, found.step[:9], graph.moments)
    C = so3.exp(-theta[None])[0] @ np.linalg.inv(chain.symmetric(c[:6]))
    full = Affine(C / np.cbrt(np.linalg.det(C)), c[6:9].copy())
    chi2 = float(theta @ np.linalg.solve(spread, theta))
    return Misalignment(theta, spread, chi2, found.misfit, full)


# -- What is left over, locked to attitude, rate or time -------------------------------------------
#
# What the epochs ask for beyond iron, bias and whatever an instrument and a place may have, against
# the columns that `diagnose` has for what real recordings leave (`locked`): a score test for each
# component, in the directions of it that the motion shows.
#
# Chance: at the answer its whitened scores z have the variance `chance` each, were nothing there.
# It is what the epochs disagree about among themselves once the component is in, in all of its
# directions or in that one, whichever is more: a field that is another at each visit, and noise
# that is slow, make them disagree, and what is locked to the attitude does not. It is known by as
# many degrees of freedom as are left, so that the test is Student's; where there are fewer than
# directions that are asked, nothing is said.
#
# Size: each coefficient has the deviation t times what is ordinary, t lognormal as real recordings
# have it, or nothing is there (`_THERE`). A direction in which the epochs tell l, in units of what
# is ordinary, then has scores of the variance chance + t^2 l. So a component that is likelier than
# nothing has a posterior: what it is found to be, and what the data leave open of it, is an error
# of the answer, as it is for an instrument's imperfections. What that does to an answer that is
# wider already for what epochs disagree about counts only as far as it is more.

_MODES = 3  # half waves over the window: slower than epochs are long
_SIZES = np.exp(np.arange(-4.0, 3.0))  # times what is ordinary
_LOG_SPREAD = 2.0  # of their logarithm: `diagnosis/priors.py`, 1.5 to 2.2
_LEAST_INFORMATION = 1e-6  # information of a direction over that of the best one: less is none
_PRIOR_PROBABILITY = 1.0 / 20.0  # probability before the data; `diagnosis/priors.py: COURSE`
_REPORT_NATS = 12.0  # nats; `diagnosis/priors.py: ODDS_REAL`: the laws are not exact
_FOLLOWS = {"attitude": "the attitude", "rate": "the rate of turn", "time": "the time"}


@dataclass(frozen=True, slots=True, eq=False)
class ResidualComponent:
    """The likeliest component of what is left over.

    key: of `LOCKED`; nats: by which it is likelier than nothing; size_gauss: rms of what it makes
    of the field where it shows; added: to the covariance (12, 12) of [M, b, w_b]
    """

    key: str
    nats: float
    size_gauss: float
    added: Array

    @property
    def words(self) -> str:
        """What it is and what to do; empty: it may be chance."""
        if not self.nats > _REPORT_NATS:
            return ""
        return (
            f"what is left follows {_FOLLOWS[self.key]}: {1e3 * self.size_gauss:.2g} mG; run "
            "`ahrsd diagnose` on the recording"
        )

    @property
    def cause(self) -> str:
        """The same as what makes the most of a sigma."""
        return (
            f"what the model leaves over follows {_FOLLOWS[self.key]}: `ahrsd diagnose` of the "
            "recording says what it is"
        )


def widen_covariance(covariance: Array, plain: Array, left: ResidualComponent | None) -> Array:
    """covariance (12, 12), which is wider than `plain` for what epochs disagree about, and no less
    wide than for what is left over."""
    if left is None:
        return covariance
    scale = np.sqrt(np.diag(covariance))
    size = np.outer(scale, scale)
    more = (left.added - (covariance - plain)) / size
    values, vectors = np.linalg.eigh((more + more.T) / 2)
    return np.asarray(covariance + size * ((vectors * np.clip(values, 0.0, None)) @ vectors.T))


def find_residual_component(
    epochs: Sequence[WindowEpoch],
    graph: Graph,
    prior_sigmas: tuple[float, Array],
    correction: InstrumentCorrection,
    noise_gauss: float,
) -> ResidualComponent | None:
    """By those epochs of a window that `linearise_locked` saw; None where nothing is likelier than
    nothing, or too few are there.

    believed_of: sigma of the gyro's bias (rad/s), and of the instrument's imperfections and the
    place (16,), the largest that may be; noise_gauss: of one reading. LinAlgError: the motion
    tells too little.
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
    modes = locked.COURSE * locked.courses(time_s, _MODES)
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
    """What epochs ask of a component, in the k directions of it that they tell.

    scores (k,): whitened by all that else may be; told (k,): information in units of what is
    ordinary; chance (k,): variance of the scores were nothing there, known by so many degrees of
    freedom; by_one (12, k): what one of each does to [M, b, w_b]
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
        course: Array,
        before: tuple[Array, Array],
    ) -> _ComponentScores | None:
        """course (N, m): by how much each coefficient of the component counts in each epoch, m
        times; before: what is believed of all else. None where the epochs can hardly
        disagree."""
        (H, g), at, others = epochs, LOCKED[key], slice(0, len(before[1]))
        own_H, own_g = H[:, at[:, None], at], g[:, at]
        to_others, modes = H[:, at, others], course.shape[1]
        cross = np.tensordot(course, to_others, (0, 0)).reshape(modes * len(at), -1).T
        pairs = course[:, :, None] * course[:, None]
        own = np.tensordot(pairs, own_H, (0, 0)).transpose(0, 2, 1, 3).reshape(cross.shape[1], -1)
        gradient = (course.T @ own_g).ravel()
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
        each = course @ step.reshape(modes, -1)
        residual_g = own_g + to_others @ others_step + chain.times(own_H, each)
        roots = np.array([one.roots[key] for one in known])
        by_others = (roots @ to_others).reshape(-1, len(scale)) * scale
        fitted = float(np.sum(by_others.T * solved(by_others.T)))
        freedom = float(sum(one.freedom[key] for one in known)) - len(values) - fitted
        if freedom < len(values):
            return None
        pooled_variance = float(np.sum(chain.times(roots, residual_g) ** 2)) / freedom
        epoch_vectors = np.tensordot(course, vectors.reshape(modes, len(at), -1), (1, 0))
        squared_by_direction = chain.times(np.swapaxes(epoch_vectors, 1, 2), residual_g) ** 2
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
        """of_one (gauss): rms of a component that asks for one."""
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
