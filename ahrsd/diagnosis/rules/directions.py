"""Noise that is slower along the field than across it.

The filter remembers the field's size for good and its direction for seconds: slow noise of the
magnetometer stays in the innovations along the field, across it the gyro takes it away.  One figure
for the noise's colour is then too small along the field, where slow noise would look like a source,
and too large across it.  So rows are weighed by direction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.innovation_filter.evidence import colour
from ahrsd.diagnosis.rules.regression import Base, based, residual
from ahrsd.samples import Array

#: colours closer than this are one: an estimate scatters by that much
ALIKE = 1.35
#: seconds over which the slowest noise is looked at
SLOW_S = 8.0


def by_direction(basis: Base, columns: Array) -> Base:
    """The basis with its rows weighed by the colour of what the columns (N, 3, p) leave.

    Its colour is that of all axes, as before.
    """
    left = residual(np.concatenate([basis.known, columns], axis=2), basis.innovation)
    field = basis.context.field_b @ basis.context.model.soft_iron
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    part = np.sum(left * unit, axis=1, keepdims=True)
    across = np.sqrt(1.5) * (left - part * unit)  # two axes of three
    along = max(colour(part, basis.rate_hz), mean_colour(part, basis.rate_hz))
    least = min(colour(across, basis.rate_hz), basis.colour)
    if along < ALIKE * basis.colour:
        return basis
    radial = unit[:, :, None] * unit[:, None, :]
    weight = np.sqrt(basis.colour / least) * (np.eye(3) - radial)
    weight += np.sqrt(basis.colour / along) * radial
    return weighed(basis, weight)


def weighed(basis: Base, weight: Array) -> Base:
    """The basis with its rows weighed by (N, 3, 3), beside what they were weighed by already."""
    known = weight @ basis.known
    innovation = np.einsum("nij,nj->ni", weight, basis.innovation)
    both = weight if basis.weight is None else weight @ basis.weight
    return replace(based(basis, basis.groups, known, innovation), weight=both)


def mean_colour(innovation: Array, rate_hz: float) -> float:
    """Power of innovations (N, k) below about 1 / `SLOW_S` over white noise's, the axes' mean."""
    reach = min(max(1, round(SLOW_S * rate_hz)), len(innovation) // 4)
    centred = innovation - innovation.mean(axis=0)
    sums = np.cumsum(np.vstack([np.zeros(centred.shape[1]), centred]), axis=0)
    return float(np.mean((sums[reach:] - sums[:-reach]) ** 2) / reach)
