"""Tests of what the residual still shows: whiteness, and by time, attitude, rate and column.

In the noise of the answer its residual is V^-1 y, where y has the variance V = 1 + X Phi X^T.
Copies are drawn from that law with the tails of the residual, and are fitted as the recording was.
Each statistic, chosen in advance, is compared with the band of its copies (`predictive_checks`).
For each bin of a regime (heading, tilt, rate, a column), a field of its own with columns Z is
tested: its score Z^T V^-1 y has the variance Z^T V^-1 Z, so half of the normalised square has a
mean of three halves of a nat if nothing is left.

"Before" is the calibration alone in the same noise.  In its own noise, what it lacks would count as
noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special
from scipy.fft import idct

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Check, RegimeMap, Whiteness
from ahrsd.diagnosis.answer.omnibus import omnibus_tests
from ahrsd.diagnosis.answer.predictive_checks import (
    COPIES,
    build_scene,
    predictive_bands,
    residual_statistics,
)
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.inference.likelihood.linearisation import CALIBRATION, Linearised, cosine_rows
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.innovation_filter.innovation import batch_columns, join_columns, sensitivities
from ahrsd.diagnosis.innovation_filter.noise import tail_freedom
from ahrsd.diagnosis.model import Columns
from ahrsd.diagnosis.where_and_when.regime import regime_columns, regimes
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """The rows of an answer, and their residuals (3 N,) for the calibration alone and for all."""

    rows: WhiteRows
    calibration: Fit
    whole: Fit
    before: Array
    after: Array

    @property
    def whitened(self) -> Array:
        """(rows of the track, 3) residual for the whole answer, 0 where there is no reading."""
        return self.rows.on_track(self.after.reshape(-1, 3))


def fit_residuals(rows: WhiteRows) -> Residuals:
    """The residuals of an answer's rows."""
    y = rows.y.reshape(-1, 1)
    calibration, whole = rows.fit(rows.made.seen[CALIBRATION].component.width), rows.fit()
    return Residuals(
        rows, calibration, whole, calibration.residual(y)[:, 0], whole.residual(y)[:, 0]
    )


def checks(found: Residuals, maps: Sequence[RegimeMap]) -> dict[str, Check]:
    """Each statistic of the residual with the band of its copies, and each regime's largest bin.

    Deterministic.
    """
    out = _check_statistics(found)
    for one in maps:
        probability = priors.BINS_OUTSIDE / (len(maps) * len(one.after))
        limit = float(special.chdtri(3.0, probability)) / 2.0
        was, now = max(one.before), max(one.after)
        out[f"by_{one.quantity}"] = Check(now, (0.0, limit), was <= limit, now <= limit)
    return out


def merge_recorded_rate_checks(slow: Mapping[str, Check], found: Residuals) -> dict[str, Check]:
    """Checks at the working rate, replaced by those at the recorded rate where there are such.

    found: rows at the recorded rate, with all that the search found removed.  "Before" is inside of
           its band only if it is so at both rates.
    """
    fast = _check_statistics(found)
    return {
        name: replace(fast[name], inside_before=fast[name].inside_before and one.inside_before)
        if name in fast
        else one
        for name, one in slow.items()
    }


def _check_statistics(found: Residuals) -> dict[str, Check]:
    """Each statistic of the residual with the band of its copies."""
    before, value, expected = _statistics_and_bands(found)
    return {
        name: Check(value[name], band, _inside(before[name], band), _inside(value[name], band))
        for name, band in expected.items()
    }


def _statistics_and_bands(
    found: Residuals,
) -> tuple[dict[str, float], dict[str, float], dict[str, tuple[float, float]]]:
    """Statistics before and after, and the bands of the copies."""
    rows = found.rows
    scene, shape = build_scene(rows.made.context), (-1, 3)

    def statistics(residual: Array) -> dict[str, float]:
        return residual_statistics(rows.on_track(residual.reshape(shape)), scene)

    rng = np.random.default_rng(0)
    e = _draw_noise(rng, found, (len(found.after), COPIES))
    w = rng.standard_normal((rows.X.shape[2], COPIES)) * found.whole.deviation[:, None]
    copies = found.whole.residual(e + found.whole.X @ w)
    return (
        statistics(found.before),
        statistics(found.after),
        predictive_bands([statistics(one) for one in copies.T]),
    )


def _draw_noise(rng: np.random.Generator, found: Residuals, shape: tuple[int, int]) -> Array:
    """White noise of unit variance with the tails of the residual."""
    filtered = found.rows.made.point.filtered
    freedom = tail_freedom(replace(filtered, whitened=found.whitened))
    e = rng.standard_normal(shape)
    if np.isfinite(freedom):
        e *= np.sqrt((freedom - 2.0) / rng.chisquare(freedom, shape))
    return e


def _inside(value: float, band: tuple[float, float]) -> bool:
    return band[0] <= value <= band[1]


def regime_maps(found: Residuals) -> tuple[RegimeMap, ...]:
    """Evidence of a field of its own in each bin of each regime, the strongest regime first."""
    tested = regimes(found.rows.made.context)
    if not tested:
        return ()
    Z = found.rows.filter_columns([regime_columns(one) for one in tested])
    Z = Z.reshape(-1, Z.shape[2])
    before = _bin_nats(Z, found.calibration, found.before)
    after = _bin_nats(Z, found.whole, found.after)
    maps, begin = [], 0
    for one in tested:
        mine = slice(begin, begin + len(one.edges) - 1)
        begin = mine.stop
        edges = tuple(float(edge) for edge in one.edges)
        maps.append(RegimeMap(one.quantity, edges, tuple(before[mine]), tuple(after[mine])))
    return tuple(sorted(maps, key=lambda one: -max(one.before)))


def _bin_nats(Z: Array, fit: Fit, residual: Array) -> list[float]:
    """Half of the score statistic, nats, of each three columns in turn."""
    score, information = Z.T @ residual, fit.information(Z)
    out = []
    for at in range(0, len(score), 3):
        s, G = score[at : at + 3], information[at : at + 3, at : at + 3]
        out.append(0.5 * float(s @ np.linalg.lstsq(G, s, rcond=1e-9)[0]))
    return out


def whiteness(start: NullFit, found: Residuals) -> dict[str, Whiteness]:
    """Tests without an alternative hypothesis, of the null model and of the answer's residual."""
    context = found.rows.made.context
    filtered = replace(found.rows.made.point.filtered, whitened=found.whitened)
    p_after = {test.name: test.p_value for test in omnibus_tests(filtered, context)}
    return {
        test.name: Whiteness(test.words, test.p_value, p_after.get(test.name, 1.0))
        for test in omnibus_tests(start.filtered, start.context())
    }


#: relative increase of the diagonal: columns equal to rounding would otherwise have no root
_ROUNDING = 1e-10
#: number of columns that are filtered together
_BATCH = 96


@dataclass(frozen=True, slots=True, eq=False)
class WhiteRows:
    """Rows of the used readings and of a set's columns, whitened by the set's noise.

    y (N, 3);  X (N, 3, q);  phi (q,): log variances of the coefficients
    log_power: log power of the noise by which they were whitened, mean over the rows
    rows: (N,) numbers of these rows in the track
    made, log_noise: the linearisation and the noise from which they were made
    """

    y: Array
    X: Array
    phi: Array
    log_power: float
    rows: NDArray[np.intp]
    made: Linearised
    log_noise: Array

    def to_time_rows(self, rows: Array) -> Array:
        """Other rows by frequency (3 M, p) as (N, 3, p) at these rows."""
        return _rows_in_time(self.made, rows, self.log_noise)[self.rows]

    def filter_columns(self, columns: Sequence[Columns]) -> Array:
        """(N, 3, p) columns of any kind, passed through the filter and whitened by this noise."""
        made, found = self.made, []
        for batch in batch_columns(columns, _BATCH):
            cube = sensitivities(made.regressing, join_columns([columns[k] for k in batch]))
            cube = made.whiten_axes(cosine_rows(cube / made.point.loud.amplitude[:, None, None]))
            found.append((batch, self.to_time_rows(cube)))
        cut = {
            number: part
            for batch, cube in found
            for number, part in zip(
                batch, _split_by_component(cube, [columns[k] for k in batch]), strict=True
            )
        }
        return np.concatenate([cut[k] for k in range(len(columns))], axis=2)

    def on_track(self, values: Array) -> Array:
        """(rows of the track, ...) values, 0 where there is no reading."""
        out = np.zeros((len(self.made.point.loud.amplitude), *values.shape[1:]))
        out[self.rows] = values
        return out

    def fit(self, width: int | None = None) -> Fit:
        """The fit of the first `width` columns, or of all."""
        X = self.X.reshape(-1, self.X.shape[2])[:, :width]
        deviation = np.exp(0.5 * self.phi[:width])
        return Fit(X, deviation, upper_root(X.T @ X, deviation))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Columns (3 N, q) with their prior deviations; root: upper, of A = I + D X^T X D."""

    X: Array
    deviation: Array
    root: Array

    def residual(self, values: Array) -> Array:
        """(3 N, k) residual of values (3 N, k) at the maximum-posterior coefficients."""
        D = self.deviation[:, None]
        w = D * linalg.cho_solve((self.root, False), D * (self.X.T @ values))
        return np.asarray(values - self.X @ w)

    def information(self, Z: Array) -> Array:
        """(p, p) Z^T V^-1 Z of other columns (3 N, p), the fit's coefficients integrated out."""
        projected = linalg.solve_triangular(
            self.root, self.deviation[:, None] * (self.X.T @ Z), trans="T", check_finite=False
        )
        return np.asarray(Z.T @ Z - projected.T @ projected)


def upper_root(G: Array, deviation: Array) -> Array:
    """Upper root of I + D G D."""
    A = G * deviation * deviation[:, None]
    diagonal = np.diag_indices_from(A)
    A[diagonal] = A[diagonal] * (1.0 + _ROUNDING) + 1.0
    return np.asarray(linalg.cholesky(A, check_finite=False))


def white_rows(all_sets: Hypotheses, hypothesis: Hypothesis) -> WhiteRows:
    """The rows of a set in its own noise."""
    made = all_sets.made
    rows = np.concatenate([*(made.rows(key) for key in hypothesis.keys), made.y[:, None]], axis=1)
    cube = _rows_in_time(made, rows, hypothesis.at.log_noise)
    used = np.flatnonzero(made.point.filtered.used)
    laws = [all_sets.component(key).law for key in hypothesis.keys]
    psi = all_sets.psi_of(hypothesis)
    phi = [law.log_variance(psi[key]) for key, law in zip(hypothesis.keys, laws, strict=True)]
    count = np.diff(made.edges)
    log_power = float(count @ hypothesis.at.log_noise) / float(count.sum())
    y, X = cube[used, :, -1], cube[used, :, :-1]
    return WhiteRows(y, X, np.concatenate(phi), log_power, used, made, hypothesis.at.log_noise)


def _rows_in_time(made: Linearised, rows: Array, log_noise: Array) -> Array:
    """(N, 3, p) of rows by frequency (3 M, p), divided by the noise's deviations."""
    scale = np.exp(-0.5 * np.repeat(log_noise, 3 * np.diff(made.edges)))
    cube = (rows * scale[:, None]).reshape(-1, 3, rows.shape[1])
    return np.asarray(idct(cube, axis=0, norm="ortho")[: len(made.point.loud.amplitude)])


def _split_by_component(cube: Array, columns: Sequence[Columns]) -> list[Array]:
    edges = np.cumsum([one.width for one in columns])[:-1]
    return np.split(cube, edges, axis=2)
