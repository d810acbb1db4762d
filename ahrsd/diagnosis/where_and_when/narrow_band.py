"""A band of frequencies far louder than those beside it: where it is, and on what it acts.

Over bands of b bins of the periodogram of three whitened axes the mean P is chi-squared of 6 b
degrees of freedom over 6 b.  The usual level C is the louder of the two sides' quietest bands, and
Whittle's likelihood gives the evidence, 3 b (P / C - 1 - ln P / C) nats of every band.
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
_SIDE = 8  # bands in which a side's quietest one is sought
_AXES = ("x", "y", "z")


def of_band(
    context: Context, left: Array, rate_hz: float, band_hz: tuple[float, float], nats: float
) -> Unexplained:
    """A band of what is left (N, 3), white but for it, as what no name explains."""
    low, high = band_hz
    inside = _passed(left, rate_hz, low, high)
    outside = _passed(left, rate_hz, max(0.0, low - (high - low)), low)
    frame = _frame(context, inside, outside)
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
    left: Array, rate_hz: float, highest_hz: float
) -> tuple[float, float, float] | None:
    """(from Hz, to Hz, nats) of the run of bands that stands out most of (N, 3); None for none."""
    power = np.mean(np.abs(np.fft.rfft(left, axis=0)) ** 2, axis=1)[1:] / len(left)
    width_hz = rate_hz / len(left)
    bins = max(_FEWEST_BINS, round(BAND_HZ / width_hz))
    count = len(power) // bins
    if count < 3:
        return None
    bands = power[: count * bins].reshape(count, bins).mean(axis=1)
    level = _usual(bands)
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


def _usual(bands: Array) -> Array:
    """(B,) the louder of the two sides' quietest bands; nan where there is no side."""
    out = np.full(len(bands), np.nan)
    for k in range(1, len(bands) - 1):
        below, above = bands[max(0, k - _SIDE) : k], bands[k + 1 : k + 1 + _SIDE]
        out[k] = max(below.min(), above.min())
    return out


def _passed(left: Array, rate_hz: float, low_hz: float, high_hz: float) -> Array:
    """(N, 3) with all other frequencies taken out."""
    spectrum = np.fft.rfft(left, axis=0)
    at = np.fft.rfftfreq(len(left), 1.0 / rate_hz)
    spectrum[(at < low_hz) | (at >= high_hz)] = 0.0
    return np.asarray(np.fft.irfft(spectrum, len(left), axis=0))


def _frame(context: Context, inside: Array, outside: Array) -> Frame:
    """Where it has a constant covariance of the smallest volume; an error of the gyro turns the
    field, and does not change its size."""
    unit = context.field_b @ context.model.soft_iron
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    louder = float(np.sum(inside**2)) - float(np.sum(outside**2))
    along = float(np.sum(np.sum(inside * unit, axis=1) ** 2))
    along -= float(np.sum(np.sum(outside * unit, axis=1) ** 2))
    if along < priors.BAND_ALONG * louder:
        return "gyro"
    world = np.einsum("nij,nj->ni", context.R_nb, inside)
    sensor, there = (np.linalg.slogdet(one.T @ one)[1] for one in (inside, world))
    return "world" if there < sensor else "sensor"
