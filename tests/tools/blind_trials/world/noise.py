"""Noise laws: what a null must not be named for."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

LAWS = ("white", "red", "heavy_tails", "gyro_walk", "drops_jitter")

#: names that are the plain truth under a law, no false ones
ALLOWED = {
    "white": (),
    "red": (),
    "heavy_tails": ("noise_burst",),
    "gyro_walk": ("gyro_bias_drift",),
    "drops_jitter": ("dropped_samples", "timestamp_jitter"),
}


def first_order(rng, samples, step_s, tau_s):
    """Unit-variance first-order Gauss-Markov noise (samples, 3)."""
    a = np.exp(-step_s / tau_s)
    white = rng.normal(size=(samples, 3))
    white[1:] *= np.sqrt(1 - a * a)
    return lfilter([1.0], [1.0, -a], white, axis=0)


def add_noise(rows, law, rng, step_s, sigma_mag, sigma_gyro, factors=()):
    """Noise onto Rows, in place; `factors` are functions of time that scale the magnetometer's.

    Returns what the law drew, for the key.
    """
    K = len(rows.time_s)
    mag, gyro = rng.normal(size=(K, 3)), rng.normal(size=(K, 3))
    drawn = {}
    if law == "red":
        part, tau = rng.uniform(0.05, 0.30), rng.uniform(0.5, 2.0)
        mag = np.sqrt(1 - part) * mag + np.sqrt(part) * first_order(rng, K, step_s, tau)
        drawn = {"red_part": part, "red_time_s": tau}
    elif law == "heavy_tails":
        nu = 3.5
        mag = rng.standard_t(nu, (K, 3)) / np.sqrt(nu / (nu - 2))
        gyro = rng.standard_t(nu, (K, 3)) / np.sqrt(nu / (nu - 2))
        drawn = {"degrees_of_freedom": nu}
    elif law == "gyro_walk":
        size = np.exp(rng.uniform(np.log(1e-5), np.log(6e-5)))
        flicker = sum(first_order(rng, K, step_s, tau) for tau in (10.0, 40.0, 160.0))
        walk = np.cumsum(rng.normal(size=(K, 3)), axis=0) / np.sqrt(K)
        gyro = gyro + size * (flicker / np.sqrt(3) + walk) / sigma_gyro
        drawn = {"instability_rad_s": size}
    scale = np.ones(K)
    for factor in factors:
        scale = scale * factor(rows.time_s)
    rows.mag = rows.mag + sigma_mag * scale[:, None] * mag
    rows.gyro = rows.gyro + sigma_gyro * gyro
    return drawn


def drop_and_jitter(rows, rng, step_s):
    """A few rows missing, with true but slightly jittering stamps."""
    lost, jitter = rng.uniform(0.002, 0.01), rng.uniform(2e-4, 1e-3)
    kept = rng.random(len(rows.time_s)) >= lost
    kept[:2] = True
    rows = rows.kept(kept)
    rows.time_s = rows.time_s + np.clip(
        rng.normal(scale=jitter, size=len(rows.time_s)), -0.2 * step_s, 0.2 * step_s
    )
    return rows, {"lost": lost, "jitter_s": jitter}
