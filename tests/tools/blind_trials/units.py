"""Units of parameters: two tools may say milligauss and gauss, or degrees and radians."""

from __future__ import annotations

import math
import re

_FACTORS = {
    "mG": ("gauss", 1e-3),
    "milligauss": ("gauss", 1e-3),
    "G": ("gauss", 1.0),
    "nT": ("gauss", 1e-5),
    "uT": ("gauss", 1e-2),
    "deg": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "ms": ("s", 1e-3),
    "%": ("1", 1e-2),
    "": ("1", 1.0),
    "C": ("degC", 1.0),
    "K": ("degC", 1.0),
    "kelvin": ("degC", 1.0),
}


def normal(unit: str) -> tuple[tuple[str, ...], float]:
    """A unit as sorted factors with exponents, and the number that converts into it.

    `mG/(deg/s)` -> (("gauss^1", "rad^-1", "s^1"), 1e-3 * 180 / pi)
    """
    exponents: dict[str, int] = {}
    factor = 1.0
    for name, exponent in _factors(unit):
        base, scale = _FACTORS.get(name, (name, 1.0))
        factor *= scale**exponent
        if base != "1":
            exponents[base] = exponents.get(base, 0) + exponent
    return tuple(f"{name}^{n}" for name, n in sorted(exponents.items()) if n), factor


def _factors(unit: str) -> list[tuple[str, int]]:
    """(name, exponent) of everything in a unit; `/` acts on the next factor or bracket only."""
    out: list[tuple[str, int]] = []
    stack, sign = [1], 1
    for token in re.findall(r"[()/*·]|[A-Za-z%°1][A-Za-z%]*(?:\^?-?\d+)?", unit):
        if token == "(":
            stack.append(stack[-1] * sign)
            sign = 1
        elif token == ")":
            if len(stack) > 1:
                stack.pop()
            sign = 1
        elif token == "/":
            sign = -1
        elif token not in ("*", "·"):
            name, power = re.fullmatch(r"([^\d^-]+|1)\^?(-?\d+)?", token).groups()  # type: ignore[union-attr]
            if name != "1":
                out.append((name.lstrip("°"), stack[-1] * sign * int(power or 1)))
            sign = 1
    return out
