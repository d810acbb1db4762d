"""What a report may contain, and how the core's events fill it, in bounded memory.

Every part is optional; a part without data has no section.

`RunTime` is the time of a run: the device's own clock, going on where the device restarted and
began again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahrsd.events import (
    Estimated,
    Event,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.samples import Array

# -- Time of a run ---------------------------------------------------------------------------------


_LATE_S = 60.0  # an estimate is not told later than this; what is older is from after a restart
_PAUSE_S = 1.0  # between the last sample before a restart and the first one behind it


class RunTime:
    """Device time in seconds that never falls; until the first restart it is the device's own."""

    def __init__(self) -> None:
        self._offset_s = self._before_s = 0.0
        self._newest_s = -np.inf  # of the device, since its last restart

    def samples(self, time_s: Array) -> Array:
        """Of samples, in their order: a time that falls is a restart."""
        run_s = np.array(time_s, dtype=np.float64)
        if len(run_s) and run_s[0] >= self._newest_s and bool(np.all(np.diff(run_s) >= 0.0)):
            self._newest_s = float(run_s[-1])
            return run_s + self._offset_s
        for k, t in enumerate(time_s.tolist()):
            if t < self._newest_s:
                self._before_s = self._offset_s
                self._offset_s += self._newest_s + _PAUSE_S - t
                self._newest_s = t
            self._newest_s = max(self._newest_s, t)
            run_s[k] += self._offset_s
        return run_s

    def at(self, at_s: float) -> float:
        """Of an event at this device time.

        One that is from before the restart stays there, and one that comes before the first sample
        behind a restart is behind the last one before it.
        """
        if self._offset_s > 0.0 and at_s > self._newest_s + _PAUSE_S:
            return at_s + self._before_s
        if at_s < self._newest_s - _LATE_S:
            return float(self._newest_s + self._offset_s + _PAUSE_S)
        return at_s + self._offset_s

    @property
    def newest_s(self) -> float:
        """Of the newest sample; nan before the first."""
        return float(self._newest_s + self._offset_s) if np.isfinite(self._newest_s) else np.nan


# -- Contents --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """One line of the summary: a number before and after, and what it should be at most."""

    name: str
    unit: str
    before: float | None
    after: float | None
    limit: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class HeadingError:
    """Heading error against the heading, on data that the estimate has not seen.

    heading_deg, before_deg, after_deg: (N,), N >= 1, any order; errors signed, in -180..180
    source: one line on where the data come from and what the error is measured against
    limit_deg: what is accepted, where there is such a number
    """

    heading_deg: Array
    before_deg: Array
    after_deg: Array
    source: str
    limit_deg: float | None = None

    def figures(self) -> tuple[KeyFigure, KeyFigure]:
        """Worst and root mean square error, before and after."""
        return (
            KeyFigure(
                "Worst heading error",
                "deg",
                float(np.max(np.abs(self.before_deg))),
                float(np.max(np.abs(self.after_deg))),
                self.limit_deg,
            ),
            KeyFigure("Heading error, rms", "deg", _rms(self.before_deg), _rms(self.after_deg)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class FieldNorm:
    """Strength of the measured field over time; a calibrated sensor reads the same everywhere.

    time_s (N,), before_gauss (N,), after_gauss (N,) with nan where there was no estimate yet
    """

    time_s: Array
    before_gauss: Array
    after_gauss: Array


@dataclass(frozen=True, slots=True, eq=False)
class FieldClouds:
    """The field in the sensor frame: raw_b_gauss (N, 3) and the estimate that corrects it."""

    raw_b_gauss: Array
    soft_iron: Array
    hard_iron_gauss: Array
    field_gauss: float


@dataclass(frozen=True, slots=True, eq=False)
class EstimateHistory:
    """One estimated quantity over time.

    labels (K,), time_s (N,), value (N, K), sigma (N, K), truth (K,) where it is known
    """

    name: str
    unit: str
    labels: tuple[str, ...]
    time_s: Array
    value: Array
    sigma: Array
    truth: Array | None = None


@dataclass(frozen=True, slots=True)
class RegisterChange:
    """A register before and after (or as proposed); `outcome` says how it ended."""

    register: int
    before: tuple[float, ...]
    after: tuple[float, ...]
    outcome: str


@dataclass(frozen=True, slots=True, eq=False)
class ReportData:
    """All of a report. `verdict` is the one sentence that a hurried person reads.

    good: whether the verdict is a success; None where it is neither
    """

    title: str
    verdict: str = ""
    good: bool | None = None
    summary: tuple[KeyFigure, ...] = ()
    heading: HeadingError | None = None
    norm: FieldNorm | None = None
    clouds: FieldClouds | None = None
    history: tuple[EstimateHistory, ...] = ()
    gates: tuple[GateResult, ...] = ()
    states: tuple[StateChanged, ...] = ()
    registers: tuple[RegisterChange, ...] = ()
    warnings: tuple[str, ...] = ()
    seed: int | None = None
    command: str = ""


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


KEPT = 4000  # samples and estimates; every second one is dropped each time this is reached
KEPT_LINES = 200  # of warnings, states and register writes each
UPPER = np.triu_indices(3)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _History:
    """Where a history is found among the kept columns, and how it is shown."""

    name: str
    unit: str
    truth: str
    labels: tuple[str, ...]
    columns: slice
    offset: Array
    scale: float


HISTORIES = (
    _History(
        "Hard iron", "gauss", "hard_iron_gauss", ("x", "y", "z"), slice(7, 10), np.zeros(3), 1.0
    ),
    _History(
        "Soft iron minus identity",
        "",
        "soft_iron",
        ("xx", "xy", "xz", "yy", "yz", "zz"),
        slice(1, 7),
        np.eye(3)[UPPER],
        1.0,
    ),
    _History(
        "Gyro bias", "mrad/s", "gyro_bias_rad_s", ("x", "y", "z"), slice(10, 13), np.zeros(3), 1e3
    ),
)


class _Thinned:
    """Rows over time of which at most KEPT are kept, evenly."""

    def __init__(self) -> None:
        self.rows: list[Array] = []
        self._every = 1
        self._seen = 0

    def add(self, row: Array) -> None:
        if self._seen % self._every == 0:
            self.rows.append(row)
        self._seen += 1
        if len(self.rows) >= KEPT:
            self.rows = self.rows[::2]
            self._every *= 2

    def array(self) -> Array:
        return np.array(self.rows)


class EventCollector:
    """Collects events; `report` turns what was seen into a report's data."""

    def __init__(self) -> None:
        self._time = RunTime()
        self._samples = _Thinned()  # time, raw (3), norm before, norm after
        self._estimates = _Thinned()  # time, value (12), sigma (12)
        self._newest: Estimated | None = None
        self._gates: tuple[GateResult, ...] = ()
        self._states: list[StateChanged] = []
        self._registers: list[RegisterChange] = []
        self._warnings: list[str] = []

    def add(self, event: Event) -> None:
        """Take one event in."""
        match event:
            case SamplesSeen():
                self._add_samples(event)
            case Estimated():
                self._add_estimate(event)
            case Judged():
                self._gates = event.gates
            case StateChanged():
                if len(self._states) < KEPT_LINES:
                    at_s = self._time.at(event.at_s)
                    self._states.append(dataclasses.replace(event, at_s=at_s))
            case RegisterWritten():
                if len(self._registers) < KEPT_LINES:
                    self._registers.append(
                        RegisterChange(event.register, event.old, event.new, event.outcome)
                    )
            case Noted() if event.level in ("warning", "error"):
                if len(self._warnings) < KEPT_LINES:
                    self._warnings.append(event.text)

    def report(
        self,
        title: str,
        truth: Mapping[str, Array] | None = None,
        **parts: Any,  # noqa: ANN401 each field has its own type
    ) -> ReportData:
        """Make a report of what was seen.

        truth: "hard_iron_gauss" (3,), "soft_iron" (3, 3), "gyro_bias_rad_s" (3,), where known;
        parts: fields of ReportData that events do not tell, or that are to replace what they tell.
        """
        warnings = tuple(dict.fromkeys([*self._warnings, *self._estimate_warnings()]))
        seen = ReportData(
            title,
            norm=self._norm(),
            clouds=self._clouds(),
            history=self._history(truth or {}),
            gates=self._gates,
            states=tuple(self._states),
            registers=tuple(self._registers),
            warnings=warnings,
        )
        return dataclasses.replace(seen, **parts)

    def _add_samples(self, event: SamplesSeen) -> None:
        raw = event.block.raw_b_gauss
        before = np.linalg.norm(event.present.apply(raw), axis=1)
        after = np.full(len(raw), np.nan)
        correction = event.proposed
        if correction is None and self._newest is not None:
            correction = self._newest.estimate.correction
        if correction is not None:
            after = np.linalg.norm(correction.apply(raw), axis=1)
        time_s = self._time.samples(event.block.time_s)
        for row in np.column_stack([time_s, raw, before, after]):
            self._samples.add(row)

    def _add_estimate(self, event: Estimated) -> None:
        estimate = event.estimate
        self._newest = event
        self._estimates.add(
            np.concatenate(
                [
                    [self._time.at(event.at_s)],
                    estimate.soft_iron[UPPER],
                    estimate.hard_iron_gauss,
                    estimate.gyro_bias_rad_s,
                    estimate.sigma,
                ]
            )
        )

    def _estimate_warnings(self) -> tuple[str, ...]:
        return () if self._newest is None else self._newest.estimate.warnings

    def _norm(self) -> FieldNorm | None:
        rows = self._samples.array()
        return FieldNorm(rows[:, 0], rows[:, 4], rows[:, 5]) if len(rows) else None

    def _clouds(self) -> FieldClouds | None:
        rows = self._samples.array()
        if not len(rows) or self._newest is None:
            return None
        estimate = self._newest.estimate
        return FieldClouds(
            rows[:, 1:4], estimate.soft_iron, estimate.hard_iron_gauss, estimate.field_gauss
        )

    def _history(self, truth: Mapping[str, Array]) -> tuple[EstimateHistory, ...]:
        rows = self._estimates.array()
        if not len(rows):
            return ()
        true = dict(truth)
        if "soft_iron" in true:
            true["soft_iron"] = true["soft_iron"][UPPER]
        return tuple(
            EstimateHistory(
                row.name,
                row.unit,
                row.labels,
                rows[:, 0],
                (rows[:, row.columns] - row.offset) * row.scale,
                rows[:, _sigma(row.columns)] * row.scale,
                (true[row.truth] - row.offset) * row.scale if row.truth in true else None,
            )
            for row in HISTORIES
        )


def _sigma(columns: slice) -> slice:
    """Columns of the standard deviations of these columns."""
    return slice(columns.start + 12, columns.stop + 12)
