"""The estimator: samples in, estimates out, at a bounded cost per sample.

Samples become steps, steps become epochs of constant size, and each epoch becomes one factor of the
graph. While the window holds all epochs, the answer is that of the batch smoother; epochs that
leave it are folded into the prior.

An `Estimate` is derived from the graph: scale as a convention, sigmas, the heading and what would
improve it, observability.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.estimator import chain, noise
from ahrsd.estimator.epoch import (
    GYRO_AMONG_IMPERFECTIONS,
    REQUIRED_NATS,
    ImperfectionLikelihood,
    Instrument,
    InstrumentCorrection,
    InstrumentPosterior,
    Widening,
    estimate_instrument,
    full_instrument_quadratics,
    instrument_quadratics,
    linearise_locked,
    required_bias_walk,
    required_gyro_correction,
    rest_quadratics,
    widening_by_imperfections,
)
from ahrsd.estimator.epoch_data import EpochBuilder, RunningTime, check_samples, with_border
from ahrsd.estimator.graph import (
    UNDETERMINED_RATIO,
    Node,
    SingularError,
    curvature_covariance,
    whitening,
)
from ahrsd.estimator.model_checks import (
    Misalignment,
    ResidualComponent,
    change_message,
    estimate_misalignment,
    find_iron_change,
    find_residual_component,
    widen_covariance,
)
from ahrsd.estimator.parameters import MIN_EPOCH_STEPS, EstimatorParameters, possible_instruments
from ahrsd.estimator.window import Window, search
from ahrsd.samples import Array, SampleBlock

# -- Accuracy of an estimate -----------------------------------------------------------------------


_NAMES = (
    *(f"soft iron {i}" for i in ("xx", "xy", "xz", "yy", "yz", "zz")),
    *(f"hard iron {i}" for i in "xyz"),
    *(f"gyro bias {i}" for i in "xyz"),
)
_TYPICAL_DIP_RAD = float(np.radians(65.0))  # pessimistic for most of the inhabited earth
_STEEPEST_RAD = float(np.radians(80.0))
_HEADINGS = 12
_FLOOR = 0.1  # ratio at which the observability score is 1


def unit_volume(c: Array) -> tuple[Array, Array, float, Array]:
    """A (3, 3) with det 1, b (3,), |h|, and d[A (6), b (3)]/d[M (6), b (3)] (9, 9).

    A = M / r with r = det(M)^(1/3), so dA = dM / r - A tr(M^-1 dM) / 3.
    """
    M = chain.symmetric(c[:6])
    r = float(np.cbrt(np.linalg.det(M)))
    A = M / r
    inverse = np.linalg.inv(M)
    J = np.eye(9)
    for j in range(6):
        dM = chain.symmetric(np.eye(6)[j])
        J[:6, j] = chain.upper_triangle(dM / r - A * np.trace(inverse @ dM) / 3)
    return A, c[6:9].copy(), r, J


def heading_sigma_deg(c: Array, covariance: Array, down_b: Array, dip_rad: float) -> float:
    """Worst 1-sigma heading error over 12 headings at the given tilts.

    down_b (K, 3): unit vectors towards the earth, sensor frame. The direction error of a field
    direction u is the tangential part of M^-1 (dM u + db); its part along (down x u) turns the
    heading by that over cos(dip).
    """
    u, across = _headings_at_tilts(down_b, dip_rad)
    along = across @ np.linalg.inv(chain.symmetric(c[:6]))
    J = np.concatenate([chain.symmetric_columns(u), np.tile(np.eye(3), (len(u), 1, 1))], axis=2)
    row = (along[:, None, :] @ J)[:, 0]
    variance = np.sum((row @ covariance[:9, :9]) * row, axis=1)
    return float(np.degrees(np.sqrt(np.maximum(np.max(variance), 0.0))))


def misalignment_heading_deg(turn_rad: Array, down_b: Array, dip_rad: float) -> float:
    """Worst heading error over the same headings for a magnetometer turned by turn_rad (3,)."""
    u, across = _headings_at_tilts(down_b, dip_rad)
    return float(np.degrees(np.max(np.abs(np.sum(np.cross(turn_rad, u) * across, axis=1)))))


def _headings_at_tilts(down_b: Array, dip_rad: float) -> tuple[Array, Array]:
    """Field directions (n, 3) over 12 headings at each tilt, and the error directions (n, 3) that
    turn the heading.
    """
    psi = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    helper = np.eye(3)[np.argmin(np.abs(down_b), axis=1)]
    north = np.cross(helper, down_b)
    north /= np.linalg.norm(north, axis=1, keepdims=True)
    east = np.cross(down_b, north)
    level = np.cos(psi)[:, None, None] * north + np.sin(psi)[:, None, None] * east
    u = (np.cos(dip_rad) * level + np.sin(dip_rad) * down_b).reshape(-1, 3)
    return u, np.cross(down_b, level).reshape(-1, 3) / np.cos(dip_rad)


_KNOWN_DEG = 0.5  # a better known heading needs no advice
_MOTION = "the motion so far does not determine enough: {}"
_WIDENED = {
    "misfit": "the field differs with place or attitude, or the iron changes with time: repeat "
    "the motion at another place, away from steel and currents, once it is warm; run `ahrsd "
    "diagnose` on the recording to find the cause",
    "axes": "the magnetometer's axes may be turned against the gyro's: roll and pitch as well",
    "turned": "the magnetometer's axes are turned against the gyro's: mount them alike, or take "
    "the correction that `ahrsd calibrate` gives for a recording",
    "lag": "the field's readings may be delayed: turn fast and slow, both ways",
    "scales": "the gyro's scales may be off by a percent: turn about every axis, and back again",
    "place": "the field may differ with place: repeat the motion at another place, away from steel",
    "bias": "the gyro's bias may still follow its temperature: go on until it is warm",
}
_LEAN_RAD = float(np.radians(30.0))
_SAME_SIGMA_RATIO = 1.5  # of two sigmas that count as equal
_SECONDS, _ROWS = 60.0, 20.0  # duration of a manoeuvre, and readings at each of its attitudes


def motion_and_misfit(explained: Array, answer: Array, W: Array) -> dict[str, Array]:
    """Split of the answer's covariance (12, 12) of [M, b, w_b] between motion and misfit.

    explained (12, 12): the covariance if the model explained the data; W whitens the prior. In
    directions that stay undetermined, the effect of misfit counts as motion: the data have too
    little information there to outweigh the misfit, and another place would change nothing.
    """
    scaled = W @ answer @ W.T
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    undetermined = vectors[:, values > UNDETERMINED_RATIO**2]
    onto_undetermined = np.linalg.solve(W, undetermined @ undetermined.T @ W)
    onto_determined = np.eye(len(W)) - onto_undetermined
    additional = answer - explained
    return {
        "motion": explained + onto_undetermined @ additional @ onto_undetermined.T,
        "misfit": onto_determined @ additional @ onto_determined.T,
    }


@dataclass(frozen=True, slots=True, eq=False)
class HeadingAdvice:
    """Advice on what would improve the heading.

    c (9,) = [M, b]: the calibration; down, dip_rad: attitudes and dip that were driven, as for
    `heading_sigma_deg`; noise_gauss: of one reading.
    """

    c: Array
    down: Array
    dip_rad: float
    noise_gauss: float

    def main_cause(
        self,
        parts: Mapping[str, Array],
        covariance: Array,
        misaligned_deg: float = 0.0,
        misfit_cause: Callable[[], str] = str,
    ) -> str:
        """The cause of more than half of the heading's variance, in words; empty if the heading is
        well known.

        covariance (12, 12): the answer's; parts: covariances (12, 12) by "motion" and the keys of
        `_WIDENED`, which add up to it apart from correlations; misaligned_deg: heading error by
        axes that were found to be turned; misfit_cause: returns the known cause of misfit in words,
        or an empty text.
        """
        if not np.hypot(self._sigma_deg(covariance), misaligned_deg) > _KNOWN_DEG:
            return ""
        variances = {name: self._sigma_deg(one) ** 2 for name, one in parts.items()}
        variances["turned"] = misaligned_deg**2
        most = max(variances, key=lambda name: variances[name])
        if not variances[most] > 0.5 * sum(variances.values()):
            return ""
        if most == "motion":
            return _MOTION.format(self.best_manoeuvre(covariance))
        return (misfit_cause() if most == "misfit" else "") or _WIDENED[most]

    def place_heading_deg(self, parts: Mapping[str, Array]) -> float:
        """1-sigma heading error by a field that differs by place; nan if unknown.

        A field that differs by place but not with the heading is part of misfit.
        """
        return self._sigma_deg(parts["place"] + parts["misfit"]) if "place" in parts else np.nan

    def best_manoeuvre(self, covariance: Array) -> str:
        """The easiest of a turn, a roll and a pitch after which the heading sigma is close to the
        least of the three.
        """
        sigma = np.sqrt(np.diag(covariance))
        size = np.outer(sigma, sigma)
        information = np.linalg.inv(covariance / size)
        after = {
            name: self._sigma_deg(
                size * np.linalg.inv(information + self._manoeuvre_information(attitudes) * size)
            )
            for name, attitudes in self._manoeuvres().items()
        }
        least = min(after.values())
        return next(
            (name for name in after if after[name] <= _SAME_SIGMA_RATIO * least), "turn and lean"
        )

    def _sigma_deg(self, covariance: Array) -> float:
        return heading_sigma_deg(self.c, covariance, self.down, self.dip_rad)

    def _manoeuvres(self) -> dict[str, list[Array]]:
        """Attitudes (n, 3, 3) from the level frame to the sensor, in order, in pieces."""
        mean = np.mean(self.down, axis=0)
        level = _level_frame(mean / np.linalg.norm(mean))
        headings = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
        turned = so3.exp(headings[:, None] * level[:, 2]) @ level
        lean = _LEAN_RAD * np.sin(headings)[:, None]
        found = {"turn through all headings": [turned]}
        for name, axis in (("roll", [1.0, 0.0, 0.0]), ("pitch", [0.0, 1.0, 0.0])):
            leant = so3.exp(lean * np.array(axis))
            found[f"{name} by 30 deg both ways, on four headings, if the vehicle can"] = [
                leant @ one for one in turned[::3]
            ]
        return found

    def _manoeuvre_information(self, pieces: Sequence[Array]) -> Array:
        """Information (12, 12) of a manoeuvre; the direction at the start of each piece is unknown.

        The total is the same for several pieces as for one.
        """
        M = chain.symmetric(self.c[:6])
        field = np.array([np.cos(self.dip_rad), 0.0, np.sin(self.dip_rad)])
        across = so3.tangent_basis(field[None])[0]
        total = np.zeros((12, 12))
        for R in pieces:
            columns = chain.symmetric_columns(R @ field)
            integral = np.cumsum(np.swapaxes(R, 1, 2), axis=0) * (_SECONDS / len(pieces) / len(R))
            # rotation error in the level frame by the gyro bias
            bias = -M @ R @ so3.skew(field) @ integral
            iron = np.concatenate([columns, np.tile(np.eye(3), (len(R), 1, 1)), bias], axis=2)
            J = np.concatenate([iron, M @ R @ across], axis=2).reshape(-1, 14)
            H = J.T @ J
            own = H[:12, :12] - H[:12, 12:] @ np.linalg.solve(H[12:, 12:], H[12:, :12])
            total += own / len(pieces)
        return total * _ROWS / self.noise_gauss**2


def _level_frame(down: Array) -> Array:
    """Columns north, east, down (3, 3) in the sensor frame; north is arbitrary."""
    north = np.cross(np.eye(3)[np.argmin(np.abs(down))], down)
    north /= np.linalg.norm(north)
    return np.column_stack([north, np.cross(down, north), down])


def tilts_and_dip(
    tilts: Iterable[Array], epochs: Sequence[tuple[Array, Array]]
) -> tuple[Array, float]:
    """Tilts driven (K, 3) and the dip of the field in rad, from gravity; without it, level and a
    steep dip.

    tilts: unit vectors towards the earth, possibly nan; epochs: directions (n, 3) of the field and
    of down.
    """
    down = np.array([d for d in tilts if np.isfinite(d).all()])
    if len(down) == 0:
        return np.array([[0.0, 0.0, 1.0]]), _TYPICAL_DIP_RAD
    along = [
        float(u[len(u) // 2] @ d[len(u) // 2])
        for u, d in epochs
        if np.isfinite(d[len(u) // 2]).all()
    ]
    if not along:
        return down, _TYPICAL_DIP_RAD
    dip = float(np.median(np.arcsin(np.clip(along, -1.0, 1.0))))
    return down, float(np.clip(dip, -_STEEPEST_RAD, _STEEPEST_RAD))


def observability(covariance: Array, W: Array) -> Observability:
    """Compare the posterior of [M (6), b (3), w_b (3)] with the prior, direction by direction.

    W (12, 12) whitens the prior.
    """
    scaled = W @ covariance @ W.T
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    ratio = np.sqrt(np.clip(values, 0.0, None))
    return Observability(
        prior_ratio=ratio,
        unobservable=undetermined_names(vectors[:, ratio > UNDETERMINED_RATIO]),
        score=float(_FLOOR / max(float(ratio[-1]), 1e-9)),
    )


def undetermined_names(vectors: Array) -> tuple[str, ...]:
    """One name for each dimension of the subspace that the orthonormal vectors (12, K) span.

    Eigenvectors of equal eigenvalues are an arbitrary basis that depends on the processor. So the
    parameter nearest to the subspace is taken first, then the nearest to the remaining subspace:
    since |P_ij| <= sqrt(P_ii P_jj) it dominates its own projection, and no two names begin alike.
    """
    P = vectors @ vectors.T
    names = []
    for _ in range(vectors.shape[1]):
        lead = int(np.argmax(np.round(np.diag(P), 6)))
        v = P[:, lead] / np.sqrt(P[lead, lead])
        others = [i for i in np.argsort(-np.abs(v), kind="stable") if i != lead and abs(v[i]) > 0.4]
        names.append(" + ".join(_NAMES[i] for i in [lead, *others[:2]]))
        P = P - np.outer(v, v)
    return tuple(names)


def misfit_words(component: ResidualComponent | None, window: Window) -> str:
    """The known cause of misfit in words; empty if unknown."""
    if component is not None and component.words:
        return component.cause
    slow = window.slow_residual()
    return "" if slow is None else slow.words


# -- The estimator ---------------------------------------------------------------------------------


_FIRST_SEARCH = 2  # epochs with motion before the first search; then at every half more
_CHANGED_EPOCHS = 2  # contradicting epochs in a row after which the iron has changed
_FEW_EPOCHS = 6  # epochs up to which each new one iterates over all to convergence
# Sigmas from the result of a search at which the answer moves there. Thinned data alone make about
# 1.
_AWAY, _AWAY_UNSETTLED = 1.5, 0.5
_FIRST_LOOKS = 4  # of the first search
_GAIN_FOLDED = 20.0  # tempered nats that outweigh folded data, which a search cannot use
_HOPELESS_DEG = 5.0  # worst heading sigma of a converged estimate
_SETTLED = 0.5  # sigmas of the last step of a settled answer
_MOST_SIGMAS = 100.0  # limit on movement and disagreement
_SCALE = 0.5  # 1-sigma of the field's magnitude over its size in the present calibration
_LAG_SIGMAS, _LAG_SAME = 3.2, 0.3  # sigmas of a lag that is corrected; of a settled lag
_LAG_PASSES, _LONGEST_LAG_S = 3, 0.1
_PASSES, _QUIETER = 8, 0.95  # of correcting the gyro; while the noise falls below this ratio
_EXPLAINED_MISFIT = 1.5  # limit on the residual ratio of explained data
_TRIED_NATS = -15.0  # log odds from which a gyro correction is tried if residuals remain
_MOST_OF_KIND = 4.0  # sigmas of an imperfection beyond which the cause is another
_KNOWN_SIGMA = 0.05  # of the field: hard-iron sigmas at which agreeing starts end the search


WHOLE = 32  # `at_once` for a complete recording: the size of a window


class Estimator:
    """The streaming estimator. Not thread-safe. Deterministic: the same samples give the same
    numbers.
    """

    def __init__(
        self,
        parameters: EstimatorParameters | None = None,
        present: Affine | None = None,
        present_gyro_bias_rad_s: Array | None = None,
        *,
        at_once: int = 1,
    ) -> None:
        """`present` is the device's calibration (registers 23 and 84): the mean of the prior.

        at_once: number of epochs after which the answer is updated; more is faster if no estimate
        is needed in between.
        """
        self.parameters = parameters or EstimatorParameters()
        self._present = present or Affine.identity()
        self._present_bias = (
            np.zeros(3) if present_gyro_bias_rad_s is None else present_gyro_bias_rad_s.copy()
        )
        self._at_once = at_once
        self._new: list[chain.EpochData] = []  # not in the window yet
        self._last: chain.EpochData | None = None  # the newest one
        self._builder = EpochBuilder(self.parameters)
        self._time = RunningTime()
        self._window: Window | None = None
        self._whitening = np.eye(12)
        self._tilts: deque[Array] = deque(maxlen=64)
        self._searching, self._agreed, self._agreement_sigmas = True, False, 0.0
        self._moving_epochs = 0
        self._next_search = _FIRST_SEARCH
        self._contradictions = 0
        self._is_copy = False  # made for one estimate
        self._contradicted_s: float | None = None  # since when motion contradicts the answer
        self._split_factor = 1.0  # `IronChange.variance_factor`
        self._misscaled = 0.0  # `Instrument.misscaled`
        self.restarted_s: float | None = None  # when the iron changed, if it did

    def add(self, block: SampleBlock) -> bool:
        """Take samples; true if they completed an epoch, so that `estimate` changes.

        A block must not span a gap (`SampleBlock`). Raises ValueError naming the row if a field,
        rate or step is not a finite number; nothing of the block is then taken.
        """
        check_samples(block)
        closed: list[chain.EpochData] = []
        if block.gap_before and len(block) > 0:
            fell = self._time.falls(block)
            block = self._time.follow(block)
            # behind a restart of the device nothing is continued
            closed = self._builder.gap(np.inf if fell else float(block.time_s[0]))
        elif len(block) > 0:
            block = self._time.follow(block)
        closed += self._builder.add(block)
        for data in closed:
            self._append(data)
        return bool(closed)

    def interrupt(self) -> bool:
        """Close the epoch with the pending samples; later samples begin a new one."""
        data = self._builder.interrupt()
        if data is not None:
            self._append(data)
        return data is not None

    def finish(self) -> Estimate | None:
        """End of the recording: use the pending samples and iterate to convergence."""
        self.interrupt()
        if self._new:
            self._grow()
        if self._window is not None:
            if self._searching and self._moving_epochs > 0:
                self._search(self._window, exactly=True)
            else:
                self._window.track(everything=True, exactly=True)
            settled = self._window.step_sigmas < _SETTLED
            self._window = self._split_at_change(self._window)
            self._window, changed = self._examine(self._window)
            if changed and self._searching:
                self._search(self._window, exactly=True)
            if not settled:  # the tests need a settled answer
                self._window = self._split_at_change(self._window)
        return self._current_estimate()

    def _append(self, data: chain.EpochData) -> None:
        if self._last is not None and not data.measures_first:
            data = with_border(data, self._last)
        self._last = data
        self._tilts.append(data.down_b[len(data) // 2])
        self._new.append(data)
        if len(self._new) >= self._at_once:
            self._follow(*self._grow())

    def _grow(self) -> tuple[Window, int]:
        """The window with the new epochs queued, and their number."""
        new, self._new = self._new, []
        window = self._window = self._window or self._create_window(new[0])
        self._moving_epochs += window.queue(new)
        return self._detect_change(window, len(new)), len(new)

    def _follow(self, window: Window, new: int) -> None:
        """Update the answer with the new epochs, unless the last one awaits confirmation of a
        change.
        """
        if self._contradictions > 0:
            return
        due = self._moving_epochs >= self._next_search
        if not (due and window.never_moved):  # otherwise there is nothing yet to track from
            window.track(new, everything=self._searching and len(window.epochs) <= _FEW_EPOCHS)
        if due:
            self._next_search = self._moving_epochs + max(1, self._moving_epochs // 2)
            if self._searching:
                self._search(window)
            window, _ = self._examine(self._split_at_change(window))
            self._window = window
        window.fold()

    def _detect_change(self, window: Window, new: int) -> Window:
        """The window, or a new one if two epochs in a row contradict a well-known answer.

        Then the iron has changed and everything before them is forgotten. After a single
        contradicting epoch the next one decides; until an epoch with motion agrees again the answer
        is not converged.
        """
        is_sure = not self._searching and window.step_sigmas < _SETTLED
        if is_sure:
            window.attach_waiting()
        for k in range(-new, 0):
            contradicts = is_sure and window.epoch_contradicts(k)
            self._contradictions = self._contradictions + 1 if contradicts else 0
            if not is_sure or (window.epochs[k].has_motion and not contradicts):
                self._contradicted_s = None
            elif contradicts and self._contradicted_s is None:
                self._contradicted_s = self._time.device_s(window.epochs[k].data.time_s[0])
            if self._contradictions == _CHANGED_EPOCHS:
                window = self._window = self._restart_after_change(window, _CHANGED_EPOCHS - 1 - k)
                break
        return window

    def _restart_after_change(self, window: Window, count: int) -> Window:
        """Forget everything before the last `count` epochs, at whose beginning the iron changed."""
        self.restarted_s = self._time.device_s(window.epochs[-count].data.time_s[0])
        self._searching, self._agreed, self._contradictions, self._contradicted_s = (
            True,
            False,
            0,
            None,
        )
        self._moving_epochs = sum(epoch.has_motion for epoch in window.epochs[-count:])
        self._next_search, self._split_factor = _FIRST_SEARCH, 1.0
        return window.restart_with_last(count)

    def _split_at_change(self, window: Window) -> Window:
        """The window, or a new one from a change of the iron before the answer was well known."""
        if not window.step_sigmas < _SETTLED:
            return window
        p = self.parameters
        try:
            quadratics = instrument_quadratics(window.epochs, window.graph)
            change = find_iron_change(
                quadratics, window.graph, p.prior_gyro_bias_rad_s, p.prior_hard_iron_gauss
            )
        except np.linalg.LinAlgError:
            return window
        self._split_factor = 1.0 if change is None else change.variance_factor
        if change is None or change.first is None:
            return window
        moving = [k for k, epoch in enumerate(window.epochs) if epoch.has_motion]
        window = self._restart_after_change(window, len(window.epochs) - moving[change.first])
        window.track(everything=True)
        self._search(window, exactly=True)
        return window

    def _create_window(self, data: chain.EpochData) -> Window:
        A0 = np.linalg.inv(self._present.matrix)
        A0 = (A0 + A0.T) / 2  # the model has no antisymmetric part
        size = float(np.median(np.linalg.norm(self._present.apply(data.field_b_gauss), axis=1)))
        c = np.r_[chain.upper_triangle(A0 * max(size, 1e-3)), self._present.offset]
        p = self.parameters
        scale = float(np.cbrt(np.linalg.det(chain.symmetric(c[:6]))))
        sigma = np.r_[np.full(6, p.prior_soft_iron * scale), np.full(3, p.prior_hard_iron_gauss)]
        belief = np.diag(sigma**2)
        belief[:6, :6] += _SCALE**2 * np.outer(c[:6], c[:6])
        self._whitening = np.diag(np.r_[np.zeros(9), np.full(3, 1 / p.prior_gyro_bias_rad_s)])
        self._whitening[:9, :9] = whitening(belief)
        direction = chain.start_directions(chain.symmetric(c[:6]), c[6:], data.field_b_gauss[:1])[0]
        first = Node.at(self._present_bias, direction)
        return Window(p, c, belief, first, noise.first_guess(data, p))

    def _search(self, window: Window, *, exactly: bool = False, looks: int = 1) -> None:
        """Let other starts compete with the present answer, until they agree on good data.

        With `exactly` the answer then iterates over all epochs to convergence. The first search
        over many epochs knows neither the held directions nor the residual level, so it may be
        repeated.
        """
        looks = _FIRST_LOOKS if window.never_moved else looks
        found = search(self.parameters, window, self._present_bias, window.data)
        window.search_residual_ratio = found.search_residual_ratio
        unsettled = window.step_sigmas > _SETTLED
        better = found.gain > _GAIN_FOLDED * window.graph.temper
        if (
            better
            or (unsettled and found.away > _AWAY_UNSETTLED)
            or (not window.folded and found.away > _AWAY)
        ):
            window.restart_at(found.c, found.bias)
            window.track(everything=True, exactly=exactly, here=True)
        elif exactly or window.never_moved:
            window.track(everything=True, exactly=exactly)
        self._agreed, self._agreement_sigmas = found.agreed, 0.0 if found.agreed else found.apart
        settled = window.step_sigmas < _SETTLED
        self._searching = not (found.agreed and settled and self._is_iron_known(window))
        if looks > 1 and not (found.agreed or window.never_moved):
            self._search(window, exactly=exactly, looks=looks - 1)

    def _examine(self, window: Window) -> tuple[Window, bool]:
        """Check the gyro's scale, and correct a lag and a gyro error if the epochs support it;
        returns the window and whether anything was corrected.

        A gyro error is corrected only if the data are then explained: a field that differs by place
        looks like one, but is not explained by it.
        """
        changed = self._correct_until_settled(window)
        if self.parameters.imperfections:
            for required_nats in (REQUIRED_NATS, _TRIED_NATS):
                trial, misscaled = window.copy(), self._misscaled
                if self._correct_until_settled(
                    trial, gyro_nats=required_nats
                ) and self._correction_explains(trial, window, required_nats):
                    window, changed = trial, True
                    break
                self._misscaled = misscaled
                if not window.has_unmodelled_residual:
                    break
        return window, changed

    def _correction_explains(self, trial: Window, before: Window, required_nats: float) -> bool:
        """Whether the data are explained by a correction; a gyro error that was improbable before
        must also become probable.
        """
        largest = np.max(possible_instruments(*self.parameters.kinds).sigmas, axis=0)
        limit = _MOST_OF_KIND * largest[GYRO_AMONG_IMPERFECTIONS]
        within = bool(np.all(np.abs(trial.correction.gyro_parameters) < limit))
        if (
            not within
            or trial.residual_ratio >= _EXPLAINED_MISFIT
            or required_nats == REQUIRED_NATS
        ):
            return within and trial.residual_ratio < _EXPLAINED_MISFIT
        posterior = self._instrument_posterior(trial)
        if posterior is None:
            return False
        # the residuals of the error inflated the gyro's noise, which is less probable by this
        log_noise_ratio = np.log(before.usual.gyro_rad_s / trial.usual.gyro_rad_s)
        gain = (
            posterior.log_odds_against_smallest(GYRO_AMONG_IMPERFECTIONS)[1]
            + trial.gyro_freedom * log_noise_ratio
        )
        return bool(gain > REQUIRED_NATS)

    def _correct_until_settled(self, window: Window, *, gyro_nats: float | None = None) -> bool:
        """Correct what the epochs support until nothing remains; whether anything was corrected.

        gyro_nats: log odds from which a gyro error is corrected too, None for never. The noise that
        it inflated then has to settle as well.
        """
        gyro = gyro_nats is not None
        least, changed, noise_settled = (
            _LAG_SIGMAS if window.correction.lag_s == 0.0 else 1.0,
            False,
            False,
        )
        for _ in range(_PASSES if gyro else _LAG_PASSES):
            found = self._estimate_instrument(window)
            if found is None:
                break
            self._misscaled = found.misscaled
            more_lag_s, sigma = found.lag_s
            correction = (
                window.correction
                if gyro_nats is None
                else self._add_gyro_correction(window, gyro_nats)
            )
            if gyro and correction is window.correction and not changed:
                break
            if abs(more_lag_s) >= least * sigma:
                lag_s = np.clip(correction.lag_s + more_lag_s, -_LONGEST_LAG_S, _LONGEST_LAG_S)
                correction, least = replace(correction, lag_s=float(lag_s)), _LAG_SAME
            noise_gauss = window.usual.mag_gauss
            if correction is not window.correction:
                window.correct_instrument(correction)
            elif not gyro or noise_settled:
                break
            window.track(everything=True, here=True)
            changed, noise_settled = True, window.usual.mag_gauss > _QUIETER * noise_gauss
        return changed

    def _estimate_instrument(self, window: Window) -> Instrument | None:
        try:
            quadratics = instrument_quadratics(window.epochs, window.graph)
            before = window.folded_since_correction.at(window.graph.c, window.correction)
            sigma_bias, scaled = (
                self.parameters.prior_gyro_bias_rad_s,
                window.correction.gyro_parameters[3],
            )
            return estimate_instrument(quadratics, window.graph, sigma_bias, before, scaled)
        except np.linalg.LinAlgError:
            return None

    def _instrument_posterior(self, window: Window) -> InstrumentPosterior | None:
        """Posterior of the instrument and the place; None if they are not considered or not
        determined.
        """
        if not self.parameters.imperfections:
            return None
        before = window.folded_information.at(window.graph.c, window.correction)
        try:
            moving = full_instrument_quadratics(window.epochs, window.graph)
            rests = rest_quadratics(window.epochs, window.graph)
            quadratics = (
                np.concatenate([moving[0], rests[0]]),
                np.concatenate([moving[1], rests[1]]),
            )
            moving_first = sorted(window.epochs, key=lambda e: not e.has_motion)
            times_s = np.array([float(e.data.time_s[[0, -1]].mean()) for e in moving_first])
            sigma_bias = self.parameters.prior_gyro_bias_rad_s
            likelihood = ImperfectionLikelihood.of(
                quadratics, times_s, window.graph, sigma_bias, before, window.correction
            )
            return InstrumentPosterior.of(likelihood, window.graph, self.parameters.kinds)
        except np.linalg.LinAlgError:
            return None

    def _add_gyro_correction(self, window: Window, required_nats: float) -> InstrumentCorrection:
        """The correction, with a further one of the gyro's axes and scales if the data
        support it.
        """
        posterior = self._instrument_posterior(window)
        if posterior is None:
            return window.correction
        correction, first, last = window.correction, window.epochs[0].data, window.epochs[-1].data
        try:
            more = required_gyro_correction(posterior, required_nats)
        except np.linalg.LinAlgError:
            return window.correction
        if more is not None:
            correction = correction.with_gyro(more)
        walk = required_bias_walk(posterior, float(last.time_s[-1] - first.time_s[0]))
        return (
            correction
            if walk == 0.0
            else replace(correction, walk=float(np.hypot(correction.walk, walk)))
        )

    @staticmethod
    def _is_iron_known(window: Window) -> bool:
        try:
            sigma = np.sqrt(window.graph.temper * np.diag(window.graph.covariance())[6:9])
        except SingularError:
            return False
        size = np.cbrt(np.linalg.det(chain.symmetric(window.graph.c[:6])))
        return bool(np.all(sigma < _KNOWN_SIGMA * size))

    def estimate(self) -> Estimate | None:
        """The present estimate; None before the first epoch or if nothing is determined.

        A pending epoch counts as far as it goes, if it is long enough to be one.
        """
        if self._new or (self._window and self._builder.pending >= MIN_EPOCH_STEPS):
            self._linearise_locked()
            return self._copy().finish()
        return self._current_estimate()

    @staticmethod
    def _lag_covariance(window: Window) -> Array:
        """Addition to the covariance (12, 12) by the uncertainty of the lag, from all
        data so far.
        """
        known = window.lag_uncertainty() if window.correction.lag_s != 0.0 else None
        return np.zeros((12, 12)) if known is None else np.outer(known.spread, known.spread)

    def _imperfection_widening(self, window: Window) -> Widening:
        """Effect of the instrument's imperfections on the answer."""
        posterior = self._instrument_posterior(window)
        return Widening.zero() if posterior is None else widening_by_imperfections(posterior)

    def _residual_component(self, window: Window) -> ResidualComponent | None:
        """The component of the residuals in the window that follows attitude, rate or time.

        Residuals of an answer that is not settled are due to the answer itself.
        """
        if not self._is_residual_tested(window):
            return None
        if not self._is_copy:
            self._linearise_locked()
        largest = np.max(possible_instruments(*self.parameters.kinds).sigmas, axis=0)[:16]
        try:
            return find_residual_component(
                window.epochs,
                window.graph,
                (self.parameters.prior_gyro_bias_rad_s, largest),
                window.correction,
                window.usual.mag_gauss,
            )
        except np.linalg.LinAlgError:
            return None

    def _linearise_locked(self) -> None:
        """Linearise the locked columns, once per epoch: a copy for one estimate can reuse them."""
        if self._window is None or not self._is_residual_tested(self._window):
            return
        with suppress(np.linalg.LinAlgError):
            linearise_locked(self._window.epochs)

    def _is_residual_tested(self, window: Window) -> bool:
        settled = self._agreed and window.step_sigmas < _SETTLED
        return bool(self.parameters.imperfections) and settled

    def _warnings(self, component: ResidualComponent | None) -> tuple[str, ...]:
        changed = () if self.restarted_s is None else (change_message(self.restarted_s),)
        return (*changed, component.words) if component is not None and component.words else changed

    def misalignment(self) -> Misalignment | None:
        """Whether the magnetometer is turned against the gyro, after `finish`; None if unknown."""
        window = self._window
        if window is None or not self._agreed:
            return None
        try:
            information = instrument_quadratics(window.epochs, window.graph)
            sigma_bias, corrected_rad = (
                self.parameters.prior_gyro_bias_rad_s,
                window.correction.gyro_parameters[:3],
            )
            return estimate_misalignment(information, window.graph, sigma_bias, corrected_rad)
        except np.linalg.LinAlgError:
            return None

    def _copy(self) -> Estimator:
        other = copy(self)
        other._is_copy = True
        other._builder, other._tilts = self._builder.copy(), self._tilts.copy()
        other._new = list(self._new)
        other._window = None if self._window is None else self._window.copy()
        return other

    def _current_estimate(self) -> Estimate | None:
        window = self._window
        if window is None or not window.epochs:
            return None
        graph = window.graph
        try:
            covariance = graph.covariance()
        except SingularError:
            return None
        observed = observability(covariance * graph.temper, self._whitening)
        # An answer that still moves, or that other starts do not reach, is known no better than
        # that.
        doubt = min(max(window.step_sigmas, self._agreement_sigmas), _MOST_SIGMAS)
        widening = self._imperfection_widening(window)
        explained, component = window.explained_covariance(), self._residual_component(window)
        tempered = widen_covariance(window.covariance() * self._split_factor, explained, component)
        parts = widening.parts | motion_and_misfit(explained, tempered, self._whitening)
        covariance = tempered * (1.0 + doubt**2)
        covariance = covariance + self._lag_covariance(window) + widening.added
        covariance[:9, :9] += curvature_covariance(graph.c, covariance[:9, :9], graph.moments)
        A, b, size, J = unit_volume(graph.c)
        K = np.eye(12)
        K[:9, :9], K[9:, 9:] = J, np.linalg.inv(window.correction.gyro)
        down, dip = tilts_and_dip(self._tilts, [(e.u, e.data.down_b) for e in window.epochs])
        misaligned_deg = misalignment_heading_deg(window.correction.gyro_parameters[:3], down, dip)
        heading = float(np.hypot(heading_sigma_deg(graph.c, covariance, down, dip), misaligned_deg))
        words = partial(misfit_words, component, window)
        advice = HeadingAdvice(graph.c, down, dip, window.usual.mag_gauss)
        averaged = self._builder.averaged
        return Estimate(
            soft_iron=A,
            hard_iron_gauss=b,
            gyro_bias_rad_s=K[9:, 9:] @ graph.nodes[graph.last].bias,
            field_gauss=size,
            field_known=False,
            covariance=K @ covariance @ K.T,
            noise_mag_gauss=window.usual.mag_gauss * float(np.sqrt(averaged)),
            noise_gyro_rad_s=window.usual.gyro_rad_s * float(np.sqrt(averaged)),
            misfit=window.found_misfit,
            heading_sigma_deg=heading,
            observability=observed,
            samples=self._builder.samples,
            duration_s=self._builder.duration_s,
            converged=bool(
                self._agreed
                and window.step_sigmas < _SETTLED
                and heading < _HOPELESS_DEG
                and self._misscaled == 0.0
                and self._contradicted_s is None
            ),
            warnings=self._warnings(component),
            mag_lag_s=window.correction.lag_s,
            gyro_misscaled=self._misscaled,
            contradicted_s=self._contradicted_s,
            widened_by=advice.main_cause(parts, covariance, misaligned_deg, words),
            place_gauss=widening.place_gauss,
            place_deg=advice.place_heading_deg(parts),
            gyro_correction=window.correction.gyro,
            gyro_covariance=widening.joint(K @ covariance @ K.T, K),
        )
