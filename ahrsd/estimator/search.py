"""Other starting points: do they lead to a better answer, and do they agree?

The likelihood has more than one valley when motion is poor. So now and then several starts descend
on a thinned copy of the window (every k-th field, rotations between them composed exactly; the
epochs whose field varied most): the device's present calibration, a linear fit, a sphere, and the
answer as it stands. The lowest wins; it may be called sure only if two starts that know nothing of
each other arrive there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.estimator import chain, start
from ahrsd.estimator.factors import Node
from ahrsd.estimator.graph import SingularError
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.steps import compose
from ahrsd.estimator.window import Window, sigmas
from ahrsd.samples import Array

_EPOCHS = 8
_STEPS = 128  # per epoch
_DESCENT = 12  # Levenberg-Marquardt steps per start
_MOVED = 0.04  # of the field's size: a smaller spread is noise and drift, nothing to search in
_SAME = 1.0  # sigmas within which two answers are one


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Best calibration c (9,) and gyro bias (3,), what it gains in log likelihood over the present
    answer, and whether two independent starts arrived at it."""

    c: Array
    bias: Array
    gain: float
    agreed: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Reached:
    cost: float
    c: Array
    bias: Array
    information: Array | None


def worthwhile(data: Sequence[chain.Data]) -> bool:
    """Whether the field varied enough, in the sensor's frame, for a search to mean anything."""
    field = np.vstack([d.field_b_gauss[::8] for d in data])
    return bool(_spread(field) > _MOVED * np.median(np.linalg.norm(field, axis=1)))


def search(
    parameters: EstimatorParameters, window: Window, present_bias: Array, data: Sequence[chain.Data]
) -> Found:
    """Descend from every start on a thinned copy of `data`; `window` itself is not touched."""
    graph = window.graph
    present, sigma = graph.anchor
    chosen = sorted(
        sorted(range(len(data)), key=lambda k: -_spread(data[k].field_b_gauss))[:_EPOCHS]
    )
    first = Node.at(present_bias, np.array([1.0, 0.0, 0.0]))
    thin = Window(parameters, present, sigma, first, window.usual)
    for k in chosen:
        thin.append(thinned(data[k], max(1, len(data[k]) // _STEPS)))
    whole = [data[k] for k in chosen]
    fields = np.vstack([d.field_b_gauss for d in whole])
    own = _descend(thin, graph.c, graph.nodes[graph.last].bias)
    independent = [
        _descend(thin, c, present_bias)
        for c in (present, start.linear_start(whole), start.sphere_start(fields))
        if c is not None
    ]
    best = min([own, *independent], key=lambda r: r.cost)
    same = [r for r in independent if _same(r, best, graph.temper)]
    return Found(best.c, best.bias, own.cost - best.cost, len(same) > 1)


def _descend(thin: Window, c: Array, bias: Array) -> _Reached:
    thin.restart_at(c, bias)
    cost = thin.optimise(_DESCENT)
    graph = thin.graph
    try:
        information = np.asarray(np.linalg.inv(graph.covariance()[:9, :9]), dtype=np.float64)
    except (SingularError, np.linalg.LinAlgError):
        information = None
    return _Reached(cost, graph.c.copy(), graph.nodes[graph.last].bias.copy(), information)


def _same(r: _Reached, best: _Reached, temper: float) -> bool:
    if best.information is None:
        return False
    return sigmas(r.c - best.c, best.information / temper) < _SAME


def _spread(field: Array) -> float:
    """Standard deviation along the direction in which the field varied most."""
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(field.T))[-1]))


def thinned(data: chain.Data, k: int) -> chain.Data:
    """Every k-th step of an epoch, by itself: its first field is measured."""
    count = (len(data) - 1) // k
    rows = np.arange(count + 1) * k
    angle = np.zeros((count + 1, 3))
    angle[1:] = compose(data.angle_b_rad[1 : count * k + 1].reshape(count, k, 3))
    dt = np.r_[data.dt_s[0], data.dt_s[1 : count * k + 1].reshape(count, k).sum(axis=1)]
    return chain.Data(
        data.field_b_gauss[rows], angle, dt, data.down_b[rows], data.time_s[rows], True
    )
