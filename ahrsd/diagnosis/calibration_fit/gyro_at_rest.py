"""A gyro at rest reads its bias: how the bias changes, without the magnetometer.

At rest the field contains almost no information on the gyro (the calibration would explain any slow
turn), but the gyro's readings do.  Their means over a second are regressed on possible causes of a
bias change.  The model includes a random walk of an ordinary gyro's size and of a few times that,
weighted by likelihood.  Warm-up, time since power-on and a random walk look nearly alike: they are
reported as one set of alternatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import logsumexp

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Finding, Share, Value, Where
from ahrsd.diagnosis.answer.text import separating_manoeuvre
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.innovation_filter.regression_statistics import (
    log_bayes_factor,
    posterior_probabilities,
    projected_score,
    solve_semidefinite,
)
from ahrsd.diagnosis.model import Context
from ahrsd.samples import Array

HARDLY_TURNED = (
    "the sensor hardly turned: only the gyro, a logged current, switches and alternating fields "
    "can be found"
)
#: sizes of the walk that are averaged over, rad/s per square root of a second
WALKS = priors.ORDINARY_WALK_RAD_S_SQRT_S * np.array([1.0, 2.0, 4.0])


@dataclass(frozen=True, slots=True, eq=False)
class _StillSeconds:
    """Still seconds.

    time_s: (n,);  mean: (n, 3) rad/s;  noise: (3,) of a mean
    second: (N,) second of each row;  chosen: (n,) the still seconds
    """

    time_s: Array
    mean: Array
    noise: Array
    second: NDArray[np.intp]
    chosen: NDArray[np.intp]

    def means(self, values: Array) -> Array:
        """(n, ...) means of (N, ...) over the still seconds."""
        return np.stack([values[self.second == k].mean(axis=0) for k in self.chosen])


def field_hardly_turns(fit: NullFit) -> bool:
    """Whether the field hardly turns in the sensor: then only effects of the gyro can be found."""
    field = fit.filtered.nominal_b
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    return bool(1.0 - np.linalg.norm(unit.mean(axis=0)) < priors.REST_SPREAD)


def effects_testable_at_rest(
    library: Mapping[str, Effect], found_at_rest: Sequence[Finding]
) -> Mapping[str, Effect]:
    """Effects that can be found while the field hardly turns.

    They are those of the gyro, those that ride with the sensor, and quick ones.
    found_at_rest: findings from the gyro's own readings; causes of these are not tested again
    The delays stay: their rows make the column that a model always has.
    """
    tested = {
        k: one for k, one in library.items() if not (found_at_rest and k in priors.REST_CAUSES)
    }
    return {k: e for k, e in tested.items() if e.family == "gyro" or e.rides or e.quick or e.delay}


def find_bias_drift_at_rest(context: Context, library: Mapping[str, Effect]) -> tuple[Finding, ...]:
    """The effect that changes the bias of a gyro at rest, with its alternatives; or nothing."""
    still = _still_seconds(context)
    if still is None or _turning_share(still, context) > priors.REST_TURNS:
        return ()
    best: dict[str, tuple[float, Setting]] = {}
    roots = [_covariance_roots(still, walk) for walk in WALKS]
    weight = np.array([_log_likelihood(still, root) for root in roots])
    for name in priors.REST_CAUSES:
        options = library[name].settings(context) if name in library else ()
        if options:
            best[name] = max(
                (
                    (_log_bayes_factor(still, context, library[name], o, roots, weight), o)
                    for o in options
                ),
                key=lambda item: item[0],
            )
            best[name] = (best[name][0] - float(np.log(len(options))), best[name][1])
    evidence = {name: nats for name, (nats, _) in best.items()}
    if not evidence or max(evidence.values()) < priors.REST_NATS:
        return ()
    shares = dict(
        sorted(
            posterior_probabilities(evidence, priors.REST_CAUSES).items(), key=lambda item: -item[1]
        )
    )
    name = next(iter(shares))
    setting, root = best[name][1], roots[int(np.argmax(weight))]
    value, deviation, drift = _fit_effect(still, context, library[name], setting, root)
    usual = priors.ORDINARY_WALK_RAD_S_SQRT_S * np.sqrt(still.time_s[-1] - still.time_s[0])
    if np.ptp(drift, axis=0).max() < priors.REST_LARGE * usual:
        return ()
    return (_build_finding(still, library, shares, best[name], value, deviation, drift),)


def _build_finding(
    still: _StillSeconds,
    library: Mapping[str, Effect],
    shares: Mapping[str, float],
    best: tuple[float, Setting],
    value: Array,
    deviation: Array,
    drift: Array,
) -> Finding:
    """The finding for the most probable effect, with its alternatives."""
    name, *others = shares
    effect = library[name]
    size = np.ptp(drift, axis=0)
    close = [other for other in others if shares[other] > priors.REST_SMALLEST_SHARE]
    return Finding(
        effect=name,
        confidence=shares[name],
        alternatives=tuple(Share(other, shares[other]) for other in close),
        where=Where(
            ((float(still.time_s[0]), float(still.time_s[-1])),),
            tuple(axis for axis, part in zip("xyz", size, strict=True) if part > 0.2 * size.max()),
            "gyro",
            "at rest",
        ),
        parameters=tuple(
            Value(p.name, float(v), float(d), p.unit)
            for p, v, d in zip(effect.parameters, value, deviation, strict=True)
        ),
        heldout=None,
        cost_if_left_out=None,
        separate_from=separating_manoeuvre(library, name, close) if close else None,
        words=effect.words,
        equation=effect.equation,
        setting=dict(best[1]),
        evidence_nats=best[0],
    )


def _still_seconds(context: Context) -> _StillSeconds | None:
    """The still seconds of a recording; None if there are too few."""
    track = context.track
    second = np.floor(track.time_s - track.time_s[0]).astype(np.intp)
    known = np.flatnonzero(np.bincount(second) > 2)
    if len(known) < priors.REST_S:  # too few, or less than three rows a second
        return None
    means = np.stack([track.gyro_b_rad_s[second == k].mean(axis=0) for k in known])
    scatter = np.array([track.gyro_b_rad_s[second == k].std(axis=0).max() for k in known])
    still = scatter < priors.REST_SCATTER * np.median(scatter)
    still &= np.abs(means - np.median(means, axis=0)).max(axis=1) < priors.REST_AWAY_RAD_S
    if np.count_nonzero(still) < priors.REST_S:
        return None
    mean = means[still]
    noise = np.sqrt(np.mean(np.diff(mean, axis=0) ** 2, axis=0) / 2)
    chosen = known[still]
    return _StillSeconds(
        chosen + 0.5 + track.time_s[0], mean, np.maximum(noise, 1e-9), second, chosen
    )


def _turning_share(still: _StillSeconds, context: Context) -> float:
    """Share of the gyro's integral by which the field turns in the sensor, constant rates removed.

    0 for a bias that changes, 1 for a slow turn: a vehicle on a straight course is not at rest.
    """
    readings = context.track.mag_b_gauss - context.model.hard_iron_gauss
    field = still.means(np.nan_to_num(readings, nan=0.0))
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    steps_s = np.diff(still.time_s, prepend=still.time_s[0])
    angle = np.cumsum((still.mean - still.mean.mean(axis=0)) * steps_s[:, None], axis=0)
    line = np.column_stack([np.ones(len(unit)), still.time_s - still.time_s[0]])
    both = np.column_stack([np.cross(unit.mean(axis=0), angle), unit])
    expected, observed = np.hsplit(both - line @ np.linalg.lstsq(line, both)[0], 2)
    return float(np.sum(expected * observed) / max(float(np.sum(expected**2)), 1e-300))


def _covariance_roots(still: _StillSeconds, walk: float) -> list[Array]:
    """Cholesky factor (n, n) for each axis of the covariance of noise, walk and the bias' prior."""
    since = still.time_s - still.time_s[0]
    common = walk**2 * np.minimum.outer(since, since) + priors.REST_BIAS_RAD_S**2
    return [linalg.cholesky(common + np.diag(np.full(len(since), s**2)), lower=True)
            for s in still.noise]  # fmt: skip


def _whiten(still: _StillSeconds, roots: list[Array], columns: Array) -> tuple[Array, Array]:
    """Whitened columns (3 n, p) and readings (3 n,), axis by axis; columns (n, 3, p)."""
    X = [
        linalg.solve_triangular(root, columns[:, axis], lower=True)
        for axis, root in enumerate(roots)
    ]
    e = [
        linalg.solve_triangular(root, still.mean[:, axis], lower=True)
        for axis, root in enumerate(roots)
    ]
    return np.concatenate(X), np.concatenate(e)


def _log_likelihood(still: _StillSeconds, roots: list[Array]) -> float:
    """Log likelihood of the readings with noise and walk alone."""
    _, e = _whiten(still, roots, np.zeros((len(still.time_s), 3, 1)))
    return -0.5 * float(e @ e) - float(sum(np.sum(np.log(np.diag(root))) for root in roots))


def _log_bayes_factor(
    still: _StillSeconds,
    context: Context,
    effect: Effect,
    setting: Setting,
    roots: list[list[Array]],
    weight: Array,
) -> float:
    """Log Bayes factor of an effect relative to the walk alone, averaged over the walk's sizes."""
    columns = effect.columns(context, setting).gyro
    if columns is None:
        return -np.inf
    means = still.means(columns)
    scale = np.array([parameter.scale for parameter in effect.parameters])
    gains = []
    for root in roots:
        X, e = _whiten(still, root, means)
        score = projected_score(X.T @ X, X.T @ e, np.einsum("ij,ij->j", X, X), scale)
        gains.append(log_bayes_factor(score))
    return float(logsumexp(weight + np.array(gains)) - logsumexp(weight))


def _fit_effect(
    still: _StillSeconds, context: Context, effect: Effect, setting: Setting, root: list[Array]
) -> tuple[Array, Array, Array]:
    """Values (p,), deviations (p,), and bias drift (n, 3) rad/s, with one walk in the model."""
    columns = effect.columns(context, setting).gyro
    means = still.means(np.zeros((len(still.second), 3, 1)) if columns is None else columns)
    X, e = _whiten(still, root, means)
    found = solve_semidefinite(X.T @ X, np.column_stack([X.T @ e, np.eye(X.shape[1])]))
    return found[:, 0], np.sqrt(np.maximum(np.diag(found[:, 1:]), 0.0)), means @ found[:, 0]
