"""What a run, a replay and `ahrsd calibrate` say in the end: JSON, lines for a person, the page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.calibration_json import (
    HeadingErrors,
    calibration_json,
    heading_words,
    why_not_converged,
)
from ahrsd.core.core import Core
from ahrsd.errors import AhrsdError
from ahrsd.estimator.model_checks import Misalignment
from ahrsd.events import Event, GateResult
from ahrsd.gates import Level, guards_a_write
from ahrsd.printable import counted
from ahrsd.stream.decompensation import Compensation

# -- Of a run and of a replay ----------------------------------------------------------------------


_TABLE_IS_RAW = (
    "a table does not say what the registers held: it was taken as raw, so the result comes on "
    "top of what registers 23, 26 and 84 did to it"
)
_NAMES = (*(f"hard iron {a}" for a in "xyz"), *(f"gyro bias {a}" for a in "xyz"))
#: of a sensor whose own scale is off by 40 %; on Earth the field has 0.22 to 0.67 gauss
_FIELD_GAUSS = (0.22 / 1.4, 0.67 * 1.4)
_DIGITS = 6  # of times in the summary: microseconds


def summary_json(core: Core, recording: str, warnings: Sequence[str] = ()) -> dict[str, object]:
    """The contract's `ahrsd.replay/1`."""
    counters = core.device_session.session.deframer.counters
    facts = core.stream.facts
    return {
        "schema": "ahrsd.replay/1",
        "recording": recording,
        "bytes": counters.fed_bytes,
        "packets": {
            "valid": counters.valid,
            "rejected": counters.rejected + core.source.undecodable,
            "by_type": dict(core.stream.by_layout),
        },
        "skipped_bytes": counters.skipped_bytes,
        "samples": facts.samples,
        "duration_s": round(facts.duration_s, _DIGITS),
        "rate_hz": _finite(facts.rate_hz),
        "rate_source": facts.rate_source,
        "gaps": [
            {"at_s": round(gap.at_s, _DIGITS), "length_s": round(gap.length_s, _DIGITS)}
            for gap in core.stream.gaps
        ],
        "device_restarts": core.stream.restarts,
        "state": core.writeback.state.value,
        "calibration": calibration_json(
            recording,
            core.calibrator.estimate,
            core.registers,
            samples=facts.samples,
            gyro_is_raw=not core.stream.compensated_gyro,
            heading=heading_errors(core),
            warnings=warnings_of(core, warnings),
            serial=serial_of(core),
        ),
        "decisions": core.decisions.entries,
        "decision_sha256": core.decisions.sha256,
    }


def serial_of(core: Core) -> int | None:
    """Serial number of the device that the recording is of; None where it does not say."""
    identity = core.device_session.identity
    return None if identity is None else identity.serial


def warnings_of(core: Core, warnings: Iterable[str] = ()) -> list[str]:
    """What a reader of the result must know: of the recording, the stream and the registers."""
    said = [*warnings, *core.stream.warnings]
    if not core.registers:
        is_table = not core.stream.by_layout
        said += [_TABLE_IS_RAW] if is_table else Compensation.unknown().warnings
    return list(dict.fromkeys(said))


def heading_errors(core: Core) -> HeadingErrors:
    """Held-out heading errors of the newest evidence."""
    evidence = core.calibrator.evidence
    if evidence is None:
        return HeadingErrors()
    before, after = evidence.heldout_rms_before_deg, evidence.heldout_rms_deg
    return HeadingErrors(_finite(before), _finite(after))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def summary_lines(core: Core, recording: str, warnings: Sequence[str] = ()) -> list[str]:
    """What a person wants to know first."""
    counters = core.device_session.session.deframer.counters
    facts, stream = core.stream.facts, core.stream
    rate = f"{facts.rate_hz:.4g} Hz" if math.isfinite(facts.rate_hz) else "unknown rate"
    source = f", {facts.rate_source}" if facts.rate_source else ""
    lines = [
        f"{recording}: {counted(facts.samples, 'sample')} in {facts.duration_s:.1f} s "
        f"({rate}{source})"
    ]
    if counters.fed_bytes:
        rejected = counters.rejected + core.source.undecodable
        lines.append(
            f"  messages: {counters.valid} valid, {rejected} rejected, "
            f"{counted(counters.skipped_bytes, 'byte')} skipped"
        )
    gaps = stream.all_gaps
    if gaps.count or stream.restarts:
        lines.append(
            f"  {counted(gaps.count, 'gap')}, {gaps.length_s:.1f} s in all; "
            f"{counted(stream.restarts, 'restart')} of the device"
        )
    lines += estimate_lines(core.calibrator.estimate)
    lines += gate_lines(core.calibrator.gates, core.settings.level)
    lines += [f"  warning: {text}" for text in warnings_of(core, warnings)]
    lines.append(f"  state {core.writeback.state.value}; decisions {core.decisions.sha256[:16]}")
    return lines


def gate_lines(gates: Sequence[GateResult], level: Level) -> list[str]:
    """Gates that are shut: of a write and its save, and of one without a person where that is."""
    guards = [gate for gate in gates if guards_a_write(gate.gate)]
    alone = [gate for gate in gates if not guards_a_write(gate.gate)]
    lines = _shut_lines(guards, "a write back")
    return lines + (
        _shut_lines(alone, "a write without approval back") if level > Level.FLASH else []
    )


def _shut_lines(gates: Sequence[GateResult], what: str) -> list[str]:
    """Gates that are shut, those with the same advice together."""
    shut: dict[str, list[str]] = {}
    for gate in gates:
        if not gate.ok:
            shut.setdefault(gate.advice, []).append(gate.gate)
    if not shut:
        return []
    number = sum(len(names) for names in shut.values())
    head = f"  {number} of {len(gates)} gates {'holds' if number == 1 else 'hold'} {what}:"
    return [head, *(f"    {', '.join(names)}: {advice}" for advice, names in shut.items())]


def estimate_lines(estimate: Estimate | None, wrong: Sequence[str] = ()) -> list[str]:
    """An estimate in the units of a field engineer. wrong: see `why_not_converged`."""
    if estimate is None:
        return ["  no estimate: too few samples"]
    numbers = np.concatenate([estimate.hard_iron_gauss, estimate.gyro_bias_rad_s]) * 1e3
    sigmas = estimate.sigma[6:] * 1e3
    blind = [name in estimate.observability.unobservable for name in _NAMES]
    values = [
        _value(number, sigma, 2 if k < 3 else 3) if not blind[k] else "not determined"
        for k, (number, sigma) in enumerate(zip(numbers, sigmas, strict=True))
    ]
    lag_ms = 1e3 * estimate.mag_lag_s
    lag = f"the field is {abs(lag_ms):.1f} ms {'late' if lag_ms > 0 else 'early'} against the gyro"
    most = "" if wrong else estimate.widened_by  # what is wrong is why, whatever followed from it
    return [
        f"  hard iron  {', '.join(values[:3])} mG",
        f"  gyro bias  {', '.join(values[3:])} mrad/s",
        f"  heading    {heading_words(estimate.heading_sigma_deg)}",
        *([f"             most of it: {most}"] if most else []),
        *([f"  lag        {lag}"] if lag_ms else []),
        *(f"  {text}" for text in why_not_converged(estimate, wrong)),
    ]


def _value(value: float, sigma: float, digits: int) -> str:
    """Value and sigma; never -0.00."""
    return f"{round(value, digits) + 0.0:+.{digits}f} +- {sigma:.{digits}f}"


# -- Of a batch calibration ------------------------------------------------------------------------


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
        turned = None if self.wrong else self.misalignment  # of axes, units or times that are wrong
        found = [
            *(f"{words}: put this right and calibrate again" for words in self._wrong_besides),
            *(_not_of_the_earth(self.estimate) if self.estimate is not None else ()),
            *warnings_of(self.core, self.warnings),
            *(self.estimate.warnings if self.estimate is not None else ()),
            *([] if turned is None or not turned.significant else [_misalignment_text(turned)]),
        ]
        return list(dict.fromkeys(found))

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


def _not_of_the_earth(estimate: Estimate) -> list[str]:
    """A field that no place on Earth has, as the sensor itself measures it: another unit."""
    size = float(estimate.field_gauss * np.cbrt(np.linalg.det(estimate.soft_iron)))
    least, most = _FIELD_GAUSS
    if not estimate.converged or least <= size <= most:
        return []
    milli = f" ({10.0 * size:.2f} if it is in mT: --columns mag_x=COLUMN:mT,...)"
    hint = milli if least <= 10.0 * size <= most else ""
    return [
        f"the field has {size:.3g} gauss, and on Earth it has 0.22 to 0.67: the magnetometer's "
        f"unit is not gauss{hint}, or its scale is wrong; the hard iron is wrong by the same factor"
    ]


def _misalignment_text(turned: Misalignment) -> str:
    x, y, z = np.degrees(turned.rotation_rad)
    rows = ", ".join(f"{v:.4f}" for v in turned.correction.matrix.ravel())
    return (
        f"the magnetometer is turned against the gyro by ({x:.2f}, {y:.2f}, {z:.2f}) deg "
        f"({np.sqrt(turned.chi2):.0f} sigma): the correction that includes it is C = [{rows}], "
        f"b = {np.round(turned.correction.offset, 4).tolist()} gauss"
    )
