"""What a model leaves that no name explains, as random effects: the yardstick for names.

Real recordings hold many small things that no library has: a room's field that differs from place
to place, a sensor that is not quite linear, a mount that gives.  Innovations are then not white,
and against white noise everything is significant.  The remainder is therefore given its own
variances, found by marginal likelihood (Kennedy and O'Hagan's discrepancy, restricted to what the
calibration and the other names leave):

    sensor, world, gyro   a free value in every twenty-fourth of the recording
    attitude              a field in sensor axes by the field's and gravity's direction
    rate                  an error of the gyro by the size and the products of its rates
    rest, way             a field in sensor axes wherever the vehicle stands, which is one place,
                          and on the way to and from it

A name is worth what it explains beyond them: the maximum of the marginal likelihood with it, over
the one without it.  Where nothing is left the variances are zero and nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.innovation_filter.evidence import SIZES, colour
from ahrsd.diagnosis.rules import variances
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.together import Together, left_beside, projected_with, together
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.diagnosis.where_and_when import locate
from ahrsd.samples import Array

PIECES = 24
#: unit of the random effects, gauss and rad/s; sizes are sought from e^-6 to e^8 of it
UNIT_GAUSS, UNIT_RAD_S = 1e-3, 1e-4
COURSES: tuple[tuple[locate.Frame, float], ...] = (
    ("sensor", UNIT_GAUSS),
    ("world", UNIT_GAUSS),
    ("gyro", UNIT_RAD_S),
)
SMALLEST, LARGEST = -6.0, 8.0
#: standing: slower than this for longer than that; it takes a moment to get away from a place
STILL_RAD_S, STILL_S = 0.05, 2.0
LEAVING_S = (4.0, 3.5, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5)  # parts of the way from a place
MOST_RESTS = 6
PARTS = 2 * len(LEAVING_S) + 1  # of a place, itself the last
PLACES, WAYS = 5, 6  # numbers of their groups
LARGEST_PLACE = 4.0  # logarithm: fields of two places in a room differ by 50 mG; a magnet's by more


@dataclass(frozen=True, slots=True, eq=False)
class Discrepancy:
    """Random effects beside a model's own columns.

    basis:   the model with all its names;  columns: whitened, (q) in units
    products: (q, q) of the columns with one another
    group:   (q,) number of the variance that a column has
    noise:   power of what is left beside everything, at least 1
    sizes:   (groups,) logarithms of the deviations of the whole model
    nats:    log marginal likelihood of the whole model over that without random effects
    unknown: the same over that with those of places alone, of which one knows what they are
    """

    basis: Base
    columns: Together
    products: Array
    group: NDArray[np.intp]
    noise: float
    sizes: Array
    nats: float
    unknown: float


def discrepancy(basis: Base) -> Discrepancy:
    """The random effects that a model needs."""
    cut = locate.segments(basis.context.track.time_s, PIECES)
    shapes = shapes_of(basis.context)
    columns = together(basis, COURSES, cut, shapes)
    widths = [3 * PIECES] * len(COURSES) + [part.width for part, _ in shapes]
    group = np.repeat(np.arange(len(widths)), widths)
    products = columns.products()
    G, s = projected_with(basis, columns, products)
    left = left_beside(basis, columns, G, s)
    noise = max(1.0, colour(left, basis.rate_hz) * float(np.mean(left**2)))
    nats, sizes = fitted(G, s, group, noise, np.zeros(len(widths)))
    known = group >= PLACES
    by_place = 0.0
    if known.any():
        at = G[np.ix_(known, known)], s[known], group[known] - PLACES
        by_place, _ = fitted(*at, noise, np.zeros(2))
    return Discrepancy(basis, columns, products, group, noise, sizes, nats, nats - by_place)


def beyond(
    found: Discrepancy, without: Base, columns: Array, scale: Array, enough: float = np.inf
) -> float:
    """Nats by which a name is more than the random effects can be; at least `enough`, if so.

    without: the basis without it;  columns (N, 3, p) whitened;  scale (p,): prior deviations
    """
    count = len(found.sizes)
    G, s = projected_with(without, found.columns, found.products, columns * scale)
    plain = slice(0, len(found.group))
    start = np.maximum(found.sizes, 0.0)  # from a variance of zero no slope leads away
    less, sizes = fitted(G[plain, plain], s[plain], found.group, found.noise, start)
    group = np.concatenate([found.group, np.full(len(scale), count)])
    less += float(np.log(len(SIZES)))
    worth = -np.inf
    for begin in (found.sizes, sizes):
        more, _ = fitted(G, s, group, found.noise, np.append(begin, 0.0), count)
        worth = max(worth, more - less)
        if worth > enough:
            break
    return worth


def shapes_of(context: Context) -> list[tuple[Columns, float]]:
    """The random effects that are no courses, and their unit."""
    out = [(by_attitude(context), UNIT_GAUSS), (by_rate(context), UNIT_RAD_S)]
    rests = places(context)
    mag = locate.frame_columns(context, "sensor", rests).mag if len(rests) else None
    if mag is not None:
        ways = 3 * (len(rests) // PARTS)  # behind the places themselves
        out += [(Columns(mag=part), UNIT_GAUSS) for part in np.split(mag, [ways], axis=2)]
    return out


def by_attitude(context: Context) -> Columns:
    """A field in sensor axes by direction: degrees 2 and 3 of the field's, 1 and 2 of gravity's.

    Degree 1 of the field's is the soft iron.
    """
    size = np.linalg.norm(context.field_b, axis=1, keepdims=True)
    x, y, z = (context.field_b / np.maximum(size, 1e-300)).T
    shapes = [
        *_second(x, y, z),
        x * (x * x - 3 * y * y), y * (3 * x * x - y * y), z * (x * x - y * y), x * y * z,
        x * (5 * z * z - 1), y * (5 * z * z - 1), z * (5 * z * z - 3),
    ]  # fmt: skip
    if context.world_levelled:
        down = context.R_nb[:, 2, :].T
        shapes += [*down, *_second(*down), *(a * b for a in (x, y, z) for b in down)]
    return every_direction(np.stack(shapes, axis=1))


def by_rate(context: Context) -> Columns:
    """An error of the gyro by its rates: their sizes and products, and with the whole rate's size.

    In proportion to them it is scale and misalignment.
    """
    rate = context.rowwise_rate_b_rad_s
    x, y, z = rate.T
    whole = np.linalg.norm(rate, axis=1, keepdims=True)
    values = np.column_stack([np.abs(rate), rate * whole, rate**2, x * y, x * z, y * z])
    return every_direction(values, gyro=True)


def every_direction(values: Array, *, gyro: bool = False) -> Columns:
    """Columns (N, 3, 3 k) of each of the (N, k) courses on each axis, of unit deviation."""
    values = values / np.maximum(values.std(axis=0), 1e-6)
    matrix = np.einsum("np,ij->nipj", values, np.eye(3)).reshape(len(values), 3, -1)
    return Columns(gyro=matrix) if gyro else Columns(mag=matrix)


def _second(x: Array, y: Array, z: Array) -> list[Array]:
    return [x * y, x * z, y * z, x * x - y * y, 2 * z * z - x * x - y * y]


def places(context: Context) -> locate.Segments:
    """The stretches in which the vehicle stands, the longest, then the ways from and to them."""
    track = context.track
    still = np.linalg.norm(context.rate_b_rad_s, axis=1) < STILL_RAD_S
    padded = np.concatenate([[False], still, [False]]).astype(int)
    firsts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    begins_s, ends_s = track.time_s[firsts], track.time_s[ends - 1]
    longest = np.argsort(begins_s - ends_s)[:MOST_RESTS]
    index = np.full(len(track), -1)
    count = 0
    for k in np.sort(longest[(ends_s - begins_s)[longest] > STILL_S]):
        for away_s in LEAVING_S:
            for low, high in ((begins_s[k] - away_s, begins_s[k]), (ends_s[k], ends_s[k] + away_s)):
                index[(track.time_s >= low) & (track.time_s <= high)] = count
                count += 1
        index[(track.time_s >= begins_s[k]) & (track.time_s <= ends_s[k])] = count
        count += 1
    rest = index // PARTS
    way = count // PARTS + index - rest
    number = np.where(index % PARTS == PARTS - 1, rest, way)
    return locate.Segments(np.arange(count + 1.0), np.where(index < 0, -1, number))


def fitted(
    G: Array,
    s: Array,
    group: NDArray[np.intp],
    noise: float,
    start: Array,
    named: int | None = None,
) -> tuple[float, Array]:
    """Largest log marginal likelihood, nats, and the logarithms of the groups' deviations there.

    named: the group that is a name: its deviation stays near its prior
    """
    low = np.full(len(start), SMALLEST)
    high = np.array([LARGEST_PLACE if k in (PLACES, WAYS) else LARGEST for k in range(len(start))])
    if named is not None:
        low[named], high[named] = np.log(SIZES[0]), np.log(SIZES[-1])
    return variances.fitted(G / noise, s / noise, group, np.asarray(start, float), low, high)
