"""A frequency band of far higher power than its neighbours: where it is, and in which frame.

The mean P of the periodogram of three whitened axes over b bins is a chi-squared of 6 b degrees of
freedom over 6 b.  The usual level C is the higher of the two sides' lowest bands, and Whittle's
likelihood gives the evidence of every band, 3 b (P / C - 1 - ln P / C) nats.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Unexplained, Where
from ahrsd.diagnosis.data_quality.facts import row_intervals
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

BAND_HZ, _FEWEST_BINS = 0.25, 30
_SIDE_BANDS = 8  # bands of a side of which the lowest is taken
_AXES = ("x", "y", "z")


def unexplained_band(
    context: Context, residual: Array, rate_hz: float, band_hz: tuple[float, float], nats: float
) -> Unexplained:
    """The answer for a band of a residual (N, 3) that is white elsewhere: unexplained."""
    low, high = band_hz
    inside = _band_pass(residual, rate_hz, low, high)
    outside = _band_pass(residual, rate_hz, max(0.0, low - (high - low)), low)
    frame = _most_probable_frame(context, inside, outside)
    power = np.mean(inside**2, axis=0)
    vectors = np.linalg.eigh(inside.T @ inside)
    x, y, z = (float(part) for part in vectors.eigenvectors[:, -1])
    time_s, sigma = context.track.time_s, context.model.sigma_mag_gauss
    return Unexplained(
        detected=True,
        where=Where(
            ((float(time_s[0]), float(time_s[-1])),),
            tuple(_AXES[k] for k in range(3) if power[k] > 0.1 * power.max()),
            frame,
            None,
            (low, high),
            (x, y, z),
        ),
        size=float(np.sqrt(2.0 * power.sum())) * sigma,
        unit="gauss",
        single_source_share=float(vectors.eigenvalues[-1] / vectors.eigenvalues.sum()),
        evidence_nats=nats,
    )


def loudest_band(
    residual: Array, rate_hz: float, highest_hz: float
) -> tuple[float, float, float] | None:
    """(from Hz, to Hz, nats) of the adjacent bands of most evidence in (N, 3); None for none."""
    power = np.mean(np.abs(np.fft.rfft(residual, axis=0)) ** 2, axis=1)[1:] / len(residual)
    width_hz = rate_hz / len(residual)
    bins = max(_FEWEST_BINS, round(BAND_HZ / width_hz))
    count = len(power) // bins
    if count < 3:
        return None
    bands = power[: count * bins].reshape(count, bins).mean(axis=1)
    level = _usual_level(bands)
    out = np.isfinite(level) & (bands > priors.BAND_STANDS_OUT * level)
    edges = np.arange(count + 1) * bins * width_hz
    out &= (edges[:-1] >= priors.BAND_LOWEST_HZ) & (edges[1:] <= highest_hz)
    ratio = np.where(out, bands / np.where(out, level, 1.0), 1.0)
    nats = 3.0 * bins * (ratio - 1.0 - np.log(ratio))
    runs = row_intervals(out)
    if not runs:
        return None
    a, b = max(runs, key=lambda run: float(nats[slice(*run)].sum()))
    return a * bins * width_hz, b * bins * width_hz, float(nats[a:b].sum())


def _usual_level(bands: Array) -> Array:
    """(B,) the higher of the two sides' lowest bands; nan where there is no side."""
    out = np.full(len(bands), np.nan)
    for k in range(1, len(bands) - 1):
        below, above = bands[max(0, k - _SIDE_BANDS) : k], bands[k + 1 : k + 1 + _SIDE_BANDS]
        out[k] = max(below.min(), above.min())
    return out


def _band_pass(values: Array, rate_hz: float, low_hz: float, high_hz: float) -> Array:
    """(N, 3) with all other frequencies removed."""
    spectrum = np.fft.rfft(values, axis=0)
    at = np.fft.rfftfreq(len(values), 1.0 / rate_hz)
    spectrum[(at < low_hz) | (at >= high_hz)] = 0.0
    return np.asarray(np.fft.irfft(spectrum, len(values), axis=0))


def _most_probable_frame(context: Context, inside: Array, outside: Array) -> Frame:
    """The frame in which the band's covariance is constant, of the smallest volume.

    An error of the gyro turns the field and does not change its size: nothing acts along the
    field.
    """
    unit = context.field_b @ context.model.soft_iron
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    excess = float(np.sum(inside**2)) - float(np.sum(outside**2))
    along = float(np.sum(np.sum(inside * unit, axis=1) ** 2))
    along -= float(np.sum(np.sum(outside * unit, axis=1) ** 2))
    if along < priors.BAND_ALONG * excess:
        return "gyro"
    world = np.einsum("nij,nj->ni", context.R_nb, inside)
    in_sensor, in_world = (np.linalg.slogdet(one.T @ one)[1] for one in (inside, world))
    return "world" if in_world < in_sensor else "sensor"
