"""Columns that nobody has a name for, as one random effect: how likely they are beside a model."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.rules.discrepancy import fitted
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.together import projected
from ahrsd.samples import Array


def effect_nats(basis: Base, columns: Array) -> float:
    """Evidence of (N, 3, p) whitened columns of one prior deviation, nats.

    That deviation is the likeliest one, and the noise that of the basis's colour: a marginal
    likelihood, in which every coefficient is paid for (`discrepancy.fitted`).
    """
    G, s = projected(basis, columns)
    group = np.zeros(len(s), dtype=np.intp)
    return float(fitted(G, s, group, max(1.0, basis.colour), np.zeros(1))[0])
