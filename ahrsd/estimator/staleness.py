"""Which epochs are worth linearising again, after the calibration moved away from where they were.

An epoch's factor is exact to second order, so a straight move costs nothing, however many sigmas
long. What counts is by how much the way there is curved (`retraction.py`), in sigmas: linearising
again moves the answer by about that. An epoch at rest knows nothing of the calibration. There the
gyro's bias counts: at another one its directions drift, which seems to be noise of the field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.epoch import WindowEpoch
from ahrsd.estimator.factors import Node
from ahrsd.estimator.graph import sigmas
from ahrsd.estimator.retraction import Moments, retract
from ahrsd.samples import Array

_WORTH = 0.02  # sigmas
_ANOTHER_NOISE, _EXACTLY = 0.1, 0.04  # of the gyro's level, that an epoch may have assumed else

_DRIFTED = 0.3  # of the field's noise: what a bias other than assumed makes of a rest


def bends(epochs: Sequence[WindowEpoch], c: Array, moments: Moments, information: Array) -> Array:
    """How curved the way is to c from where each was linearised, in sigmas (E,); 0 at rest."""
    known: dict[int, float] = {}
    for epoch in epochs:
        at = epoch.factor.point.c
        if epoch.turned and id(at) not in known:
            known[id(at)] = sigmas(retract(at, c - at, moments) - c, information)
    return np.array([known[id(e.factor.point.c)] if e.turned else 0.0 for e in epochs])


def drifts(epochs: Sequence[WindowEpoch], nodes: Mapping[int, Node], usual: chain.Noise) -> Array:
    """How far directions at rest drift over their epoch by another bias than it assumed, (E,).

    In units of the field's noise; 0 with motion.
    """
    out = np.zeros(len(epochs))
    for k, epoch in enumerate(epochs):
        if not epoch.turned:
            at = epoch.factor.point
            length_s = float(epoch.data.time_s[-1] - epoch.data.time_s[0])
            angle = float(np.linalg.norm(nodes[epoch.a].bias - at.a.bias)) * length_s
            size = float(np.cbrt(np.linalg.det(chain.symmetric(at.c[:6]))))
            out[k] = angle * size / usual.mag_gauss
    return out


def outdated(
    epochs: Sequence[WindowEpoch],
    bent: Array,
    drifted: Array,
    usual: chain.Noise,
    *,
    exactly: bool,
) -> list[int]:
    """Epochs that were left too far behind, or assumed another noise of the gyro than `usual`."""
    assumed = np.array([e.usual.gyro_rad_s for e in epochs])
    limit = _EXACTLY if exactly else _ANOTHER_NOISE
    other = np.abs(assumed / usual.gyro_rad_s - 1.0) > limit
    return [int(k) for k in np.flatnonzero((bent > _WORTH) | (drifted > _DRIFTED) | other)]
