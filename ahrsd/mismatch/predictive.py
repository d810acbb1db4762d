"""Posterior predictive checks: does the recording look like what its model simulates?

The fitted null and the repaired model are simulated along the recording's own motion, covariates
and gaps, some copies each, and all of them go through the null's filter as the recording did.  Both
have the repaired model's noise: the null's own would hold what was left out as noise.
Every statistic below is chosen before anything is looked at.  Its band covers a simulation with
95 % for all statistics together (Bonferroni; normal in the logarithm, the copies' own mean and
deviation, Student's t).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from ahrsd.mismatch import forward
from ahrsd.mismatch.diagnosis import Check
from ahrsd.mismatch.effects import series
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.innovation import run_filter
from ahrsd.mismatch.null import NullFit
from ahrsd.mismatch.track import Track
from ahrsd.mismatch.values import Context, NullModel, Term
from ahrsd.samples import Array

COPIES = 24
_OUTSIDE = 0.05
_SEGMENT_S = 20.0
_LAGS = 50
_LEAST = 1e-12


def checks(
    null: NullFit,
    repaired: NullFit,
    terms: Sequence[Term],
    *,
    library: Mapping[str, Effect] = EFFECTS,
    copies: int = COPIES,
    seed: int = 0,
) -> dict[str, Check]:
    """The statistics of the recording, inside the null's bands and inside the repaired model's.

    null: the fit without terms, of the recording;  repaired, terms: the fit with them, and them.
    Deterministic.
    """
    context = null.context()
    noise = forward.noise_of(repaired.model, repaired.filtered)
    value = statistics(null.filtered.whitened, context)
    before = _bands(_simulated(null, noise, (), context, library, copies, seed))
    after = before
    if terms:
        after = _bands(_simulated(repaired, noise, terms, context, library, copies, seed + 1))
    return {
        name: Check(
            value[name],
            after[name],
            before[name][0] <= value[name] <= before[name][1],
            after[name][0] <= value[name] <= after[name][1],
        )
        for name in value
    }


def statistics(e: Array, context: Context) -> dict[str, float]:
    """What is compared, of whitened innovations (N, 3) along a context's motion.

    normalised_innovation   mean square
    autocorrelation         portmanteau over the first 50 lags
    shift_sensor, _world    largest mean of a 20 s segment in the frame, in deviations of noise
    shift_turn              the same of the part that a wrong rate leaves: h x e
    field_size              largest correlation of the part along the field with time, and its
                            largest segment
    covariates              largest correlation with a column or its derivative, in deviations
    heading                 largest first or second harmonic of heading, in deviations
    tail                    the 99.9 % quantile of the size of a component
    line                    highest line of the periodogram over its mean
    """
    track = context.track
    unit = context.field_b / np.linalg.norm(context.field_b, axis=1, keepdims=True)
    along = np.sum(e * unit, axis=1)[:, None]
    time = track.time_s - track.time_s.mean()
    heading = np.arctan2(context.R_nb[:, 1, 0], context.R_nb[:, 0, 0])
    harmonics = np.column_stack([f(n * heading) for n in (1, 2) for f in (np.cos, np.sin)])
    power = np.abs(np.fft.rfft(e, axis=0)[1:]) ** 2
    out = {
        "normalised_innovation": float(np.mean(e**2)),
        "autocorrelation": _portmanteau(e),
        "shift_sensor": _shift(e, track),
        "shift_world": _shift(np.einsum("nij,nj->ni", context.R_nb, e), track),
        "shift_turn": _shift(np.cross(unit, e), track),
        "field_size": max(_shift(along, track), _follows(along, time[:, None])),
        "heading": _follows(e, harmonics - harmonics.mean(axis=0)),
        "tail": float(np.quantile(np.abs(e), 0.999)),
        "line": float((power / power.mean(axis=0)).max()),
    }
    columns = _columns(track)
    if columns is not None:
        out["covariates"] = _follows(e, columns)
    return out


def _simulated(
    fit: NullFit,
    noise: forward.Noise,
    terms: Sequence[Term],
    seen: Context,
    library: Mapping[str, Effect],
    copies: int,
    seed: int,
) -> list[dict[str, float]]:
    """The statistics of simulations of a fit, filtered by the null of the context `seen`."""
    truth = forward.truth_along(fit.context())
    made = [
        forward.track_of(forward.simulated(truth, terms, noise, seed=1000 * seed + k))
        for k in range(copies)
    ]
    whole = _filtered(_joined(made), seen.model)
    rows = len(seen.track)
    return [
        statistics(whole[k * rows : (k + 1) * rows], seen)
        for k in range(copies)
        if len(made[k]) == rows
    ]


def _filtered(track: Track, model: NullModel) -> Array:
    return run_filter(track, model, sensitive=False).whitened


def _joined(tracks: Sequence[Track]) -> Track:
    """Tracks one behind the other, each with runs of its own: the filter takes them all at once."""
    first = tracks[0]
    length = first.duration_s + 10.0
    dt_s = np.concatenate([track.dt_s for track in tracks])
    return replace(
        first,
        time_s=np.concatenate([track.time_s + k * length for k, track in enumerate(tracks)]),
        dt_s=dt_s,
        mag_b_gauss=np.vstack([track.mag_b_gauss for track in tracks]),
        gyro_b_rad_s=np.vstack([track.gyro_b_rad_s for track in tracks]),
        accel_b_m_s2=None,
        covariates={},
        runs=tuple(series.runs(dt_s)),
    )


def _bands(found: Sequence[Mapping[str, float]]) -> dict[str, tuple[float, float]]:
    """Where one more simulation would be, for every statistic."""
    count, names = len(found), list(found[0])
    reach = float(student.ppf(1 - _OUTSIDE / 2 / len(names), count - 1)) * np.sqrt(1 + 1 / count)
    out = {}
    for name in names:
        logs = np.log(np.maximum([one[name] for one in found], _LEAST))
        middle, width = float(np.mean(logs)), reach * float(np.std(logs, ddof=1))
        out[name] = (float(np.exp(middle - width)), float(np.exp(middle + width)))
    return out


def _portmanteau(e: Array) -> float:
    """Sum of squared autocorrelations times their number, over the number of lags."""
    count = len(e)
    spectrum = np.abs(np.fft.rfft(e, 2 * count, axis=0)) ** 2
    lags = np.fft.irfft(spectrum.sum(axis=1))[: min(_LAGS, count - 1) + 1]
    return float(np.mean((lags[1:] / max(lags[0], _LEAST)) ** 2) * 3 * count)


def _shift(values: Array, track: Track) -> float:
    """Largest |mean| of a segment (N, k), in standard deviations of a mean of unit noise."""
    segment = ((track.time_s - track.time_s[0]) // _SEGMENT_S).astype(int)
    count = np.bincount(segment)
    kept = count > 0.3 * count.max()
    sums = np.column_stack([np.bincount(segment, weights=column) for column in values.T])
    return float(np.abs(sums[kept] / np.sqrt(count[kept])[:, None]).max())


def _follows(values: Array, courses: Array) -> float:
    """Largest correlation of a column (N, k) with a course (N, c), in deviations of unit noise."""
    size = np.linalg.norm(courses, axis=0)
    used = size > 0
    return float(np.abs(values.T @ (courses[:, used] / size[used])).max()) if used.any() else 0.0


def _columns(track: Track) -> Array | None:
    """Usable covariates and their derivatives, centred, (N, c); None without any."""
    found = []
    for values in track.covariates.values():
        if np.isfinite(values).all() and np.ptp(values) > 0:
            change = series.derivative(values, track.time_s, track.dt_s)
            found += [values - values.mean(), change - change.mean()]
    return np.column_stack(found) if found else None
