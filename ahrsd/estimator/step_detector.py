"""Detector of a step in hard iron or gyro bias since the calibration was made, next to the
estimator.

Every ten seconds of the stream give one small Gram matrix, scored against the newest converged
estimate of that time. The newest blocks that show motion are tested together against the estimate
from before the first of them, including its covariance:

    T = 2 max over D of the gain in log likelihood by a step D of the hard iron (or the gyro bias)

T is compared with the usual gain of such blocks in this stream (lag, gradients, coloured noise). A
step is reported only if one D explains two blocks or more, each of them on its own, and better than
a step of the other sensor or a field that changes in the world. Then the time of the step is
estimated.

A step is reported once; `restart` begins again, with data from after it.

A recording's filter (`innovation`) loops over samples; next to a running estimator that is too
expensive. Within a block the same whitened innovations follow without a loop: the gyro rotates
every reading into the frame of the first one, where the field is constant,

    y_k = R_k C (m_k - b) = h + noise,   R_k = R_k-1 Exp(G (w_k - w_b) dt)

and the noise is white (magnetometer) plus, across the field, a random walk (gyro). The inverse of
the Cholesky factor of its covariance gives the innovations of a filter without prior knowledge of
h; it is the same for every block. The field h of the block is projected out, so a block at rest has
no information, whatever happens to the field around it. So is a lag between the two sensors, which
nearly every stream has and no calibration contains. G is the estimator's correction of the gyro's
angles (`Estimate.gyro_correction`): wrong scales are a bias that changes with the sense of turning.
The remaining uncertainty of G is considered as an error of the calibration.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Estimate
from ahrsd.estimator.chain import symmetric_columns
from ahrsd.estimator.epoch import GYRO_BASIS, InstrumentCorrection
from ahrsd.samples import Array, SampleBlock

ROWS = 128  # thinned samples per block
LAG_S = 0.05  # 1-sigma of a lag between magnetometer and gyro
LEAST_ROWS = 64  # least rows of a piece before a gap that is scored
#: columns of a block: those of `Estimate.gyro_covariance`, then a drift of the field in the world
SOFT, IRON, GYRO, MATRIX = slice(0, 6), slice(6, 9), slice(9, 12), slice(12, 21)
DRIFT, _LAG, _RESIDUAL = slice(21, 24), 27, 28
# and the nuisance parameters of a block: field (3) and lag
_CALIBRATION_COLUMNS, _OWN = 21, slice(24, 28)
_ENTRIES = np.triu_indices(3)
# least 1-sigma of a calibration: its own changes from minute to minute
_FLOOR = np.r_[np.full(6, 1e-3), np.full(3, 5e-4), np.full(3, 2e-4)]
_KEEP_ROOT = 1.2  # change of the noise ratio up to which the whitening is kept


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCalibration:
    """A calibration to test: theta (21,), a root (21, 21) of its covariance, and the noise levels.

    theta: in the order of `Estimate.covariance`, then turn, scale and shape of the gyro's
    correction; gyro_correction (3, 3): acts on the gyro's reading less its bias.
    """

    theta: Array
    root: Array
    correction: Array
    offset: Array
    gyro_bias_rad_s: Array
    gyro_correction: Array
    noise_mag_gauss: float
    noise_gyro_rad_s: float

    @staticmethod
    def of(estimate: Estimate) -> ReferenceCalibration:
        """From an estimate."""
        A = estimate.soft_iron
        covariance = np.zeros((_CALIBRATION_COLUMNS, _CALIBRATION_COLUMNS))
        covariance[:12, :12] = estimate.covariance
        if estimate.gyro_covariance is not None:
            covariance = estimate.gyro_covariance.copy()
        covariance[:12, :12] += np.diag(_FLOOR**2)
        # the units differ so much that small variances would be lost
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
        values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
        gyro = replace(InstrumentCorrection.identity(), gyro=estimate.gyro_correction)
        return ReferenceCalibration(
            np.r_[
                A[_ENTRIES],
                estimate.hard_iron_gauss,
                estimate.gyro_bias_rad_s,
                gyro.gyro_parameters,
            ],
            size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)),
            np.asarray(np.linalg.inv(A), float),
            estimate.hard_iron_gauss,
            estimate.gyro_bias_rad_s,
            estimate.gyro_correction,
            max(estimate.noise_mag_gauss, 1e-5),
            max(estimate.noise_gyro_rad_s, 1e-6),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """Rows of a block: means of `averaged` samples; angle_b_rad is the integral of the
    gyro's rate.
    """

    time_s: Array
    raw_b_gauss: Array
    angle_b_rad: Array
    averaged: int


@dataclass(frozen=True, slots=True, eq=False)
class ScoredBlock:
    """A scored block.

    information (24, 24), score (24,): of the columns, marginalised over the block's own field and
    lag. residual (n, 3), lever (n, 3, 3): y - h and its derivative by the hard iron, in the frame
    of the first row.
    """

    reference: ReferenceCalibration
    time_s: Array
    information: Array
    score: Array
    residual: Array
    lever: Array


class Scorer:
    """Scores blocks; caches the whitening, which depends on the noise only."""

    def __init__(self) -> None:
        self._ratio = 0.0
        self._root: Array = np.eye(ROWS)

    def score(self, rows: Thinned, reference: ReferenceCalibration) -> ScoredBlock:
        """One block of at most ROWS rows against `reference`."""
        n = len(rows.time_s)
        dt_s = np.diff(rows.time_s, prepend=rows.time_s[:1])
        turn = np.diff(rows.angle_b_rad, axis=0, prepend=rows.angle_b_rad[:1])
        turn -= dt_s[:, None] * reference.gyro_bias_rad_s
        turn = turn @ reference.gyro_correction.T
        R = accumulate_rotations(so3.exp(turn))
        lever = R @ reference.correction
        y = (lever @ (rows.raw_b_gauss - reference.offset)[:, :, None])[:, :, 0]
        h = y.mean(axis=0)
        Z = np.zeros((n, 3, _RESIDUAL + 1))
        across = so3.skew(h)
        Z[:, :, SOFT] = lever @ symmetric_columns(h @ R)
        Z[:, :, IRON] = lever
        bias_integral = np.cumsum(R * dt_s[:, None, None], axis=0) @ reference.gyro_correction
        Z[:, :, GYRO] = -across @ bias_integral
        unit_matrices = np.einsum("nij,kjl,nl->nik", R, GYRO_BASIS, turn, optimize=True)
        Z[:, :, MATRIX] = across @ np.cumsum(unit_matrices, axis=0)
        Z[:, [0, 1, 2], [21, 22, 23]] = np.linspace(-1.0, 1.0, n)[:, None]
        Z[:, [0, 1, 2], [24, 25, 26]] = 1.0
        Z[:, :, _LAG] = np.cross(h, (R @ _rates_at_rows(turn, dt_s)[:, :, None])[:, :, 0])
        Z[:, :, _RESIDUAL] = y - h
        G = self._gram(Z, h, reference, float(dt_s[1:].mean()), rows.averaged)
        own = G[_OWN, _OWN] + np.diag([0.0, 0.0, 0.0, LAG_S**-2])
        G = G - G[:, _OWN] @ np.linalg.solve(own, G[_OWN])
        return ScoredBlock(reference, rows.time_s, G[:24, :24], G[:24, _RESIDUAL], y - h, lever)

    def _gram(
        self, Z: Array, h: Array, reference: ReferenceCalibration, dt_s: float, averaged: int
    ) -> Array:
        """Along the field only the magnetometer's noise, across it also the gyro's random walk."""
        size = float(np.linalg.norm(h))
        sigma = reference.noise_mag_gauss / np.sqrt(averaged)
        walk = size * reference.noise_gyro_rad_s * dt_s / np.sqrt(averaged)
        u = h / max(size, 1e-12)
        frame = np.column_stack([u, so3.tangent_basis(u[None])[0]])
        turned = frame.T @ Z
        across = self._whitening(walk / sigma)[: len(Z), : len(Z)] @ turned[:, 1:].reshape(
            len(Z), -1
        )
        rows = np.concatenate([turned[:, 0], across.reshape(-1, Z.shape[2])]) / sigma
        return np.asarray(rows.T @ rows)

    def _whitening(self, ratio: float) -> Array:
        """L^-1 of I + ratio^2 min(i, j) = L L^T; for fewer rows it is the upper left corner."""
        if not self._ratio / _KEEP_ROOT <= ratio <= self._ratio * _KEEP_ROOT:
            steps = np.arange(ROWS, dtype=np.float64)
            noise = np.eye(ROWS) + ratio**2 * np.minimum(steps[:, None], steps)
            self._root, self._ratio = np.linalg.inv(np.linalg.cholesky(noise)), ratio
        return self._root


def accumulate_rotations(turns: Array) -> Array:
    """R_k = turns_0 ... turns_k, (n, 3, 3), in log2(n) passes."""
    out, step = turns, 1
    while step < len(out):
        out = np.concatenate([out[:step], out[:-step] @ out[step:]])
        step *= 2
    return out


def _rates_at_rows(turn: Array, dt_s: Array) -> Array:
    """Rates (n, 3) at the times of the rows, from the rotations between them."""
    rate = turn[1:] / dt_s[1:, None]
    out = np.concatenate([rate[:1], rate])
    out[1:-1] = (rate[:-1] + rate[1:]) / 2
    return out


RATE_HZ = 12.5  # of the thinned samples: a higher rate follows faster motion and costs more
KEPT = 16  # blocks
_LARGEST_READING = 100.0  # gauss or rad/s: beyond the range of these sensors
_RATE_ROWS = 9  # that give the rate of a piece, independently of the blocks
# numbers of informative blocks that are tested together; 1: for the baseline only
_WINDOWS = (1, 2, 4, 8)
_LEAST_BASELINE, _LONGEST_BASELINE = 4, 24  # number of blocks in the baseline
_LEAST_GAIN_RATIO = 40.0  # T over the baseline; in a simulated week 17, with coloured noise 27
_LEAST_GAIN_SHARE = 0.7  # of the gain of each block by a D of its own
_SIGNIFICANT_SIGMAS = 4.0  # of a component of the step
_INFORMATIVE_SIGMA = 0.005  # gauss: the best-known direction of an informative block
_PRIOR_SIGMA = {"hard iron": 0.5, "gyro bias": 0.1}  # of a step
_LEAST_STEP = {"hard iron": 0.005, "gyro bias": 0.002}  # smaller steps are not reported
_COLUMNS = {"hard iron": IRON, "gyro bias": GYRO}
_SHOWN = {"hard iron": (1e3, "mG"), "gyro bias": (1e3, "mrad/s")}
_WHY = {
    "hard iron": "something magnetic was mounted, moved or removed",
    "gyro bias": "the gyro got a shock, or its temperature jumped",
}


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step of `what` ("hard iron" or "gyro bias") by `size` +- `sigma`, (3,), gauss or rad/s.

    at_s: its device time; told_s: end of the block that decided it; blocks: number that agree.
    """

    what: str
    at_s: float
    told_s: float
    size: Array
    sigma: Array
    blocks: int

    @property
    def frame(self) -> str:
        """The sensor that it concerns."""
        return "sensor" if self.what == "hard iron" else "gyro"

    @property
    def unit(self) -> str:
        """Unit of size and sigma."""
        return "gauss" if self.what == "hard iron" else "rad/s"

    @property
    def words(self) -> str:
        """For the log: size, time and meaning."""
        factor, unit = _SHOWN[self.what]
        size = ", ".join(f"{value:+.1f}" for value in self.size * factor)
        sigma = ", ".join(f"{value:.1f}" for value in self.sigma * factor)
        return (
            f"the {self.what} changed by ({size}) +- ({sigma}) {unit} at {self.at_s:.0f} s: the "
            f"calibration in force is void; {_WHY[self.what]}"
        )


class StepDetector:
    """Samples and the newest estimate in, a `Step` out, once. Bounded memory, deterministic."""

    def __init__(self) -> None:
        self.found: Step | None = None
        self._scorer = Scorer()
        self._estimate: Estimate | None = None
        self._reference: ReferenceCalibration | None = None
        self.scored = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything, for another iron or another calibration."""
        self._estimate = self._reference = self.found = None
        self._blocks: deque[ScoredBlock] = deque(maxlen=KEPT)
        self._single_gains: deque[float] = deque(maxlen=_LONGEST_BASELINE + max(_WINDOWS))
        self._builder = _BlockBuilder()

    @property
    def armed(self) -> bool:
        """Whether a step would be reported."""
        return self.found is None and self._baseline_gain() is not None

    def add(self, block: SampleBlock, estimate: Estimate | None) -> Step | None:
        """Take samples; the step, if they show one."""
        if self.found is not None:
            return None
        if estimate is not None and estimate is not self._estimate and estimate.converged:
            self._estimate = estimate
            if np.isfinite(estimate.covariance).all():
                self._reference = ReferenceCalibration.of(estimate)
        for rows in self._builder.add(block):
            step = None if self._reference is None else self._test_block(rows, self._reference)
            if step is not None:
                self.found = step
                return step
        return None

    def _test_block(self, rows: Thinned, reference: ReferenceCalibration) -> Step | None:
        block = self._scorer.score(rows, reference)
        self._blocks.append(block)
        self.scored += 1
        if not _is_informative(block):
            return None
        informative = [b for b in self._blocks if _is_informative(b)]
        baseline = self._baseline_gain()
        step = None
        for count in _WINDOWS:
            if count > len(informative):
                break
            newest = informative[-count:]
            gains = _step_gains(newest)
            if count == 1:
                self._single_gains.append(max(gain for gain, _, _ in gains.values()) / 3.0)
            elif step is None and baseline is not None:
                step = self._decide(newest, gains, baseline)
        return step

    def _baseline_gain(self) -> float | None:
        """Usual gain of a block without a step, at least 1, its value under the model. The newest
        blocks do not count.
        """
        known = list(self._single_gains)
        older = known[: -min(max(_WINDOWS), max(2, len(known) - _LEAST_BASELINE))]
        return None if len(older) < _LEAST_BASELINE else max(1.0, float(np.mean(older)))

    def _decide(
        self,
        newest: list[ScoredBlock],
        gains: dict[str, tuple[float, Array, Array]],
        baseline: float,
    ) -> Step | None:
        what = max(gains, key=lambda name: gains[name][0])
        gain, size, information = gains[what]
        if (
            gain < _LEAST_GAIN_RATIO * baseline
            or _significant_size(size, information) < _LEAST_STEP[what]
        ):
            return None
        if gain < sum(_drift_gain(block, newest[0].reference) for block in newest):
            return None
        if any(
            _gain_share(block, newest[0].reference, what, size) < _LEAST_GAIN_SHARE
            for block in newest
        ):
            return None
        at_s = float(newest[0].time_s[0])
        if what == "hard iron":
            # it may have occurred within the first block: then only the later ones contain all of
            # it
            _, later_size, later_information = _step_gains(newest[1:], newest[0].reference)[what]
            explained = [float(np.max(_onset_gains(newest[0], D))) for D in (size, later_size)]
            at_s = self._onset_time(newest[0], later_size if explained[1] > explained[0] else size)
            if at_s > newest[0].time_s[0]:
                size, information = later_size, later_information
        sigma = np.sqrt(baseline * np.diag(np.linalg.inv(information)))
        return Step(what, at_s, float(newest[-1].time_s[-1]), size, sigma, len(newest))

    def _onset_time(self, first: ScoredBlock, size: Array) -> float:
        """The time from which the step explains most, searched backwards from the first block.

        While the vehicle is at rest only the jump itself shows.
        """
        blocks = list(self._blocks)
        best, at_s, after = 0.0, float(first.time_s[0]), 0.0
        last = next(k for k, block in enumerate(blocks) if block is first)
        for block in reversed(blocks[: last + 1]):
            gains = after + _onset_gains(block, size)
            row = int(np.argmax(gains))
            if gains[row] > best:
                best, at_s = float(gains[row]), float(block.time_s[row])
            after = float(gains[0])
        return at_s


class _BlockBuilder:
    """Samples to thinned blocks; a gap, a clock that runs back or a change of registers ends a
    block.
    """

    def __init__(self) -> None:
        self._waiting: list[SampleBlock] = []
        self._count = 0
        self._averaged = 0

    def add(self, block: SampleBlock) -> list[Thinned]:
        if len(block) == 0:
            return []
        out = self._close() if self._is_break(block) else []
        self._waiting.append(block)
        self._count += len(block)
        if not self._averaged and self._count >= _RATE_ROWS:
            first = np.concatenate([b.time_s for b in self._waiting])[:_RATE_ROWS]
            usual_s = max(1e-4, float(np.median(np.diff(first))))
            self._averaged = max(1, round(1.0 / (usual_s * RATE_HZ)))
        while self._averaged and self._count >= ROWS * self._averaged:
            out += self._take_rows(ROWS)
        return out

    def _is_break(self, block: SampleBlock) -> bool:
        if not self._waiting:
            return False
        last = self._waiting[-1]
        return block.gap_before or block.epoch != last.epoch or block.time_s[0] <= last.time_s[-1]

    def _close(self) -> list[Thinned]:
        rows = self._count // self._averaged if self._averaged else 0
        out = self._take_rows(rows) if rows >= LEAST_ROWS else []
        self._waiting, self._count, self._averaged = [], 0, 0
        return out

    def _take_rows(self, rows: int) -> list[Thinned]:
        """The first `rows` thinned rows; none if a number is beyond the range of the sensor."""
        m, used = self._averaged, rows * self._averaged
        time_s = np.concatenate([b.time_s for b in self._waiting])
        table = np.concatenate(
            [np.column_stack([b.raw_b_gauss, b.gyro_b_rad_s]) for b in self._waiting]
        )
        last = self._waiting[-1]
        remaining = len(time_s) - used
        self._waiting = [_last_rows(last, remaining)] if remaining else []
        self._count = remaining
        dt_s = np.diff(time_s[:used], prepend=time_s[:1])
        if not ((np.abs(table) < _LARGEST_READING).all() and (dt_s[1:] > 0).all()):
            return []
        table = table[:used]
        angle = np.cumsum(table[:, 3:] * dt_s[:, None], axis=0)
        mean = np.column_stack([time_s[:used], table[:, :3], angle])
        mean = mean.reshape(rows, m, 7).mean(axis=1)
        return [Thinned(mean[:, 0], mean[:, 1:4], mean[:, 4:], m)]


def _last_rows(block: SampleBlock, rows: int) -> SampleBlock:
    return replace(
        block,
        time_s=block.time_s[-rows:],
        dt_s=block.dt_s[-rows:],
        raw_b_gauss=block.raw_b_gauss[-rows:],
        gyro_b_rad_s=block.gyro_b_rad_s[-rows:],
        covariates={},
    )


def _is_informative(block: ScoredBlock) -> bool:
    """Whether the block alone determines the hard iron in some direction."""
    return bool(np.linalg.eigvalsh(block.information[IRON, IRON])[-1] > _INFORMATIVE_SIGMA**-2)


def _gradient_given_reference(
    blocks: list[ScoredBlock], reference: ReferenceCalibration
) -> tuple[Array, Array]:
    """Information (21, 21) and score (21,) of deviations from the reference, given its
    covariance.
    """
    known = slice(0, _CALIBRATION_COLUMNS)
    total = sum(
        (b.information[known, known] for b in blocks),
        np.zeros((_CALIBRATION_COLUMNS, _CALIBRATION_COLUMNS)),
    )
    score = np.zeros(_CALIBRATION_COLUMNS)
    for b in blocks:
        theta_change = b.reference.theta - reference.theta
        score += b.score[known] + b.information[known, known] @ theta_change
    K = total @ reference.root
    inner = np.eye(_CALIBRATION_COLUMNS) + reference.root.T @ K
    solved = np.linalg.solve(inner, np.column_stack([K.T, reference.root.T @ score]))
    return total - K @ solved[:, known], score - K @ solved[:, _CALIBRATION_COLUMNS]


def _step_gains(
    blocks: list[ScoredBlock], reference: ReferenceCalibration | None = None
) -> dict[str, tuple[float, Array, Array]]:
    """By sensor: T, the step (3,) and its information (3, 3), relative to the first block's
    reference.
    """
    information, score = _gradient_given_reference(blocks, reference or blocks[0].reference)
    return {what: _step_gain(information, score, what) for what in _COLUMNS}


def _step_gain(information: Array, score: Array, what: str) -> tuple[float, Array, Array]:
    columns = _COLUMNS[what]
    J = information[columns, columns] + np.eye(3) / _PRIOR_SIGMA[what] ** 2
    size = np.asarray(np.linalg.solve(J, score[columns]), float)
    return float(score[columns] @ size), size, J


def _gain_share(
    block: ScoredBlock, reference: ReferenceCalibration, what: str, size: Array
) -> float:
    """Gain of a block by this step, over its gain by the best step of its own."""
    information, score = _gradient_given_reference([block], reference)
    most, _, J = _step_gain(information, score, what)
    return float(2 * size @ score[_COLUMNS[what]] - size @ J @ size) / max(most, 1e-12)


def _drift_gain(block: ScoredBlock, reference: ReferenceCalibration) -> float:
    """T of a field that drifts in the world during the block."""
    known = slice(0, _CALIBRATION_COLUMNS)
    score = block.score + block.information[:, known] @ (block.reference.theta - reference.theta)
    G, K = block.information, block.information[:, known] @ reference.root
    inner = np.eye(_CALIBRATION_COLUMNS) + reference.root.T @ K[known]
    solved = np.linalg.solve(inner, np.column_stack([K.T, reference.root.T @ score[known]]))
    J = (G - K @ solved[:, : len(G)])[DRIFT, DRIFT] + np.eye(3) * 1e-6
    s = (score - K @ solved[:, len(G)])[DRIFT]
    return float(s @ np.linalg.solve(J, s))


def _significant_size(size: Array, information: Array) -> float:
    """Length of the step along the directions in which it is significant."""
    values, vectors = np.linalg.eigh(information)
    along = vectors.T @ size
    return float(np.linalg.norm(along[np.abs(along) * np.sqrt(values) > _SIGNIFICANT_SIGMAS]))


def _onset_gains(block: ScoredBlock, size: Array) -> Array:
    """(n,) gains in this block of a step that begins in row k, with the block's field fitted."""
    effect = block.lever @ size
    residual = block.residual
    cross = np.cumsum(np.sum(effect * residual, axis=1)[::-1])[::-1]
    square = np.cumsum(np.sum(effect**2, axis=1)[::-1])[::-1]
    mean = np.cumsum(effect[::-1], axis=0)[::-1]
    return np.asarray(2 * cross - square + np.sum(mean**2, axis=1) / len(effect))
