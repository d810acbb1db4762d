"""ASCII messages: the table of all that a VN-100 streams, and text to wire. Sans I/O.

    $ VNxxx [, field]* * CS CR LF          (vn100-protocol 1.1, 2; UM001 "Async Data Output")

Reading is by commas and never by column, so the widths that older firmware printed decode too.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.vn100 import fields
from drivers.vn100.checksum import crc16, xor8
from drivers.vn100.fields import Columns, Layout

Check = Literal["xor", "crc"]


@dataclass(frozen=True, slots=True)
class Message:
    """A row of the table of asynchronous messages.

    output_type: ADOR, the value of register 6 that selects it
    register:    the register that holds the same values, 0 where none does
    """

    name: str
    output_type: int
    register: int
    columns: Columns


_ROWS = (
    Message("VNYPR", 1, 8, fields.YPR),
    Message("VNQTN", 2, 9, fields.QUATERNION),
    Message("VNQMR", 8, 15, fields.QUATERNION + fields.MAG + fields.ACCEL + fields.GYRO),
    Message("VNMAG", 10, 17, fields.MAG),
    Message("VNACC", 11, 18, fields.ACCEL),
    Message("VNGYR", 12, 19, fields.GYRO),
    Message("VNMAR", 13, 20, fields.MAG + fields.ACCEL + fields.GYRO),
    Message("VNYMR", 14, 27, fields.YPR + fields.MAG + fields.ACCEL + fields.GYRO),
    Message("VNYBA", 16, 239, fields.YPR + fields.LINEAR_ACCEL_BODY + fields.GYRO),
    Message("VNYIA", 17, 240, fields.YPR + fields.LINEAR_ACCEL_NED + fields.GYRO),
    Message(
        "VNIMU",
        19,
        54,
        fields.UNCOMP_MAG
        + fields.UNCOMP_ACCEL
        + fields.UNCOMP_GYRO
        + fields.TEMPERATURE
        + fields.PRESSURE,
    ),
    Message("VNDTV", 30, 80, fields.DELTA_TIME + fields.DELTA_THETA + fields.DELTA_VELOCITY),
    Message("VNHVE", 34, 115, fields.HEAVE),
    # of firmware 1; the vendor's old library names its values uncompensated
    Message(
        "VNCMV",
        253,
        0,
        fields.UNCOMP_MAG_E + fields.UNCOMP_ACCEL_E + fields.UNCOMP_GYRO_E + fields.TEMPERATURE_E,
    ),
)
MESSAGES: dict[str, Message] = {row.name: row for row in _ROWS}

REGISTER_WORDS = frozenset({"VNRRG", "VNWRG"})
COMMAND_WORDS = frozenset(
    {
        *("VNWNV", "VNRFS", "VNRST", "VNASY", "VNKMD", "VNKAD"),
        *("VNSGB", "VNTAR", "VNBOM", "VNSFB", "VNSIH"),
    }
)


_LAYOUTS = {
    (row.name, count, status): Layout(
        row.name,
        row.columns + (fields.SERIAL_COUNT,) * count + (fields.SERIAL_STATUS,) * status,
    )
    for row in _ROWS
    for count in (False, True)
    for status in (False, True)
}


def sentence_layout(name: str, count: bool = False, status: bool = False) -> Layout:
    """The layout of a message, with the columns that register 30 may append. KeyError if unknown.

    Count comes before status in the columns, whichever the device prints first.
    """
    return _LAYOUTS[name, count, status]


_TEXT = rb"[ -#%-)+-~]"  # printable, neither $ nor *
_CHECKED = rb"\$(VN%b{3,})\*((?:[0-9A-F]{2}){1,2})" % _TEXT
# A port in text mode makes CR CR LF of CR LF; one that edits lines may leave CR alone.
LINE = re.compile(_CHECKED + rb"(?:\r{0,2}\n|\r{1,2}(?=[$\xfa]))")
LINE_AT_THE_END = re.compile(_CHECKED + rb"(?:\r{0,2}\n|\r{1,2}(?=[$\xfa]|\Z))")
COMMAND_LINE = re.compile(rb"\$(VN%b{3,})\*((?:[0-9A-F]{2}){1,2}|XX)\r?\n" % _TEXT)


def line_intact(match: re.Match[bytes]) -> bool:
    """Whether the check of a line, matched by one of the two, is right.

    Two digits are the XOR, four the CRC; a host may write XX to have none.
    """
    body, check = match.groups()
    if check == b"XX":
        return True
    return (xor8(body) if len(check) == 2 else crc16(body)) == int(check, 16)


def encode(body: str, crc: bool = False) -> bytes:
    """Frame what goes between ``$`` and ``*``; `crc` for the 4-digit check instead of the XOR.

    ValueError for text that cannot be inside a sentence.
    """
    raw = body.encode("ascii", "replace")
    if not body.isascii() or not body.isprintable() or "$" in body or "*" in body:
        raise ValueError(f"{body!r} cannot be a sentence: printable ASCII without $ and * only")
    check = b"%04X" % crc16(raw) if crc else b"%02X" % xor8(raw)
    return b"$%b*%b\r\n" % (raw, check)


def encode_sentence(
    name: str,
    values: Sequence[float],
    count: int | None = None,
    status: int | None = None,
    check: Check = "xor",
) -> bytes:
    """An asynchronous message as the device prints it, from SI values in the order of its columns.

    count, status: what register 30 appends. KeyError for an unknown name, ValueError for a wrong
    number of values or one that is not finite.
    """
    columns = MESSAGES[name].columns
    if len(values) != len(columns):
        raise ValueError(f"{name} has {len(columns)} values, not {len(values)}")
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{name} cannot carry a value that is not finite")
    tokens = [name]
    tokens += [c.printed % (value * c.per_si) for c, value in zip(columns, values, strict=True)]
    if count is not None:
        tokens.append(f"T{count:010d}")
    if status is not None:
        tokens.append(f"S{status:04X}")
    return encode(",".join(tokens), crc=check == "crc")


@dataclass(frozen=True, slots=True)
class Reply:
    """The device's answer to a command: its word, the register if it has one, and the rest."""

    word: str
    register: int | None
    tokens: tuple[str, ...]
