"""From blocks of samples to steps and epochs, and the preparation of their data.

Any split of the samples into blocks gives the same result. The rate is measured on the first
_RATE_ROWS samples after a start or a gap. It determines how many samples make a step. The same
samples show whether the magnetometer's readings are held over several samples (`HeldReadings`).
Pieces between short gaps share an epoch: nothing links the steps on the two sides of a gap, but the
gyro bias is the same.

Before the data of an epoch are linearised: a test for motion, a shift of the fields by the
magnetometer's lag, and grouping of steps that can share a state. For a search, epochs are thinned
and joined.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.chain import Index
from ahrsd.estimator.parameters import MIN_EPOCH_STEPS, EstimatorParameters
from ahrsd.samples import Array, SampleBlock

# -- Samples averaged into steps -------------------------------------------------------------------
#
# Averaging of fast streams into steps, exact where possible.
#
# The field of a step is the mean of an odd number n of consecutive samples and belongs to the
# middle one. The rotation between two steps is the product of all sample rotations between their
# middle samples. Averaging shortens the field by (w T)^2 / 24 for a rate w over the averaging time
# T: 0.04 % at 4 rad/s and 25 ms.


# -- From samples to epochs ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """N consecutive steps; the rotation of row k leads from step k-1 to step k.

    time_s (N,), field_b_gauss (N, 3), angle_b_rad (N, 3) rotation vector of the step, dt_s (N,),
    accel_b_m_s2 (N, 3), linked (N,): 0 for the first step of a piece, whose rotation and time are
    nan, else 1.
    """

    time_s: Array
    field_b_gauss: Array
    angle_b_rad: Array
    dt_s: Array
    accel_b_m_s2: Array
    linked: Array

    def __len__(self) -> int:
        return len(self.time_s)


def samples_per_step(rate_hz: float, step_rate_hz: float) -> int:
    """The largest odd number of samples whose rate stays at or above `step_rate_hz`, at least 1."""
    n = int(rate_hz / step_rate_hz)
    return max(1, n - 1 + n % 2)


class StepAverager:
    """Samples in, steps out. It keeps at most n samples, so any split gives the same steps."""

    def __init__(self, averaged: int) -> None:
        self.averaged = averaged
        self._rows: list[Array] = []
        self._linked = False

    def add(self, rows: Array) -> Steps:
        """Take samples (N, 11) without a gap, return completed steps.

        Columns: time_s, dt_s, field (3), gyro (3), accel (3).
        """
        if self._rows:
            rows = np.vstack([*self._rows, rows])
        n, half = self.averaged, self.averaged // 2
        # The second half of the last step's samples is kept: their rotations lead to the next step.
        lead = half if self._linked else 0
        count = max(0, (len(rows) - lead) // n)
        used = lead + count * n
        if count == 0:
            self._rows = [rows]
            return _no_steps()
        steps = _average_rows(rows[:used], lead, n, count, self._linked)
        self._rows = [rows[used - half :]]
        self._linked = True
        return steps


def _average_rows(rows: Array, lead: int, n: int, count: int, linked: bool) -> Steps:
    half = n // 2
    body = rows[lead:].reshape(count, n, -1)
    dt = rows[:, 1]
    phi = rows[:, 5:8] * dt[:, None]
    # rotation of step k: samples (middle of k-1, middle of k]; the first has them only if linked
    middles = lead + half + n * np.arange(count)
    angle = np.full((count, 3), np.nan)
    length = np.full(count, np.nan)
    first = 0 if linked else 1
    if count > first:
        index = middles[first:, None] - np.arange(n - 1, -1, -1)[None, :]
        angle[first:] = so3.compose(phi[index])
        length[first:] = dt[index].sum(axis=1)
    return Steps(
        time_s=body[:, half, 0],
        field_b_gauss=body[:, :, 2:5].mean(axis=1),
        angle_b_rad=angle,
        dt_s=length,
        accel_b_m_s2=body[:, :, 8:11].mean(axis=1),
        linked=np.isfinite(length).astype(np.float64),
    )


def join_steps(parts: Sequence[Steps]) -> Steps:
    """Concatenate consecutive steps."""
    if len(parts) == 1:
        return parts[0]
    return Steps(
        np.concatenate([p.time_s for p in parts]),
        np.concatenate([p.field_b_gauss for p in parts]),
        np.concatenate([p.angle_b_rad for p in parts]),
        np.concatenate([p.dt_s for p in parts]),
        np.concatenate([p.accel_b_m_s2 for p in parts]),
        np.concatenate([p.linked for p in parts]),
    )


def split_steps(steps: Steps, at: int) -> tuple[Steps, Steps]:
    """The first `at` steps and the remaining ones."""
    return _select_steps(steps, slice(0, at)), _select_steps(steps, slice(at, None))


def _select_steps(s: Steps, rows: slice) -> Steps:
    return Steps(
        s.time_s[rows],
        s.field_b_gauss[rows],
        s.angle_b_rad[rows],
        s.dt_s[rows],
        s.accel_b_m_s2[rows],
        s.linked[rows],
    )


def _no_steps() -> Steps:
    z3 = np.zeros((0, 3))
    return Steps(np.zeros(0), z3, z3, np.zeros(0), z3, np.zeros(0))


# -- Readings that are held over several samples ---------------------------------------------------
#
# A magnetometer that is sampled more slowly than the gyro: each reading counts once.
#
# Loggers write the newest reading of each sensor into every row, so a 10 Hz magnetometer in 100 Hz
# rows repeats each reading ten times. If these were ten measurements, the repeated field would seem
# to turn with the sensor. So the rows from one new reading to the next are merged: the gyro's
# rotations are composed; reading and specific force are those of the row with the new reading.

TIME, STEP, FIELD, GYRO = 0, 1, slice(2, 5), slice(5, 8)  # columns of the rows, accel behind them
_RUNS = 8  # of equal readings that identify a slow magnetometer
_MOST_ROWS = 512  # limit of the wait for these runs
_REPEATED = 0.4  # share of the rows that repeat a reading
_LONGEST_RUNS = 5  # in typical runs: a reading that is held for longer counts again


def rows_per_reading(rows: Array, fewest: int) -> int | None:
    """Number of rows for which a reading is held, 1 if each row has its own; None: too few rows to
    decide.

    rows (N, 11): of one piece from its beginning; fewest: number of rows needed in any case. The
    result depends on the first rows only, so it is the same for any split.
    """
    if len(rows) < fewest:
        return None
    fresh = np.any(rows[1:, FIELD] != rows[:-1, FIELD], axis=1)
    first = fresh[: fewest - 1]
    alive = np.any(rows[1:fewest, GYRO] != rows[: fewest - 1, GYRO], axis=1)
    stale = ~first & alive
    if np.mean(stale) < _REPEATED:
        return 1
    changes = np.flatnonzero(fresh)[: _RUNS + 1]
    if len(changes) <= _RUNS or changes[-1] >= _MOST_ROWS:
        return None if len(rows) < _MOST_ROWS else 1
    lengths = np.diff(changes)
    usual = int(np.median(lengths))
    regular = np.all(np.abs(lengths - usual) <= usual // 4)
    return usual if usual >= 2 and regular else 1


class HeldReadings:
    """Rows in, one row per new reading out; it keeps the rows since the last one."""

    def __init__(self, length: int) -> None:
        self.length = length
        self._rows = np.empty((0, 0))
        self._has_reading = False

    def copy(self) -> HeldReadings:
        """An independent copy."""
        return copy(self)

    def merge_rows(self, rows: Array) -> Array:
        """(M, 11) rows with a new reading from the next (N, 11), which follow without a gap."""
        if len(self._rows):
            rows = np.vstack([self._rows, rows])
        new = np.concatenate([[False], np.any(rows[1:, FIELD] != rows[:-1, FIELD], axis=1)])
        at = self._limit_distance(np.flatnonzero(new).tolist(), len(rows))
        out: list[Array] = []
        before = 0
        for row in at:
            out.append(self._merge(rows[before + 1 : row + 1]))
            before = row
        self._rows = rows[before:] if self._has_reading else rows[-1:]
        return np.array(out).reshape(-1, rows.shape[1])

    def _limit_distance(self, at: list[int], count: int) -> list[int]:
        """The rows with new readings, and rows in between where these are too far apart."""
        most = _LONGEST_RUNS * self.length
        out: list[int] = []
        last = 0
        for row in [*at, count]:
            out += range(last + most, row, most) if self._has_reading or out else []
            if row < count:
                out.append(row)
            last = row
        return out

    def _merge(self, rows: Array) -> Array:
        """One row for the rows up to a new reading; the first of a piece has no time step."""
        row: Array = rows[-1].copy()
        if not self._has_reading:
            self._has_reading = True
            row[STEP] = np.nan
            return row
        step_s = float(rows[:, STEP].sum())
        turn = so3.compose((rows[:, GYRO] * rows[:, STEP, None])[None])[0]
        row[STEP], row[GYRO] = step_s, turn / step_s
        return row


# -- Epochs ----------------------------------------------------------------------------------------

_RATE_ROWS = 33
SHORTEST_GAP_S = 0.1
_LONGEST_GAP_S = 60.0  # after a longer one the gyro bias may have changed
_SPARE_STEPS = 2  # steps by which the estimated count of waiting steps may be wrong


def check_samples(block: SampleBlock) -> None:
    """Raises ValueError naming the first row that is not a finite sample with a positive step.

    Only the first row of a block after a gap may have no step.
    """
    table = (
        ("time_s", block.time_s),
        ("raw_b_gauss", block.raw_b_gauss),
        ("gyro_b_rad_s", block.gyro_b_rad_s),
    )
    for name, values in table:
        good = np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
        if not good.all():
            k = int(np.argmin(good))
            raise ValueError(f"{name} of row {k} is not finite: {values[k]}")
    start = int(block.gap_before)
    good = block.dt_s[start:] > 0.0
    good &= block.dt_s[start:] < np.inf
    if not good.all():
        k = start + int(np.argmin(good))
        raise ValueError(f"dt_s of row {k} is not a positive step: {block.dt_s[k]}")


class RunningTime:
    """Device times on one line that only rises, also where the device restarted.

    There the device's time falls, and how long the pause was only the host's clock says. Drifts and
    what comes back are fitted over this time: on the device's own, a run behind a restart would lie
    within the run before it.
    """

    def __init__(self) -> None:
        self._newest_s = self._host_s = -np.inf  # running time and host time of the newest sample
        self._runs: list[tuple[float, float]] = [(-np.inf, 0.0)]  # behind when, and what is added

    def falls(self, block: SampleBlock) -> bool:
        """Whether this block begins another run of the device's time."""
        return float(block.time_s[0]) + self._runs[-1][1] <= self._newest_s

    def follow(self, block: SampleBlock) -> SampleBlock:
        """The block in running time; unchanged as long as the device's time has not fallen."""
        if self.falls(block):
            pause_s = float(block.host_s[0]) - self._host_s
            begins_s = self._newest_s + (pause_s if pause_s > SHORTEST_GAP_S else SHORTEST_GAP_S)
            self._runs.append((self._newest_s, begins_s - float(block.time_s[0])))
        if shift_s := self._runs[-1][1]:
            block = replace(block, time_s=block.time_s + shift_s)
        self._newest_s, self._host_s = float(block.time_s[-1]), float(block.host_s[-1])
        return block

    def device_s(self, running_s: float) -> float:
        """The device's own time at this running time."""
        return running_s - next(added for behind, added in self._runs[::-1] if running_s > behind)


class EpochBuilder:
    """Blocks in, epochs out; counts samples and duration."""

    def __init__(self, parameters: EstimatorParameters) -> None:
        self._parameters = parameters
        self.averaged = 1
        self.samples = 0
        self._averager: StepAverager | None = None
        self._held_readings: HeldReadings | None = None
        self._rows: list[Array] = []  # samples of a piece of unknown rate
        self._waiting: list[Array] = []  # samples that are not averaged yet
        self._waiting_count = 0
        self._pending: list[Steps] = []
        self._pending_count = 0
        self._measures_first = True
        self._earlier_s = 0.0
        self._from_s: float | None = None
        self._to_s = 0.0

    @property
    def duration_s(self) -> float:
        """Time covered, without gaps."""
        return self._earlier_s + (0.0 if self._from_s is None else self._to_s - self._from_s)

    def add(self, block: SampleBlock) -> list[chain.EpochData]:
        """Take samples that follow the last ones without a gap; returns completed epochs."""
        if len(block) == 0:
            return []
        self.samples += len(block)
        if self._from_s is None:
            self._from_s = float(block.time_s[0])
        self._to_s = float(block.time_s[-1])
        rows = np.column_stack(
            [block.time_s, block.dt_s, block.raw_b_gauss, block.gyro_b_rad_s, block.accel_b_m_s2]
        )
        closed: list[chain.EpochData] = []
        if self._averager is None:
            self._rows.append(rows)
            rows = np.vstack(self._rows)
            length = rows_per_reading(rows, _RATE_ROWS)
            if length is None:
                return []
            self._rows.clear()
            closed = self._measure_rate(rows[1:_RATE_ROWS, 1], length)
        if self._held_readings is not None:
            rows = self._held_readings.merge_rows(rows)
        self._waiting.append(rows)
        self._waiting_count += len(rows)
        enough = self._parameters.epoch_steps + int(self._measures_first)
        if self._pending_count + self._waiting_count // self.averaged + _SPARE_STEPS >= enough:
            self._average_waiting()
        return closed + self._complete_epochs()

    def _average_waiting(self) -> None:
        """Average the waiting samples; they wait because each call has a fixed cost."""
        if self._waiting:
            self._add_steps(np.vstack(self._waiting))
            self._waiting.clear()
            self._waiting_count = 0

    def _measure_rate(self, dt_s: Array, length: int) -> list[chain.EpochData]:
        """Measure the rate; steps of different lengths do not share an epoch.

        length: number of samples for which a reading is held.
        """
        self._held_readings = HeldReadings(length) if length > 1 else None
        rate_hz = 1.0 / (length * float(np.median(dt_s)))
        averaged = samples_per_step(rate_hz, self._parameters.step_rate_hz)
        data = self._close_pending() if averaged != self.averaged else None
        self.averaged = averaged
        self._averager = StepAverager(averaged)
        return [] if data is None else [data]

    def _add_steps(self, rows: Array) -> None:
        averager = self._averager or StepAverager(self.averaged)
        steps = averager.add(rows)
        if len(steps):
            self._pending.append(steps)
            self._pending_count += len(steps)

    def gap(self, next_s: float) -> list[chain.EpochData]:
        """The next sample, at `next_s`, does not follow the last one; returns the epochs that end
        here.
        """
        self._average_waiting()
        if self._averager is None and self._pending_count and self._is_unmeasured_short:
            rows = np.vstack(self._rows)  # too short for its rate: as in the piece before
            self._add_steps(
                rows
                if self._held_readings is None
                else HeldReadings(self._held_readings.length).merge_rows(rows)
            )
        closed = self._close_unmeasured() + self._complete_epochs()
        if self._pending_count and 0.0 <= next_s - self._to_s <= _LONGEST_GAP_S:
            self._start_piece()
        elif (data := self.interrupt()) is not None:
            closed.append(data)
        return closed

    @property
    def _is_unmeasured_short(self) -> bool:
        return 0 < sum(map(len, self._rows)) < _RATE_ROWS

    def _close_unmeasured(self) -> list[chain.EpochData]:
        """Close a piece that ends before the held length is known: it is taken as in the piece
        before.
        """
        if self._averager is not None or not self._rows or self._is_unmeasured_short:
            return []
        rows = np.vstack(self._rows)
        self._rows.clear()
        length = 1 if self._held_readings is None else self._held_readings.length
        closed = self._measure_rate(rows[1:_RATE_ROWS, 1], length)
        self._add_steps(
            rows if self._held_readings is None else self._held_readings.merge_rows(rows)
        )
        return closed

    def _start_piece(self) -> None:
        self._rows.clear()
        self._averager = None
        self._earlier_s, self._from_s = self.duration_s, None

    def _complete_epochs(self) -> list[chain.EpochData]:
        closed = []
        while self._pending_count >= self._parameters.epoch_steps + int(self._measures_first):
            closed.append(
                self._take_epoch(self._parameters.epoch_steps + int(self._measures_first))
            )
        return closed

    @property
    def pending(self) -> int:
        """Number of steps of the incomplete epoch."""
        self._average_waiting()
        return self._pending_count

    def copy(self) -> EpochBuilder:
        """An independent copy, with which to close the epoch early."""
        self._average_waiting()
        other = copy(self)
        other._pending, other._rows = list(self._pending), list(self._rows)
        other._averager, other._waiting = copy(self._averager), []
        other._held_readings = None if self._held_readings is None else self._held_readings.copy()
        return other

    def interrupt(self) -> chain.EpochData | None:
        """The pending steps as a short epoch, if there are enough; the next one starts anew."""
        self._average_waiting()
        data = self._close_pending()
        self._start_piece()
        return data

    def _close_pending(self) -> chain.EpochData | None:
        enough = self._pending_count >= MIN_EPOCH_STEPS
        data = self._take_epoch(self._pending_count) if enough else None
        self._pending.clear()
        self._pending_count = 0
        self._measures_first = True
        return data

    def _take_epoch(self, count: int) -> chain.EpochData:
        steps, remaining = split_steps(join_steps(self._pending), count)
        self._pending = [remaining] if len(remaining) else []
        self._pending_count = len(remaining)
        fresh, self._measures_first = self._measures_first, False
        cut = steps.linked == 0
        angle = np.where(cut[:, None], 0.0, steps.angle_b_rad)
        return chain.EpochData(
            steps.field_b_gauss,
            angle,
            np.where(cut, np.median(steps.dt_s[~cut]), steps.dt_s),
            _down_directions(steps.accel_b_m_s2, angle),
            steps.time_s,
            measures_first=fresh,
            linked=steps.linked if cut[1:].any() else None,
        )


def _down_directions(accel: Array, angle: Array) -> Array:
    """Unit vectors towards the earth (n, 3) from specific force, which points up at rest.

    The force is averaged over the epoch in the frame of its middle, to which the gyro's angles (n,
    3) rotate it. So accelerations of the vehicle average out, and a gyro bias does to first order.
    """
    if not np.isfinite(accel).all():
        return np.full_like(accel, np.nan)
    R = so3.products(so3.exp(angle))
    up = np.einsum("nji,j->ni", R, np.einsum("nij,nj->i", R, accel))
    return np.asarray(-up / np.maximum(np.sqrt(np.sum(up * up, axis=1, keepdims=True)), 1e-9))


def with_border(data: chain.EpochData, before: chain.EpochData) -> chain.EpochData:
    """Prepend the last step of the previous epoch, as the shared border."""
    return chain.EpochData(
        np.vstack([before.field_b_gauss[-1:], data.field_b_gauss]),
        np.vstack([np.zeros((1, 3)), data.angle_b_rad]),
        np.r_[data.dt_s[0], data.dt_s],
        np.vstack([before.down_b[-1:], data.down_b]),
        np.r_[before.time_s[-1], data.time_s],
        measures_first=False,
        linked=None if data.linked is None else np.r_[1.0, data.linked],
    )


# -- Whether an epoch turned the sensor ------------------------------------------------------------
#
# Whether the sensor turned during an epoch: without motion it has no information on the iron.
#
# A field that changes while the sensor is at rest (a lift, a magnet, drift) would look like a
# different calibration. So both sensors must have seen a rotation. How much of a steady rate is the
# gyro bias is not well known: if the field swept far, any turn seen by the gyro suffices.

# -- Before they are linearised --------------------------------------------------------------------


_LEAST_SWEEP = 0.10  # spread of the field over its size: a turn, if the gyro saw one
_LEAST_PATH = 0.3  # spread of the integrated rate less the known bias, over that of the field
_LEAST_SWEEP_UNSTEADY = 0.004  # spread of the field, if the gyro saw an unsteady turn
_TURNED_RAD = 0.002  # spread of the integrated rate less its mean: an unsteady turn
_SMOOTHED_STEPS = 16  # steps


def principal_deviation(field: Array) -> float:
    """Standard deviation of (N, 3) along the direction of largest variance."""
    away = field - field.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(away.T @ away)[-1] / (len(field) - 1)))


def has_motion(data: chain.EpochData, bias_rad_s: Array) -> bool:
    """Whether the epoch has information on the calibration; bias (3,): known bias of the gyro."""
    count = len(data) // _SMOOTHED_STEPS
    field = (
        data.field_b_gauss[: count * _SMOOTHED_STEPS]
        .reshape(count, _SMOOTHED_STEPS, 3)
        .mean(axis=1)
    )
    size_gauss = float(np.median(np.linalg.norm(data.field_b_gauss, axis=1)))
    if not size_gauss > 0.0:  # a silent magnetometer shows no motion
        return False
    relative = principal_deviation(field) / size_gauss
    angle = data.angle_b_rad[1:]
    path = np.cumsum(angle - bias_rad_s * data.dt_s[1:, None], axis=0)
    if relative > _LEAST_SWEEP and principal_deviation(path) > _LEAST_PATH * relative:
        return True
    unsteady = np.cumsum(angle - angle.mean(axis=0), axis=0)
    return relative > _LEAST_SWEEP_UNSTEADY and principal_deviation(unsteady) > _TURNED_RAD


# -- A lag of the magnetometer ---------------------------------------------------------------------
#
# A lag of the magnetometer against the gyro: a reading at t has the direction at t - tau.
#
# Every real system has one, by filters, buses and interrupts. A lag of tau at a rate w looks like a
# field that is turned by w tau. It is corrected in the prediction of the field: the row measured M
# Exp(w tau) u + b. The gyro's readings stay as they are, so nothing is smoothed and no noise is
# mixed. This holds for tau of a few steps at most: w is the mean rate of the row's steps.


def row_rates(data: chain.EpochData) -> Array:
    """Rate (n, 3) in rad/s at each row: mean of the steps before and after it, if linked."""
    if data.averaging is not None:
        return data.averaging.rate_b_rad_s
    linked = np.ones(len(data)) if data.linked is None else data.linked.copy()
    linked[0] = 0.0
    rate = data.angle_b_rad / data.dt_s[:, None] * linked[:, None]
    both = rate.copy()
    both[:-1] += rate[1:]
    sides = linked.copy()
    sides[:-1] += linked[1:]
    return np.asarray(both / np.maximum(sides, 1.0)[:, None])


def with_lag(data: chain.EpochData, lag_s: float) -> chain.EpochData:
    """The same epoch with its fields taken to be late by a further `lag_s`."""
    rate = row_rates(data)
    turn = so3.exp(lag_s * rate)
    averaging = data.averaging
    if averaging is None:
        averaging = chain.Averaging(np.ones(len(data)), turn, data.dt_s, rate)
    else:
        averaging = replace(averaging, turn=turn @ averaging.turn)
    return replace(data, averaging=averaging)


def with_gyro_matrix(data: chain.EpochData, gyro: Array, lag_s: float) -> chain.EpochData:
    """The same epoch with the gyro's angles multiplied by a matrix (3, 3).

    lag_s: lag of its fields that is already applied. Inside a group the angles are so small that
    only the rotation by the lag changes.
    """
    angle, averaging = data.angle_b_rad @ gyro.T, data.averaging
    if averaging is not None:
        rate = averaging.rate_b_rad_s @ gyro.T
        turn = so3.exp(lag_s * rate) @ so3.exp(-lag_s * averaging.rate_b_rad_s) @ averaging.turn
        averaging = replace(averaging, turn=turn, rate_b_rad_s=rate)
    return replace(data, angle_b_rad=angle, averaging=averaging)


# -- Steps in groups -------------------------------------------------------------------------------
#
# Several steps in one state of the chain: nearly the same information at a fraction of the cost.
#
# If the gyro propagates the direction over a few steps much better than the magnetometer measures
# it, the steps of a group need no states of their own: their fields are averaged. The mean of M u_j
# + b over the group is M P u + b exactly, with P the mean of the rotations from the middle to each
# step, so rotation inside the group loses nothing. Groups never span a gap; the first and the last
# row of an epoch stay single, because the neighbouring epochs share them.
#
# The loss is the gyro's noise inside a group (it adds _LOST_INFORMATION of the field's variance)
# and the differences of the fields inside it, which matter only at large rotations (_TURN_RAD).

_LARGEST_GROUP = 7
# rotation in a group, which this share of the steps respects
_TURN_RAD, _FAST_SHARE = 0.3, 0.95
_LOST_INFORMATION = 0.03
_FEWEST_ROWS = 3  # shorter epochs are not grouped


def group_size(data: chain.EpochData, noise: chain.Noise, size_gauss: float) -> int:
    """Number of steps that can share a state: odd, 1 if the gyro is poor or the rotation fast.

    noise: a guess, per step; size_gauss: of the field. The mean of k fields has the variance s_m^2
    / k, and the gyro's noise adds k / 12 (size s_g dt)^2.
    """
    dt = float(np.median(data.dt_s[1:]))
    ratio = noise.mag_gauss / (size_gauss * noise.gyro_rad_s * dt)
    turns = np.sqrt(np.sum(data.angle_b_rad[1:] ** 2, axis=1))
    fast = int(np.ceil(_FAST_SHARE * (len(turns) - 1)))
    turn = float(np.partition(turns, fast)[fast])
    most = min(ratio * np.sqrt(12 * _LOST_INFORMATION), _TURN_RAD / max(turn, 1e-9), _LARGEST_GROUP)
    return max(1, int(most) - 1 + int(most) % 2)


def group_steps(epochs: Sequence[chain.EpochData], sizes: Sequence[int]) -> list[chain.EpochData]:
    """Epochs of single steps with `sizes` (odd) steps in each state; all at once."""
    out = list(epochs)
    which = [k for k, size in enumerate(sizes) if size > 1 and len(epochs[k]) > _FEWEST_ROWS]
    if which:
        few = _group_epochs([epochs[k] for k in which], [sizes[k] for k in which])
        for k, data in zip(which, few, strict=True):
            out[k] = data
    return out


def _group_epochs(epochs: Sequence[chain.EpochData], sizes: Sequence[int]) -> list[chain.EpochData]:
    lengths = np.array([len(d) for d in epochs])
    first = np.cumsum(lengths) - lengths
    linked = [np.ones(len(d)) if d.linked is None else d.linked for d in epochs]
    edges = [_group_starts(own, size) for own, size in zip(linked, sizes, strict=True)]
    ends = np.cumsum([len(e) for e in edges])
    links = np.concatenate(linked)
    links[first] = 0.0
    edge = np.concatenate([e + at for e, at in zip(edges, first, strict=True)])
    count = np.diff(np.r_[edge, len(links)])
    rows = edge + count // 2
    turn = so3.exp(
        np.where(links[:, None] > 0, np.concatenate([d.angle_b_rad for d in epochs]), 0.0)
    )
    step = np.concatenate([d.dt_s for d in epochs])
    angle, dt, spread, joins = _rotations_between(step, turn, links, rows)
    field, rate, P = (
        np.add.reduceat(np.concatenate([d.field_b_gauss for d in epochs]), edge) / count[:, None],
        np.add.reduceat(np.concatenate([row_rates(d) for d in epochs]), edge) / count[:, None],
        _mean_rotations(turn, rows, edge, count),
    )
    out = []
    for data, own, end, at in zip(epochs, edges, ends, first, strict=True):
        piece, own_rows = slice(end - len(own), end), rows[end - len(own) : end] - at
        own_dt, own_spread, own_joins = dt[piece].copy(), spread[piece].copy(), joins[piece].copy()
        own_dt[0], own_spread[0], own_joins[0] = own_dt[1], own_spread[1], 1.0
        averaging = chain.Averaging(
            count[piece].astype(float), P[piece].copy(), own_spread, rate[piece].copy()
        )
        out.append(
            chain.EpochData(
                field[piece].copy(),
                angle[piece].copy(),
                own_dt,
                data.down_b[own_rows],
                data.time_s[own_rows],
                data.measures_first,
                linked=None if own_joins.all() else own_joins,
                averaging=averaging,
            )
        )
    return out


def _group_starts(linked: Array, size: int) -> Index:
    """First row of each group of an epoch; its first and last row are groups of one."""
    n = len(linked)
    cuts = [1, *(2 + np.flatnonzero(linked[2 : n - 1] == 0)), n - 1]
    return np.concatenate([[0], *(np.arange(a, b, size) for a, b in pairwise(cuts)), [n - 1]])


def _rotations_between(
    step_s: Array, turn: Array, linked: Array, rows: Index
) -> tuple[Array, Array, Array, Array]:
    """For each state from the one before: rotation vector, time, root of the sum of squared time
    steps, 1 if linked else 0; of the first state only the shapes are valid.
    """
    before = np.r_[rows[0], rows[:-1]]
    total = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    for j in range(1, int((rows - before).max()) + 1):
        k = before + j
        total = total @ np.where((k <= rows)[:, None, None], turn[np.minimum(k, rows)], np.eye(3))
    first = np.r_[rows[0], rows[:-1] + 1]
    return (
        so3.log(total),
        np.asarray(np.add.reduceat(step_s, first)),
        np.sqrt(np.add.reduceat(step_s**2, first)),
        np.minimum.reduceat(linked, first),
    )


def _mean_rotations(turn: Array, rows: Index, start: Index, length: Index) -> Array:
    """Mean over each group of the rotations from the sensor frame of its middle to those of its
    steps.
    """
    P = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    end = start + length
    ahead = behind = np.broadcast_to(np.eye(3), P.shape)
    for j in range(1, int(length.max()) // 2 + 1):
        up, down = rows + j < end, rows - j >= start
        ahead = np.swapaxes(turn[np.minimum(rows + j, len(turn) - 1)], 1, 2) @ ahead
        behind = turn[np.maximum(rows - j + 1, 0)] @ behind
        P += np.where(up[:, None, None], ahead, 0.0) + np.where(down[:, None, None], behind, 0.0)
    P /= length[:, None, None]
    return P


# -- Parts of a window for a search ----------------------------------------------------------------


def thin_rows(data: chain.EpochData, k: int) -> chain.EpochData:
    """Every k-th row of an epoch, on its own."""
    if k == 1:
        return data
    count = (len(data) - 1) // k
    rows = np.arange(count + 1) * k
    linked = None
    if data.linked is not None:
        linked = np.r_[1.0, data.linked[1 : count * k + 1].reshape(count, k).min(axis=1)]
    angle = np.zeros((count + 1, 3))
    angle[1:] = so3.compose(data.angle_b_rad[1 : count * k + 1].reshape(count, k, 3))
    dt = np.r_[data.dt_s[1], data.dt_s[1 : count * k + 1].reshape(count, k).sum(axis=1)]
    averaging = data.averaging
    if averaging is not None:
        averaging = chain.Averaging(
            averaging.count[rows], averaging.turn[rows], dt, averaging.rate_b_rad_s[rows]
        )
    return chain.EpochData(
        data.field_b_gauss[rows],
        angle,
        dt,
        data.down_b[rows],
        data.time_s[rows],
        measures_first=True,
        linked=linked,
        averaging=averaging,
    )


def join_epochs(parts: Sequence[chain.EpochData]) -> chain.EpochData:
    """Epochs as one chain with cuts between them; each measures its first field."""
    ones = [np.ones(len(p)) for p in parts]
    linked = [
        np.r_[0.0, (o if p.linked is None else p.linked)[1:]]
        for p, o in zip(parts, ones, strict=True)
    ]
    averaging = None
    if any(p.averaging is not None for p in parts):
        all_ = [
            p.averaging
            or chain.Averaging(o, np.tile(np.eye(3), (len(p), 1, 1)), p.dt_s, row_rates(p))
            for p, o in zip(parts, ones, strict=True)
        ]
        averaging = chain.Averaging(
            np.concatenate([a.count for a in all_]),
            np.concatenate([a.turn for a in all_]),
            np.concatenate([a.spread_s for a in all_]),
            np.concatenate([a.rate_b_rad_s for a in all_]),
        )
    return chain.EpochData(
        np.vstack([p.field_b_gauss for p in parts]),
        np.vstack([p.angle_b_rad for p in parts]),
        np.concatenate([p.dt_s for p in parts]),
        np.vstack([p.down_b for p in parts]),
        np.concatenate([p.time_s for p in parts]),
        measures_first=True,
        linked=np.concatenate(linked),
        averaging=averaging,
    )
