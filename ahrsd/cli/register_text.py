"""A register's values for a person: by the names of the fields, in short numbers, with units.

23  Magnetometer Calibration
    c [1 0 0; 0 1 0; 0 0 1]  b [0.12 -0.08 0.06] gauss
75  Binary Output Register 1
    async_mode 3  rate_divisor 40  groups 29  field_word [7FFF 0210 000C]
"""

from __future__ import annotations

import re
from itertools import groupby

from drivers.vn100.register_codec import Register, RegisterField, Value
from drivers.vn100.registers import REGISTERS, Values

_PLACE = re.compile(r"(_[xyznedw]|_?[0-9]{1,2})$")  # of a value in its vector or matrix
_MATRIX, _ROW = 9, 3
_DIGITS = {"f32": 6, "f64": 9}  # 6 are all that the device prints of an f32


def described(number: int, values: Values) -> str:
    """The values on one line."""
    register = REGISTERS[number]
    if register.opaque:
        return " ".join(map(str, values)) + "  (fields are not documented)"
    pairs = list(zip(_fields(register, len(values)), values, strict=False))
    parts = []
    for (name, unit), group in groupby(pairs, key=lambda pair: (_stem(pair[0]), pair[0].unit)):
        texts = [_short(field, value) for field, value in group]
        text = texts[0] if len(texts) == 1 else f"[{_rows(texts)}]"
        parts.append(" ".join(part for part in (name, text, unit) if part))
    return "  ".join(parts)


def _fields(register: Register, count: int) -> list[RegisterField]:
    fields = list(register.fields)
    return fields + fields[-1:] * (count - len(fields)) if register.repeated else fields


def _stem(field: RegisterField) -> str:
    return _PLACE.sub("", field.name)


def _rows(texts: list[str]) -> str:
    """A matrix has its rows apart."""
    step = _ROW if len(texts) == _MATRIX else len(texts)
    return "; ".join(" ".join(texts[at : at + step]) for at in range(0, len(texts), step))


def _short(field: RegisterField, value: Value) -> str:
    if isinstance(value, str):
        return value or '""'
    if field.kind.startswith("hex"):
        return f"{int(value):0{2 if field.kind == 'hex8' else 4}X}"
    return f"{value:.{_DIGITS[field.kind]}g}" if field.kind in _DIGITS else str(value)
