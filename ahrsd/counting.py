"""Counts in English."""

from __future__ import annotations


def counted(number: int, thing: str, form: str = "") -> str:
    """`1 sample`, `2 samples`; of a thing whose plural is its name with an s.

    form: how the number is written, as in a format specification
    """
    return f"{number:{form}} {thing}" if number == 1 else f"{number:{form}} {thing}s"
