"""A magnetometer that is read more slowly than the gyro: each reading counts once.

Loggers write the newest reading of each sensor into every row, so that a 10 Hz magnetometer in
100 Hz rows repeats each reading ten times.  Taken as ten measurements they turn with the sensor and
look like a field that comes and goes.  Rows are therefore merged from one new reading to the next:
the gyro's rotations are composed, the reading and the force are those of the row in which it came.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from ahrsd.estimator.steps import compose
from ahrsd.samples import Array

TIME, STEP, FIELD, GYRO = 0, 1, slice(2, 5), slice(5, 8)  # columns of the rows, accel behind them
_RUNS = 8  # of equal readings, by which a slow magnetometer is told
_MOST_ROWS = 512  # after which nobody waits for them
_REPEATED = 0.4  # share of the rows
_LONGEST = 5  # usual runs, after which a reading counts again: it is stuck, or nothing turns


def rows_per_reading(rows: Array, fewest: int) -> int | None:
    """How many rows a reading is held for, 1 where each has its own; None: too few rows to tell.

    rows (N, 11): of one piece from its beginning; fewest: that are needed in any case. The answer
    depends on the first rows only, so that it is the same however they are split.
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
    """Rows in, one row for each new reading out; the state is the rows since the last one."""

    def __init__(self, length: int) -> None:
        self.length = length
        self._rows = np.empty((0, 0))
        self._begun = False

    def copy(self) -> HeldReadings:
        """A copy that goes its own way."""
        return copy(self)

    def thin(self, rows: Array) -> Array:
        """(M, 11) rows with a new reading of the next (N, 11), which follow without a gap."""
        if len(self._rows):
            rows = np.vstack([self._rows, rows])
        new = np.concatenate([[False], np.any(rows[1:, FIELD] != rows[:-1, FIELD], axis=1)])
        at = self._not_too_far(np.flatnonzero(new).tolist(), len(rows))
        out: list[Array] = []
        before = 0
        for row in at:
            out.append(self._merged(rows[before + 1 : row + 1]))
            before = row
        self._rows = rows[before:] if self._begun else rows[-1:]
        return np.array(out).reshape(-1, rows.shape[1])

    def _not_too_far(self, at: list[int], count: int) -> list[int]:
        """The rows with new readings, and some of those between that are very far apart."""
        most = _LONGEST * self.length
        out: list[int] = []
        last = 0
        for row in [*at, count]:
            out += range(last + most, row, most) if self._begun or out else []
            if row < count:
                out.append(row)
            last = row
        return out

    def _merged(self, rows: Array) -> Array:
        """One row for those up to a new reading; nothing leads to the first one of a piece."""
        row: Array = rows[-1].copy()
        if not self._begun:
            self._begun = True
            row[STEP] = np.nan
            return row
        step_s = float(rows[:, STEP].sum())
        turn = compose((rows[:, GYRO] * rows[:, STEP, None])[None])[0]
        row[STEP], row[GYRO] = step_s, turn / step_s
        return row
