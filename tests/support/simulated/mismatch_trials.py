"""Small random recordings with known effects in them, for tests and benchmarks of the engine."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.track import Track
from ahrsd.simulation import ScenarioSettings, simulate


@dataclass(frozen=True)
class Trial:
    """What to make.  effects: (identifier, strength in typical sizes); hidden: columns withheld."""

    seed: int
    effects: tuple[tuple[str, float], ...] = ()
    hidden: tuple[str, ...] = ()
    scenario: str = "mam"
    noise: str = "white"
    samples: int = 10_000
    rate_hz: float = 25.0
    sigma_mag: float = 6e-4
    sigma_gyro: float = 3e-4


@dataclass
class Made:
    """A track and what is in it."""

    track: Track
    truth: list[tuple[str, np.ndarray, dict]] = field(default_factory=list)
    settings: ScenarioSettings | None = None


def made(trial: Trial) -> Made:
    """Build the trial: motion, covariates, effects exactly, then noise."""
    rng = np.random.default_rng([trial.seed, 77])
    settings = ScenarioSettings(
        scenario=trial.scenario,
        motion="rov",
        seed=trial.seed,
        samples=trial.samples,
        rate_hz=trial.rate_hz,
        noise_mag_gauss=0.0,
        noise_gyro_rad_s=0.0,
    )
    run = simulate(settings)
    block = run.samples
    rate = run.rate_b_rad_s
    readings = Readings(
        time_s=block.time_s,
        dt_s=block.dt_s,
        mag_b_gauss=block.raw_b_gauss,
        gyro_b_rad_s=block.gyro_b_rad_s,
        accel_b_m_s2=block.accel_b_m_s2,
        rate_b_rad_s=rate,
        field_b=run.field_b,
        R_nb=run.R_nb,
        soft_iron=run.truth.soft_iron,
        covariates=covariates(block.time_s, trial.rate_hz, rng),
    )
    truth = []
    for name, strength in trial.effects:
        effect = EFFECTS[name]
        value, setting = effect.example(readings, strength)
        value = value * rng.choice([-1.0, 1.0], len(value)) if len(value) > 1 else value
        if "onset_s" in setting:
            span = block.time_s[-1] - block.time_s[0]
            onset = block.time_s[0] + span * rng.uniform(0.15, 0.85)
            setting = {**setting, "onset_s": float(onset)}
        readings = effect.simulate(readings, value, setting)
        truth.append((name, value, setting))
    mag, gyro = noises(trial, len(block), rng)
    kept = {k: v for k, v in readings.covariates.items() if k not in trial.hidden}
    accel = None if "accel" in trial.hidden else readings.accel_b_m_s2
    return Made(
        Track(
            readings.time_s,
            readings.dt_s,
            readings.mag_b_gauss + mag,
            readings.gyro_b_rad_s + gyro,
            accel,
            kept,
            (slice(0, len(readings.time_s)),),
        ),
        truth,
        settings,
    )


def covariates(time_s, rate_hz, rng):
    """Two currents, a temperature that warms up, a position, a joint, a speed."""
    count = len(time_s)
    t = time_s - time_s[0]
    span = t[-1]

    def levels(mean_s, low, high):
        edges = np.cumsum(rng.exponential(mean_s, int(4 * span / mean_s) + 5))
        values = rng.uniform(low, high, len(edges) + 1)
        steps = values[np.searchsorted(edges, t)]
        smooth = np.empty(count)
        keep = np.exp(-1.0 / (0.5 * rate_hz))
        last = steps[0]
        for k in range(count):
            last = keep * last + (1 - keep) * steps[k]
            smooth[k] = last
        return smooth

    phase = rng.uniform(0, 2 * np.pi, 4)
    return {
        "motor_current_a": levels(8.0, 0.5, 12.0),
        "temperature_c": 20.0
        + 8.0 * (1 - np.exp(-t / (0.6 * span)))
        + 0.02 * rng.standard_normal(count),
        "position_north_m": 8 * np.sin(2 * np.pi * t / 130 + phase[0]),
        "position_east_m": 8 * np.sin(2 * np.pi * t / 90 + phase[1]),
        "position_down_m": 3 + 2 * np.sin(2 * np.pi * t / 170 + phase[2]),
        "arm_angle_rad": 0.8 * np.sin(2 * np.pi * t / 37 + phase[3]),
        "speed_m_s": levels(25.0, 0.0, 2.0),
    }


def noises(trial, count, rng):
    """Magnetometer and gyro noise (N, 3) of the trial's law, of equal power."""
    mag, gyro = rng.standard_normal((2, count, 3))
    if trial.noise == "red":
        share = rng.uniform(0.05, 0.3)
        keep = np.exp(-1.0 / trial.rate_hz)
        slow = np.zeros((count, 3))
        white = rng.standard_normal((count, 3)) * np.sqrt(1 - keep**2)
        slow[0] = rng.standard_normal(3)
        for k in range(1, count):
            slow[k] = keep * slow[k - 1] + white[k]
        mag = np.sqrt(1 - share) * mag + np.sqrt(share) * slow
    elif trial.noise == "heavy":
        mag = rng.standard_t(3, (count, 3)) / np.sqrt(3)
        gyro = rng.standard_t(3, (count, 3)) / np.sqrt(3)
    elif trial.noise == "walk":
        walk = np.cumsum(rng.standard_normal((count, 3)), axis=0)
        gyro = gyro + walk * 0.3 / np.sqrt(count)
    elif trial.noise == "bursts":
        mag *= 1 + 3 * (rng.random((count, 1)) < 0.02)
    return trial.sigma_mag * mag, trial.sigma_gyro * gyro
