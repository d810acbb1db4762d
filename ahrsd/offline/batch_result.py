"""What `ahrsd calibrate` says of a recording: the estimate, what is wrong, JSON and page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.calibration_json import calibration_json, why_not_converged
from ahrsd.core.core import Core
from ahrsd.errors import AhrsdError
from ahrsd.estimator.model_checks import Misalignment
from ahrsd.events import Event
from ahrsd.report.summary import serial_of, warnings_of


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """What `ahrsd calibrate` says.

    wrong: units, axes, signs and times that cannot be as recorded, in words
    facts: what the recording says of itself: a capture's header, or those of another program's
    """

    name: str
    core: Core
    estimate: Estimate | None
    events: tuple[Event, ...]
    warnings: tuple[str, ...]
    misalignment: Misalignment | None = None
    wrong: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Samples used."""
        return self.core.stream.facts.samples

    @property
    def converged(self) -> bool:
        """Whether the recording determines the calibration."""
        return self.estimate is not None and self.estimate.converged

    def all_warnings(self) -> list[str]:
        """Warnings of recording and stream."""
        turned = self.misalignment
        return [
            *(f"{words}: put this right and calibrate again" for words in self._wrong_besides),
            *warnings_of(self.core, self.warnings),
            *(self.estimate.warnings if self.estimate is not None else ()),
            *([] if turned is None or not turned.significant else [_misalignment_text(turned)]),
        ]

    @property
    def _wrong_besides(self) -> tuple[str, ...]:
        """What is wrong and is not told already as the reason why it has not converged."""
        return self.wrong if self.estimate is None or self.converged else ()

    def reasons(self) -> list[str]:
        """Why it has not converged; empty where it has."""
        return why_not_converged(self.estimate, self.wrong)

    def json(self, method: str) -> dict[str, object]:
        """The contract's calibration.json."""
        return calibration_json(
            self.name,
            self.estimate,
            self.core.registers,
            method=method,
            samples=self.samples,
            gyro_is_raw=not self.core.stream.compensated_gyro,
            warnings=self.all_warnings(),
            serial=serial_of(self.core),
            wrong=self.wrong,
        )

    def write_report(self, path: Path) -> None:
        """A page with pictures.  AhrsdError where it cannot be written."""
        from ahrsd.report import EventCollector, write_report

        collector = EventCollector()
        for event in self.events:
            collector.add(event)
        report = collector.report(
            f"Calibration of {self.name}",
            verdict=" ".join(f"{text[:1].upper()}{text[1:]}." for text in self.reasons()),
            good=self.converged,
            command=f"ahrsd calibrate {self.name}",
            warnings=tuple(self.all_warnings()),
        )
        try:
            write_report(path, report)
        except OSError as error:
            raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error


def _misalignment_text(turned: Misalignment) -> str:
    x, y, z = np.degrees(turned.rotation_rad)
    rows = ", ".join(f"{v:.4f}" for v in turned.correction.matrix.ravel())
    return (
        f"the magnetometer is turned against the gyro by ({x:.2f}, {y:.2f}, {z:.2f}) deg "
        f"({np.sqrt(turned.chi2):.0f} sigma): the correction that includes it is C = [{rows}], "
        f"b = {np.round(turned.correction.offset, 4).tolist()} gauss"
    )
