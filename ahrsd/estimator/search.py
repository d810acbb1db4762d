"""Other starting points: do they lead to a better answer, and do they agree?

The likelihood has more than one valley when motion is poor. So now and then several starts descend
on a part of the window (the epochs whose field varied most, all in one chain with cuts in it; of
an epoch of single steps every k-th field, rotations between them composed exactly): the device's
present calibration, a linear fit, a sphere, and the answer as it stands. The lowest wins; it may be
called sure only if two starts that know nothing of each other arrive there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.estimator import chain, start
from ahrsd.estimator.excitation import spread
from ahrsd.estimator.factors import Node
from ahrsd.estimator.graph import SingularError, sigmas
from ahrsd.estimator.lag import rates
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.steps import compose
from ahrsd.estimator.window import Window
from ahrsd.samples import Array

_EPOCHS = 6
_STEPS = 128  # rows per epoch, at most twice that
_DESCENT = 8  # Levenberg-Marquardt steps per start
_NEAR = 0.1  # sigmas from the best so far at which a descent need not go on
_SAME = 1.0  # sigmas within which two answers are one
_LOUD = 2.0  # residual variance over that of the fields' differences that the model left over


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Best calibration c (9,) and gyro bias (3,).

    away:   sigmas between it and the answer as it stands
    gain:   in log likelihood over where a descent from the answer as it stands leads
    apart:  sigmas from it within which two starts that know nothing of each other ended
    loud:   residual variance that even the best leaves over that of the fields' differences, at
            which the starts descend; 1 where the model explains the data
    """

    c: Array
    bias: Array
    away: float
    gain: float
    apart: float
    loud: float

    @property
    def agreed(self) -> bool:
        """Two starts that know nothing of each other arrived at the best."""
        return self.apart < _SAME


@dataclass(frozen=True, slots=True, eq=False)
class _Reached:
    cost: float
    c: Array
    bias: Array
    information: Array | None
    loud: float


def search(
    parameters: EstimatorParameters,
    window: Window,
    present_bias: Array,
    data: Sequence[chain.EpochData],
) -> SearchResult:
    """Descend from every start on a thinned copy of `data`; `window` itself is not touched."""
    graph = window.graph
    present, information = graph.anchor
    belief = np.asarray(np.linalg.inv(information), dtype=np.float64)
    chosen = sorted(
        sorted(range(len(data)), key=lambda k: -spread(data[k].field_b_gauss))[:_EPOCHS]
    )
    first = Node.at(present_bias, np.array([1.0, 0.0, 0.0]))
    thin = Window(parameters, present, belief, first, window.usual)
    thin.learn_from(window)
    thin.graph.temper = graph.temper
    if window.loud > 1.0:
        thin.graph.hold = graph.hold
    thin.attach(
        [joined([thinned(data[k], max(1, len(data[k]) // _STEPS)) for k in chosen])], [True]
    )
    whole = [data[k] for k in chosen]
    fields = np.vstack([d.field_b_gauss for d in whole])
    own = _descend(thin, graph.c, graph.nodes[graph.last].bias, None)
    starts = [start.linear_start(whole), start.sphere_start(fields)]
    best, independent = own, []
    if np.array_equal(graph.c, present):
        independent.append(own)
    else:
        starts.insert(0, present)
    known = [c for c in starts if c is not None]
    if window.loud > 1.0:
        known = [graph.with_held(c) for c in known]
    for c in known:
        if _positive(c):
            independent.append(_descend(thin, c, present_bias, best))
            best = min(best, independent[-1], key=lambda r: r.cost)
    loud = best.loud if best.loud > _LOUD else 1.0
    away = _distance(graph.c, best, graph.temper * loud if loud > 1.0 else 1.0)
    apart = sorted(_distance(r.c, best, graph.temper * loud) for r in independent)
    gain = (own.cost - best.cost) / loud
    return SearchResult(best.c, best.bias, away, gain, (*apart, np.inf)[1], loud)


def _positive(c: Array) -> bool:
    return bool(np.linalg.eigvalsh(chain.symmetric(c[:6]))[0] > 0.0)


def _descend(thin: Window, c: Array, bias: Array, best: _Reached | None) -> _Reached:
    """Downhill from c, until it is clear that this leads to the best so far."""
    thin.restart_at(c, bias)

    def near(at: Array) -> bool:
        return best is not None and _distance(at, best, 1.0) < _NEAR

    cost = thin.optimise(_DESCENT, near)
    graph = thin.graph
    try:
        information = np.asarray(np.linalg.inv(graph.covariance()[:9, :9]), dtype=np.float64)
    except (SingularError, np.linalg.LinAlgError):
        information = None
    found = thin.epochs[0].residuals
    loud = found.mag_gauss2 / found.mag_freedom / thin.usual.mag_gauss**2
    bias_reached = graph.nodes[graph.last].bias.copy()
    return _Reached(cost, graph.c.copy(), bias_reached, information, loud)


def _distance(c: Array, best: _Reached, temper: float) -> float:
    if best.information is None:
        return float(np.inf)
    return sigmas(c - best.c, best.information / temper)


def thinned(data: chain.EpochData, k: int) -> chain.EpochData:
    """Every k-th row of an epoch, by itself."""
    if k == 1:
        return data
    count = (len(data) - 1) // k
    rows = np.arange(count + 1) * k
    linked = None
    if data.linked is not None:
        linked = np.r_[1.0, data.linked[1 : count * k + 1].reshape(count, k).min(axis=1)]
    angle = np.zeros((count + 1, 3))
    angle[1:] = compose(data.angle_b_rad[1 : count * k + 1].reshape(count, k, 3))
    dt = np.r_[data.dt_s[1], data.dt_s[1 : count * k + 1].reshape(count, k).sum(axis=1)]
    averaging = data.averaging
    if averaging is not None:
        averaging = chain.Averaging(
            averaging.count[rows], averaging.turn[rows], dt, averaging.rate_b_rad_s[rows]
        )
    return chain.EpochData(
        data.field_b_gauss[rows],
        angle,
        dt,
        data.down_b[rows],
        data.time_s[rows],
        measures_first=True,
        linked=linked,
        averaging=averaging,
    )


def joined(parts: Sequence[chain.EpochData]) -> chain.EpochData:
    """Epochs as one chain that is cut between them; each measures its first field."""
    ones = [np.ones(len(p)) for p in parts]
    linked = [
        np.r_[0.0, (o if p.linked is None else p.linked)[1:]]
        for p, o in zip(parts, ones, strict=True)
    ]
    averaging = None
    if any(p.averaging is not None for p in parts):
        all_ = [
            p.averaging or chain.Averaging(o, np.tile(np.eye(3), (len(p), 1, 1)), p.dt_s, rates(p))
            for p, o in zip(parts, ones, strict=True)
        ]
        averaging = chain.Averaging(
            np.concatenate([a.count for a in all_]),
            np.concatenate([a.turn for a in all_]),
            np.concatenate([a.spread_s for a in all_]),
            np.concatenate([a.rate_b_rad_s for a in all_]),
        )
    return chain.EpochData(
        np.vstack([p.field_b_gauss for p in parts]),
        np.vstack([p.angle_b_rad for p in parts]),
        np.concatenate([p.dt_s for p in parts]),
        np.vstack([p.down_b for p in parts]),
        np.concatenate([p.time_s for p in parts]),
        measures_first=True,
        linked=np.concatenate(linked),
        averaging=averaging,
    )
