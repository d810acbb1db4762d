"""How one register's values look on the wire, both directions, from the row that describes it.

Sans I/O and without knowledge of any particular register: the rows are in `registers`. Numbers of
the manual's sections are those of the VN-100 user manual (UM001), command and register chapters.

The device stores a float as f32 and prints it like C's ``%G`` with 6 digits, so a value that was
sent comes back rounded twice. `same` knows that; nothing else may compare register values.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Value = float | int | str
Values = tuple[Value, ...]
Kind = Literal["u8", "u16", "u32", "f32", "f64", "hex8", "hex16", "string"]

MAX_COMMAND_BYTES = 256  # receive buffer of the device; a longer line is error 02
TOO_FEW, TOO_MANY, OUT_OF_RANGE = 0x05, 0x06, 0x07  # what the device itself would answer

_SMALLEST_USEFUL = 1e-12  # far below the f32 steps of anything a register holds in SI or gauss
_INTEGER = re.compile(r"[+-]?[0-9]{1,12}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_HEX = re.compile(r"[0-9A-Fa-f]{1,4}")
_TEXT = re.compile(r"[ -#%-)+\-./0-~]*")  # printable, without $ * and comma
_LARGEST: dict[str, int] = {
    "u8": 0xFF,
    "u16": 0xFFFF,
    "u32": 0xFFFF_FFFF,
    "hex8": 0xFFFF,  # two digits at least; other models announce a second group byte
    "hex16": 0xFFFF,
}


class RegisterValueError(ValueError):
    """Values that a register cannot take; `code` is the VNERR code that the device would give."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class RegisterField:
    """One value of a register.

    minimum, maximum: inclusive, None where only the kind limits it; for a string the most
                      characters. allowed: the only values, where they are not a range.
    optional: may be absent at the end (the port of registers 5 to 7).
    printed:  C format of a reply where it is not the plain integer or ``%G``.
    """

    name: str
    kind: Kind
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    allowed: tuple[int, ...] = ()
    optional: bool = False
    printed: str = ""


@dataclass(frozen=True, slots=True)
class Register:
    """A row of the register map: wire order, units, permission, factory values, source.

    defaults:    factory values by firmware generation; absent where each unit has its own
    generations: firmware generations (2, 3) that have the register
    repeated:    the last field repeats, as often as the values in front of it say (75 to 77)
    opaque:      the manual does not print the fields: read as text, never written
    keep_off:    why this must not be written although the device would accept it
    unconfirmed: what of the row rests on one source; empty where two agree
    check:       what the values must fulfil together; raises RegisterValueError
    """

    id: int
    name: str
    access: Literal["R", "RW"]
    fields: tuple[RegisterField, ...]
    section: str
    defaults: Mapping[int, Values] = field(default_factory=dict)
    generations: tuple[int, ...] = (2, 3)
    repeated: bool = False
    opaque: bool = False
    keep_off: str = ""
    unconfirmed: str = ""
    check: Callable[[Values], None] | None = None

    @property
    def writable(self) -> bool:
        """True where this program may write the register at all."""
        return self.access == "RW" and not self.opaque and not self.keep_off


def parse_values(register: Register, tokens: Sequence[str]) -> Values:
    """The values that `tokens` (what follows the register number) spell.

    Ranges are not checked: what a device reports is a fact, even if the manual does not know it.
    Raises RegisterValueError, naming register, field and token.
    """
    if register.opaque:
        return tuple(tokens)
    if not tokens and register.fields[0].kind == "string":
        tokens = ("",)  # an empty tag is printed without its comma by some firmware
    fields = _fields_for(register, len(tokens))
    return tuple(_parse(register, f, token) for f, token in zip(fields, tokens, strict=True))


def check_values(register: Register, values: Values) -> None:
    """Raises RegisterValueError where the device would refuse `values`, with its error code."""
    if register.opaque:
        return
    fields = _fields_for(register, len(values))
    for f, value in zip(fields, values, strict=True):
        _check_field(register, f, value)
    if register.check is not None:
        register.check(values)


def command_text(register: Register, values: Values, *, held: bool = False) -> str:
    """``NN,value,...`` as a write sends it: fixed point, shortest digits that give the same f32.

    held: the device itself held the values, so ranges are not checked.
    Raises RegisterValueError where the register may not be written, where the values do not fit it
    or where the line would overrun the device's receive buffer (see `as_stored_values`).
    """
    if not register.writable:
        reason = register.keep_off or (
            "its fields are not documented" if register.opaque else "it is read only"
        )
        raise RegisterValueError(f"register {register.id} is never written: {reason}", 0x09)
    fields = _fields_for(register, len(values))
    if not held:
        check_values(register, values)
    for f, value in zip(fields, values, strict=True):
        if f.kind != "string":
            _number(f"register {register.id}, {f.name}", f, value)
    texts = [_command_value(f, value) for f, value in zip(fields, values, strict=True)]
    text = ",".join([f"{register.id:02d}", *texts])
    length = len(f"$VNWRG,{text}*XX\r\n")
    if length > MAX_COMMAND_BYTES:
        raise RegisterValueError(
            f"register {register.id}: the command would have {length} bytes, the device accepts "
            f"{MAX_COMMAND_BYTES}; round the values first (as_stored)",
            0x02,
        )
    return text


def reply_text(register: Register, values: Values) -> str:
    """``NN,value,...`` as the device prints it in a reply to a read or a write."""
    fields = register.fields
    if not register.opaque:
        fields = _fields_for(register, len(values))
        texts = [_reply_value(f, value) for f, value in zip(fields, values, strict=True)]
    else:
        texts = [str(value) for value in values]
    return ",".join([f"{register.id:02d}", *texts])


def same_values(register: Register, sent: Values, read_back: Values) -> bool:
    """True where a device that stored `sent` prints `read_back`.

    A float is equal where it equals the stored f32 or what ``%G`` leaves of it (6 digits, about
    5e-6 relative: all that a read-back can confirm). NaN equals nothing.
    """
    if len(sent) != len(read_back):
        return False
    if register.opaque:
        return sent == read_back
    fields = _fields_for(register, len(sent))
    return all(_same(f, s, r) for f, s, r in zip(fields, sent, read_back, strict=True))


def as_stored_values(register: Register, values: Values) -> Values:
    """`values` as the device will hold them: f32, and below 1e-12 zero.

    Numerical dust such as 3e-17 in a matrix would need more digits than the receive buffer has.
    Use it before a write, and show a person these numbers. Raises RegisterValueError.
    """
    fields = _fields_for(register, len(values))
    return tuple(
        _f32(register, f, value) if f.kind == "f32" else value
        for f, value in zip(fields, values, strict=True)
    )


def float32(value: float) -> float:
    """The f32 nearest to `value`, infinity where it has none."""
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return rounded


def _fields_for(register: Register, count: int) -> tuple[RegisterField, ...]:
    """The fields that `count` values belong to, or RegisterValueError."""
    fields = register.fields
    if register.repeated:
        fields = fields[:-1] + fields[-1:] * max(0, count - len(fields) + 1)
    least = sum(not f.optional for f in fields)
    if count < least:
        missing = fields[count].name
        raise RegisterValueError(
            f"register {register.id}: {count} values, at least {least} needed ({missing} missing)",
            TOO_FEW,
        )
    if count > len(fields):
        raise RegisterValueError(
            f"register {register.id}: {count} values, at most {len(fields)} possible", TOO_MANY
        )
    return fields[:count]


def _parse(register: Register, f: RegisterField, token: str) -> Value:
    pattern = {"f32": _NUMBER, "f64": _NUMBER, "hex8": _HEX, "hex16": _HEX, "string": _TEXT}.get(
        f.kind, _INTEGER
    )
    if pattern.fullmatch(token):
        if f.kind == "string":
            return token
        if f.kind in ("f32", "f64"):
            number = float(token)
            if math.isfinite(number):
                return number
        else:
            integer = int(token, 16 if f.kind.startswith("hex") else 10)
            if 0 <= integer <= _LARGEST[f.kind]:
                return integer
    raise RegisterValueError(
        f"register {register.id}, {f.name}: {token!r} is no {f.kind}", OUT_OF_RANGE
    )


def _check_field(register: Register, f: RegisterField, value: Value) -> None:
    where = f"register {register.id}, {f.name}"
    if f.kind == "string":
        longest = int(f.maximum or 0)
        if not isinstance(value, str) or not _TEXT.fullmatch(value) or len(value) > longest:
            raise RegisterValueError(
                f"{where}: {value!r} is no text of at most {longest} printable characters "
                "without '$', '*' and ','",
                OUT_OF_RANGE,
            )
        return
    number = _number(where, f, value)
    low = f.minimum if f.minimum is not None else -math.inf
    high = f.maximum if f.maximum is not None else math.inf
    if not low <= number <= high:
        raise RegisterValueError(f"{where}: {number} is not in {low}..{high}", OUT_OF_RANGE)
    if f.allowed and number not in f.allowed:
        raise RegisterValueError(f"{where}: {number} is not one of {f.allowed}", OUT_OF_RANGE)


def _number(where: str, f: RegisterField, value: Value) -> float:
    """`value` as the number that its kind can hold, or RegisterValueError."""
    if isinstance(value, str) or not math.isfinite(value):
        raise RegisterValueError(f"{where}: {value!r} is no finite number", OUT_OF_RANGE)
    if f.kind in ("f32", "f64"):
        if f.kind == "f32" and not math.isfinite(float32(value)):
            raise RegisterValueError(f"{where}: {value!r} does not fit an f32", OUT_OF_RANGE)
        return value
    if value != int(value) or not 0 <= value <= _LARGEST[f.kind]:
        raise RegisterValueError(f"{where}: {value!r} is no {f.kind}", OUT_OF_RANGE)
    return int(value)


def _command_value(f: RegisterField, value: Value) -> str:
    if isinstance(value, str):
        return value
    if f.kind == "f32":  # + 0.0: never "-0"
        return np.format_float_positional(np.float32(value) + np.float32(0.0), trim="-")
    if f.kind == "f64":
        return np.format_float_positional(np.float64(value) + 0.0, trim="-")
    return _reply_value(f, value)


def _reply_value(f: RegisterField, value: Value) -> str:
    if isinstance(value, str):
        return value
    if f.kind in ("f32", "f64"):
        return (f.printed or "%G") % (float32(value) if f.kind == "f32" else value)
    if f.kind.startswith("hex"):
        return f"{int(value):0{2 if f.kind == 'hex8' else 4}X}"
    return (f.printed or "%d") % int(value)


def _same(f: RegisterField, sent: Value, read_back: Value) -> bool:
    if isinstance(sent, str) or isinstance(read_back, str):
        return sent == read_back
    if f.kind not in ("f32", "f64"):
        return sent == read_back
    if not (math.isfinite(sent) and math.isfinite(read_back)):
        return False
    printed = float(_reply_value(f, sent))
    if f.kind == "f64":
        return read_back in (printed, sent)
    return float32(read_back) in (float32(printed), float32(sent))


def _f32(register: Register, f: RegisterField, value: Value) -> float:
    number = float32(_number(f"register {register.id}, {f.name}", f, value))
    return 0.0 if abs(number) < _SMALLEST_USEFUL else number
