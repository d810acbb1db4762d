"""Access to the single fact of a recording with one fault."""

from __future__ import annotations

from ahrsd.diagnosis.data_quality.facts import Fact


def only(facts: tuple[Fact, ...]) -> Fact:
    """The fact, if there is exactly one."""
    assert len(facts) == 1, [fact.words for fact in facts]
    return facts[0]


def value(fact: Fact) -> float:
    """The value of its first parameter."""
    return fact.parameters[0].value
