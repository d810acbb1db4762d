"""How a running daemon stands, as plain values: for `status`, `watch`, `explain` and metrics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.core.core import Core
from ahrsd.core.estimation import Calibrator
from ahrsd.events import GateResult, SamplesSeen
from ahrsd.evidence.values import Evidence
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array
from ahrsd.sharing.share_output import ShareFacts
from ahrsd.telemetry.protocol import STATUS_SCHEMA

# -- Readings of now -------------------------------------------------------------------------------


def readings(seen: SamplesSeen, now_s: float) -> dict[str, object]:
    """Means over the newest block of samples; `now_s` is the host's monotonic clock.

    Headings are magnetic, by the field levelled with the specific force, so a vehicle that
    accelerates spoils them for as long; nan where the stream has no acceleration. `would_be` is
    by the newest estimate, nan before it has converged.
    """
    block = seen.block
    raw, force = np.mean(block.raw_b_gauss, axis=0), np.mean(block.accel_b_m_s2, axis=0)
    in_force = seen.present.apply(raw)
    would_be = np.full(3, np.nan) if seen.proposed is None else seen.proposed.apply(raw)
    with np.errstate(invalid="ignore", divide="ignore"):  # a force of zero has no direction
        down = -force / np.linalg.norm(force)
        now_deg, new_deg = _heading_deg(in_force, force), _heading_deg(would_be, force)
    return {
        "time_s": float(block.time_s[-1]),
        "age_s": max(now_s - float(block.host_s[-1]), 0.0),
        "raw_b_gauss": raw,
        "corrected_b_gauss": in_force,
        "would_be_b_gauss": would_be,
        "gyro_b_rad_s": np.mean(block.gyro_b_rad_s, axis=0),
        "accel_b_m_s2": force,
        "heading_deg": now_deg,
        "heading_would_be_deg": new_deg,
        "roll_deg": float(np.degrees(np.arctan2(down[1], down[2]))),
        "pitch_deg": float(np.degrees(np.arcsin(np.clip(-down[0], -1.0, 1.0)))),
    }


def _heading_deg(field_b: Array, force_b: Array) -> float:
    heading_rad = tilt_compensated_heading(field_b[None, :], force_b[None, :])
    return float(np.degrees(heading_rad[0]) % 360.0)


# -- The status ------------------------------------------------------------------------------------


_RATE_S = 1.0  # rates are means over at least so long


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """What the shell knows and the core does not. Times in s of the host's monotonic clock."""

    port: str
    baud: int | None
    is_open: bool
    latency_timer_ms: int | None = None
    capture: str = ""
    capture_error: str = ""
    viewer_dropped: int = 0
    viewer_fault: str = ""
    interlock: str = "none"  # none, safe, not safe
    complaints: tuple[str, ...] = ()  # what is wrong with files of the vehicle or of an operator
    estimator_stuck: bool = False
    shares: tuple[ShareFacts, ...] = ()


class StatusMaker:
    """Makes a status about once a second; keeps only what rates need."""

    def __init__(self, started_s: float) -> None:
        self._started_s = started_s
        self._mark = (started_s, 0, 0)
        self._rates = (float("nan"), float("nan"))
        self._seen: SamplesSeen | None = None

    def saw(self, samples: SamplesSeen) -> None:
        """The newest samples."""
        self._seen = samples

    def make(self, core: Core, link: LinkFacts, now_s: float) -> dict[str, object]:
        """The status at `now_s`."""
        counters = core.device_session.session.deframer.counters
        self._tally(now_s, counters.fed_bytes, core.stream.facts.samples)
        identity = core.device_session.identity
        return {
            "schema": STATUS_SCHEMA,
            "host_s": now_s,
            "uptime_s": now_s - self._started_s,
            "at_s": core.at_s,
            "mode": core.settings.policy.mode.name.lower(),
            "mode_now": core.writeback.mode.name.lower(),
            "device": None
            if identity is None
            else {
                "model": identity.model,
                "serial": identity.serial,
                "firmware": identity.firmware,
            },
            "link": {
                "port": link.port,
                "baud": link.baud,
                "open": link.is_open,
                "latency_timer_ms": link.latency_timer_ms,
                "bytes": counters.fed_bytes,
                "bytes_per_s": self._rates[0],
            },
            "stream": self._stream(core),
            "readings": None if self._seen is None else readings(self._seen, now_s),
            "motion": _motion(core.calibrator.evidence),
            "sensors": list(core.source.sensors.findings.values()),
            "estimator": _estimator(core, link.estimator_stuck),
            "warm_start": core.warm.text,
            "estimate": _estimate(core.calibrator.estimate),
            "mismatch": _mismatch(core.calibrator),
            "gates": [_gate(gate, core.at_s) for gate in core.calibrator.gates],
            "write_back": _write_back(core),
            "interlock": link.interlock,
            "shares": [_share(share, core.clients.counts(share.name)) for share in link.shares],
            "complaints": list(link.complaints),
            "capture": {"file": link.capture, "error": link.capture_error},
            "viewer": {"dropped": link.viewer_dropped, "fault": link.viewer_fault},
            "warnings": list(core.stream.warnings),
            "decision_sha256": core.decisions.sha256,
        }

    def _tally(self, now_s: float, fed_bytes: int, samples: int) -> None:
        before_s, bytes_before, samples_before = self._mark
        if now_s - before_s >= _RATE_S:
            step_s = now_s - before_s
            self._rates = (fed_bytes - bytes_before) / step_s, (samples - samples_before) / step_s
            self._mark = (now_s, fed_bytes, samples)

    def _stream(self, core: Core) -> dict[str, object]:
        counters, facts = core.device_session.session.deframer.counters, core.stream.facts
        return {
            "samples": facts.samples,
            "samples_per_s": self._rates[1],
            "rate_hz": facts.rate_hz,
            "rate_source": facts.rate_source,
            "messages": counters.valid,
            "rejected": counters.rejected + core.source.undecodable,
            "skipped_bytes": counters.skipped_bytes,
            "by_type": dict(core.stream.by_layout),
            "gaps": core.stream.all_gaps.count,
            "restarts": core.stream.restarts,
            "faults": core.faults,
            "strays": core.source.strays,
            "refused": [str(error) for error in core.stream.refused.values()],
            "waits_for": list(core.source.vehicle.waits_for),
        }


def _share(share: ShareFacts, counts: dict[str, int]) -> dict[str, object]:
    return {
        "port": share.name,
        "open": share.readers is None or share.readers > 0,
        "send": share.send,
        "readers": share.readers,
        "lost_bytes": share.lost_bytes,
        "turned_away": share.turned_away,
        "ignored_bytes": share.ignored_bytes,
        "fault": share.fault,
        **counts,
    }


def _motion(evidence: Evidence | None) -> dict[str, object] | None:
    """What the vehicle has shown and what is missing."""
    if evidence is None:
        return None
    seen = evidence.motion
    return {
        "regime": seen.regime,
        "heading_deg": seen.heading_deg,
        "roll_deg": seen.roll_deg,
        "pitch_deg": seen.pitch_deg,
        "next": seen.turn,
        "directions": "".join("1" if cell else "0" for cell in seen.directions),
        "down_b": seen.down_b,
        "dip_deg": evidence.field.inclination_deg,
    }


def _estimator(core: Core, stuck: bool) -> dict[str, object]:
    """Whether the estimator works, and how it broke off last."""
    state = core.estimation.state
    return {
        "state": "FAILED" if state.failed else "STUCK" if stuck else "RUNNING",
        "reason": state.reason,
        "failures": state.failures,
        "begins_anew_in_s": max(state.left_s, 0.0),
    }


def _estimate(estimate: Estimate | None) -> dict[str, object] | None:
    if estimate is None:
        return None
    sigma = estimate.sigma
    return {
        "converged": estimate.converged,
        "soft_iron": estimate.soft_iron,
        "hard_iron_gauss": estimate.hard_iron_gauss,
        "gyro_bias_rad_s": estimate.gyro_bias_rad_s,
        "field_gauss": estimate.field_gauss,
        "field_known": estimate.field_known,
        "sigma_soft_iron": sigma[:6],
        "sigma_hard_iron_gauss": sigma[6:9],
        "sigma_gyro_bias_rad_s": sigma[9:],
        "heading_sigma_deg": estimate.heading_sigma_deg,
        "misfit": estimate.misfit,
        "unobservable": list(estimate.observability.unobservable),
        "warnings": list(estimate.warnings),
    }


def _mismatch(calibrator: Calibrator) -> dict[str, object]:
    """What the model beside the estimator says: whether it watches, and what stepped last."""
    step = calibrator.step
    return {
        "watching": calibrator.steps.armed,
        "blocks": calibrator.steps.scored,
        "open": calibrator.step_open,
        "step": None
        if step is None
        else {
            "what": step.what,
            "frame": step.frame,
            "at_s": step.at_s,
            "told_s": step.told_s,
            "size": step.size,
            "sigma": step.sigma,
            "unit": step.unit,
            "text": step.words,
        },
    }


def _gate(gate: GateResult, at_s: float) -> dict[str, object]:
    return {
        "gate": gate.gate,
        "value": gate.value,
        "limit": gate.limit,
        "unit": gate.unit,
        "ok": gate.ok,
        "since_s": gate.since_s,
        "for_s": at_s - gate.since_s,
        "advice": gate.advice,
    }


def _write_back(core: Core) -> dict[str, object]:
    writeback, history = core.writeback, core.writeback.history
    proposal = writeback.proposal
    return {
        "state": writeback.state.value,
        "holds": [*filter(None, [core.warm.holds]), *writeback.obstacles()],
        "proposal": None
        if proposal is None
        else {
            "id": proposal.id,
            "lines": list(proposal.lines),
            "heading_change_deg": proposal.heading_change_deg,
        },
        "transaction": None if history.open is None else history.open.id,
        "locked": history.locked,
        "flashes": history.flashes,
        "rollbacks": history.rollbacks,
    }
