"""What is told of a recording that has one fault."""

from __future__ import annotations

from ahrsd.diagnosis.data_quality.facts import Fact


def only(facts: tuple[Fact, ...]) -> Fact:
    """The fact, where there is one."""
    assert len(facts) == 1, [fact.words for fact in facts]
    return facts[0]


def value(fact: Fact) -> float:
    """Its first number."""
    return fact.parameters[0].value
