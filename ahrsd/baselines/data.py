"""What every published method takes, what it gives back, and what none can use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.estimator.chain import symmetric
from ahrsd.printable import counted
from ahrsd.samples import Array

# -- What a method takes and gives -----------------------------------------------------------------


Derivative = Literal["median", "savgol"]
Constraint = Literal["trace", "fang"]


class MethodError(ValueError):
    """A method has no answer for these data; the text says why in one line."""


@dataclass(frozen=True, slots=True, eq=False)
class MethodData:
    """N samples in the sensor frame, raw, in segments that no gap interrupts.

    time_s (N,), dt_s (N,)    instants, and the step that ends at each; dt_s is not used at a start
    raw_b_gauss (N, 3)        m = A h + b + noise
    gyro_b_rad_s (N, 3)       mean rate over the step that ends at the sample, with its bias
    starts                    row of each segment's first sample, ascending, beginning with 0
    accel_b_m_s2 (N, 3)       specific force, or None
    R_nb (N, 3, 3)            attitude, or None
    field_n_gauss (3,)        the local field in north, east, down, or None
    field_norm_gauss          its magnitude, one number or (N,); None where nobody knows
    """

    time_s: Array
    dt_s: Array
    raw_b_gauss: Array
    gyro_b_rad_s: Array
    starts: tuple[int, ...] = (0,)
    accel_b_m_s2: Array | None = None
    R_nb: Array | None = None
    field_n_gauss: Array | None = None
    field_norm_gauss: float | Array | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def segments(self) -> Iterator[slice]:
        """The rows of each segment."""
        for first, last in zip(self.starts, (*self.starts[1:], len(self)), strict=True):
            yield slice(first, last)

    def field_norms(self) -> Array:
        """|H_k| of every sample, (N,).  MethodError where it is not known."""
        known = self.field_norm_gauss
        if known is None and self.field_n_gauss is not None:
            known = float(np.linalg.norm(self.field_n_gauss))
        if known is None:
            raise MethodError("needs the field's magnitude: give position and date, or the field")
        norms = np.asarray(known, dtype=np.float64)
        if norms.shape not in ((), (len(self),)):
            raise MethodError(f"the field's magnitude has {norms.shape}: one or {len(self)}")
        if not np.all(norms > 0) or not np.isfinite(norms).all():
            raise MethodError("the field's magnitude must be a positive number of gauss")
        return np.asarray(np.broadcast_to(norms, (len(self),)))


def _zero() -> Array:
    return np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class MethodSettings:
    """What the publications leave to the user; the defaults are theirs.

    sigma_mag_gauss:   noise of one reading per axis; None: measured on the data [None]
    sigma_field_gauss: noise of the given |H_k|, one number or (N,), for np-uncertain-field [1.5e-3,
                       about the world magnetic model's error of the total intensity]
    known_gyro_bias_rad_s: for magical-ls, which does not estimate it [0]
    derivative:        "median" as in the seeds: first differences, their median per window.
                       "savgol": readings smoothed by a Savitzky-Golay filter first
    ellipsoid_constraint: "trace": a + b + c = -3, as [R]. "fang": 4 a b - (2 h)^2 = 1, as Fang et
                       al.; far better where z varies little ["trace"]
    window:            theta, samples per factor [25]
    update_every:      Gamma, factors per optimisation of the incremental methods [10]
    savgol_window:     samples of the Savitzky-Golay filter, of order 2 [51]
    relinearize:       iSAM2's threshold of movement for linearising again; 0 for never, None for
                       the method's own: never in magical-ifg, 0.1 (GTSAM's) in magyc-ifg [None]
    """

    sigma_mag_gauss: float | None = None
    sigma_field_gauss: float | Array = 1.5e-3
    known_gyro_bias_rad_s: Array = field(default_factory=_zero)
    derivative: Derivative = "median"
    ellipsoid_constraint: Constraint = "trace"
    window: int = 25
    update_every: int = 10
    savgol_window: int = 51
    relinearize: float | None = None

    def __post_init__(self) -> None:
        """MethodError naming the setting that cannot be."""
        positive = {
            "sigma_mag_gauss": self.sigma_mag_gauss,
            "sigma_field_gauss": self.sigma_field_gauss,
        }
        for name, value in positive.items():
            if value is not None and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
                raise MethodError(f"{name} is {value}: it must be a positive number of gauss")
        least = {"window": 2, "update_every": 1, "savgol_window": 5}
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise MethodError(f"{name} is {getattr(self, name)}: at least {minimum}")
        words = {"derivative": get_args(Derivative), "ellipsoid_constraint": get_args(Constraint)}
        for name, known in words.items():
            if getattr(self, name) not in known:
                raise MethodError(f"{name} is {getattr(self, name)}: one of {', '.join(known)}")


@dataclass(frozen=True, slots=True, eq=False)
class MethodFit:
    """An answer: A (3, 3), b (3,) in gauss, w_b (3,) in rad/s; None what is not estimated."""

    soft_iron: Array | None
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array | None
    iterations: int
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """What a method said. Without convergence there are no numbers and `reason` says why.

    soft_iron A is symmetric positive definite; det A = 1 unless the method knows |h|. `reason` of a
    converged result is empty or a remark. seconds is nan where no clock was given.
    """

    method: str
    soft_iron: Array | None
    hard_iron_gauss: Array | None
    gyro_bias_rad_s: Array | None
    converged: bool
    reason: str
    iterations: int
    seconds: float


def field_spread(corrected: Array) -> float:
    """Standard deviation of |h| over its mean, of corrected fields (N, 3); 0 is perfect."""
    size = np.linalg.norm(corrected, axis=1)
    return float(np.std(size) / np.mean(size))


def corrected(raw_b_gauss: Array, soft_iron: Array | None, hard_iron_gauss: Array) -> Array:
    """A^-1 (m - b) of readings (N, 3); without a soft iron m - b."""
    centred = raw_b_gauss - hard_iron_gauss
    if soft_iron is None:
        return centred
    return np.asarray(np.linalg.solve(soft_iron, centred.T).T, dtype=np.float64)


# -- What none can use -----------------------------------------------------------------------------


MINIMUM_SAMPLES = 20
_FIELD_GAUSS = (0.01, 10.0)  # median magnitude; the earth has 0.22 to 0.67 and iron adds to it
_RATE_RAD_S = 70.0  # twice what the VN-100's gyroscope can measure
_STUCK = 0.05  # part of the samples at an axis' very largest or smallest reading
_NOISE_SPREADS = 5.0  # a direction needs this many sigmas of spread to count as moved in
_LEAST_NOISE_GAUSS = 1e-9  # simulated readings may have none
_FLATNESS = 0.015  # third spread over first; a car that circles has 0.05 to 0.09, LAM 0.13 to 0.2
_EXPLAINED = 0.4  # part of the turning that a gyroscope must explain; real drives have 0.57 to 0.98
_TRUSTED = 0.95  # part of the runs that must be explained
_MOST_PER_RAD = 5.0  # gauss that a reading can change by in a turn; the earth has 0.7 at most
_TURN_RAD, _MOST_STEPS = 0.5, 256  # a change is over steps that turn about so far together
_WEAK = 0.1  # the same, below which the answer across that plane rests on little


def mag_noise(data: MethodData, settings: MethodSettings) -> float:
    """Sigma of one reading in gauss: as set, else from third differences: too quick for motion."""
    if settings.sigma_mag_gauss is not None:
        return settings.sigma_mag_gauss
    parts = [np.diff(data.raw_b_gauss[rows], n=3, axis=0) for rows in data.segments()]
    third = np.vstack([part for part in parts if len(part)] or [np.zeros((1, 3))])
    # the median absolute value of a Gaussian is 0.6745 sigma; 1, 3, 3, 1 squared and summed is 20
    sigma = float(np.median(np.abs(third)) / (0.6745 * np.sqrt(20.0)))
    return max(sigma, _LEAST_NOISE_GAUSS)


def usable(data: MethodData) -> None:
    """MethodError naming the first thing that makes these samples unusable for every method."""
    if len(data) < MINIMUM_SAMPLES:
        raise MethodError(f"{counted(len(data), 'sample')}: at least {MINIMUM_SAMPLES} are needed")
    for name in ("time_s", "raw_b_gauss", "gyro_b_rad_s"):
        good = np.isfinite(getattr(data, name)).reshape(len(data), -1).all(axis=1)
        if not good.all():
            raise MethodError(f"{name} of row {int(np.argmin(good))} is not finite")
    inner = np.ones(len(data), dtype=bool)
    inner[list(data.starts)] = False
    good = ~inner | ((data.dt_s > 0) & np.isfinite(data.dt_s))
    if not good.all():
        k = int(np.argmin(good))
        raise MethodError(f"dt_s of row {k} is {data.dt_s[k]}: time must go forward")
    size = float(np.median(np.linalg.norm(data.raw_b_gauss, axis=1)))
    if not _FIELD_GAUSS[0] < size < _FIELD_GAUSS[1]:
        raise MethodError(f"the readings are about {size:.3g} in size: is the unit gauss?")
    rate = float(np.max(np.abs(data.gyro_b_rad_s)))
    if rate > _RATE_RAD_S:
        raise MethodError(f"the gyroscope reads up to {rate:.3g}: is the unit rad/s?")


def spreads(field: Array) -> Array:
    """Standard deviations of readings (N, 3) along their principal axes, descending, in gauss."""
    scales = np.linalg.svd(field - field.mean(axis=0), compute_uv=False)
    return np.asarray(scales / np.sqrt(len(field)), dtype=np.float64)


def check_motion(data: MethodData, settings: MethodSettings, axes: int) -> str:
    """A remark where the motion is weak, else "".

    MethodError unless the field's readings vary along `axes` principal directions (2 or 3).
    """
    spread = spreads(data.raw_b_gauss)
    noise = mag_noise(data, settings)
    if spread[1] < max(_NOISE_SPREADS * noise, 1e-4):
        raise MethodError(
            f"the sensor hardly turned: readings spread by {1e3 * spread[0]:.2g} mG, "
            f"noise is {1e3 * noise:.2g} mG"
        )
    if axes >= 3 and spread[2] < max(_NOISE_SPREADS * noise, _FLATNESS * spread[0]):
        raise MethodError(
            "the sensor turned about one axis only: readings lie in a plane "
            f"({1e3 * spread[2]:.2g} mG off it, noise is {1e3 * noise:.2g} mG); pitch and roll too"
        )
    if words := stuck(data.raw_b_gauss):
        raise MethodError(words)
    if axes >= 3 and spread[2] < _WEAK * spread[0]:
        return f"weak motion: readings leave a plane by {1e3 * spread[2]:.2g} mG only"
    return ""


def stuck(raw_b_gauss: Array) -> str:
    """Which axis of the readings (N, 3) stands at its own limit far too often, in words, or ""."""
    for axis, values in zip("xyz", raw_b_gauss.T, strict=True):
        for limit in (values.min(), values.max()):
            if np.mean(values == limit) > _STUCK:
                why = "saturated" if limit else "the magnetometer gave none"
                return f"readings of {axis} stick at {limit:.4g} gauss: {why}"
    return ""


def agrees_with_gyro(data: MethodData, fit: MethodFit) -> None:
    """MethodError where the gyroscope does not explain how the field turns.

    Wrong units, axes, signs or times explain nothing, and then no answer of a method that rests on
    the gyroscope means anything.
    """
    bias = np.zeros(3) if fit.gyro_bias_rad_s is None else fit.gyro_bias_rad_s
    begin, turn = _runs(data)
    if not begin.size:
        return
    end = begin + len(turn)
    change = data.raw_b_gauss[end] - data.raw_b_gauss[begin]
    turned = np.sum(np.sum(turn, axis=0) ** 2)
    per_rad = float(np.sqrt(np.sum(change**2) / max(float(turned), 1e-300)))
    if per_rad > _MOST_PER_RAD:
        raise MethodError(
            f"the field turns by {per_rad:.3g} gauss for each radian of the gyroscope: is its unit "
            "rad/s?"
        )
    h = corrected(data.raw_b_gauss, fit.soft_iron, fit.hard_iron_gauss)
    own = bias * data.dt_s[begin + np.arange(1, len(turn) + 1)[:, None]][..., None]
    share = explained(h[begin], h[end], turn - own)
    if share < _EXPLAINED:
        raise MethodError(
            f"the gyroscope explains {100 * max(share, 0.0):.0f} % of how the field turns: are its "
            "unit, axes and the time right?"
        )


def explained(begin: Array, end: Array, turn: Array) -> float:
    """1 - sum |h_end - R h_begin|^2 / sum |h_end - h_begin|^2 without the worst runs.

    Corrected fields (n, 3) at both ends of each run; turn (steps, n, 3) in rad, step by step. What
    passes by, and what was lost, spoils few runs; those are left out of both sums.
    """
    found = begin
    for step in turn:
        found = np.einsum("nji,nj->ni", so3.exp(step), found)
    missed = np.sum((end - found) ** 2, axis=1)
    changed = np.sum((end - begin) ** 2, axis=1)
    kept = np.argsort(missed)[: max(int(np.ceil(_TRUSTED * len(missed))), 1)]
    return 1.0 - float(np.sum(missed[kept])) / max(float(np.sum(changed[kept])), 1e-300)


def _runs(data: MethodData) -> tuple[NDArray[np.intp], Array]:
    """First rows (n,) of runs that turn by about half a radian, and turn (steps, n, 3) of each."""
    inner = np.ones(len(data), dtype=bool)
    inner[list(data.starts)] = False
    turn = data.gyro_b_rad_s * np.where(inner, data.dt_s, 0.0)[:, None]
    usual = max(float(np.median(np.linalg.norm(turn[inner], axis=1))), 1e-12)
    steps = int(np.clip(np.ceil(_TURN_RAD / usual), 1, _MOST_STEPS))
    begins = [np.arange(s.start, s.stop - steps, steps) for s in data.segments()]
    begin = np.concatenate(begins).astype(np.intp)
    return begin, turn[begin + np.arange(1, steps + 1)[:, None]]


def answer(c6: Array, pseudo: Array) -> tuple[Array, Array]:
    """A of unit volume and b = A b' of c and b' at any common scale.

    MethodError where C is not positive definite or the answer no sensor's.
    """
    C = symmetric(c6)
    if not (np.isfinite(c6).all() and np.isfinite(pseudo).all()):
        raise MethodError("diverged: the answer is not finite")
    values = np.linalg.eigvalsh(C)
    if values[0] <= 0:
        raise MethodError("the matrix that fits best is not positive definite: no soft iron")
    if values[-1] > _LARGEST_CONDITION * values[0]:
        raise MethodError(
            f"the soft iron that fits best is distorted {values[-1] / values[0]:.0f} : 1: "
            "the motion does not determine it"
        )
    A = np.asarray(np.linalg.inv(C), dtype=np.float64)
    b = A @ pseudo  # the scale of C and b' cancels here
    return rescaled(A), b


_LARGEST_CONDITION = 50.0  # of A: no sensor in use is distorted like that; a diverged fit is


def rescaled(A: Array) -> Array:
    """A (l0 l1 l2)^(-1/3), symmetric to the last bit."""
    A = (A + A.T) / 2
    return np.asarray(A * float(np.linalg.det(A)) ** (-1 / 3))
