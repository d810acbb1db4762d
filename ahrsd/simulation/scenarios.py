"""The theses' experiments: WAM, MAM and LAM of [R] chapter 5, and [L]'s along a recorded gyro.

The motion of [R] is "slow" or "rov"; what goes wrong on real streams can be added to it.

An `Experiment` is the samples that a sensor would have sent, and the truth behind every one, in the
two conventions of the theses. It can be laid out as a recording: in the contract's table columns,
or as VNYMR sentences.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ahrsd import so3
from ahrsd.samples import Array, SampleBlock
from drivers.vn100.messages import encode_sentence

# -- An experiment ---------------------------------------------------------------------------------


def _constant(*rows: object) -> Array:
    value = np.array(rows, dtype=np.float64)
    value.flags.writeable = False
    return value


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The hidden values in this project's convention, m = A h + b.

    soft_iron:       A (3, 3), symmetric, det A = 1
    hard_iron_gauss: b (3,), at the end of the experiment where it steps
    gyro_bias_rad_s: (3,)
    field_gauss:     |h|, the field's magnitude in the units that det A = 1 leaves
    noise_mag_gauss, noise_gyro_rad_s: standard deviations per sample and axis
    """

    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    field_gauss: float
    noise_mag_gauss: float
    noise_gyro_rad_s: float

    @property
    def parameters(self) -> Array:
        """(12,) in the order of `Estimate.covariance`: A's upper triangle by rows, b, w_b."""
        triangle = self.soft_iron[np.triu_indices(3)]
        return np.concatenate([triangle, self.hard_iron_gauss, self.gyro_bias_rad_s])

    def json(self) -> dict[str, object]:
        """The values as calibration.json names them."""
        return {
            "soft_iron": self.soft_iron.tolist(),
            "hard_iron_gauss": self.hard_iron_gauss.tolist(),
            "gyro_bias_rad_s": self.gyro_bias_rad_s.tolist(),
            "field_gauss": self.field_gauss,
            "noise_mag_gauss": self.noise_mag_gauss,
            "noise_gyro_rad_s": self.noise_gyro_rad_s,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Iron:
    """The theses' description of a sensor: A of any volume and the pseudo hard iron m_b.

    [R] (3.1) writes m = A (m_t + m_b), so b = A m_b (the default). The figures of its Table 5.1
    were made with m = A m_t + m_b whatever (3.1) says: `offset_behind_iron` gives b = m_b.
    Defaults: [R]'s sensor, mG and mrad/s divided by 1000.
    """

    soft_iron: Array = field(
        default_factory=lambda: _constant(
            (1.10, 0.10, 0.04), (0.10, 0.88, 0.02), (0.04, 0.02, 1.22)
        )
    )
    pseudo_hard_iron_gauss: Array = field(default_factory=lambda: _constant(0.020, 0.120, 0.090))
    gyro_bias_rad_s: Array = field(default_factory=lambda: _constant(4e-3, -5e-3, 2e-3))
    field_n_gauss: Array = field(default_factory=lambda: _constant(0.227, 0.052, 0.412))
    offset_behind_iron: bool = False

    @property
    def hard_iron_gauss(self) -> Array:
        """b (3,) of m = A h + b."""
        if self.offset_behind_iron:
            return self.pseudo_hard_iron_gauss
        return np.asarray(self.soft_iron @ self.pseudo_hard_iron_gauss)

    def scaled(self, scale: float) -> Iron:
        """The same sensor with `scale` times the hard iron ([L]'s range of biases)."""
        return replace(self, pseudo_hard_iron_gauss=scale * self.pseudo_hard_iron_gauss)

    def truth(self, noise_mag_gauss: float, noise_gyro_rad_s: float) -> Truth:
        """The same sensor with det A = 1: the field's magnitude takes the volume."""
        volume = float(np.cbrt(np.linalg.det(self.soft_iron)))
        return Truth(
            soft_iron=self.soft_iron / volume,
            hard_iron_gauss=self.hard_iron_gauss,
            gyro_bias_rad_s=self.gyro_bias_rad_s,
            field_gauss=float(np.linalg.norm(self.field_n_gauss)) * volume,
            noise_mag_gauss=noise_mag_gauss,
            noise_gyro_rad_s=noise_gyro_rad_s,
        )


GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """N samples with their truth.

    name:         says what it is, for people
    samples:      what the sensor sent; `dt_s` is nan in the first row and behind each gap
    R_nb:         (N, 3, 3) attitude
    field_b:      (N, 3) true field in gauss in the units of det A = 1, so |field_b| is constant
    rate_b_rad_s: (N, 3) true mean rate over the step that ends at the sample
    """

    name: str
    samples: SampleBlock
    truth: Truth
    R_nb: Array
    field_b: Array
    rate_b_rad_s: Array

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def starts(self) -> list[int]:
        """Row 0 and every row behind a gap."""
        return [0, *(np.flatnonzero(np.isnan(self.samples.dt_s[1:])) + 1).tolist()]

    def first(self, count: int) -> Experiment:
        """The first `count` samples."""
        return self.taken(np.arange(len(self)) < count)

    def taken(self, rows: NDArray[np.bool]) -> Experiment:
        """The rows for which `rows` (N,) bool is true; steps over left-out rows become unknown."""
        index = np.flatnonzero(rows)
        new = index[np.flatnonzero(np.diff(index) > 1) + 1]
        dt_s = self.samples.dt_s.copy()
        dt_s[new] = np.nan
        dt_s[index[:1]] = np.nan
        kept = replace(self.samples, dt_s=dt_s).part(index, gap_before=True)
        return Experiment(
            self.name,
            kept,
            self.truth,
            self.R_nb[index],
            self.field_b[index],
            self.rate_b_rad_s[index],
        )

    def blocks(self, rows: int) -> Iterator[SampleBlock]:
        """Blocks of at most `rows` rows, none of which spans a gap."""
        starts = self.starts
        for start, end in zip(starts, [*starts[1:], len(self)], strict=True):
            for at in range(start, end, rows):
                yield self.samples.part(slice(at, min(at + rows, end)), gap_before=at == start)


def measured(
    name: str,
    iron: Iron,
    R_nb: Array,
    rate_b_rad_s: Array,
    time_s: Array,
    noise: tuple[float, float],
    rng: tuple[np.random.Generator, np.random.Generator],
) -> Experiment:
    """What the sensor reads on a trajectory: m = A h + b + noise, w + w_b + noise, gravity.

    R_nb (N, 3, 3), rate_b_rad_s (N, 3), row 0 nan (before the first sample nothing is known; its
    reading repeats the next one); noise and rng: of the magnetometer (gauss), the gyro (rad/s).
    """
    truth = iron.truth(*noise)
    size = float(np.linalg.norm(iron.field_n_gauss))
    field_b = np.einsum("nji,j->ni", R_nb, iron.field_n_gauss * (truth.field_gauss / size))
    count = len(R_nb)
    raw = field_b @ truth.soft_iron.T + truth.hard_iron_gauss
    raw += noise[0] * rng[0].standard_normal((count, 3))
    rate = rate_b_rad_s.copy()
    rate[0] = rate[1]
    gyro = rate + truth.gyro_bias_rad_s + noise[1] * rng[1].standard_normal((count, 3))
    block = SampleBlock(
        time_s=time_s,
        dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
        host_s=time_s,
        raw_b_gauss=raw,
        gyro_b_rad_s=gyro,
        accel_b_m_s2=R_nb[:, 2, :] * -GRAVITY_M_S2,
        gap_before=True,
    )
    return Experiment(name, block, truth, R_nb, field_b, rate)


# -- Scenarios -------------------------------------------------------------------------------------


# -- How the sensor turns --------------------------------------------------------------------------
#
# How the sensor turns: sinusoids in roll, pitch and heading ([R] chapter 5).
#
#     angle_i(t) = A_i sin(2 pi f_i t + phi_i),   phi_i uniform in 0..2 pi, f_i uniform per run
#
# [R] gives the half-ranges A_i and no frequencies. "slow" has those of the authors' early code, in
# which the field's derivative is buried in noise; "rov" the peak rates 2 pi f_i A_i of their later
# code.


SUBSTEPS = 8  # per sample; the attitude itself is exact at every one of them

#: Half-ranges of roll, pitch and heading in degrees: wide, medium and low angular movement.
SCENARIOS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"wam": (180.0, 180.0, 180.0), "mam": (5.0, 45.0, 180.0), "lam": (5.0, 15.0, 90.0)}
)
#: Ranges per angle from which each run draws, and whether they are frequencies or peak rates.
MOTIONS: Mapping[str, tuple[str, tuple[tuple[float, float], ...]]] = MappingProxyType(
    {
        "slow": ("frequency_hz", ((5e-3, 10e-3), (5e-3, 8e-3), (4e-3, 8e-3))),
        "rov": ("peak_rate_rad_s", ((0.05, 0.08), (0.1, 0.3), (0.2, 0.4))),
    }
)


def sinusoids(
    scenario: str, motion: str, rng: np.random.Generator, samples: int, rate_hz: float
) -> Array:
    """Attitude R_nb ((samples - 1) * SUBSTEPS + 1, 3, 3) at the sub-steps; row 0 is sample 0.

    Raises KeyError for an unknown scenario or motion.
    """
    half_range = np.radians(SCENARIOS[scenario])
    kind, ranges = MOTIONS[motion]
    drawn = np.array([rng.uniform(low, high) for low, high in ranges])
    frequency_hz = drawn if kind == "frequency_hz" else drawn / (2 * np.pi * half_range)
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    time_s = np.arange((samples - 1) * SUBSTEPS + 1) / (SUBSTEPS * rate_hz)
    angle = half_range * np.sin(2 * np.pi * frequency_hz * time_s[:, None] + phase)
    roll, pitch, heading = angle.T
    return so3.from_yaw_pitch_roll(heading, pitch, roll)


def mean_rate(R_nb: Array, substeps: int, dt_s: float) -> Array:
    """Mean body rate (N, 3) in rad/s over the step that ends at each sample; row 0 is nan.

    R_nb ((N - 1) * substeps + 1, 3, 3): the mean is the sum of the sub-steps' rotation vectors over
    the step, which is what a gyroscope that integrates its signal reports.
    """
    increment = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    angle = increment.reshape(-1, substeps, 3).sum(axis=1)
    return np.vstack([np.full((1, 3), np.nan), angle / dt_s])


def quaternion(R_nb: Array) -> Array:
    """Unit quaternions (N, 4), scalar first, sensor to world, continuous in sign, of (N, 3, 3)."""
    q = Rotation.from_matrix(R_nb).as_quat(canonical=True, scalar_first=True)
    flips = np.sign(np.sum(q[1:] * q[:-1], axis=1))
    q[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
    return q


# -- What goes wrong on real streams ---------------------------------------------------------------
#
# What goes wrong on real streams, kept simple: outliers, a magnet passing by, a step, a gap.


_STEP_AXIS = np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
_MAGNET_AXIS = np.array([0.6, 0.0, 0.8])


@dataclass(frozen=True, slots=True)
class Disturbances:
    """None of them by default. Times are seconds after the first sample.

    outlier_fraction: of the samples, each off by `outlier_gauss` in a random direction
    magnet_at_s:      a magnet passes: a bump of `magnet_gauss`, `magnet_length_s` long (raised
                      cosine), along a fixed axis of the sensor
    step_at_s:        the hard iron steps by `step_gauss` and stays; `Truth` has the last value
    gap_at_s:         no samples for `gap_length_s`
    """

    outlier_fraction: float = 0.0
    outlier_gauss: float = 0.1
    magnet_at_s: float | None = None
    magnet_length_s: float = 10.0
    magnet_gauss: float = 0.1
    step_at_s: float | None = None
    step_gauss: float = 0.03
    gap_at_s: float | None = None
    gap_length_s: float = 2.0

    def __post_init__(self) -> None:
        """Raises ValueError where the fraction of outliers is no fraction."""
        if not 0.0 <= self.outlier_fraction <= 1.0:
            raise ValueError(f"outlier_fraction is {self.outlier_fraction}: it must be in 0..1")


def disturbed(experiment: Experiment, wanted: Disturbances, rng: np.random.Generator) -> Experiment:
    """The experiment with what is wanted added; the very same object where nothing is.

    ValueError where something would come before or after all samples.
    """
    if wanted == Disturbances():
        return experiment
    time_s = experiment.samples.time_s - experiment.samples.time_s[0]
    for name in ("magnet_at_s", "step_at_s", "gap_at_s"):
        at_s = getattr(wanted, name)
        if at_s is not None and not 0.0 <= at_s <= time_s[-1]:
            raise ValueError(f"{name} is {at_s:g}: the recording lasts {time_s[-1]:.6g} s")
    raw = experiment.samples.raw_b_gauss.copy()
    truth = experiment.truth
    if wanted.outlier_fraction > 0:
        raw += _outliers(len(raw), wanted, rng)
    if wanted.magnet_at_s is not None:
        phase = np.clip((time_s - wanted.magnet_at_s) / wanted.magnet_length_s, 0.0, 1.0)
        bump = wanted.magnet_gauss * (1 - np.cos(2 * np.pi * phase)) / 2
        raw += bump[:, None] * _MAGNET_AXIS
    if wanted.step_at_s is not None:
        step = wanted.step_gauss * _STEP_AXIS
        raw[time_s >= wanted.step_at_s] += step
        truth = replace(truth, hard_iron_gauss=truth.hard_iron_gauss + step)
    samples = replace(experiment.samples, raw_b_gauss=raw)
    changed = replace(experiment, samples=samples, truth=truth)
    if wanted.gap_at_s is None:
        return changed
    inside = (time_s > wanted.gap_at_s) & (time_s < wanted.gap_at_s + wanted.gap_length_s)
    return changed.taken(~inside)


def _outliers(count: int, wanted: Disturbances, rng: np.random.Generator) -> Array:
    hit = rng.random(count) < wanted.outlier_fraction
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(wanted.outlier_gauss * hit[:, None] * direction)


# -- The experiments of [R] ------------------------------------------------------------------------
#
# The experiments of [R] chapter 5: WAM, MAM, LAM, in "slow" and in "rov" motion.


@dataclass(frozen=True, slots=True)
class ScenarioSettings:
    """One experiment. The same settings give the same samples, bit by bit, on one machine.

    scenario: "wam", "mam" or "lam"; motion: "slow" or "rov"
    seed:     chooses frequencies and phases, and, each from a generator of its own, the noises: a
              sweep over noise or bias keeps the trajectory
    """

    scenario: str = "wam"
    motion: str = "slow"
    seed: int = 0
    samples: int = 10_000
    rate_hz: float = 25.0
    noise_mag_gauss: float = 1e-3
    noise_gyro_rad_s: float = 5e-3
    iron: Iron = field(default_factory=Iron)
    disturbances: Disturbances = field(default_factory=Disturbances)

    def __post_init__(self) -> None:
        """Raises ValueError naming the setting that cannot be."""
        for name, known in (("scenario", SCENARIOS), ("motion", MOTIONS)):
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"no {name} {value!r}; there are {', '.join(known)}")
        if self.samples < 2:
            raise ValueError(f"samples is {self.samples}: at least 2")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}: it must not be negative")
        for name in ("rate_hz", "noise_mag_gauss", "noise_gyro_rad_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0 and (value > 0 or name != "rate_hz")):
                raise ValueError(f"{name} is {value}: it must be a positive number")

    @property
    def truth(self) -> Truth:
        """What is hidden, before any disturbance."""
        return self.iron.truth(self.noise_mag_gauss, self.noise_gyro_rad_s)


def generator(seed: int, purpose: int) -> np.random.Generator:
    """A generator of its own for each purpose (0 motion, 1 field, 2 gyro, 3 disturbances)."""
    return np.random.default_rng([seed, purpose])


def simulate(settings: ScenarioSettings) -> Experiment:
    """Make the experiment."""
    s = settings
    fine = sinusoids(s.scenario, s.motion, generator(s.seed, 0), s.samples, s.rate_hz)
    made = measured(
        f"{s.scenario} {s.motion}, seed {s.seed}",
        s.iron,
        fine[::SUBSTEPS],
        mean_rate(fine, SUBSTEPS, 1.0 / s.rate_hz),
        np.arange(1, s.samples + 1) / s.rate_hz,
        (s.noise_mag_gauss, s.noise_gyro_rad_s),
        (generator(s.seed, 1), generator(s.seed, 2)),
    )
    return disturbed(made, s.disturbances, generator(s.seed, 3))


# -- The experiment of [L] -------------------------------------------------------------------------
#
# [L]'s experiment: a recorded gyro stream moves the sensor, the field is simulated.
#
# [L] (2.13), first order with normalisation:   q+ = q + (dt / 2) q (x) (0, w),   q = q+ / |q+|
# reading:                                      B_k = A_k H + b + noise,  A_k = attitude of q_k


LICHLYTER = Iron(soft_iron=np.eye(3), gyro_bias_rad_s=np.zeros(3), offset_behind_iron=True)


def integrate(rate_b_rad_s: Array, dt_s: Array) -> Array:
    """Quaternions (N, 4), scalar first, sensor to world, from rates (N, 3) and steps (N,).

    Row 0 is the identity and its rate is not used: a rate belongs to the step that ends at it.
    """
    q = np.empty((len(dt_s), 4))
    q[0] = (1.0, 0.0, 0.0, 0.0)
    half = rate_b_rad_s * dt_s[:, None] / 2
    for k in range(1, len(dt_s)):
        w, v = q[k - 1, 0], q[k - 1, 1:]
        q[k, 0] = w - v @ half[k]
        q[k, 1:] = v + w * half[k] + np.cross(v, half[k])
        q[k] /= np.linalg.norm(q[k])
    return q


def simulate_recorded(
    time_s: Array,
    gyro_b_rad_s: Array,
    *,
    iron: Iron = LICHLYTER,
    seed: int = 0,
    noise_mag_gauss: float = 1e-3,
    noise_gyro_rad_s: float = 0.0,
) -> Experiment:
    """An experiment on the motion of a recorded gyro stream without gaps: (N,) and (N, 3).

    [L] calls the recorded rates true. First-order integration turns by 2 atan(|w| dt / 2) and not
    by |w| dt, so the true rate is taken from the attitude it gives: both agree to the last digit.
    Raises ValueError where the time does not increase or a rate is not finite.
    """
    dt_s = np.concatenate([[np.nan], np.diff(time_s)])
    if not np.all(dt_s[1:] > 0):
        row = int(np.flatnonzero(~(dt_s[1:] > 0))[0]) + 1
        raise ValueError(f"time_s of row {row} does not increase: {time_s[row]}")
    if not np.isfinite(gyro_b_rad_s).all():
        row = int(np.argmin(np.isfinite(gyro_b_rad_s).all(axis=1)))
        raise ValueError(f"gyro_b_rad_s of row {row} is not finite: {gyro_b_rad_s[row]}")
    R_nb = Rotation.from_quat(integrate(gyro_b_rad_s, dt_s), scalar_first=True).as_matrix()
    turned = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    rate = np.vstack([np.full((1, 3), np.nan), turned / dt_s[1:, None]])
    return measured(
        f"recorded gyro stream, seed {seed}",
        iron,
        R_nb,
        rate,
        np.asarray(time_s, dtype=np.float64),
        (noise_mag_gauss, noise_gyro_rad_s),
        (generator(seed, 1), generator(seed, 2)),
    )


# -- As a recording --------------------------------------------------------------------------------


def columns(experiment: Experiment) -> dict[str, Array]:
    """Columns by name: samples, then the true attitude ref_q{w,x,y,z}, sensor to world."""
    s = experiment.samples
    out = {"time_s": s.time_s}
    for name, unit, vectors in (
        ("mag", "gauss", s.raw_b_gauss),
        ("gyro", "rad_s", s.gyro_b_rad_s),
        ("accel", "m_s2", s.accel_b_m_s2),
    ):
        out |= {f"{name}_{axis}_{unit}": vectors[:, i] for i, axis in enumerate("xyz")}
    q = quaternion(experiment.R_nb)
    return out | {f"ref_q{part}": q[:, i] for i, part in enumerate("wxyz")}


def sentences(experiment: Experiment) -> Iterator[bytes]:
    """One VNYMR sentence per sample, as a device with factory registers prints it.

    Yaw, pitch and roll are the truth. The text rounds the field to 0.1 mG and carries no time.
    """
    R, s = experiment.R_nb, experiment.samples
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    pitch = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    rows = np.column_stack([yaw, pitch, roll, s.raw_b_gauss, s.accel_b_m_s2, s.gyro_b_rad_s])
    for row in rows.tolist():
        yield encode_sentence("VNYMR", row)


def truth_json(experiment: Experiment, made_from: dict[str, object]) -> dict[str, object]:
    """FILE.truth.json: the hidden values, and what makes the same file again."""
    return {
        "schema": "ahrsd.truth/1",
        "name": experiment.name,
        "convention": "m = A h + b + noise with det A = 1; w_read = w + w_b + noise",
        **experiment.truth.json(),
        "made_from": made_from,
    }


def settings_json(settings: ScenarioSettings) -> dict[str, object]:
    """The settings by name, the sensor in the theses' terms."""
    iron = settings.iron
    return {
        "scenario": settings.scenario,
        "motion": settings.motion,
        "seed": settings.seed,
        "samples": settings.samples,
        "rate_hz": settings.rate_hz,
        "soft_iron": iron.soft_iron.tolist(),
        "pseudo_hard_iron_gauss": iron.pseudo_hard_iron_gauss.tolist(),
        "hard_iron_is": "m_b" if iron.offset_behind_iron else "A m_b",
        "field_n_gauss": iron.field_n_gauss.tolist(),
        "disturbances": asdict(settings.disturbances),
    }
