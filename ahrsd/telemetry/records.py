"""Events of the core as records for the socket."""

from __future__ import annotations

from collections.abc import Sequence

from ahrsd import events
from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock

Record = dict[str, object]


def stream_of(event: events.Event) -> str:
    """The stream that the event belongs to; empty where it is nobody's business."""
    if isinstance(event, events.SamplesSeen):
        return "samples"
    public = (
        events.Noted,
        events.StateChanged,
        events.RegisterWritten,
        events.Estimated,
        events.Judged,
    )
    return "events" if isinstance(event, public) else ""


def record_of(event: events.Event) -> Record:
    """The event as plain values. Times: `at_s` of the device, `host_s` monotonic of the host."""
    match event:
        case events.SamplesSeen(block):
            return samples_record(block, event.present)
        case events.Noted(at_s, host_s, level, text):
            return _at("note", at_s, host_s) | {"level": level, "text": text}
        case events.StateChanged(at_s, host_s, old, new, reason):
            return _at("state", at_s, host_s) | {"old": old, "new": new, "reason": reason}
        case events.RegisterWritten(at_s, host_s, register, old_values, new_values, outcome):
            values = {"old": old_values, "new": new_values, "outcome": outcome}
            return _at("register", at_s, host_s) | {"register": register} | values
        case events.Estimated(at_s, host_s, estimate):
            return _at("estimate", at_s, host_s) | {
                "hard_iron_gauss": estimate.hard_iron_gauss,
                "gyro_bias_rad_s": estimate.gyro_bias_rad_s,
                "soft_iron": estimate.soft_iron,
                "standard_deviation": estimate.sigma,
                "heading_sigma_deg": estimate.heading_sigma_deg,
                "converged": estimate.converged,
            }
        case events.Judged(at_s, host_s, gates):
            shut = [gate.gate for gate in gates if not gate.ok]
            return _at("gates", at_s, host_s) | {"shut": shut, "count": len(gates)}
    raise TypeError(f"{type(event).__name__} is not for the socket")


def samples_record(block: SampleBlock, present: Affine) -> Record:
    """The samples of a block; `present` is register 23."""
    return {
        "record": "samples",
        "time_s": block.time_s,
        "host_s": block.host_s,
        "raw_b_gauss": block.raw_b_gauss,
        "gyro_b_rad_s": block.gyro_b_rad_s,
        "corrected_b_gauss": present.apply(block.raw_b_gauss),
        "calibration_epoch": block.epoch,
        "gap_before": block.gap_before,
    }


class Newest:
    """Each sample is told once, though before its block is full; known by the device's time."""

    def __init__(self) -> None:
        self._ahead: set[float] = set()  # told, and their block is not full yet
        self._was_full = False

    def waiting(self, blocks: Sequence[SampleBlock]) -> list[SampleBlock]:
        """What waits for its block to be full, and was not told yet."""
        if self._was_full:
            self._ahead.clear()
            self._was_full = False
        parts = [part for block in blocks if (part := self._rest(block)) is not None]
        for block in blocks:
            self._ahead.update(block.time_s.tolist())
        return parts

    def full(self, block: SampleBlock) -> SampleBlock | None:
        """The part of a block that was not told while it waited."""
        self._was_full = True
        return self._rest(block)

    def _rest(self, block: SampleBlock) -> SampleBlock | None:
        new = (k for k, at_s in enumerate(block.time_s.tolist()) if at_s not in self._ahead)
        if (first := next(new, None)) is None:
            return None
        return block.part(slice(first, None), gap_before=block.gap_before and not first)


def _at(kind: str, at_s: float, host_s: float) -> Record:
    return {"record": kind, "at_s": at_s, "host_s": host_s}
