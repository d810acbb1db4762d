"""A gyro that stands still reads its bias: what the bias does, without the magnetometer.

At rest the field says next to nothing of the gyro (the calibration would explain any slow turn of
it), but the readings themselves do.  Their means over a second are regressed on what could move a
bias, beside a random walk of an ordinary gyro's size and a few times that, weighted by likelihood.
Warming up, time since power-on and wandering look nearly alike; they are told as one set.
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
    "can be told"
)
#: sizes of the walk that are weighed, rad/s per square root of a second
WALKS = priors.ORDINARY_WALK_RAD_S_SQRT_S * np.array([1.0, 2.0, 4.0])


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """Still seconds.  time_s (n,);  mean (n, 3) rad/s;  noise (3,) of a mean; rows: of each."""

    time_s: Array
    mean: Array
    noise: Array
    second: NDArray[np.intp]
    chosen: NDArray[np.intp]

    def means(self, values: Array) -> Array:
        """(n, ...) means of (N, ...) over the still seconds."""
        return np.stack([values[self.second == k].mean(axis=0) for k in self.chosen])


def at_rest(fit: NullFit) -> bool:
    """Whether the field hardly turns in the sensor: then only the gyro can be told about."""
    field = fit.filtered.nominal_b
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    return bool(1.0 - np.linalg.norm(unit.mean(axis=0)) < priors.REST_SPREAD)


def told_at_rest(library: Mapping[str, Effect], still: Sequence[Finding]) -> Mapping[str, Effect]:
    """What a field that hardly turns can tell: the gyro, what rides with the sensor, what is quick.

    still: what a gyro that stands tells of its bias, which is not asked of the field again
    The delays stay: their rows make the column that a model always has.
    """
    asked = {k: one for k, one in library.items() if not (still and k in priors.REST_CAUSES)}
    return {k: e for k, e in asked.items() if e.family == "gyro" or e.rides or e.quick or e.delay}


def resting(context: Context, library: Mapping[str, Effect]) -> tuple[Finding, ...]:
    """The name for what moves the bias of a gyro that stands, with what is as likely; or none."""
    rest = _rest(context)
    if rest is None or _turning(rest, context) > priors.REST_TURNS:
        return ()
    best: dict[str, tuple[float, Setting]] = {}
    roots = [_roots(rest, walk) for walk in WALKS]
    weight = np.array([_log_likelihood(rest, root) for root in roots])
    for name in priors.REST_CAUSES:
        options = library[name].settings(context) if name in library else ()
        if options:
            best[name] = max(
                ((_evidence(rest, context, library[name], o, roots, weight), o) for o in options),
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
    value, deviation, course = _fitted(rest, context, library[name], setting, root)
    usual = priors.ORDINARY_WALK_RAD_S_SQRT_S * np.sqrt(rest.time_s[-1] - rest.time_s[0])
    if np.ptp(course, axis=0).max() < priors.REST_LARGE * usual:
        return ()
    return (_finding(rest, library, shares, best[name], value, deviation, course),)


def _finding(
    rest: _Rest,
    library: Mapping[str, Effect],
    shares: Mapping[str, float],
    best: tuple[float, Setting],
    value: Array,
    deviation: Array,
    course: Array,
) -> Finding:
    name, *others = shares
    effect = library[name]
    size = np.ptp(course, axis=0)
    close = [other for other in others if shares[other] > priors.REST_SMALLEST_SHARE]
    return Finding(
        effect=name,
        confidence=shares[name],
        alternatives=tuple(Share(other, shares[other]) for other in close),
        where=Where(
            ((float(rest.time_s[0]), float(rest.time_s[-1])),),
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


def _rest(context: Context) -> _Rest | None:
    track = context.track
    second = np.floor(track.time_s - track.time_s[0]).astype(np.intp)
    known = np.flatnonzero(np.bincount(second) > 2)
    if len(known) < priors.REST_S:  # rows that come more slowly
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
    return _Rest(chosen + 0.5 + track.time_s[0], mean, np.maximum(noise, 1e-9), second, chosen)


def _turning(rest: _Rest, context: Context) -> float:
    """Share of the gyro's integral by which the field turns in the sensor; constant rates aside.

    0 for a bias that changes, 1 for a slow turn: a vehicle on a straight course is not at rest.
    """
    readings = context.track.mag_b_gauss - context.model.hard_iron_gauss
    field = rest.means(np.nan_to_num(readings, nan=0.0))
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    steps_s = np.diff(rest.time_s, prepend=rest.time_s[0])
    angle = np.cumsum((rest.mean - rest.mean.mean(axis=0)) * steps_s[:, None], axis=0)
    line = np.column_stack([np.ones(len(unit)), rest.time_s - rest.time_s[0]])
    both = np.column_stack([np.cross(unit.mean(axis=0), angle), unit])
    expected, seen = np.hsplit(both - line @ np.linalg.lstsq(line, both)[0], 2)
    return float(np.sum(expected * seen) / max(float(np.sum(expected**2)), 1e-300))


def _roots(rest: _Rest, walk: float) -> list[Array]:
    """Per axis the Cholesky factor (n, n) of noise, walk and the bias' own prior."""
    since = rest.time_s - rest.time_s[0]
    common = walk**2 * np.minimum.outer(since, since) + priors.REST_BIAS_RAD_S**2
    return [linalg.cholesky(common + np.diag(np.full(len(since), s**2)), lower=True)
            for s in rest.noise]  # fmt: skip


def _whitened(rest: _Rest, roots: list[Array], columns: Array) -> tuple[Array, Array]:
    """(3 n, p) columns and (3 n,) readings, whitened axis by axis; columns (n, 3, p)."""
    X = [
        linalg.solve_triangular(root, columns[:, axis], lower=True)
        for axis, root in enumerate(roots)
    ]
    e = [
        linalg.solve_triangular(root, rest.mean[:, axis], lower=True)
        for axis, root in enumerate(roots)
    ]
    return np.concatenate(X), np.concatenate(e)


def _log_likelihood(rest: _Rest, roots: list[Array]) -> float:
    _, e = _whitened(rest, roots, np.zeros((len(rest.time_s), 3, 1)))
    return -0.5 * float(e @ e) - float(sum(np.sum(np.log(np.diag(root))) for root in roots))


def _evidence(
    rest: _Rest,
    context: Context,
    effect: Effect,
    setting: Setting,
    roots: list[list[Array]],
    weight: Array,
) -> float:
    """Log Bayes factor against the walk alone, over the walks' sizes."""
    columns = effect.columns(context, setting).gyro
    if columns is None:
        return -np.inf
    means = rest.means(columns)
    scale = np.array([parameter.scale for parameter in effect.parameters])
    gains = []
    for root in roots:
        X, e = _whitened(rest, root, means)
        what = projected_score(X.T @ X, X.T @ e, np.einsum("ij,ij->j", X, X), scale)
        gains.append(log_bayes_factor(what))
    return float(logsumexp(weight + np.array(gains)) - logsumexp(weight))


def _fitted(
    rest: _Rest, context: Context, effect: Effect, setting: Setting, root: list[Array]
) -> tuple[Array, Array, Array]:
    """Value (p,), deviation (p,), and course (n, 3) rad/s beside one walk."""
    columns = effect.columns(context, setting).gyro
    means = rest.means(np.zeros((len(rest.second), 3, 1)) if columns is None else columns)
    X, e = _whitened(rest, root, means)
    found = solve_semidefinite(X.T @ X, np.column_stack([X.T @ e, np.eye(X.shape[1])]))
    return found[:, 0], np.sqrt(np.maximum(np.diag(found[:, 1:]), 0.0)), means @ found[:, 0]
