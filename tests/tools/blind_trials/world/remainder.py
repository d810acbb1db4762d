"""What a real recording has left of its own, and how far an injected effect stands out of it.

The gyro, less its bias, turns every reading into the world: u_k = R_k (M m_k - c), with
M = A^-1 and c = M b.  A perfect sensor in one field gives a constant.  What is left of a real one
moves: gyro noise turns R, the field of a room differs from place to place, the sensor has errors.
All that is taken as noise, and measured: two spectra, across the field and along it.

* Transform.  The noise is a walk with an unknown start, plus something flat.  The precision of
  such a walk is D'D (D: differences), which the cosine transform (DCT-II) diagonalises with
  eigenvalues 4 sin^2(pi k / 2K); so for it the coefficients are independent, exactly, and what
  else is smooth in frequency is nearly so (Whittle).  Coefficient 0, the field itself, is dropped.
* Spectrum.  A walk's 1/eigenvalue plus a level, times band means of what is left of the ratio.
  A band with n coefficients, less what the fit took of them, divides by n - 2: then 1/power has
  no bias.
* Calibration.  M (symmetric; its size is the field's), c and the gyro's bias are fitted with the
  spectrum as weights, the spectrum to what they leave, in turn; less K log det M, without which
  a fit would make the readings smaller along an axis that the motion does not show, and their
  noise with them.  A delay of the magnetometer is fitted beside them: it is no noise.
* Signal to noise of a difference (mag, gyro), with w = 1/power and the calibration's columns
  projected out: the root of  min over columns N of  sum_k w_k |D_k - N_k z|^2.  For D:
      u changes by R M dm + x cross h,    x_k = sum_(j<=k) R_j dw_j dt.
  There and in the columns stands the field h that does not move (mean direction and usual size of
  u), not u itself: a turn of half a radian would show as half of the noise, at all frequencies,
  though noise that is turned is the same noise; and a soft iron that takes up an effect would be
  as dear as that.

* What a spectrum does not say.  A remainder that is not stationary (a room walked through, iron
  that creeps) looks more like a step than noise of its spectrum does.  `score` measures that with
  the same effect at other times and in other directions, which nobody injected.

The observer knows shape, spectrum and when; it is told nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.fft import dct

_PER_BAND = 14  # coefficients that a band of the spectrum has at least
_RATIO = 1.25  # of a band's edges
_FIRST_HZ = (0.3, 0.3, 0.3, 0.1, 0.1, 0.03, 0.03, 0.01)  # below, the first turns of the fit take
# the world's field to wander: the gyro's bias comes in from fast motion to slow
_TURNS = 14  # of the fit; the later ones take the spectrum
_PRIOR = (0.15, 1.0, 0.1, 0.1)  # of soft iron, hard iron / gauss, bias / rad/s, delay / s
_TRACELESS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=float,
)


def attitudes(gyro, steps_s):
    """Sensor to world (K, 3, 3); a row's rate (K, 3) is the turn of the step that ends there."""
    angle = gyro * steps_s[:, None]
    size = np.linalg.norm(angle, axis=1)
    x, y, z = (angle / np.where(size > 0, size, 1.0)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    turns = np.eye(3) + np.sin(size)[:, None, None] * cross
    turns += (1 - np.cos(size))[:, None, None] * (cross @ cross)
    out = np.empty_like(turns)
    reached = np.eye(3)
    for k, turn in enumerate(turns[1:], start=1):
        out[k - 1] = reached
        reached = reached @ turn
    out[-1] = reached
    return out


def steps_of(time_s):
    """Seconds from the row before (K,): a host's stamps jitter, a sensor's clock does not."""
    steps = np.diff(time_s, prepend=2 * time_s[0] - time_s[1])
    usual = steps < 1.5 * np.median(steps)
    return np.where(usual, np.mean(steps[usual]), steps)


def _transformed(u):
    """Cosine coefficients (K - 1, ...) of a series (K, ...), without the mean's."""
    return dct(u, type=2, axis=0, norm="ortho")[1:]


def eigenvalues(K):
    """Of the precision of a walk of K samples with an unknown start, without the zero."""
    return 4 * np.sin(np.pi * np.arange(1, K) / (2 * K)) ** 2


def bands(count):
    """Edges of bands of coefficients."""
    edges = [0]
    while edges[-1] < count:
        edges.append(max(edges[-1] + _PER_BAND, int(edges[-1] * _RATIO)))
    edges[-1] = count
    if len(edges) > 2 and edges[-1] - edges[-2] < _PER_BAND:
        del edges[-2]
    return edges


def _walk_and_level(walk, power, first):
    """a / eigenvalue + b, of the likeliest a, b >= 0 for the first powers, (K - 1,)."""
    inverse, power = 1 / walk[:first], power[:first]
    a, b = np.mean(power / inverse), np.mean(power)
    for _ in range(30):  # each step raises the likelihood and keeps the signs
        scale = a * inverse + b
        pull = power / scale**2
        a *= np.sum(inverse * pull) / np.sum(inverse / scale)
        b *= np.sum(pull) / np.sum(1 / scale)
    return a / walk + b


def spectrum(coefficients, free=None):
    """Noise power (K - 1, 3), smooth in frequency, whose inverse has no bias.

    One for the two axes across the field, so that it does not matter where they point; one along
    it.  free: what a fit left of each coefficient's freedom, 1 where nothing was fitted.
    """
    free = np.ones_like(coefficients) if free is None else free
    out = np.empty_like(coefficients)
    edges = bands(len(coefficients))
    walk = eigenvalues(len(coefficients) + 1)
    for axes in (slice(0, 2), slice(2, 3)):
        power = np.mean(coefficients[:, axes] ** 2, axis=1)
        shape = _walk_and_level(walk, power, 3 * _PER_BAND)
        ratio = np.sum(coefficients[:, axes] ** 2, axis=1) / shape
        left = np.sum(free[:, axes], axis=1)
        for a, b in pairwise(edges):
            out[a:b, axes] = shape[a:b, None] * np.sum(ratio[a:b]) / max(np.sum(left[a:b]) - 2, 1)
    return out


@dataclass(frozen=True, eq=False)
class Remainder:
    """A fitted recording.

    turn (K, 3, 3), inverse soft iron (3, 3), reading in the world (K, 3), field there (3,), noise
    power (K - 1, 3), the calibration's columns (K - 1, 3, 11), steps (K,) s, own delay of the
    magnetometer in s
    """

    turn: np.ndarray
    inverse: np.ndarray
    world: np.ndarray
    field: np.ndarray
    power: np.ndarray
    columns: np.ndarray
    steps_s: np.ndarray
    own_delay_s: float

    def signal_to_noise(self, mag, gyro):
        """Of differences (K, 3) in gauss and rad/s, the calibration projected out."""
        return float(np.linalg.norm(self._shown(mag, gyro)))

    def score(self, mag, gyro):
        """How much of such differences the recording has itself, in standard deviations.

        About 1 in the mean square where the remainder is what its spectrum says and no more.
        """
        shown = self._shown(mag, gyro)
        left = (_transformed(self.world) / np.sqrt(self.power)).ravel()
        return float(shown @ left / np.linalg.norm(shown))

    def _shown(self, mag, gyro):
        """Differences in units of the noise, without what a calibration would take up."""
        turned = np.cumsum(np.einsum("kij,kj->ki", self.turn, gyro * self.steps_s[:, None]), axis=0)
        seen = np.einsum("kij,jl,kl->ki", self.turn, self.inverse, mag)
        seen = seen + np.cross(turned, self.field)
        weight = 1 / np.sqrt(self.power)
        left = (weight * _transformed(seen)).ravel()
        N = (weight[:, :, None] * self.columns).reshape(len(left), -1)
        N = N / np.linalg.norm(N, axis=0)
        return left - N @ np.linalg.lstsq(N, left, rcond=1e-9)[0]


def _columns(turn, mag, inverse, world, steps_s):
    """Of M's five shapes, c, the bias and a delay, (K, 3, 12)."""
    made = [np.einsum("kij,kj->ki", turn, mag @ E) for E in _TRACELESS]
    made += [-turn[:, :, i] for i in range(3)]
    for i in range(3):  # a bias that is larger turns the world back
        made.append(-np.cross(np.cumsum(turn[:, :, i] * steps_s[:, None], axis=0), world))
    slope = np.gradient(mag, axis=0) / steps_s[:, None]
    made.append(np.einsum("kij,jl,kl->ki", turn, inverse, slope))
    return np.stack(made, axis=-1)


def _facing(field):
    """A rotation that brings a direction to the third axis."""
    third = field / np.linalg.norm(field)
    first = np.cross(third, np.eye(3)[np.argmin(np.abs(third))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def fit(time_s, mag, gyro):
    """The Remainder of a recording: times (K,), gauss (K, 3), rad/s (K, 3)."""
    steps = steps_of(time_s)
    soft, c, bias, delay = np.zeros(5), np.zeros(3), np.zeros(3), 0.0
    size = np.linalg.norm(np.std(mag, axis=0))
    prior = np.repeat([_PRIOR[0], _PRIOR[1], _PRIOR[2], _PRIOR[3]], [5, 3, 3, 1])
    walk = eigenvalues(len(mag))[:, None]
    facing = np.eye(3)
    for number in range(_TURNS):
        if number < len(_FIRST_HZ):
            corner = (2 * np.pi * _FIRST_HZ[number] * np.median(steps)) ** 2
            power = (0.02 * size) ** 2 * np.repeat(1 + corner / walk, 3, axis=1)
        inverse = np.eye(3) + np.tensordot(soft, _TRACELESS, axes=1)
        turn = facing @ attitudes(gyro - bias, steps)
        slope = np.gradient(mag, axis=0) / steps[:, None]
        now = mag + delay * slope
        world = np.einsum("kij,kj->ki", turn, now @ inverse - c)
        turned = _facing(np.mean(world, axis=0))
        facing, turn, world = turned @ facing, turned @ turn, world @ turned.T
        columns = _columns(turn, now, inverse, world, steps)
        C = dct(columns, type=2, axis=0, norm="ortho")[1:]
        left = _transformed(world)
        weight = 1 / np.sqrt(power)
        C_w = (weight[:, :, None] * C).reshape(-1, C.shape[2])
        state = np.concatenate([soft, c, bias, [delay]])
        G = C_w.T @ C_w + np.diag(prior**-2.0)
        slope_of = C_w.T @ (weight * left).ravel() + state / prior**2
        bent = np.linalg.solve(inverse, _TRACELESS)
        slope_of[:5] -= len(mag) * np.einsum("nii->n", bent)
        G[:5, :5] += len(mag) * np.einsum("nij,mji->nm", bent, bent)
        step = -np.linalg.solve(G, slope_of)
        soft, c, bias, delay = np.split(state + step, [5, 8, 11])
        delay = float(delay[0])
        if number >= len(_FIRST_HZ) - 1:
            taken = np.einsum("ij,jk,ik->i", C_w, np.linalg.inv(G), C_w).reshape(power.shape)
            power = spectrum(left + C @ step, 1 - taken)
    field = np.mean(world, axis=0)
    field *= np.sqrt(np.mean(np.sum(world**2, axis=1))) / np.linalg.norm(field)
    reading = (np.einsum("kji,j->ki", turn, field) + c) @ np.linalg.inv(inverse)
    columns = _columns(turn, reading, inverse, field, steps)[:, :, :11]
    return Remainder(turn, inverse, world, field, power, _transformed(columns), steps, delay)
