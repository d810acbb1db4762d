"""The closing summary of a run and of a replay: one JSON object, and lines for a person."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from ahrsd.calibration import Estimate
from ahrsd.core import Core
from ahrsd.result import HeadingErrors, calibration_json


def summary_json(core: Core, recording: str, warnings: Sequence[str] = ()) -> dict[str, object]:
    """The contract's `ahrsd.replay/1`."""
    counters = core.conversation.session.deframer.counters
    facts = core.stream.facts
    said = [*warnings, *core.stream.warnings]
    by_type: Counter[str] = Counter(core.stream.by_layout)
    return {
        "schema": "ahrsd.replay/1",
        "recording": recording,
        "bytes": counters.fed_bytes,
        "packets": {
            "valid": counters.valid,
            "rejected": counters.rejected + core.undecodable,
            "by_type": dict(by_type),
        },
        "skipped_bytes": counters.skipped_bytes,
        "samples": facts.samples,
        "duration_s": round(core.at_s - core.first_s, 6),
        "rate_hz": facts.rate_hz if facts.rate_hz == facts.rate_hz else None,
        "rate_source": facts.rate_source,
        "gaps": [{"at_s": g.at_s, "length_s": g.length_s} for g in core.stream.gaps],
        "device_restarts": core.stream.restarts,
        "state": core.writeback.state.value,
        "calibration": calibration_json(
            recording,
            core.calibrator.estimate,
            core.registers,
            samples=facts.samples,
            gyro_is_raw=not core.stream.compensated_gyro,
            heading=heading_errors(core),
            warnings=said,
        ),
        "decisions": core.decisions.entries,
        "decision_sha256": core.decisions.sha256,
    }


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
    counters = core.conversation.session.deframer.counters
    facts = core.stream.facts
    rejected = counters.rejected + core.undecodable
    rate = f"{facts.rate_hz:.4g} Hz" if facts.rate_hz == facts.rate_hz else "unknown rate"
    lines = [
        f"{recording}: {facts.samples} samples in {core.at_s - core.first_s:.1f} s ({rate}, "
        f"{facts.rate_source or 'no stream'})",
        f"  messages: {counters.valid} valid, {rejected} rejected, {counters.skipped_bytes} bytes "
        f"skipped; {len(core.stream.gaps)} gaps, {core.stream.restarts} restarts",
    ]
    lines += estimate_lines(core.calibrator.estimate)
    for gate in core.calibrator.gates:
        if not gate.ok:
            lines.append(f"  gate {gate.gate}: {gate.value:.4g} {gate.unit}: {gate.advice}")
    lines += [f"  warning: {text}" for text in (*warnings, *core.stream.warnings)]
    lines.append(f"  state {core.writeback.state.value}; decisions {core.decisions.sha256[:16]}")
    return lines


def estimate_lines(estimate: Estimate | None) -> list[str]:
    """An estimate in the units of a field engineer."""
    if estimate is None:
        return ["  no estimate: too few samples"]
    sigma = estimate.sigma
    b, w = estimate.hard_iron_gauss * 1e3, estimate.gyro_bias_rad_s * 1e3
    lines = [
        "  hard iron  "
        + ", ".join(f"{v:+.2f} +- {s * 1e3:.2f}" for v, s in zip(b, sigma[6:9], strict=True))
        + " mG",
        "  gyro bias  "
        + ", ".join(f"{v:+.3f} +- {s * 1e3:.3f}" for v, s in zip(w, sigma[9:], strict=True))
        + " mrad/s",
        f"  worst heading sigma {estimate.heading_sigma_deg:.2f} deg; "
        + ("converged" if estimate.converged else "not converged"),
    ]
    if estimate.observability.unobservable:
        lines.append("  not observable: " + "; ".join(estimate.observability.unobservable))
    return lines
