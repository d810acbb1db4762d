"""The remainder of a recording as noise with a spectrum, in the axes of the world.

What a room does to the field, what a sensor has that is not quite linear and what a mount gives is
seldom white, and stays where it is while the vehicle turns.  Seen from the world it is slow or
quick, across the field or along it; against noise that is as loud at all frequencies as it is at
its loudest, nothing stands out.  So its spectrum is measured, and innovations and columns are
divided by it:

* Innovations, whitened, are brought back to gauss and turned into the frame that the gyro carries
  along, held by the field: two axes across it, one along it.
* What the filter followed them by, e_j by K_j e_j, is put back: with h+ = h- + K e the reading less
  the field that the gyro alone would have carried there is
      u_k = C e_k + sum_(j<k) K_j e_j      (all turned into the world),
  linear in the innovations and lossless, whatever the gains.  In the innovations themselves what is
  slow is small, as small as what the ends of the recording make of a quick remainder, and a gyro's
  error that adds up was lost beside it.  Where the field was in the beginning nobody knows: the
  mean of u is dropped.
* The cosine transform (DCT-II) makes walks, levels and differences of them independent.  The power
  is a walk's, a level's and a difference's, as much of each as is likeliest, times the mean of what
  is left in bands; for both axes across alike.
* Calibration and names, and a candidate where one is asked about, are regressed out with the power
  as weights, the power measured from what they leave, in turn: what a name explains is no noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import fft

from ahrsd.diagnosis.innovation_filter.context import held_by_field
from ahrsd.diagnosis.innovation_filter.evidence import colour
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.regression import Base, based
from ahrsd.samples import Array

#: coefficients that a band has at least, and its end over its beginning
PER_BAND, WIDER = 14, 1.25
#: rounds of regression and spectrum, and of the power's shape
ROUNDS, SHAPE_ROUNDS = 4, 40
#: axes across the field, which have one spectrum, and along it
AXES = (slice(0, 2), slice(2, 3))


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """From whitened innovations to gauss in the world: two axes across the field, one along it.

    turn: (N, 3, 3) the innovation itself;  followed: (N, 3, 3) what the filter followed it by
    """

    turn: Array
    followed: Array


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Noise of its own power at every frequency.

    seen: how innovations are seen from the world;  power: (N, 3) of coefficients
    nats: log likelihood of what was left, but for a constant
    """

    seen: World
    power: Array
    nats: float

    def whitened(self, values: Array) -> Array:
        """Values (N, 3) or (N, 3, p), again in time."""
        seen = transformed(self.seen, values.reshape(*self.power.shape, -1))
        seen /= np.sqrt(self.power)[:, :, None]
        return np.asarray(fft.idct(seen, type=2, axis=0, norm="ortho").reshape(values.shape))


def against(basis: Base, noise: Spectrum) -> Base:
    """The basis with a spectrum whitened out of it."""
    known, innovation = noise.whitened(basis.known), noise.whitened(basis.innovation)
    out = replace(based(basis, basis.groups, known, innovation), rest=noise)
    return replace(out, colour=colour(innovation, basis.rate_hz))


def spectrum_of(basis: Base, columns: Array | None = None) -> Spectrum:
    """The spectrum of what known columns, and these beside them (N, 3, p), leave of a basis."""
    world = in_world(basis)
    beside = () if columns is None else (columns,)
    stacked = np.concatenate([basis.known, *beside, basis.innovation[:, :, None]], axis=2)
    seen = transformed(world, stacked)
    Z, e = seen[:, :, :-1], seen[:, :, -1]
    power = smooth_power(e, _freedom(len(e)))
    for _ in range(ROUNDS):
        weight = 1.0 / np.sqrt(power)
        F = (Z * weight[:, :, None]).reshape(-1, Z.shape[2])
        inverse = solve(F.T @ F, np.eye(Z.shape[2]))
        left = e - Z @ (inverse @ (F.T @ (e * weight).ravel()))
        free = 1.0 - np.einsum("ij,jk,ik->i", F, inverse, F).reshape(e.shape)
        free *= _freedom(len(e))
        power = smooth_power(left, free)
    nats = -0.5 * float(np.sum(np.log(power) + left**2 / power))
    return Spectrum(world, power, nats)


def in_world(basis: Base) -> World:
    """How the innovations of a basis are seen from the world."""
    done = basis.filtered
    root = np.zeros_like(done.gains.innovation_covariance)
    root[done.used] = np.linalg.cholesky(done.gains.innovation_covariance[done.used])
    runs = done.track.runs or (slice(0, len(root)),)
    carried = np.einsum("nij,nj->ni", done.orientation, done.nominal_b)
    turn = held_by_field(carried, runs) @ done.orientation
    for run in runs:
        along = carried[run][0] / np.linalg.norm(carried[run][0])
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        turn[run] = np.stack([across, np.cross(along, across), along]) @ turn[run]
    gain = np.where(done.used[:, None, None], done.gains.gain[:, :3], 0.0)
    return World(turn @ np.linalg.inv(done.model.soft_iron) @ root, turn @ gain @ root)


def transformed(world: World, values: Array) -> Array:
    """Cosine coefficients (N, 3, p) in the world of whitened values (N, 3, p).

    The first, where the field was in the beginning, is known to nobody: zero.
    """
    followed = np.cumsum(world.followed @ values, axis=0)
    left = world.turn @ values
    left[1:] += followed[:-1]
    out = fft.dct(left, type=2, axis=0, norm="ortho")
    out[0] = 0.0
    return np.asarray(out)


def _freedom(count: int) -> Array:
    """(N, 3) of the coefficients where nothing was fitted."""
    out = np.ones((count, 3))
    out[0] = 0.0
    return out


def smooth_power(coefficients: Array, free: Array) -> Array:
    """Power (N, 3) of coefficients, smooth in frequency.

    free: (N, 3) what a regression left of each coefficient's freedom, 1 where nothing was fitted
    """
    count = len(coefficients)
    walk = 4.0 * np.sin(np.pi * np.maximum(np.arange(count), 0.5) / (2 * count)) ** 2
    shapes = np.stack([1.0 / walk, np.ones(count), walk])
    edges = _bands(count)
    out = np.empty_like(coefficients)
    for axes in AXES:
        square, left = (np.sum(v[:, axes], axis=1) for v in (coefficients**2, free))
        shape = _likeliest(shapes, square, left)
        for a, b in pairwise(edges):
            ratio = np.sum(square[a:b] / shape[a:b]) / max(float(np.sum(left[a:b])), 1.0)
            out[a:b, axes] = ratio * shape[a:b, None]
    return np.maximum(out, 1e-12 * float(out.max()))


def _likeliest(shapes: Array, square: Array, free: Array) -> Array:
    """The likeliest sum (N,) of shapes (k, N), none of them negative.  Each step is a gain."""
    weight = np.sum(square) / np.maximum(np.sum(shapes * free, axis=1), 1e-300) / len(shapes)
    for _ in range(SHAPE_ROUNDS):
        power = weight @ shapes
        weight = weight * np.sum(shapes * (square / power**2), axis=1)
        weight /= np.sum(shapes * (free / power), axis=1)
    return np.asarray(weight @ shapes)


def _bands(count: int) -> list[int]:
    edges = [0]
    while edges[-1] < count:
        edges.append(max(edges[-1] + PER_BAND, int(edges[-1] * WIDER)))
    edges[-1] = count
    if len(edges) > 2 and edges[-1] - edges[-2] < PER_BAND:
        del edges[-2]
    return edges
