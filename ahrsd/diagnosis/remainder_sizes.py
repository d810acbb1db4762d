"""How much is left of a recording beside its names, component by component, in mG and degrees.

The random effects of `discrepancy` hold what no name explains: a course on the sensor, in the
world and of the gyro, a field by attitude, an error of the gyro by its rates, fields of places.
Here they get their sizes: the deviation over the recording of what each adds to the readings, at
the likeliest coefficients (posterior mean), less what another calibration would take of it.
That part is no remainder: on a car that hardly tilts nearly all of a field by attitude is such.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ahrsd.diagnosis import locate
from ahrsd.diagnosis.discrepancy import (
    COURSES,
    PIECES,
    Discrepancy,
    fitted,
    shapes_of,
)
from ahrsd.diagnosis.exam import random_effects
from ahrsd.diagnosis.search import State, formed_basis_of
from ahrsd.diagnosis.together import projected_with
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.samples import Array

#: components, and the groups of random effects that they are (`discrepancy`): places where the
#: vehicle stood, and the ways from them, are the world's as its course is
COMPONENTS = {
    "sensor_course": (0,),
    "by_attitude": (3,),
    "world": (1, 5, 6),
    "gyro_course": (2,),
    "by_rate": (4,),
}
#: where no accelerometer says what is level: the horizontal part of the field at 60 degrees of dip
LEVEL_SHARE = 0.5
#: smallest horizontal part of the field in which a heading is told
LEAST_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Size:
    """What one component adds to the readings.

    size:    deviation over the recording, gauss, of the gyro's errors rad/s
    heading_deg: deviation of the heading of a level vehicle by it; None of the gyro's errors
    evidence_nats: by which the recording is likelier with it, beside the other components
    """

    component: str
    size: float
    heading_deg: float | None
    evidence_nats: float


@dataclass(frozen=True, slots=True)
class Left:
    """Everything that is left beside the names.

    field_gauss, heading_deg: of all fields together;  gyro_rad_s: of all errors of the gyro
    beside_gauss: of the fields but for the largest component
    """

    sizes: tuple[Size, ...]
    field_gauss: float
    heading_deg: float
    gyro_rad_s: float
    beside_gauss: float


def sizes_left(state: State) -> Left:
    """The sizes of what is left beside a state's names."""
    basis = formed_basis_of(state)
    found = random_effects(state, basis)
    G, s = projected_with(basis, found.columns, found.products)
    value = likeliest(found, G, s) * found.columns.units
    nats = {name: found.nats - _without(found, G, s, groups) for name, groups in COMPONENTS.items()}
    return sizes_of([value[found.group == k] for k in range(len(found.sizes))], nats, basis.context)


def sizes_of(values: Sequence[Array], nats: Mapping[str, float], context: Context) -> Left:
    """The sizes of components.

    values: coefficients of each group, in gauss and rad/s;  nats: evidence of each component
    """
    cut = locate.segments(context.track.time_s, PIECES)
    columns = [locate.frame_columns(context, frame, cut) for frame, _ in COURSES]
    columns += [part for part, _ in shapes_of(context)]
    take = calibration_of(context)
    sizes, whole = [], {False: _nothing(cut), True: _nothing(cut)}
    for name, groups in COMPONENTS.items():
        added, of_gyro = _nothing(cut), columns[groups[0]].mag is None
        for k in groups:
            if k < len(columns):  # places only where the vehicle stood
                added += _added(columns[k], values[k])
        added = added if of_gyro else less_calibration(added, take)
        whole[of_gyro] += added
        heading_deg = None if of_gyro else heading_off_deg(added, context)
        sizes.append(Size(name, deviation(added), heading_deg, nats[name]))
    field, rate = whole[False], whole[True]
    whole_deg = heading_off_deg(field, context)
    fields = sorted(one.size for one in sizes if one.heading_deg is not None)
    beside = float(np.linalg.norm(fields[:-1]))
    return Left(tuple(sizes), deviation(field), whole_deg, deviation(rate), beside)


def _nothing(cut: locate.Segments) -> Array:
    return np.zeros((len(cut.index), 3))


def likeliest(found: Discrepancy, G: Array, s: Array) -> Array:
    """(q,) posterior mean of the random effects, in their units; G, s: projected products."""
    spread = np.exp(found.sizes)[found.group]
    A = G * (spread * spread[:, None]) / found.noise
    A[np.diag_indices_from(A)] += 1.0
    return np.asarray(spread * linalg.solve(A, spread * s / found.noise, assume_a="pos"))


def _without(found: Discrepancy, G: Array, s: Array, groups: Sequence[int]) -> float:
    """Log marginal likelihood, nats, where one component is nothing."""
    keep = np.setdiff1d(np.arange(len(found.sizes)), groups)
    kept = np.isin(found.group, keep)
    group = np.searchsorted(keep, found.group[kept])
    G, s, start = G[np.ix_(kept, kept)], s[kept], found.sizes[keep]
    return fitted(G, s, group, found.noise, start)[0]


def _added(columns: Columns, value: Array) -> Array:
    matrix = columns.gyro if columns.mag is None else columns.mag
    return np.zeros((0, 3)) if matrix is None else np.asarray(matrix @ value)


def calibration_of(context: Context) -> Array:
    """(3 N, 9) orthonormal: how readings move with soft and hard iron."""
    x, y, z = context.field_b.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    soft = [
        (x, zero, zero), (zero, y, zero), (zero, zero, z), (y, x, zero), (z, zero, x), (zero, z, y)
    ]  # fmt: skip
    hard = [(one, zero, zero), (zero, one, zero), (zero, zero, one)]
    columns = np.stack([np.column_stack(part).ravel() for part in (*soft, *hard)], axis=1)
    return np.asarray(np.linalg.svd(columns, full_matrices=False)[0])


def less_calibration(added: Array, take: Array) -> Array:
    """(N, 3) what no soft and hard iron would take over; take: `calibration_of`."""
    flat = added.ravel()
    return np.asarray((flat - take @ (take.T @ flat)).reshape(added.shape))


def deviation(added: Array) -> float:
    """Root mean square length of (N, 3) about its mean."""
    return float(np.sqrt(np.sum(np.var(added, axis=0))))


def heading_off_deg(added: Array, context: Context) -> float:
    """Deviation of a level vehicle's heading by a field (N, 3) that is added to the readings.

    Across the horizontal field; where nothing says what is level, of any direction in a field of
    usual dip.
    """
    read = context.field_b @ context.model.soft_iron.T
    if not context.world_levelled:
        size = float(np.median(np.linalg.norm(read, axis=1)))
        return float(np.degrees(deviation(added) / np.sqrt(3.0) / (LEVEL_SHARE * size)))
    outside, in_world = (_turned(context.R_nb, vectors) for vectors in (read, added))
    north, east, _ = mean = outside.mean(axis=0)
    level = float(np.hypot(north, east))
    least = max(level, LEAST_SHARE * float(np.linalg.norm(mean)))
    across = in_world[:, :2] @ np.array([-east, north]) / max(level, 1e-300)
    return float(np.degrees(np.std(across) / least))


def _turned(rotations: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", rotations, vectors))
