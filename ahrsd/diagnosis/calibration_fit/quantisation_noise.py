"""The noise level of readings that come in coarse steps.

With coarse steps the variance of the readings' noise is mostly that of rounding, a twelfth of the
step squared.  The noise itself determines how often a reading differs from the one before, if the
motion is slow.  So simulations with noise of several sizes, rounded to the steps, are compared with
the recording in both statistics (the method of simulated moments).  Each is weighted by its scatter
between simulations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.innovation_filter.innovation import nuisance_columns, sensitivities
from ahrsd.diagnosis.innovation_filter.regression_statistics import spectral_peak
from ahrsd.diagnosis.model import Noise
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: sizes that are tried, relative to the first guess; simulations that show the scatter
_SIZES_TRIED = np.geomspace(0.25, 4.0, 9)
_COPIES = 8
_FINE_SIZES = 400  # interpolated between those
_LEAST_VARIANCE = 1e-8  # variance of a moment: readings that never differ have no scatter
_LEAST_SHARE = 0.1  # of the noise including rounding: the first guess at least


def noise_before_rounding(
    fit: NullFit,
    seen: Noise,
    step_gauss: float,
    simulate: Callable[[Noise, int], tuple[Array, Array]],
) -> Noise:
    """The noise of readings before they were rounded to steps of that size.

    seen: noise including what rounding adds.  Rounding errors are bounded, and their spectrum
          follows
    the motion: they are simulated, not drawn.
    simulate: readings (N, 3) and whitened innovations (N, 3) for a noise law and a seed; with the
              fit's own calibration if the seed is 0, otherwise with one drawn from its uncertainty
    """
    done = fit.filtered
    usual = np.ones(len(done.track)) if seen.level is None else seen.level
    rms_level = float(np.sqrt(np.mean(usual**2)))
    remaining_share = 1.0 - step_gauss**2 / 12 / (seen.mag_gauss * rms_level) ** 2
    guess = float(np.sqrt(max(remaining_share, _LEAST_SHARE**2)))

    def law(size: float) -> Noise:
        return replace(seen, level=size * usual)

    def moments(size: float, seed: int) -> Array:
        mag, whitened = simulate(law(size), seed)
        return _moments(mag, whitened[done.used], step_gauss)

    sizes = guess * _SIZES_TRIED
    found = np.array([moments(size, 0) for size in sizes])
    wanted = _moments(done.track.mag_b_gauss, done.whitened[done.used], step_gauss)
    fine = np.geomspace(sizes[0], sizes[-1], _FINE_SIZES)
    first = fine[
        int(
            np.argmin(
                _squared_distances(_interpolate_moments(fine, sizes, found) - wanted, np.eye(2))
            )
        )
    ]
    copies = np.array([moments(first, 1 + k) for k in range(_COPIES)])
    scatter = np.cov(copies.T) + _LEAST_VARIANCE * np.eye(2)
    off = _interpolate_moments(fine, sizes, found) - wanted
    return law(float(fine[int(np.argmin(_squared_distances(off, scatter)))]))


def calibration_covariance(fit: NullFit) -> Array:
    """(11, 11) of the fit's own calibration, for noise with the spectrum of its residual."""
    seen = sensitivities(fit.filtered, nuisance_columns(fit.filtered))
    flat = seen.reshape(-1, seen.shape[2])
    power = spectral_peak(fit.filtered.whitened, 1.0 / fit.filtered.track.step_s)
    power *= fit.filtered.normalised_innovation
    return np.asarray(np.linalg.inv(flat.T @ flat) * power)


def readings_of_drawn_calibration(truth: Readings, covariance: Array, seed: int) -> Readings:
    """Readings for a calibration drawn from the uncertainty of the fit.

    The filter sees a linear effect of it, which is removed again; but the positions of the readings
    relative to their quantisation steps differ.
    """
    dice = np.random.default_rng([seed, 3])
    zero = np.zeros(len(covariance))
    # not checked: a covariance that is an inverse may be indefinite by rounding
    drawn = dice.multivariate_normal(zero, covariance, check_valid="ignore")
    iron = np.einsum("a,aij->ij", drawn[:5], TRACELESS)
    return replace(truth, mag_b_gauss=truth.mag_b_gauss + truth.field_b @ iron + drawn[5:8])


def _moments(mag_b_gauss: Array, whitened: Array, step_gauss: float) -> Array:
    """(2,) logarithms of the mean square and of how often a reading differs from the one before."""
    differ = np.abs(np.diff(mag_b_gauss, axis=0)) > step_gauss / 2
    return np.log([float(np.mean(whitened**2)), float(np.mean(differ)) + 1e-6])


def _interpolate_moments(fine: Array, sizes: Array, found: Array) -> Array:
    """(F, 2) moments at sizes between those of (S, 2), linear in the logarithm of the size."""
    at = np.log(fine), np.log(sizes)
    return np.column_stack([np.interp(*at, column) for column in found.T])


def _squared_distances(off: Array, scatter: Array) -> Array:
    """(F,) squared Mahalanobis distances of differences (F, 2)."""
    return np.asarray(np.sum(off * np.linalg.solve(scatter, off.T).T, axis=1))
