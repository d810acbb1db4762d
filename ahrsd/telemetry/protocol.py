"""The protocol of the socket: its lines, the core's events as records, and what waits for a client.

One JSON object a line, both ways.

    {"ask": "status"}                                one answer, `ahrsd.status/1`
    {"ask": "explain"}                               one answer, `ahrsd.explain/1`
    {"ask": "watch", "of": ["status", "events"]}     records until the client goes

Every record that is watched has a `seq`; where a slow reader lost some, a `gap` record says which.

An `Outbox` is what waits for one client: bounded, and honest about what did not fit. A reader that
is slow or never reads costs this many bytes and nothing else. Records that do not fit are dropped;
as soon as there is room, a `gap` record says how many and which.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ahrsd import events
from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock

# -- Lines -----------------------------------------------------------------------------------------


SCHEMA: Final = "ahrsd.socket/1"
STATUS_SCHEMA: Final = "ahrsd.status/1"
STREAMS: Final = ("status", "events", "samples")
ASKS: Final = ("status", "explain", "watch")
LONGEST_REQUEST: Final = 4096


@dataclass(frozen=True, slots=True)
class SocketRequest:
    """What a client wants; `streams` is empty but for `watch`."""

    ask: str
    streams: frozenset[str] = frozenset()


class BadRequest(ValueError):
    """A line that is no request; the text says what is wrong and what is allowed."""


def parse_request(line: bytes) -> SocketRequest:
    """A request out of one line. Raises BadRequest, and nothing else on any bytes."""
    try:
        body = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"not a JSON object: {str(error)[:80]}") from None
    if not isinstance(body, dict):
        raise BadRequest('not a JSON object, such as {"ask": "status"}')
    ask = body.get("ask")
    if ask not in ASKS:
        raise BadRequest(f"ask = {str(ask)[:40]!r}: must be one of {', '.join(ASKS)}")
    if ask != "watch":
        return SocketRequest(ask)
    of = body.get("of", ["status", "events"])
    if not isinstance(of, list) or not of or not all(isinstance(one, str) for one in of):
        raise BadRequest(f"of: must be a list of {', '.join(STREAMS)}")
    if wrong := sorted(set(of) - set(STREAMS)):
        raise BadRequest(f"of: {wrong[0][:40]!r} is none of {', '.join(STREAMS)}")
    return SocketRequest(ask, frozenset(of))


def line_of(body: Mapping[str, object]) -> bytes:
    """One JSON line; numbers that are not finite become null, because JSON has none."""
    return json.dumps(plain(body), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def plain(value: object) -> object:
    """The same with null for numbers that are not finite, lists for arrays and tuples."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(one) for one in value]
    raise TypeError(f"{type(value).__name__} does not go into JSON")


# -- Records of events -----------------------------------------------------------------------------


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


# -- What waits for a client -----------------------------------------------------------------------


LIMIT_BYTES = 1 << 20


class Outbox:
    """Lines in order; whole lines are dropped, never parts."""

    def __init__(self, limit_bytes: int = LIMIT_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.dropped = 0  # records, since the client came
        self.lost_bytes = 0  # of what was dropped
        self._data = bytearray()
        self._gap: tuple[int, int, int] | None = None  # count, first seq, last seq

    def __len__(self) -> int:
        return len(self._data)

    def answer(self, line: bytes) -> bool:
        """An answer to a request; false where there is no room for it."""
        if len(self._data) + len(line) > self.limit_bytes:
            return False
        self._data += line
        return True

    def offer(self, message: bytes) -> None:
        """A message that nobody is told of where there is no room for it; it is counted."""
        if not self.answer(message):
            self.dropped += 1
            self.lost_bytes += len(message)

    def record(self, line: bytes, seq: int) -> None:
        """A record that is watched; dropped, and counted, where there is no room."""
        note = self._gap_line(seq)
        if len(self._data) + len(note) + len(line) > self.limit_bytes:
            count, first, _ = self._gap or (0, seq, seq)
            self._gap = (count + 1, first, seq)
            self.dropped += 1
            self.lost_bytes += len(line)
            return
        self._data += note + line
        self._gap = None

    def head(self, size: int) -> bytes:
        """The first bytes that wait."""
        return bytes(self._data[:size])

    def sent(self, size: int) -> None:
        """So many bytes are gone."""
        del self._data[:size]

    def _gap_line(self, seq: int) -> bytes:
        if self._gap is None:
            return b""
        count, first, last = self._gap
        gap = {"record": "gap", "seq": seq, "lost": count, "first_seq": first, "last_seq": last}
        return line_of(gap)
