"""What a part of the model gains on readings that it was not fitted to, and what its copies gain.

The recording is cut into intervals of some seconds, which are assigned to five folds in turn
(cross-validation).  The readings of each fold are predicted from the other four: the coefficients
are those of the other folds, the sizes and the noise spectrum are those of the whole recording.
The predictive density of a fold is p(all) / p(the other folds), with the coefficients integrated
out.  The gain is the log likelihood ratio of a fold's readings with the accepted members and
without them, each set in its own noise.  If it is negative, the members predict other readings
wrongly.

Copies are the same columns shifted in time, as a cause of the same statistics would have them that
is unrelated to the readings.  For a free process in time, the copies are free processes in the
other frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Heldout
from ahrsd.diagnosis.inference.answer.residual_checks import WhiteRows, upper_root, white_rows
from ahrsd.diagnosis.inference.likelihood.candidates import averaged_log_bayes_factor
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis, Names
from ahrsd.samples import Array

#: least number of readings of an interval
_FEWEST_READINGS = 8


@dataclass(frozen=True, slots=True, eq=False)
class _FoldProducts:
    """Products of rows by fold: G (F, q, q), s (F, q), square (F,), rows (F,)."""

    G: Array
    s: Array
    square: Array
    rows: Array

    def all_but(self, number: int) -> tuple[Array, Array, float, float]:
        """The sums over all folds but one; over all folds if there is none of this number."""
        others = np.arange(len(self.rows)) != number
        return (
            self.G[others].sum(axis=0),
            self.s[others].sum(axis=0),
            float(self.square[others].sum()),
            float(self.rows[others].sum()),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """How well a set predicts each fold from the others.

    nats: log density of all folds
    square: mean square error of the prediction of the next reading, in the filter's unit; the mean
            of the noise's log powers is the log error variance of a prediction from all before
    """

    nats: float
    square: float


@dataclass(eq=False)
class HeldOut:
    """Sets of one recording, each predicted once; gains are per recorded reading."""

    all_sets: Hypotheses
    best: Hypothesis

    def __post_init__(self) -> None:
        """Start with no predictions."""
        self._rows: dict[Names, WhiteRows] = {}
        self._parts: dict[Names, _FoldProducts] = {}
        self._predictions: dict[Names, Prediction] = {}
        recorded = self.all_sets.made.point.problem.recorded
        self.samples = int(np.count_nonzero(np.isfinite(recorded.mag_b_gauss).all(axis=1)))

    def rows(self, names: Names) -> WhiteRows:
        """The rows of a set in its own noise; kept for the best set and for the last other one."""
        if names not in self._rows:
            self._rows = {key: one for key, one in self._rows.items() if key == self.best.names}
            self._rows[names] = white_rows(self.all_sets, self.all_sets.judge(names, self.best))
        return self._rows[names]

    def predict(self, names: Names) -> Prediction:
        """How well a set predicts each fold from the others."""
        if names not in self._predictions:
            self._predictions[names] = _predict_folds(self.parts(names), self.rows(names))
        return self._predictions[names]

    def parts(self, names: Names) -> _FoldProducts:
        """Products of a set's rows by fold."""
        if names not in self._parts:
            rows = self.rows(names)
            self._parts[names] = _fold_products(rows.X, rows.y, assign_folds(rows))
        return self._parts[names]

    def gain(self, without: Names) -> float:
        """Nats per recorded reading by which the best set predicts better than `without`."""
        return float(self.predict(self.best.names).nats - self.predict(without).nats) / self.samples

    def held_out_gain(self, keys: Sequence[str]) -> Heldout:
        """The held-out gain of members of the best set together, and the largest of copies."""
        without = self.without(keys)
        free_process = any(self.all_sets.component(key).row is None for key in keys)
        if free_process:
            copies = self._best_other_frame_nats(without)
        else:
            copies = max(self._best_shifted_copy_nats(key, without) for key in keys)
        before, after = (self._prediction_rms_gauss(names) for names in (without, self.best.names))
        return Heldout(before, after, self.gain(without), copies / self.samples)

    def without(self, keys: Sequence[str]) -> Names:
        """The best set without some members."""
        names = self.best.names
        for key in keys:
            names = self.all_sets.without_member(names, key)
        return names

    def _prediction_rms_gauss(self, names: Names) -> float:
        """Root mean square error of the prediction, gauss."""
        found, filtered = self.predict(names), self.all_sets.made.point.filtered
        used, level = filtered.used, self.all_sets.made.point.loud.amplitude[:, None]
        own = float(np.mean(filtered.innovation[used] ** 2))
        per_unit = own / max(float(np.mean((filtered.whitened / level)[used] ** 2)), 1e-300)
        return float(np.sqrt(found.square * per_unit))

    def _best_shifted_copy_nats(self, key: str, without: Names) -> float:
        """Largest gain, nats, of a member's copies shifted in time, added to the set without it."""
        rows, one = self.rows(without), self.all_sets.component(key)
        shifted = [one.shifted_columns(share) for share in priors.SHIFTS]
        copies = rows.filter_columns(shifted)
        parts = _append_columns(self.parts(without), rows, copies)
        known = rows.X.shape[2]
        cuts = [slice(k * one.width, (k + 1) * one.width) for k in range(len(shifted))]

        def copy_nats(number: int) -> Array:
            """Log Bayes factor of each copy on all folds but one."""
            G, s, _, _ = parts.all_but(number)
            deviation = np.exp(0.5 * rows.phi)
            root = upper_root(G[:known, :known], deviation)
            W, projected = (
                linalg.solve_triangular(root, deviation[:, None] * right, trans="T")
                for right in (G[:known, known:], s[:known, None])
            )
            own, remaining = G[known:, known:] - W.T @ W, s[known:] - W.T @ projected[:, 0]
            return np.array(
                [averaged_log_bayes_factor(own[cut, cut], remaining[cut], one) for cut in cuts]
            )

        folds = len(parts.rows)
        nats_of_others = sum((copy_nats(number) for number in range(folds)), np.zeros(len(shifted)))
        return float(np.max(folds * copy_nats(folds) - nats_of_others))

    def _best_other_frame_nats(self, without: Names) -> float:
        """Largest gain, in nats, of a free process in a frame in which the best set has none."""
        others = [one for one in priors.COURSE_UNIT if f"free {one}" not in self.best.names]
        fitted = [f"free {one}" for one in others if f"free {one}" in self.all_sets.made.seen]
        base = self.predict(without).nats
        return max((self.predict(without | {other}).nats - base for other in fitted), default=0.0)


def assign_folds(rows: WhiteRows) -> NDArray[np.intp]:
    """(N,) fold of each row: successive intervals belong to the folds in turn."""
    track = rows.made.point.problem.track
    length_s = max(priors.STRETCH_S, _FEWEST_READINGS * track.step_s)
    at_s = track.time_s[rows.rows] - track.time_s[0]
    return np.asarray((at_s // length_s).astype(np.intp) % priors.PARTS)


def _fold_products(X: Array, y: Array, fold_of_row: NDArray[np.intp]) -> _FoldProducts:
    products = []
    for number in range(priors.PARTS):
        inside = fold_of_row == number
        A, b = X[inside].reshape(-1, X.shape[2]), y[inside].reshape(-1)
        products.append((A.T @ A, A.T @ b, float(b @ b), float(len(b))))
    return _FoldProducts(*(np.array(one) for one in zip(*products, strict=True)))


def _append_columns(known: _FoldProducts, rows: WhiteRows, copies: Array) -> _FoldProducts:
    """The products with further columns (N, 3, p) behind those of the set."""
    fold_of_row, products = assign_folds(rows), []
    for number in range(priors.PARTS):
        inside = fold_of_row == number
        X, C = (one[inside].reshape(-1, one.shape[2]) for one in (rows.X, copies))
        products.append((X.T @ C, C.T @ C, C.T @ rows.y[inside].reshape(-1)))
    across, own, s = (np.array(one) for one in zip(*products, strict=True))
    above = np.concatenate([known.G, across], axis=2)
    below = np.concatenate([np.swapaxes(across, 1, 2), own], axis=2)
    G = np.concatenate([above, below], axis=1)
    return _FoldProducts(G, np.concatenate([known.s, s], axis=1), known.square, known.rows)


def _predict_folds(parts: _FoldProducts, rows: WhiteRows) -> Prediction:
    """Predict each fold from the others."""
    deviation = np.exp(0.5 * rows.phi)
    unit = np.log(2 * np.pi) + rows.log_power

    def density(number: int) -> tuple[float, Array]:
        """Log density of all folds but one, and the maximum-posterior coefficients there."""
        G, s, square, count = parts.all_but(number)
        root = upper_root(G, deviation)
        m = linalg.cho_solve((root, False), deviation * s)
        log_det = 2.0 * float(np.sum(np.log(np.diag(root))))
        return -0.5 * (count * unit + square + log_det - float(m @ (deviation * s))), deviation * m

    folds = len(parts.rows)
    whole, total, residual_square = density(folds)[0], 0.0, 0.0
    for number in range(folds):
        nats, w = density(number)
        total += whole - nats
        fold_square = parts.square[number] - 2 * parts.s[number] @ w + w @ parts.G[number] @ w
        residual_square += float(fold_square)
    return Prediction(
        total, float(np.exp(rows.log_power)) * residual_square / float(parts.rows.sum())
    )
