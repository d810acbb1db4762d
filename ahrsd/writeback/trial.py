"""The trial: new registers compared with the old ones, on the same live samples.

**Figures.** The figure is the spread (std / mean) of the corrected field over the newest minute.
Both corrections have the same motion and disturbances, so only their quality differs. At rest both
show the sensor's noise, scaled by a matrix each, and are not compared. Noise also causes spread, so
the spread does not show whether the new registers are *right*; the part of it that an error of the
calibration explains does (`LeftoverError`). That does not test the gyroscope, nor a rotation of the
matrix: `CarriedField` does, with the new registers and with each alternative to them (either one
restored, or both; at rest only the gyroscope's).

The heading jump is the difference of the two tilt-compensated headings of the same samples,
averaged over the first seconds of samples in which the vehicle is nearly level. The prediction is
for a level vehicle; on its side the jump may be twice as much, and at 15 deg a hard iron along the
vertical adds half as much again. So each sample is rotated to level on its own heading before the
comparison. Only time covered by samples counts, in pieces of a quarter of a second: over a gap, or
over many seconds that a busy host reads at once, the vehicle turns, and a mean over a turn is no
field.

**Leftover error.** How much of the corrected field's variation a wrong calibration still explains.

y = |C (m - B)| / its mean    u = direction of C (m - B), sensor frame

With right registers y varies by noise and by place, neither of which depends on the attitude. A
remaining hard or soft iron error makes y a function of u:

y = const + d . u + u' S u       d: 3 numbers, S: 5

The samples are divided into segments in which the vehicle turned; within each, y and the columns
are centred, so that a field that differs by place explains nothing.

b, the eight numbers of d and S, is fitted twice, to alternate segments. With A the Gram matrix of
the columns and n the samples, Q = b1' (A / n) b2 is the explained mean square: the noise of b1 is
independent of that of b2, so with right registers Q is zero on average at any noise level. The
residual r_k = g_k - A_k b of each segment from the other half's fit gives the uncertainty of b, for
any colour of the noise within a segment:

Cov b = A^-1 (sum r_k r_k') A^-1    var Q = 4 b' (A/n) Cov (A/n) b + 2 tr((A/n) Cov (A/n) Cov)

**Carried field.** How constant the corrected field is in one frame, rotated there by the corrected
gyroscope.

u_k = R_k C (m_k - B),  R_k = R_{k-1} Exp((w_k - w_b) dt_k),  R = I at the start of a segment

u is constant for a fixed field: its spread over a segment, |u - mean| / |mean| (rms), is the error
of both corrections together, without any other reference. A wrong gyro bias rotates u, a wrong C or
B changes it as the vehicle turns, and a C that is rotated about one axis changes it when the
vehicle turns about another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array, SampleBlock

# -- Verdicts --------------------------------------------------------------------------------------


JUMP_NOISE_DEG = 1.0  # noise of a heading from single samples: a smaller jump is never unexpected


@dataclass(frozen=True, slots=True)
class TrialPolicy:
    """Conditions for proving written registers. Times are of the device's clock.

    duration_s, turns: whichever comes first ends the trial; longer proves more [600 s, 2 turns]
    worse_percent, worse_for_s: undo where the live figure is worse than the old registers' on the
                       same samples by this, for this long [10 %, 60 s]
    max_wrong_percent, wrong_sigmas: undo where an error of the calibration explains more of the
                       corrected field than this, by so many of the figure's own sigmas [0.5 %, 2.5]
    max_spread_percent: undo where std/mean of the corrected field exceeds this, whatever explains
                       it [10 %]
    max_jump_deg:      undo where the heading jumped by this much more than predicted [5 deg]
    interlock:         undo if the interlock opens; false lets the trial continue while driving,
                       for vehicles whose interlock only concerns the moment of writing [true]
    """

    duration_s: float = 600.0
    turns: float = 2.0
    worse_percent: float = 10.0
    worse_for_s: float = 60.0
    max_wrong_percent: float = 0.5
    wrong_sigmas: float = 2.5
    max_spread_percent: float = 10.0
    max_jump_deg: float = 5.0
    interlock: bool = True


@dataclass(frozen=True, slots=True)
class TrialMetrics:
    """Figures over the trial so far, both corrections applied to the same raw samples.

    duration_s, turns: of use, on the device's clock
    new_figure, old_figure: the same figure of quality (heading or field error, smaller is better)
                       over the newest stretch with the new and with the old registers
    turned:            whether the vehicle turned in that stretch; at rest the figures are of noise,
                       which a soft iron makes larger along some axes than along others
    field_spread:      std/mean of the corrected field
    new_swing, old_swing: how far the corrected field moves when the corrected gyroscope carries it
                       into one frame, in parts of the field; `old`: the least with either or both
                       of the registers put back; 0 while nothing is known
    heading_jump_deg:  how far the heading moved when the registers changed; None: not seen yet
    wrong, old_wrong:  how much of the corrected field an error of the calibration still explains,
                       in parts of the field; nan while nothing is known
    wrong_sigmas:      by how many of its own sigmas that is beyond the limit; negative: within
    """

    duration_s: float
    turns: float
    new_figure: float
    old_figure: float
    field_spread: float
    turned: bool = True
    heading_jump_deg: float | None = None
    new_swing: float = 0.0
    old_swing: float = 0.0
    wrong: float = float("nan")
    old_wrong: float = float("nan")
    wrong_sigmas: float = float("nan")

    @property
    def finite(self) -> bool:
        """Whether the figures can be judged."""
        return bool(
            np.isfinite(
                [self.duration_s, self.turns, self.new_figure, self.old_figure, self.field_spread]
            ).all()
        )


class TrialVerdict(Enum):
    """Result of judging the metrics."""

    GOES_ON = "goes on"
    PASSED = "passed"
    FAILED = "failed"


class Trial:
    """Judges a sequence of metrics; `predicted_jump_deg` comes from the proposal."""

    def __init__(self, policy: TrialPolicy, predicted_jump_deg: float) -> None:
        self._policy = policy
        self._predicted_deg = predicted_jump_deg
        self._worse_since_s: float | None = None

    @property
    def currently_worse(self) -> bool:
        """Whether the newest figures are worse with the new registers."""
        return self._worse_since_s is not None

    def judge(self, metrics: TrialMetrics) -> tuple[TrialVerdict, str]:
        """The verdict and its reason. Metrics that are not finite are not judged."""
        if not metrics.finite:
            return TrialVerdict.GOES_ON, "nothing to judge yet"
        if reason := self._find_failure(metrics):
            return TrialVerdict.FAILED, reason
        policy = self._policy
        if self._worse_since_s is not None:
            return TrialVerdict.GOES_ON, "worse than the old registers for the moment"
        # turns end a trial only once they have been judged
        turned = metrics.turns >= policy.turns and np.isfinite(metrics.wrong_sigmas)
        if metrics.duration_s >= policy.duration_s or turned:
            return TrialVerdict.PASSED, (
                f"the field varies by {metrics.new_figure:.2%}, with the old registers by "
                f"{metrics.old_figure:.2%} ({metrics.duration_s:.0f} s, {metrics.turns:.1f} turns)"
            )
        return TrialVerdict.GOES_ON, ""

    def _find_failure(self, metrics: TrialMetrics) -> str | None:
        policy = self._policy
        spread_percent = 100.0 * metrics.field_spread
        if spread_percent > policy.max_spread_percent:
            return (
                f"the corrected field varies by {spread_percent:.1f} %, "
                f"limit {policy.max_spread_percent} %"
            )
        if metrics.wrong_sigmas > policy.wrong_sigmas:
            return (
                f"an error of the calibration explains {metrics.wrong:.2%} of the corrected field "
                f"(with the old registers {metrics.old_wrong:.2%}), clearly more than "
                f"{policy.max_wrong_percent} %"
            )
        if (jump := metrics.heading_jump_deg) is not None and self._is_unexpected_jump(jump):
            return f"the heading jumped by {jump:.1f} deg, predicted {self._predicted_deg:.1f} deg"
        worse = _describe_worsening(metrics, 1.0 + policy.worse_percent / 100.0)
        if worse is None:
            self._worse_since_s = None
            return None
        if self._worse_since_s is None:
            self._worse_since_s = metrics.duration_s
        if metrics.duration_s - self._worse_since_s >= policy.worse_for_s:
            return f"{worse}, for {policy.worse_for_s:.0f} s"
        return None

    def _is_unexpected_jump(self, jump_deg: float) -> bool:
        """Whether it is over twice the prediction, or over it by the limit; nan counts as so."""
        size = abs(jump_deg)
        likely = size <= 2.0 * self._predicted_deg + JUMP_NOISE_DEG
        return not (likely and size <= self._predicted_deg + self._policy.max_jump_deg)


def _describe_worsening(metrics: TrialMetrics, factor: float) -> str | None:
    """What is worse with the new registers than with the old ones, in words; None: nothing."""
    if metrics.turned and metrics.new_figure > metrics.old_figure * factor:
        return (
            f"the field varies by {metrics.new_figure:.2%}, with the old registers by "
            f"{metrics.old_figure:.2%}"
        )
    if metrics.new_swing > metrics.old_swing * factor:
        return (
            f"propagated by the gyroscope, the field changes by {metrics.new_swing:.2%}, with a "
            f"register put back by {metrics.old_swing:.2%}"
        )
    return None


# -- Leftover error --------------------------------------------------------------------------------


SHORTEST_S, LONGEST_S = 5.0, 20.0  # lengths of a segment
LEFTOVER_STRETCHES = 60  # only the newest segments are kept
LEFTOVER_FEWEST = 6  # segments that a result needs
TURNED = 0.02  # variance of u that a segment needs: a turn of about 8 deg to each side
_WELL_TURNED = 0.15  # variance of u at which a segment ends before its longest time
_FEWEST_ROWS = 20  # fields that a segment needs
_BELIEF = 0.05  # prior sigma of d and S, as a share of the field
_LEAST_SIGMA = 1e-7  # least sigma of Q, for rounding errors if there is no noise
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Leftover:
    """The explained share of the field, rms, and by how many of its sigmas its square exceeds the
    square of a limit; negative: below it. nan: too few segments.
    """

    share: float = float("nan")
    sigmas: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    rows: int
    A: Array
    g: Array
    yy: float


class LeftoverError:
    """Takes corrected fields, returns `Leftover`. Bounded memory."""

    def __init__(self) -> None:
        self._fields: list[Array] = []
        self._start_s = 0.0
        self._stretches: deque[_Stretch] = deque(maxlen=LEFTOVER_STRETCHES)

    def add(self, time_s: float, corrected: Array) -> None:
        """Add one corrected field (3,), about ten per second."""
        if not self._fields:
            self._start_s = time_s
        self._fields.append(corrected)
        length_s = time_s - self._start_s
        if not 0.0 <= length_s <= 2.0 * LONGEST_S:  # a gap, or the clock fell
            self._fields = [corrected]
            self._start_s = time_s
        elif length_s >= SHORTEST_S:
            self._close_stretch(last=length_s >= LONGEST_S)

    def leftover(self, limit: float) -> Leftover:
        """The explained share, and how significantly it exceeds `limit` (share of the field)."""
        count = len(self._stretches)
        if count < LEFTOVER_FEWEST:
            return Leftover()
        halves = [list(self._stretches)[half::2] for half in (0, 1)]
        (first, _), (second, _) = (_fit_leftover(half) for half in halves)
        both, A = _fit_leftover([one for half in halves for one in half])
        residuals = [one.g - one.A @ second for one in halves[0]]
        residuals += [one.g - one.A @ first for one in halves[1]]
        deviation = np.linalg.solve(A, np.array(residuals).T)
        per_row = A / sum(one.rows for one in self._stretches)
        spread = per_row @ (deviation @ deviation.T)
        square = float(first @ per_row @ second)
        variance = 4.0 * both @ spread @ per_row @ both + 2.0 * np.trace(spread @ spread)
        sigma = max(float(np.sqrt(max(variance, 0.0))), _LEAST_SIGMA)
        return Leftover(float(np.sqrt(max(square, 0.0))), (square - limit**2) / sigma)

    def _close_stretch(self, *, last: bool) -> None:
        """End the segment after enough turning or at its longest; drop it without turning."""
        field = np.array(self._fields)
        size = np.linalg.norm(field, axis=1)
        u = field / np.maximum(size, 1e-9)[:, None]
        turned = float(u.var(axis=0).sum())
        if turned < _WELL_TURNED and not last:
            return
        self._fields = []
        if turned > TURNED and len(field) >= _FEWEST_ROWS and np.isfinite(field).all():
            square = (u[:, :, None] * u[:, None, :])[:, _UPPER[0], _UPPER[1]][:, :5]
            X = np.column_stack([u, square])
            X = X - X.mean(axis=0)
            y = size / size.mean()
            y = y - y.mean()
            self._stretches.append(_Stretch(len(y), X.T @ X, X.T @ y, float(y @ y)))


def _fit_leftover(stretches: list[_Stretch]) -> tuple[Array, Array]:
    """b (8,) by least squares with a zero-mean prior; its normal matrix (8, 8)."""
    A, g = sum(one.A for one in stretches), sum(one.g for one in stretches)
    noise = sum(one.yy for one in stretches) / sum(one.rows for one in stretches)
    regularized = np.asarray(A) + np.eye(8) * (noise / _BELIEF**2 + 1e-9)
    return np.asarray(np.linalg.solve(regularized, np.asarray(g))), regularized


# -- Steadiness of the carried field ---------------------------------------------------------------


STRETCH_S = 10.0  # length of a segment
CARRIED_STRETCHES = 6  # only the newest segments are kept: one minute
_CARRIED_FEWEST = 10  # usable samples that a segment needs


class CarriedField:
    """Compares pairs of corrections on the same samples; `spreads` in the order of `pairs`."""

    def __init__(self, pairs: Sequence[tuple[Affine, Array]]) -> None:
        self._pairs = [(mag, bias.copy()) for mag, bias in pairs]
        self._spreads: deque[Array] = deque(maxlen=CARRIED_STRETCHES)
        self._begin_stretch()

    def take(self, block: SampleBlock) -> None:
        """Take samples; a time step of unknown length starts a new segment."""
        usable = np.isfinite(block.gyro_b_rad_s).all(axis=1) & np.isfinite(block.dt_s)
        dt_s = np.where(usable, block.dt_s, 0.0)
        rate = np.where(usable[:, None], block.gyro_b_rad_s, 0.0)
        turns = [so3.exp((rate - bias) * dt_s[:, None]) for _, bias in self._pairs]
        fields = [mag.apply(block.raw_b_gauss) for mag, _ in self._pairs]
        for k in range(len(block)):
            if not usable[k] or self._length_s > STRETCH_S:
                self._close_stretch()
                self._begin_stretch()
                continue
            self._length_s += float(dt_s[k])
            for n in range(len(self._pairs)):
                self._R[n] = self._R[n] @ turns[n][k]
                self._carried[n].append(self._R[n] @ fields[n][k])

    @property
    def spreads(self) -> Array:
        """(pairs,) rms over the newest segments; nan before the first one has ended."""
        if not self._spreads:
            return np.full(len(self._pairs), np.nan)
        return np.asarray(np.sqrt(np.mean(self._spreads, axis=0)))

    def _begin_stretch(self) -> None:
        self._length_s = 0.0
        self._R = [np.eye(3) for _ in self._pairs]
        self._carried: list[list[Array]] = [[] for _ in self._pairs]

    def _close_stretch(self) -> None:
        if len(self._carried[0]) < _CARRIED_FEWEST:
            return
        u = np.array(self._carried)
        mean = u.mean(axis=1)
        squares = ((u - mean[:, None]) ** 2).sum(axis=2).mean(axis=1)
        self._spreads.append(squares / (mean**2).sum(axis=1))


# -- Live figures ----------------------------------------------------------------------------------


_WINDOW_S = 60.0  # newest samples from which the spread of the field is computed
_JUMP_S = 3.0  # samples, near level, from which the heading jump is computed
_PIECE_S = 0.25  # samples averaged to one heading: a vehicle turns by little in this time
_LEVEL = np.cos(np.radians(15.0))  # least vertical component of the direction down, near level
_OLD_GYRO = 2  # index of the pair with the new magnetometer register and the old gyro register
_SPACING_S = 0.1  # samples closer in time than this add nothing to a spread


class LiveTrial:
    """Computes `TrialMetrics` from the moment the new registers are in force."""

    def __init__(
        self,
        new: Affine,
        old: Affine,
        gyro_bias_rad_s: Array,
        old_gyro_bias_rad_s: Array | None = None,
        *,
        wrong_limit: float = 0.005,
    ) -> None:
        self._wrong_limit = wrong_limit
        self._leftover, self._old_leftover = LeftoverError(), LeftoverError()
        self._new, self._old, self._bias = new, old, gyro_bias_rad_s.copy()
        before = self._bias if old_gyro_bias_rad_s is None else old_gyro_bias_rad_s
        self._carried = CarriedField(
            [(new, self._bias), (old, self._bias), (new, before), (old, before)]
        )
        self._rows: deque[tuple[float, Array]] = deque()
        self._jumps: list[float] = []
        self._jump_covered_s = 0.0  # by the samples of the jumps
        self._start_s: float | None = None
        self._last_s = 0.0
        self._turned_rad = 0.0

    def take(self, block: SampleBlock) -> TrialMetrics:
        """Take samples; returns the figures so far."""
        if self._start_s is None:
            self._start_s = self._last_s = float(block.time_s[0])
        self._carried.take(block)
        down = _mean_down(block.accel_b_m_s2)
        rate = (block.gyro_b_rad_s - self._bias) @ down if np.isfinite(down).all() else np.zeros(1)
        self._turned_rad += abs(float(np.nansum(rate * np.nan_to_num(block.dt_s))))
        for t, m in zip(block.time_s.tolist(), block.raw_b_gauss, strict=True):
            if not self._rows or t - self._rows[-1][0] >= _SPACING_S:
                self._rows.append((t, m))
                self._leftover.add(t, self._new.apply(m[None])[0])
                self._old_leftover.add(t, self._old.apply(m[None])[0])
        now_s = float(block.time_s[-1])
        while self._rows and now_s - self._rows[0][0] > _WINDOW_S:
            self._rows.popleft()
        self._last_s = now_s
        for piece in _split_pieces(block.time_s):
            if self._jump_covered_s < _JUMP_S:
                self._add_heading_jump(
                    block.raw_b_gauss[piece], block.accel_b_m_s2[piece], block.dt_s[piece]
                )
        return self._metrics()

    def _add_heading_jump(self, raw: Array, accel: Array, dt_s: Array) -> None:
        """Add the heading difference between new and old registers for these samples."""
        down = _mean_down(accel)
        if not down[2] >= _LEVEL:  # nor where it is nan
            return
        field = self._new.apply(raw.mean(axis=0)[None])
        heading = tilt_compensated_heading(field, -down[None])
        level = self._new.undo(_level_field(field[0], heading[0], down)[None])
        before = tilt_compensated_heading(self._old.apply(level), np.array([[0.0, 0.0, -1.0]]))
        self._jumps.append(float((heading - before)[0]))
        self._jump_covered_s += float(np.nansum(np.minimum(dt_s, _PIECE_S)))

    def _metrics(self) -> TrialMetrics:
        field = np.array([m for _, m in self._rows])
        new = np.linalg.norm(self._new.apply(field), axis=1)
        old = np.linalg.norm(self._old.apply(field), axis=1)
        directions = self._new.apply(field) / new[:, None]
        turned = bool(len(field) > 1 and directions.var(axis=0).sum() > TURNED)
        spread = float(new.std() / new.mean()) if len(field) > 1 else float("nan")
        jump = None
        if self._jumps:
            angles = np.array(self._jumps)
            jump = float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))
        leftover = self._leftover.leftover(self._wrong_limit)
        swing = np.nan_to_num(self._carried.spreads)
        start = self._last_s if self._start_s is None else self._start_s
        return TrialMetrics(
            duration_s=self._last_s - start,
            turns=self._turned_rad / (2 * np.pi),
            new_figure=spread,
            old_figure=float(old.std() / old.mean()) if len(field) > 1 else float("nan"),
            field_spread=spread,
            turned=turned,
            heading_jump_deg=jump,
            new_swing=float(swing[0]),
            old_swing=float(swing[1:].min() if turned else swing[_OLD_GYRO]),
            wrong=leftover.share,
            old_wrong=self._old_leftover.leftover(self._wrong_limit).share,
            wrong_sigmas=leftover.sigmas,
        )


def _level_field(field_b: Array, heading_rad: float, down_b: Array) -> Array:
    """The field in the sensor's axes if the sensor were level, on the same heading."""
    vertical = float(down_b @ field_b)
    horizontal = float(np.linalg.norm(field_b - vertical * down_b))
    north = np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])
    return np.asarray(horizontal * north + np.array([0.0, 0.0, vertical]))


def _split_pieces(time_s: Array) -> list[slice]:
    """Slices of samples within `_PIECE_S` of the first sample of the slice."""
    starts = [0]
    for k, t in enumerate(time_s.tolist()):
        if not 0.0 <= t - time_s[starts[-1]] < _PIECE_S:
            starts.append(k)
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(time_s)], strict=True)]


def _mean_down(accel: Array) -> Array:
    mean = accel.mean(axis=0)
    return np.asarray(-mean / max(float(np.linalg.norm(mean)), 1e-9))
