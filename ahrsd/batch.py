"""Batch calibration: every sample of a recording in one estimate, iterated to the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ahrsd.calibration import Estimate
from ahrsd.config import Config
from ahrsd.core import Core
from ahrsd.events import Estimated, Event
from ahrsd.replay import replay
from ahrsd.result import calibration_json


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """What `ahrsd calibrate` says."""

    name: str
    core: Core
    estimate: Estimate | None
    events: tuple[Event, ...]
    warnings: tuple[str, ...]

    @property
    def samples(self) -> int:
        """Samples used."""
        return self.core.stream.facts.samples

    @property
    def converged(self) -> bool:
        """Whether the recording determines the calibration."""
        return self.estimate is not None and self.estimate.converged

    def said(self) -> list[str]:
        """Warnings of recording and stream."""
        return [*self.warnings, *self.core.stream.warnings]

    def json(self, method: str) -> dict[str, object]:
        """The contract's calibration.json."""
        return calibration_json(
            self.name,
            self.estimate,
            self.core.registers,
            method=method,
            samples=self.samples,
            gyro_is_raw=not self.core.stream.compensated_gyro,
            warnings=self.said(),
        )

    def write_report(self, path: Path) -> None:
        """A page with pictures."""
        from ahrsd.report import EventCollector, write_report

        collector = EventCollector()
        for event in self.events:
            collector.add(event)
        report = collector.report(
            f"Calibration of {self.name}",
            verdict="" if self.converged else "The motion does not determine the calibration.",
            good=self.converged,
            command=f"ahrsd calibrate {self.name}",
        )
        write_report(path, report)


def calibrate(
    path: Path,
    config: Config,
    *,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> BatchResult:
    """Estimate from the whole recording; nothing is held out.  RecordingError as `replay`."""
    seen: list[Event] = []
    done = replay(
        path, config, rate_hz=rate_hz, listeners=[seen.append], progress=progress, held_out=False
    )
    estimate = done.core.calibrator.finish()
    if estimate is not None:
        seen.append(Estimated(done.core.at_s, done.core.at_s, estimate))
    return BatchResult(path.name, done.core, estimate, tuple(seen), tuple(done.warnings))
