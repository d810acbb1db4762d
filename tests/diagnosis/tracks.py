"""Tracks for the tests of the diagnosis: simulated nulls, and the real recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.recording.table import read_table
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, ScenarioSettings, simulate

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"


def experiment(
    scenario: str = "mam",
    *,
    seed: int = 1,
    samples: int = 6000,
    rate_hz: float = 25.0,
    sigma_mag: float = 1e-3,
    sigma_gyro: float = 5e-4,
    motion: str = "rov",
) -> Experiment:
    """A simulated null with VN-100 class noise by default."""
    return simulate(
        ScenarioSettings(scenario, motion, seed, samples, rate_hz, sigma_mag, sigma_gyro)
    )


def track_of(made: Experiment) -> Track:
    """The samples of an experiment."""
    s, starts = made.samples, made.starts
    runs = tuple(slice(a, b) for a, b in zip(starts, [*starts[1:], len(made)], strict=True))
    return Track(s.time_s, s.dt_s, s.raw_b_gauss, s.gyro_b_rad_s, s.accel_b_m_s2, {}, runs)


def true_model(made: Experiment) -> NullModel:
    """The true model, normalised to trace 3."""
    truth = made.truth
    return NullModel(
        truth.soft_iron * 3 / np.trace(truth.soft_iron),
        truth.hard_iron_gauss,
        truth.gyro_bias_rad_s,
        truth.noise_mag_gauss,
        truth.noise_gyro_rad_s,
    )


def moved_model(model: NullModel, direction: np.ndarray) -> NullModel:
    """The model with its 11 parameters changed, in the order of `nuisance_columns`."""
    from ahrsd.estimator.locked import TRACELESS

    return replace(
        model,
        soft_iron=model.soft_iron + np.einsum("a,aij->ij", direction[:5], TRACELESS),
        hard_iron_gauss=model.hard_iron_gauss + direction[5:8],
        gyro_bias_rad_s=model.gyro_bias_rad_s + direction[8:],
    )


def recorded(name: str) -> Track:
    """A real recording by its path below the recordings; the test is skipped without it."""
    path = RECORDINGS / f"{name}.csv.gz"
    if not path.exists():
        pytest.skip(f"the real recordings are not here: {path.name}")
    table = read_table(path)
    rows, starts = table.rows, table.starts
    runs = tuple(slice(a, b) for a, b in zip(starts, [*starts[1:], len(rows)], strict=True))
    accel = rows.accel_b_m_s2 if np.isfinite(rows.accel_b_m_s2).all() else None
    dt_s = rows.dt_s.copy()
    dt_s[list(starts)] = np.nan
    return Track(
        rows.time_s, dt_s, rows.raw_b_gauss, rows.gyro_b_rad_s, accel, dict(rows.covariates), runs
    )


def coloured(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    band_hz: tuple[float, float],
    rate_hz: float = 25.0,
) -> Array:
    """Noise along the first axis between two frequencies, with unit standard deviation and zero
    mean.
    """
    spectrum = np.fft.rfft(rng.normal(size=shape), axis=0)
    hertz = np.fft.rfftfreq(shape[0], 1 / rate_hz)
    spectrum[(hertz < band_hz[0]) | (hertz > band_hz[1])] = 0.0
    spectrum[0] = 0.0
    values = np.fft.irfft(spectrum, shape[0], axis=0)
    return np.asarray(values / values.std(axis=0))
