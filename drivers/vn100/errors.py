"""What the device says when it refuses, as a table and as exceptions. Source: UM001 "Error Codes".

    DriverError
     ├── DeviceRefused(code)   the device answered VNERR
     └── ...                   session and port errors, in their own modules

Codes are hexadecimal on the wire (vn100-protocol 3.1).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class Remedy(Enum):
    """What a program can do about an error."""

    RETRY = "retry"  # the command was damaged on the way and not carried out
    STOP = "stop"  # the same command will be refused again
    RESET = "reset"  # the device restarted: RAM settings are gone
    BANDWIDTH = "bandwidth"  # more output than the baud rate carries


@dataclass(frozen=True, slots=True)
class ErrorCode:
    """A row of the table of error codes. `advice` is for a person."""

    code: int
    name: str
    outcome: Remedy
    advice: str


# For a person who meets lines that end without one (register 30, as firmware 1 and others had it).
NO_CHECKSUM = (
    "lines arrive without a checksum, and what nothing protects is not used: switch it on with "
    "$VNWRG,30,0,0,0,0,1,0,1*69"
)

_ROWS = (
    ErrorCode(0x01, "hard fault", Remedy.RESET, "its processor restarted; RAM settings are gone"),
    ErrorCode(0x02, "serial input buffer overflow", Remedy.RETRY, "a line was over 256 bytes"),
    ErrorCode(0x03, "invalid checksum", Remedy.RETRY, "a byte was lost on the way to the device"),
    ErrorCode(0x04, "invalid command", Remedy.STOP, "this firmware does not know the command"),
    ErrorCode(0x05, "not enough parameters", Remedy.STOP, "this firmware expects more values"),
    ErrorCode(0x06, "too many parameters", Remedy.STOP, "this firmware expects fewer values"),
    ErrorCode(0x07, "invalid parameter", Remedy.STOP, "a value is out of the allowed range"),
    ErrorCode(0x08, "invalid register", Remedy.STOP, "this model or firmware lacks the register"),
    ErrorCode(0x09, "unauthorized access", Remedy.STOP, "the register is read-only"),
    ErrorCode(0x0A, "watchdog reset", Remedy.RESET, "the device restarted; RAM settings are gone"),
    ErrorCode(0x0B, "output buffer overflow", Remedy.BANDWIDTH, "lower rates or raise the baud"),
    ErrorCode(0x0C, "insufficient baud rate", Remedy.BANDWIDTH, "lower rates or raise the baud"),
    ErrorCode(0xFF, "error buffer overflow", Remedy.STOP, "errors came faster than it reports"),
)
ERRORS: dict[int, ErrorCode] = {row.code: row for row in _ROWS}
_CODE = re.compile(r"[0-9A-Fa-f]{1,2}")
_BY_NAME = {row.name.replace(" ", ""): row.code for row in _ROWS}
_BY_NAME["serialbufferoverflow"] = 0x02  # the manual's name


def code_of(tokens: Sequence[str]) -> int | None:
    """The code of what follows VNERR: in hexadecimal, or the error's name as a text; else None."""
    if not tokens:
        return None
    if _CODE.fullmatch(tokens[0]):
        return int(tokens[0], 16)
    return _BY_NAME.get(_letters("".join(tokens)))


def _letters(text: str) -> str:
    return "".join(character for character in text.lower() if character.isalpha())


def device_error(code: int) -> ErrorCode:
    """The row of `code`; codes that no manual lists get one that says so."""
    advice = "no manual lists this code; nothing was confirmed"
    return ERRORS.get(code) or ErrorCode(code, "unknown error", Remedy.STOP, advice)


class DriverError(Exception):
    """Root of everything that the VN-100 driver raises about the device and the link."""


class DeviceRefused(DriverError):
    """The device answered ``$VNERR,code``; `error` is the table's row, `to` the command."""

    def __init__(self, code: int, to: object = None) -> None:
        self.code = code
        self.error = device_error(code)
        where = "" if to is None else f"{to}: "
        super().__init__(
            f"{where}the device answered error {code:02X} ({self.error.name}): {self.error.advice}"
        )
