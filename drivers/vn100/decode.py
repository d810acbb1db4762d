"""Messages to values in SI. Total: every frame gives a result, and nothing raises.

A right checksum does not make sane numbers: what cannot be read, has too few or too many values or
is not finite becomes `Undecodable` (vn100-protocol 1.4).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from operator import truediv

from drivers.vn100.deframer import Packet, Sentence
from drivers.vn100.errors import code_of
from drivers.vn100.messages import (
    COMMAND_WORDS,
    MESSAGES,
    REGISTER_WORDS,
    Layout,
    Reply,
    sentence_layout,
)

_REGISTER = re.compile(r"[0-9]{1,3}")
_COUNT = re.compile(r"T[0-9]{1,20}")  # a time in ns has more digits than a count
_STATUS = re.compile(r"S[0-9A-Fa-f]{1,4}")
_OTHER = re.compile(r"VN[A-Z0-9]{3}")
_LAYOUTS = {name: sentence_layout(name) for name in MESSAGES}


@dataclass(frozen=True, slots=True)
class Measurement:
    """One measurement. `values` in SI, the field in gauss, in the order of `layout.columns`.

    A time is exact to its float: 0.1 us after ten years. `BinaryLayout.unpack` has nanoseconds.
    """

    layout: Layout
    values: tuple[float, ...]
    offset: int


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """``$VNERR``; the codes are in `errors.ERRORS`."""

    code: int


@dataclass(frozen=True, slots=True)
class Undecodable:
    """A message with a right checksum whose content makes no sense; `what` is for a person."""

    what: str
    offset: int


@dataclass(frozen=True, slots=True)
class Unused:
    """A whole message of which nothing is used: another model's, or fields that no VN-100 has.

    name: "VNINS", or header bytes and field words of a packet
    """

    name: str
    offset: int


Decoded = Measurement | Reply | ErrorReply | Undecodable | Unused


def decode(frame: Sentence | Packet) -> Decoded:
    """The content of a message."""
    if isinstance(frame, Packet):
        return _decode_packet(frame)
    tokens = frame.body.split(",")
    layout = _LAYOUTS.get(tokens[0])
    if layout is not None:
        return _decode_measurement(layout, tokens, frame)
    return _decode_reply(tokens[0], tokens[1:], frame)


def _decode_reply(
    word: str, tokens: list[str], frame: Sentence
) -> Reply | ErrorReply | Undecodable | Unused:
    if word in REGISTER_WORDS:
        if not tokens or not _REGISTER.fullmatch(tokens[0]):
            return Undecodable(f"{word} without a register number", frame.offset)
        return Reply(word, int(tokens[0]), tuple(tokens[1:]))
    if word in COMMAND_WORDS:
        return Reply(word, None, tuple(tokens))
    if word == "VNERR":
        code = code_of(tokens)
        if code is None:
            return Undecodable("VNERR without an error code", frame.offset)
        return ErrorReply(code)
    if _OTHER.fullmatch(word):
        return Unused(word, frame.offset)
    return Undecodable(f"{word} is not a message of a VN-100", frame.offset)


def _decode_packet(packet: Packet) -> Measurement | Undecodable | Unused:
    layout = packet.layout
    values = tuple(map(truediv, layout.unpack(packet.data), layout.per_si))
    if not values:
        return Unused(layout.name, packet.offset)
    if not all(map(math.isfinite, values)):
        bad = next(c.name for c, v in zip(layout.columns, values) if not math.isfinite(v))
        return Undecodable(f"{layout.name}: {bad} is not finite", packet.offset)
    return Measurement(layout, values, packet.offset)


def _decode_measurement(
    layout: Layout, tokens: list[str], sentence: Sentence
) -> Measurement | Undecodable:
    """The message of which `tokens` are name and values."""
    numbers = tokens[1:]
    if len(numbers) > len(layout.columns):
        appended = _appended(numbers[len(layout.columns) :])
        if appended is None:
            return Undecodable(f"{layout.name}: too many values", sentence.offset)
        del numbers[len(layout.columns) :]
        layout = sentence_layout(layout.name, "count" in appended, "status" in appended)
        numbers += appended.values()
    if len(numbers) != len(layout.columns):
        what = f"{layout.name}: {len(numbers)} values where {len(layout.columns)} belong"
        return Undecodable(what, sentence.offset)
    try:
        wire = list(map(float, numbers))
    except ValueError:
        wire = [math.nan]
    body = sentence.body  # float() also takes what no device prints: nan, inf, 1_0, blanks
    if not math.isfinite(sum(wire)) or "_" in body or " " in body:
        return Undecodable(f"{layout.name}: a value is no number: {body}", sentence.offset)
    return Measurement(layout, tuple(map(truediv, wire, layout.per_si)), sentence.offset)


def _appended(tokens: list[str]) -> dict[str, str] | None:
    """Serial count and status as register 30 appends them, in either order, as decimal numbers.

    In the dictionary count comes first; None where anything else is there.
    """
    count = [token[1:] for token in tokens if _COUNT.fullmatch(token)]
    status = [str(int(token[1:], 16)) for token in tokens if _STATUS.fullmatch(token)]
    if len(count) > 1 or len(status) > 1 or len(count) + len(status) < len(tokens):
        return None
    return dict(zip(["count"] * len(count) + ["status"] * len(status), count + status))
