"""Counts in English."""

from __future__ import annotations


def counted(number: int, thing: str) -> str:
    """`1 sample`, `2 samples`; of a thing whose plural is its name with an s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
