"""What a report may contain. Every part is optional; a part without data has no section."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.events import GateResult, StateChanged
from ahrsd.samples import Array


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
