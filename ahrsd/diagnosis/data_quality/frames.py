"""Do gyro and magnetometer mean the same axes and the same unit?

A field that is fixed in the world turns against the sensor: with iron b, gyro bias -c, and the
gyro's axes and unit P between it and the magnetometer,

    dm/dt = (m - b) x (P w + c) = m x P w - (b x) P w + m x c - b x c

linear in [P, (b x) P, c, b x c].  Integrated over windows it needs no derivative of a noisy
reading, and the normal equations of all 24 unknowns, made once, hold those of each of the 48
signed permutations P = s Pi: 10 unknowns [s, s b, c, b x c], for which the 24 are a linear map.
Iron that deforms is left out here; it bends all 48 alike.

A turn at a constant rate c is in every one of them, whatever the gyro says: a frame is told by what
it explains beyond that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array
from ahrsd.so3 import skew

_WINDOW_S = 0.5
_ROWS, _WINDOWS = 4000, 80  # samples and windows, those that turn most


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One of the 48: gyro_true_i = signs_i * gyro_(axes_i) * scale.

    cost: residual sum of squares over that of a turn at a constant rate, 0..1
    """

    axes: tuple[int, int, int]
    signs: tuple[int, int, int]
    scale: float
    cost: float

    @property
    def is_identity(self) -> bool:
        """Whether nothing is swapped or negated."""
        return self.axes == (0, 1, 2) and self.signs == (1, 1, 1)

    @property
    def matrix(self) -> Array:
        """(3, 3) the signed permutation P, true rate = P reading."""
        P = np.zeros((3, 3))
        P[range(3), self.axes] = self.signs
        return P


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Normal equations of windows: gram (24, 24), right (24,), total of the readings' changes."""

    gram: Array
    right: Array
    total: float
    count: int


def window_rows(track: Track) -> int:
    """Samples of a window."""
    return max(4, round(_WINDOW_S / track.step_s))


def windows(track: Track, part: slice | None = None) -> Windows | None:
    """Normal equations of the windows that turn most; None where there is too little.

    part: rows of the track, None: all
    """
    length = window_rows(track)
    whole = part or slice(0, len(track))
    blocks = [one for one in _blocks(track, length) if whole.start <= one.start < whole.stop]
    if len(blocks) < 12:
        return None
    turn = np.array([np.sum(np.abs(track.gyro_b_rad_s[rows]), axis=0).max() for rows in blocks])
    chosen = np.argsort(-turn)[: max(_WINDOWS, _ROWS // length)]
    rows = np.concatenate([np.arange(blocks[k].start, blocks[k].stop) for k in np.sort(chosen)])
    m0, m1 = track.mag_b_gauss[rows - 1], track.mag_b_gauss[rows]
    middle, dt = (m0 + m1) / 2, track.dt_s[rows][:, None]
    rate = track.gyro_b_rad_s[rows] * dt
    starts = np.arange(0, len(rows), length)
    cross = skew(middle)
    parts = [
        np.einsum("nab,nj->nabj", cross, rate).reshape(-1, 3, 9),
        np.einsum("ab,nj->nabj", np.eye(3), rate).reshape(-1, 3, 9),
        cross * dt[:, :, None],
        np.eye(3) * dt[:, :, None],
    ]
    X = np.add.reduceat(np.concatenate(parts, axis=2), starts, axis=0).reshape(-1, 24)
    y = np.add.reduceat(m1 - m0, starts, axis=0).ravel()
    if not (np.isfinite(X).all() and np.isfinite(y).all()):
        good = np.isfinite(X).all(axis=1) & np.isfinite(y)
        X, y = X[good], y[good]
    return Windows(X.T @ X, X.T @ y, float(y @ y), len(starts))


def _blocks(track: Track, length: int) -> Iterator[slice]:
    for run in track.runs or (slice(0, len(track)),):
        for first in range(run.start + 1, run.stop - length + 1, length):
            yield slice(first, first + length)


def ranked(found: Windows) -> list[Frame]:
    """The best first; of each frame and its negative, the one whose scale is positive."""
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    usual = max(found.total - _solved(found, constant)[1], 1e-300)
    out = []
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), axes] = signs
            scale, gained = _fitted(found, P)
            if scale > 0:
                i, j, k = axes
                a, b, c = signs
                out.append(Frame((i, j, k), (a, b, c), scale, (found.total - gained) / usual))
    return sorted(out, key=lambda frame: frame.cost)


#: relative: what is smaller is nothing but rounding
_UNSEEN = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class FreeFrame:
    """Any linear map (3, 3) between the two, true rate = matrix @ reading, with its deviation.

    cost: as of a `Frame`
    """

    matrix: Array
    deviation: float
    cost: float


def free_frame(found: Windows) -> FreeFrame:
    """The map with which all 24 unknowns explain most; deviation: the largest of its entries,
    infinite where one was never seen."""
    constant = np.vstack([np.zeros((18, 6)), np.eye(6)])
    usual = max(found.total - _solved(found, constant)[1], 1e-300)
    solved, gained = _solved(found, np.eye(24))
    left = max(found.total - gained, 0.0)
    scale = np.sqrt(np.maximum(np.diag(found.gram), 0.0))
    if not np.all(scale[:9] > _UNSEEN * np.max(scale)):
        return FreeFrame(np.eye(3), np.inf, 1.0)
    scale = np.maximum(scale, _UNSEEN * np.max(scale))
    spread = np.linalg.inv(found.gram / scale[:, None] / scale + 1e-9 * np.eye(24))
    variance = np.diag(spread)[:9] / scale[:9] ** 2 * left / max(3 * found.count - 24, 1)
    return FreeFrame(solved[:9].reshape(3, 3), float(np.sqrt(variance.max())), left / usual)


def _fitted(found: Windows, P: Array) -> tuple[float, float]:
    """Scale of P = s Pi and what it explains, the hard iron and the bias free."""
    T = np.zeros((24, 10))
    T[:9, 0] = P.ravel()
    for axis in range(3):
        T[9:18, 1 + axis] = -(skew(np.eye(3)[axis]) @ P).ravel()
    T[18:, 4:] = np.eye(6)
    solved, gained = _solved(found, T)
    return float(solved[0]), gained


def _solved(found: Windows, T: Array) -> tuple[Array, float]:
    """Unknowns (k,) of which the 24 are a linear map (24, k), and what they explain."""
    gram, right = T.T @ found.gram @ T, T.T @ found.right
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    normal = gram / scale[:, None] / scale + 1e-9 * np.eye(T.shape[1])
    solved = np.linalg.solve(normal, right / scale)
    # twice the linear part less the quadratic one: right also where the ridge acts
    gained = 2 * solved @ (right / scale) - solved @ (gram / scale[:, None] / scale) @ solved
    return np.asarray(solved / scale), float(gained)
