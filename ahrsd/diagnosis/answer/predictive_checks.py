"""Posterior predictive checks: does the recording look like simulations of its model?

The fitted model is simulated along the recording's own motion, covariates and gaps.  The copies go
through its filter as the recording did.  They have the noise of the fit, in which anything slow
that was left out counts as noise. All statistics were chosen before looking at any recording.  The
band of each covers a simulation with 99 % for all statistics together (Bonferroni; normal in the
logarithm, with mean and standard deviation of the copies, Student-t).  A statistic that is the
largest of many differences follows Gumbel's law, and its band begins at zero: smaller differences
than in a simulation are no mismatch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.answer.diagnosis import Check
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.calibration_fit.quantisation_noise import (
    calibration_covariance,
    noise_before_rounding,
    readings_of_drawn_calibration,
)
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.innovation_filter.noise import colour_before_filter, fit_colour, tail_freedom
from ahrsd.diagnosis.innovation_filter.regression_statistics import student_quantile
from ahrsd.diagnosis.model import Context, Noise, Term
from ahrsd.diagnosis.repaired_model import forward
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

COPIES = 16
# simulations that determine the noise's colour, and how many rows are enough
_TRIAL_COPIES, _TRIAL_ROWS, _TRIAL_SEED = 8, 40_000, 2
_SEGMENT_S = 20.0
_LAGS = 50
_TINY = 1e-12
_TWO_SIDED = ("normalised_innovation", "autocorrelation", "tail")
_QUANTISATION = "mag_quantisation"
_TANGENTIAL_SHARE = 2.0 / 3.0  # two of the three components of an innovation are across the field
_LEAST_MAG_NOISE = 1e-3  # least noise of the magnetometer, relative to an innovation's deviation


def check_null(null: NullFit) -> dict[str, Check]:
    """The statistics of the residuals of a calibration alone, with the bands of its simulations.

    Deterministic.
    """
    context = null.context()
    scene, found = build_scene(context), _CalibrationColumns.of(null)
    value = residual_statistics(found.left(null.filtered.whitened), scene)
    simulated = _simulated_innovations(null, fit_noise_law(null), (), EFFECTS, COPIES, 0)
    expected = predictive_bands([residual_statistics(found.left(e), scene) for e in simulated])
    return {
        name: Check(value[name], band, inside := _inside(value[name], band), inside)
        for name, band in expected.items()
    }


def compare_with_refits(
    null: NullFit, refitted: Sequence[NullFit]
) -> tuple[dict[str, Check], float]:
    """The statistics of the residuals of a calibration alone, with bands from refitted simulations.

    refitted: two or more fits to simulations of the calibration, each made as `null` was
    Their bands hold where a fit is not linear in the readings, as with a noisy gyro.  They are
    factors: the residual that the error of a fit leaves is as large as that error.
    Also the p-value of the most extreme statistic, by its rank (Bonferroni).
    """
    found = [_fit_statistics(one) for one in refitted]
    value, expected = _fit_statistics(null), predictive_bands(found, by_factor=True)
    ranks = []
    for name in expected:
        above = sum(one[name] >= value[name] for one in found)
        below = len(found) - above
        ranks.append(2 * min(above, below) if name in _TWO_SIDED else above)
    out = {
        name: Check(value[name], band, inside := _inside(value[name], band), inside)
        for name, band in expected.items()
    }
    return out, min(1.0, len(ranks) * (1 + min(ranks)) / (1 + len(found)))


def _fit_statistics(fit: NullFit) -> dict[str, float]:
    """The statistics of the residuals of a fit."""
    return residual_statistics(
        _CalibrationColumns.of(fit).left(fit.filtered.whitened), build_scene(fit.context())
    )


def fit_noise_law(
    fit: NullFit,
    noisy_intervals: Sequence[tuple[float, float]] = (),
    terms: Sequence[Term] = (),
    library: Mapping[str, Effect] = EFFECTS,
) -> Noise:
    """The noise of a fit: levels, colour, and Student-t tails where they are heavy.

    noisy_intervals: in seconds; they have a level of their own, each relative to the filter's.
    Readings in coarse steps (a term) are rounded after the noise.
    Residuals that are constant for 20 s in the sensor's axes or the world's, beyond what the colour
    of the remaining noise explains, are no noise and left out.  The colour is such that the
    innovations of simulations have the colour of the recording's.
    """
    filtered, quick = fit.filtered, _without_segment_means(fit, fit.filtered.whitened)
    slow = filtered.normalised_innovation - quick.normalised_innovation
    if slow > priors.SLOW_BEYOND * _slow_power(quick, segment_index(filtered.track)):
        filtered = quick
    within = np.zeros(len(filtered.track), dtype=bool)
    for begin, end in noisy_intervals:
        within |= (filtered.track.time_s >= begin) & (filtered.track.time_s <= end)
    law = forward.model_noise(fit.model, filtered)
    steps = [float(term.value[0]) for term in terms if term.identifier == _QUANTISATION]
    gyro_power = 0.0 if steps else _gyro_power(fit, law, terms, library, quick=filtered is quick)
    level = np.ones(len(within))
    for rows in (within, ~within):
        if np.any(rows & filtered.used):
            mag_power = float(np.mean(filtered.whitened[rows & filtered.used] ** 2)) - gyro_power
            level[rows] = np.sqrt(max(mag_power, _LEAST_MAG_NOISE**2) / (1.0 - gyro_power))
    if steps:
        truth, covariance = forward.noise_free_readings(fit.context()), calibration_covariance(fit)

        def simulate(noise: Noise, seed: int) -> tuple[Array, Array]:
            known = readings_of_drawn_calibration(truth, covariance, seed) if seed else truth
            simulated = forward.track_from_readings(
                forward.simulate_readings(known, terms, noise, seed, library)
            )
            return simulated.mag_b_gauss, _filter_tracks([simulated], fit)

        return noise_before_rounding(fit, replace(law, colour=(), level=level), steps[0], simulate)
    law = replace(law, level=level)
    if filtered.track.lost_turns is None:  # else lost turns make the tails, and these are simulated
        law = replace(
            law,
            freedom=tail_freedom(replace(filtered, whitened=filtered.whitened / level[:, None])),
        )
    if not law.colour:
        return law
    tried = int(np.clip(_TRIAL_ROWS // len(level), 1, _TRIAL_COPIES))
    simulated = _simulated_innovations(fit, law, terms, library, tried, _TRIAL_SEED)
    seen = [
        _without_segment_means(fit, e) if filtered is quick else replace(filtered, whitened=e)
        for e in simulated
    ]
    stacked = np.concatenate([one.whitened for one in seen])
    found = fit_colour(replace(filtered, whitened=stacked, used=np.tile(filtered.used, len(seen))))
    colour, amplification = colour_before_filter(fit_colour(filtered), found)
    return replace(law, colour=tuple(colour.coefficients.tolist()), level=level * amplification)


def _gyro_power(
    fit: NullFit,
    law: Noise,
    terms: Sequence[Term],
    library: Mapping[str, Effect],
    *,
    quick: bool,
) -> float:
    """Mean square of whitened innovations that the gyro's noise alone makes, two thirds at most.

    At least a third is the magnetometer's: along the field the gyro's noise has no effect.
    """
    gyro_only = replace(law, mag_gauss=0.0, colour=())
    (simulated,) = _simulated_innovations(fit, gyro_only, terms, library, 1, _TRIAL_SEED)
    seen = _without_segment_means(fit, simulated).whitened if quick else simulated
    return min(float(np.mean(seen[fit.filtered.used] ** 2)), _TANGENTIAL_SHARE)


def constant_level_noise(
    fit: NullFit,
    noisy_intervals: Sequence[tuple[float, float]] = (),
    terms: Sequence[Term] = (),
    library: Mapping[str, Effect] = EFFECTS,
) -> Noise:
    """The noise law of a fit at one level, that of most rows."""
    law = fit_noise_law(fit, noisy_intervals, terms, library)
    usual = 1.0 if law.level is None else float(np.median(law.level))
    return replace(law, mag_gauss=law.mag_gauss * usual, level=None)


def _without_segment_means(fit: NullFit, whitened: Array) -> Filtered:
    """Whitened innovations (N, 3) less their means over segments, in both frames."""
    context, used = fit.context(), fit.filtered.used
    segment = segment_index(context.track)
    count = np.maximum(np.bincount(segment, weights=used), 1.0)[:, None]

    def centred(values: Array) -> Array:
        means = np.column_stack([np.bincount(segment, weights=column) for column in values.T])
        return np.where(used[:, None], values - (means / count)[segment], 0.0)

    in_world = np.einsum("nij,nj->ni", context.R_nb, centred(whitened))
    left = np.einsum("nji,nj->ni", context.R_nb, centred(in_world))
    return replace(fit.filtered, whitened=left)


def _slow_power(quick: Filtered, segment: NDArray[np.intp]) -> float:
    """Mean square that the means over segments take of noise of this colour, in both frames."""
    colour = fit_colour(quick)
    density = colour.variance / max(1.0 - float(colour.coefficients.sum()), _TINY) ** 2
    return 2.0 * density * len(np.unique(segment)) / max(int(np.count_nonzero(quick.used)), 1)


def _simulated_innovations(
    fit: NullFit,
    noise: Noise,
    terms: Sequence[Term],
    library: Mapping[str, Effect],
    copies: int,
    seed: int,
) -> list[Array]:
    """Whitened innovations (N, 3) of simulations along the recording's motion."""
    truth, track = forward.noise_free_readings(fit.context()), fit.filtered.track
    seeds = [1000 * seed + k for k in range(copies)]
    truths = [truth] * copies
    if any(term.identifier == _QUANTISATION for term in terms):
        covariance = calibration_covariance(fit)
        truths = [readings_of_drawn_calibration(truth, covariance, one) for one in seeds]
    simulated = [
        _lose_turns(
            track,
            forward.track_from_readings(
                forward.simulate_readings(along, terms, noise, one, library)
            ),
            one,
        )
        for along, one in zip(truths, seeds, strict=True)
    ]
    whole = [track for track in simulated if len(track) == len(fit.filtered.track)]
    return np.split(_filter_tracks(whole, fit), len(whole))


def _lose_turns(track: Track, simulated: Track, seed: int) -> Track:
    """A simulation that loses as many turns as the recording is expected to have lost unseen.

    They are corrected on average: if a step loses n of them where m are expected, its true turn
    exceeds the gyro's by that of n - m device steps.
    """
    expected = track.lost_turns
    if expected is None or len(simulated) != len(track):
        return simulated
    lost = np.random.default_rng([seed, len(simulated)]).poisson(expected)
    short = track.step_share * (lost - expected)
    gyro = simulated.gyro_b_rad_s * (1.0 - short)[:, None]
    return replace(simulated, gyro_b_rad_s=gyro, lost_turns=expected, step_share=track.step_share)


def _inside(value: float, band: tuple[float, float]) -> bool:
    return band[0] <= value <= band[1]


@dataclass(frozen=True, slots=True, eq=False)
class _CalibrationColumns:
    """The whitened columns (3 N, 11) of the calibration, orthonormal."""

    columns: Array

    @staticmethod
    def of(fit: NullFit) -> _CalibrationColumns:
        """Of a fit, whose filter run has sensitivities."""
        flat = sensitivities(fit.filtered, nuisance_columns(fit.filtered)).reshape(-1, 11)
        return _CalibrationColumns(
            np.linalg.svd(flat / np.linalg.norm(flat, axis=0), full_matrices=False)[0]
        )

    def left(self, whitened: Array) -> Array:
        """Whitened innovations (N, 3) with the columns projected out."""
        flat = whitened.ravel()
        return np.asarray((flat - self.columns @ (self.columns.T @ flat)).reshape(-1, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What innovations are compared with: directions, segments and time series of unit length.

    unit_b (N, 3): direction of the field;  R_nb (N, 3, 3);  segment (N,): number of the 20 s
    segment time (N, 1), heading (N, 4), columns (N, c): centred;  columns may have no column
    """

    unit_b: Array
    R_nb: Array
    segment: NDArray[np.intp]
    time: Array
    heading: Array
    columns: Array


def build_scene(context: Context) -> Scene:
    """The scene of a recording."""
    track = context.track
    return Scene(
        unit_b=context.field_b
        / np.maximum(np.linalg.norm(context.field_b, axis=1, keepdims=True), 1e-300),
        R_nb=context.R_nb,
        segment=segment_index(track),
        time=_standardise([track.time_s]),
        heading=_standardise(
            [f(n * context.heading_rad) for n in (1, 2) for f in (np.cos, np.sin)]
        ),
        columns=_standardise(
            [
                series
                for values in track.covariates.values()
                if np.isfinite(values).all() and np.ptp(values) > 0
                for series in (values, time_series.derivative(values, track.time_s, track.dt_s))
            ]
        ).reshape(len(track), -1),
    )


def segment_index(track: Track) -> NDArray[np.intp]:
    """(N,) number of the 20 s segment of a row, counting segments that have a row."""
    piece = (track.time_s - track.time_s[0]) // _SEGMENT_S
    return np.asarray(np.unique(piece, return_inverse=True)[1], dtype=np.intp)


def residual_statistics(e: Array, scene: Scene) -> dict[str, float]:
    """The compared statistics of whitened innovations (N, 3) in a scene.

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
    seen = e[np.any(e != 0.0, axis=1)]
    along = np.sum(e * scene.unit_b, axis=1)[:, None]
    power = np.abs(np.fft.rfft(e, axis=0)[1:]) ** 2
    out = {
        "normalised_innovation": float(np.mean(seen**2)),
        "autocorrelation": _portmanteau(e),
        "shift_sensor": _largest_segment_mean(e, scene),
        "shift_world": _largest_segment_mean(np.einsum("nij,nj->ni", scene.R_nb, e), scene),
        "shift_turn": _largest_segment_mean(np.cross(scene.unit_b, e), scene),
        "field_size": max(
            _largest_segment_mean(along, scene), _largest_correlation(along, scene.time)
        ),
        "heading": _largest_correlation(e, scene.heading),
        "tail": float(np.quantile(np.abs(seen), 0.999)),
        "line": float((power / power.mean(axis=0)).max()),
    }
    if scene.columns.shape[1]:
        out["covariates"] = _largest_correlation(e, scene.columns)
    return out


def _filter_tracks(tracks: Sequence[Track], fit: NullFit) -> Array:
    """Whitened innovations of tracks of the fit's own length, its terms subtracted as in its run.

    Each has its own gains and nominal field, as the recording has: with the field direction of
    another track, a noisy gyro would seem to change the field's size.
    """
    count = len(tracks)
    mag, gyro = (
        None if part is None else np.tile(part, (count, 1))
        for part in (fit.terms_mag, fit.terms_gyro)
    )
    blind = np.tile(np.isnan(fit.filtered.track.mag_b_gauss).any(axis=1), count)
    joined = _concatenate_tracks(tracks)
    joined.mag_b_gauss[blind] = np.nan
    return run_filter(joined, fit.model, mag, gyro, with_sensitivities=False).whitened


def _concatenate_tracks(tracks: Sequence[Track]) -> Track:
    """Tracks one after another, each with its own runs, so that the filter takes all at once."""
    first = tracks[0]
    length = first.duration_s + 10.0
    dt_s = np.concatenate([track.dt_s for track in tracks])
    lost = [track.lost_turns for track in tracks if track.lost_turns is not None]
    return replace(
        first,
        time_s=np.concatenate([track.time_s + k * length for k, track in enumerate(tracks)]),
        dt_s=dt_s,
        mag_b_gauss=np.vstack([track.mag_b_gauss for track in tracks]),
        gyro_b_rad_s=np.vstack([track.gyro_b_rad_s for track in tracks]),
        accel_b_m_s2=None,
        covariates={},
        runs=tuple(time_series.gap_free_runs(dt_s)),
        lost_turns=np.concatenate(lost) if lost else None,
    )


def predictive_bands(
    found: Sequence[Mapping[str, float]], *, by_factor: bool = False
) -> dict[str, tuple[float, float]]:
    """The band of one more simulation, for every statistic.

    by_factor: whether the largest of many differences are spread in the logarithm as well
    """
    count, names = len(found), list(found[0])
    outside = priors.CHECKS_OUTSIDE / len(names)
    two_sided = student_quantile(1 - outside / 2, count - 1) * np.sqrt(1 + 1 / count)
    out = {}
    for name in names:
        values = np.array([one[name] for one in found])
        logs = np.log(np.maximum(values, _TINY))
        middle, spread = float(np.mean(logs)), float(np.std(logs, ddof=1))
        if name in _TWO_SIDED:
            width = two_sided * spread
            out[name] = (float(np.exp(middle - width)), float(np.exp(middle + width)))
        elif by_factor:
            out[name] = (0.0, float(np.exp(middle + priors.CHECKS_LARGEST_REACH * spread)))
        else:
            out[name] = (
                0.0,
                float(values.mean() + priors.CHECKS_LARGEST_REACH * values.std(ddof=1)),
            )
    return out


def _portmanteau(e: Array) -> float:
    """Sum of squared autocorrelations times their number, over the number of lags."""
    count, axes = e.shape
    flat = e.ravel()
    longest_lag = min(_LAGS, count - 1)
    lags = [float(flat[: flat.size - k * axes] @ flat[k * axes :]) for k in range(longest_lag + 1)]
    return float(np.mean((np.array(lags[1:]) / max(lags[0], _TINY)) ** 2) * 3 * count)


def _largest_segment_mean(values: Array, scene: Scene) -> float:
    """Largest |mean| of a segment (N, k), in standard deviations of a mean of unit noise."""
    count = np.bincount(scene.segment, weights=np.any(values != 0.0, axis=1))
    kept = count > 0.3 * count.max()
    sums = np.column_stack([np.bincount(scene.segment, weights=column) for column in values.T])
    means = np.abs(sums[kept] / np.sqrt(count[kept])[:, None])
    return float(means.max(initial=0.0))


def _largest_correlation(values: Array, series: Array) -> float:
    """Largest correlation of a column (N, k) with a series (N, c), in deviations of unit noise."""
    return float(np.abs(values.T @ series).max())


def _standardise(values: Sequence[Array]) -> Array:
    """Series (N,) side by side, centred and of unit length; constant ones are 0."""
    if not values:
        return np.zeros((0, 0))
    centred = np.column_stack([value - value.mean() for value in values])
    size = np.linalg.norm(centred, axis=0)
    return np.asarray(centred / np.where(size > 0, size, 1.0))
