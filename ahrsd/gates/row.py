"""A row of the gates' table.

`value` is the path of a number or of a yes/no in Evidence (yes = 1), `limit` the name of a limit in
GateLimits or a number. In `advice`, {v} is the value, {l} the limit, {e} the whole evidence.
`applies` names a property of Evidence; where it is false, the row does not exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """What a row guards; each level needs those below it. UNATTENDED: to write without a person."""

    CANDIDATE = 0
    RAM = 1
    FLASH = 2
    UNATTENDED = 3


@dataclass(frozen=True, slots=True)
class Gate:
    """One row. `code`: the gate's family, G0 to G12."""

    gate: str
    code: str
    value: str
    unit: str
    limit: str | float
    at_most: bool
    level: Level
    meaning: str
    advice: str
    missing: str = "this could not be measured"
    applies: str = ""


def most(
    gate: str, code: str, value: str, unit: str, limit: str | float, level: Level, **words: str
) -> Gate:
    """A row that holds up to its limit."""
    return Gate(gate, code, value, unit, limit, at_most=True, level=level, **words)


def least(
    gate: str, code: str, value: str, unit: str, limit: str | float, level: Level, **words: str
) -> Gate:
    """A row that holds from its limit on."""
    return Gate(gate, code, value, unit, limit, at_most=False, level=level, **words)


def yes(gate: str, code: str, value: str, level: Level, **words: str) -> Gate:
    """A row that must be true."""
    return Gate(gate, code, value, "", 1.0, at_most=False, level=level, **words)


def no(gate: str, code: str, value: str, level: Level, **words: str) -> Gate:
    """A row that must be false."""
    return Gate(gate, code, value, "", 0.0, at_most=True, level=level, **words)
