"""Effects as a person asks for them: ID, ID=STRENGTH, ID=name=value,name=value.

STRENGTH is a multiple of the effect's typical size.  A name is a parameter (the others are then 0)
or a part of the setting (`onset_s`, `time_constant_s`, ...).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ahrsd.diagnosis.effects.effect import Effect, Readings, Setting
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term


@dataclass(frozen=True, slots=True)
class Request:
    """An effect that a person wants: its size as a multiple, or value by name."""

    effect: Effect
    strength: float = 1.0
    given: Mapping[str, str] = field(default_factory=dict)

    def term(self, readings: Readings) -> Term:
        """The effect's value and setting on those readings.

        Raises ValueError in one line for an unknown name, a value that does not fit, or readings
        that lack what the effect needs.
        """
        value, setting = self.effect.example(readings, self.strength)
        names = [parameter.name for parameter in self.effect.parameters]
        if any(name in names for name in self.given):
            value = np.zeros(len(names))
        for name, text in self.given.items():
            if name in names:
                value[names.index(name)] = _number(text, name, self.effect)
            elif name in setting:
                setting = {**setting, name: _alike(setting, name, text, self.effect)}
            else:
                known = ", ".join([*names, *setting])
                raise ValueError(f"{self.effect.identifier} has no {name}; it has {known}")
        return Term(self.effect.identifier, value, np.zeros(len(names)), setting)


def parse(text: str, library: Mapping[str, Effect] = EFFECTS) -> Request:
    """The request in the text.  ValueError in one line."""
    identifier, _, rest = text.partition("=")
    if identifier not in library:
        close = difflib.get_close_matches(identifier, library, n=1)
        hint = f"; is {close[0]} meant?" if close else "; docs/reference/effects.md lists them"
        raise ValueError(f"no effect {identifier!r}{hint}")
    effect, strength = library[identifier], 1.0
    given: dict[str, str] = {}
    for position, part in enumerate(rest.split(",") if rest else []):
        name, equals, value = part.partition("=")
        if equals:
            given[name.strip()] = value
        elif position == 0:
            strength = _number(part, "strength", effect)
        else:
            raise ValueError(f"{identifier}: {part!r} is neither a strength nor name=value")
    if strength < 0:
        raise ValueError(f"{identifier}: the strength {strength:g} is negative")
    return Request(effect, strength, given)


def _alike(setting: Setting, name: str, text: str, effect: Effect) -> object:
    """The text as the kind of value that the setting has there."""
    present = setting[name]
    if isinstance(present, str):
        return text
    if isinstance(present, bool) or not isinstance(present, int | float):
        raise ValueError(f"{effect.identifier}: {name} cannot be given here")
    number = _number(text, name, effect)
    return round(number) if isinstance(present, int) else number


def _number(text: str, name: str, effect: Effect) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{effect.identifier}: {name} is {text!r}, a number is needed")
    return number
