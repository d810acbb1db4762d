"""Counts in English, in the lines that a person reads."""

from ahrsd.counting import counted


def test_one_is_singular_and_nothing_else_is():
    assert [counted(n, "sample") for n in (0, 1, 2)] == ["0 samples", "1 sample", "2 samples"]
