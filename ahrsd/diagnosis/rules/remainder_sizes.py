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

from ahrsd.diagnosis.answer.added_field import (
    calibration_of,
    deviation,
    heading_off_deg,
    less_calibration,
)
from ahrsd.diagnosis.rules.discrepancy import COURSES, PIECES, Discrepancy, fitted, shapes_of
from ahrsd.diagnosis.rules.exam import random_effects
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.rules.together import projected_with
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.diagnosis.where_and_when import locate
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
