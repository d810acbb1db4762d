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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from ahrsd.mismatch import forward
from ahrsd.mismatch.diagnosis import Check
from ahrsd.mismatch.effects import series
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.gains import Gains
from ahrsd.mismatch.innovation import Filtered, run_filter
from ahrsd.mismatch.null import NullFit
from ahrsd.mismatch.track import Track
from ahrsd.mismatch.values import Context, NullModel, Term
from ahrsd.samples import Array

COPIES = 16
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
    scene = scene_of(context)
    value = statistics(null.filtered.whitened, scene)
    held = null.filtered
    before = _bands(_simulated(null, noise, (), scene, held, library, copies, seed))
    after = before
    if terms:
        after = _bands(_simulated(repaired, noise, terms, scene, held, library, copies, seed + 1))
    return {
        name: Check(
            value[name],
            after[name],
            before[name][0] <= value[name] <= before[name][1],
            after[name][0] <= value[name] <= after[name][1],
        )
        for name in value
    }


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What innovations are compared with: directions, segments and courses of unit length.

    unit_b (N, 3): direction of the field;  R_nb (N, 3, 3);  segment (N,): number of the 20 s piece
    time (N, 1), heading (N, 4), columns (N, c): centred;  columns may have no column
    """

    unit_b: Array
    R_nb: Array
    segment: NDArray[np.intp]
    time: Array
    heading: Array
    columns: Array


def scene_of(context: Context) -> Scene:
    """The scene of a recording."""
    track = context.track
    heading = np.arctan2(context.R_nb[:, 1, 0], context.R_nb[:, 0, 0])
    return Scene(
        unit_b=context.field_b / np.linalg.norm(context.field_b, axis=1, keepdims=True),
        R_nb=context.R_nb,
        segment=((track.time_s - track.time_s[0]) // _SEGMENT_S).astype(np.intp),
        time=_courses([track.time_s]),
        heading=_courses([f(n * heading) for n in (1, 2) for f in (np.cos, np.sin)]),
        columns=_courses(
            [
                course
                for values in track.covariates.values()
                if np.isfinite(values).all() and np.ptp(values) > 0
                for course in (values, series.derivative(values, track.time_s, track.dt_s))
            ]
        ).reshape(len(track), -1),
    )


def statistics(e: Array, scene: Scene) -> dict[str, float]:
    """What is compared, of whitened innovations (N, 3) in a scene.

    normalised_innovation   mean square
    autocorrelation         portmanteau over the first 50 lags, 1 for white noise
    shift_sensor, _world    largest mean of a 20 s segment in the frame, in deviations of noise
    shift_turn              the same of the part that a wrong rate leaves: h x e
    field_size              the same of the part along the field, or its trend
    heading                 largest first or second harmonic of heading, in deviations
    tail                    the 99.9 % quantile of the size of a component
    line                    highest line of the periodogram over its mean
    covariates              largest correlation with a column or its derivative, in deviations
    """
    along = np.sum(e * scene.unit_b, axis=1)[:, None]
    power = np.abs(np.fft.rfft(e, axis=0)[1:]) ** 2
    out = {
        "normalised_innovation": float(np.mean(e**2)),
        "autocorrelation": _portmanteau(e),
        "shift_sensor": _shift(e, scene),
        "shift_world": _shift(np.einsum("nij,nj->ni", scene.R_nb, e), scene),
        "shift_turn": _shift(np.cross(scene.unit_b, e), scene),
        "field_size": max(_shift(along, scene), _follows(along, scene.time)),
        "heading": _follows(e, scene.heading),
        "tail": float(np.quantile(np.abs(e), 0.999)),
        "line": float((power / power.mean(axis=0)).max()),
    }
    if scene.columns.shape[1]:
        out["covariates"] = _follows(e, scene.columns)
    return out


def _simulated(
    fit: NullFit,
    noise: forward.Noise,
    terms: Sequence[Term],
    scene: Scene,
    held: Filtered,
    library: Mapping[str, Effect],
    copies: int,
    seed: int,
) -> list[dict[str, float]]:
    """The statistics of simulations of a fit, filtered as the null's run was."""
    truth = forward.truth_along(fit.context())
    made = [
        forward.track_of(forward.simulated(truth, drawn, noise, seed=1000 * seed + k))
        for k, drawn in enumerate(_drawn(fit, terms, copies, seed))
    ]
    rows = len(scene.segment)
    alike = all(len(track) == rows for track in made)
    whole = _filtered(_joined(made), held.model, _tiled(held, len(made)) if alike else None)
    return [
        statistics(whole[k * rows : (k + 1) * rows], scene)
        for k in range(copies)
        if len(made[k]) == rows
    ]


def _drawn(fit: NullFit, terms: Sequence[Term], copies: int, seed: int) -> list[list[Term]]:
    """The terms of each copy: values as they may be, given the calibration, for all that is known.

    A repaired model whose coefficients are known to a tenth does not simulate them exactly.
    """
    if not terms or not np.any(fit.covariance):
        return [list(terms) for _ in range(copies)]
    sigma = np.sqrt(np.diag(fit.covariance))
    information = np.linalg.inv(fit.covariance / np.outer(sigma, sigma))[11:, 11:]
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    root = sigma[11:, None] * vectors / np.sqrt(np.maximum(values, 1e-6))
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(copies):
        change = root @ rng.normal(size=len(root))
        ends = np.cumsum([len(term.value) for term in terms])
        parts = np.split(change, ends[:-1])
        out.append([replace(t, value=t.value + d) for t, d in zip(terms, parts, strict=True)])
    return out


def _filtered(track: Track, model: NullModel, held: Filtered | None) -> Array:
    return run_filter(track, model, held=held, sensitive=False).whitened


def _tiled(done: Filtered, copies: int) -> Filtered:
    """The gains of the recording's own run, as often as there are copies of its motion."""
    found = done.gains
    gains = Gains(
        np.tile(found.gain, (copies, 1, 1)), np.tile(found.innovation_covariance, (copies, 1, 1))
    )
    return replace(done, nominal_b=np.tile(done.nominal_b, (copies, 1)), gains=gains)


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


def _shift(values: Array, scene: Scene) -> float:
    """Largest |mean| of a segment (N, k), in standard deviations of a mean of unit noise."""
    count = np.bincount(scene.segment)
    kept = count > 0.3 * count.max()
    sums = np.column_stack([np.bincount(scene.segment, weights=column) for column in values.T])
    return float(np.abs(sums[kept] / np.sqrt(count[kept])[:, None]).max())


def _follows(values: Array, courses: Array) -> float:
    """Largest correlation of a column (N, k) with a course (N, c), in deviations of unit noise."""
    return float(np.abs(values.T @ courses).max())


def _courses(values: Sequence[Array]) -> Array:
    """Courses (N,) side by side, centred and of unit length; those that do not change are 0."""
    if not values:
        return np.zeros((0, 0))
    centred = np.column_stack([value - value.mean() for value in values])
    size = np.linalg.norm(centred, axis=0)
    return np.asarray(centred / np.where(size > 0, size, 1.0))
