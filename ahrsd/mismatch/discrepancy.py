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

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ahrsd.mismatch import locate
from ahrsd.mismatch.evidence import SIZES, colour
from ahrsd.mismatch.gram import RANK_SHARE, solve
from ahrsd.mismatch.regression import Base, residual
from ahrsd.mismatch.values import Columns, Context
from ahrsd.samples import Array

PIECES = 24
#: unit of the random effects, gauss and rad/s; sizes are sought from e^-6 to e^8 of it
UNIT_GAUSS, UNIT_RAD_S = 1e-3, 1e-4
SMALLEST, LARGEST = -6.0, 8.0
#: standing: slower than this for longer than that; it takes a moment to get away from a place
STILL_RAD_S, STILL_S = 0.05, 2.0
LEAVING_S = (4.0, 3.5, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5)  # parts of the way from a place
MOST_RESTS = 6
PARTS = 2 * len(LEAVING_S) + 1  # of a place, itself the last
PLACES, WAYS = 5, 6  # numbers of their groups
LARGEST_PLACE = 4.0  # logarithm: fields of two places in a room differ by 50 mG; a magnet's by more
ITERATIONS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Discrepancy:
    """Random effects beside a model's own columns.

    basis:   the model with all its names;  columns: (N, 3, q) whitened, in units
    products: (q, q) of the columns with one another
    group:   (q,) number of the variance that a column has
    noise:   power of what is left beside everything, at least 1
    sizes:   (groups,) logarithms of the deviations of the whole model
    nats:    log marginal likelihood of the whole model over that without random effects
    unknown: the same over that with those of places alone, of which one knows what they are
    """

    basis: Base
    columns: Array
    products: Array
    group: NDArray[np.intp]
    noise: float
    sizes: Array
    nats: float
    unknown: float


def discrepancy(basis: Base) -> Discrepancy:
    """The random effects that a model needs."""
    parts = _random_effects(basis.context)
    columns = basis.whitened([make(basis.context) for make, _ in parts])
    units = [unit for _, unit in parts]
    scaled = [part * unit for part, unit in zip(columns, units, strict=True)]
    group = np.repeat(np.arange(len(parts)), [part.shape[2] for part in scaled])
    together = np.concatenate(scaled, axis=2)
    flat = together.reshape(-1, len(group))
    products = flat.T @ flat
    G, s = projected(basis, together, products)
    left = _left(basis, together, G, s)
    noise = max(1.0, colour(left, basis.rate_hz) * float(np.mean(left**2)))
    nats, sizes = fitted(G, s, group, noise, np.zeros(len(parts)))
    known = group >= PLACES
    by_place = 0.0
    if known.any():
        at = G[np.ix_(known, known)], s[known], group[known] - PLACES
        by_place, _ = fitted(*at, noise, np.zeros(2))
    return Discrepancy(basis, together, products, group, noise, sizes, nats, nats - by_place)


def beyond(
    found: Discrepancy, without: Base, columns: Array, scale: Array, enough: float = np.inf
) -> float:
    """Nats by which a name is more than the random effects can be; at least `enough`, if so.

    without: the basis without it;  columns (N, 3, p) whitened;  scale (p,): prior deviations
    """
    count = len(found.sizes)
    together = np.concatenate([found.columns, columns * scale], axis=2)
    G, s = projected(without, together, found.products)
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


def _random_effects(context: Context) -> list[tuple[Callable[[Context], Columns], float]]:
    """What makes the columns of each group, and their unit."""
    cut = locate.segments(context.track.time_s, PIECES)

    def course(frame: locate.Frame) -> Callable[[Context], Columns]:
        return lambda here: locate.frame_columns(here, frame, cut)

    out: list[tuple[Callable[[Context], Columns], float]] = [
        (course("sensor"), UNIT_GAUSS),
        (course("world"), UNIT_GAUSS),
        (course("gyro"), UNIT_RAD_S),
        (by_attitude, UNIT_GAUSS),
        (by_rate, UNIT_RAD_S),
    ]
    rests = places(context)
    if len(rests):
        itself = np.repeat(np.arange(len(rests)) % PARTS == PARTS - 1, 3)
        mag = locate.frame_columns(context, "sensor", rests).mag
        if mag is not None:
            standing, leaving = Columns(mag=mag[:, :, itself]), Columns(mag=mag[:, :, ~itself])
            out += [(lambda _: standing, UNIT_GAUSS), (lambda _: leaving, UNIT_GAUSS)]
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
    rate = context.rate_b_rad_s
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
    """The stretches in which the vehicle stands, the longest, and the ways from and to them."""
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
    return locate.Segments(np.arange(count + 1.0), index)


def projected(basis: Base, columns: Array, products: Array | None = None) -> tuple[Array, Array]:
    """Information (q, q) and score (q,) of the columns with the known ones regressed out.

    products: of the first columns with one another, where they are known already
    Combinations with less information than RANK_SHARE of what the columns had are left out: they
    are made of the noise of the field that the columns were built from.
    """
    Z = basis.known.reshape(-1, basis.known.shape[2])
    X = columns.reshape(len(Z), -1)
    e = basis.innovation.ravel()
    cross = Z.T @ X
    M = solve(Z.T @ Z, cross)
    whole = X.T @ X if products is None else _more_products(products, X)
    root = np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((whole - cross.T @ M) / np.outer(root, root))
    kept = values > RANK_SHARE * len(root)
    directions = root[:, None] * vectors[:, kept]
    s = vectors[:, kept].T @ ((X.T @ e - M.T @ (Z.T @ e)) / root)
    return (directions * values[kept]) @ directions.T, directions @ s


def _more_products(known: Array, X: Array) -> Array:
    """(q, q) X^T X of (N, q), of which the first rows and columns are known."""
    count = len(known)
    new = X.T @ X[:, count:]
    return np.block([[known, new[:count]], [new[:count].T, new[count:]]])


def _left(basis: Base, columns: Array, G: Array, s: Array) -> Array:
    """(N, 3) innovation with the known columns and these, projected G and s, regressed out."""
    theta = solve(G, s[:, None])[:, 0]
    return residual(basis.known, basis.innovation - columns @ theta)


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
    count = len(start)

    G, s = G / noise, s / noise

    def loss(sizes: Array) -> tuple[float, Array]:
        deviation = np.exp(sizes)[group]
        A = G * deviation
        A *= deviation[:, None]
        A[np.diag_indices_from(A)] += 1.0
        # of the inverse only the diagonal is asked for: sums of squares down the columns of L^-1
        L = linalg.cholesky(A.T, lower=True, overwrite_a=True, check_finite=False)
        root, _ = linalg.lapack.dtrtri(L, lower=1, overwrite_c=1)
        seen = root @ (deviation * s)
        mean = seen @ root
        nats = 0.5 * float(seen @ seen) + float(np.sum(np.log(np.diag(root))))
        pull = mean**2 + np.einsum("ij,ij->j", root, root) - 1.0
        return -nats, np.asarray(-np.bincount(group, pull, count), float)

    bounds = [(SMALLEST, LARGEST_PLACE if k in (PLACES, WAYS) else LARGEST) for k in range(count)]
    if named is not None:
        bounds[named] = (float(np.log(SIZES[0])), float(np.log(SIZES[-1])))
    from scipy.optimize import minimize  # dear to import, and needed beside a name only

    result = minimize(
        loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ITERATIONS}
    )
    return float(-result.fun), np.asarray(result.x, float)
