"""Three steps along one line are the levels of one source that nobody logged."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.diagnosis.rules import levels, unknown
from ahrsd.diagnosis.rules.levels import without_levels

ALONG = np.array([-2.6, 1.6, 1.2])


def state_of(*steps: tuple[str, np.ndarray]) -> SimpleNamespace:
    terms = [SimpleNamespace(value=value) for _, value in steps]
    return SimpleNamespace(
        names=tuple(name for name, _ in steps),
        fit=SimpleNamespace(terms=terms),
        problem=SimpleNamespace(limits=None),
    )


def named(name: str, *values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    return [(name, value) for value in values]


IRON = named("hard_iron_step", ALONG, -1.2 * ALONG, 0.7 * ALONG)


@pytest.mark.parametrize(
    ("steps", "left", "gone"),
    [
        (IRON, True, [0, 1, 2]),
        ([("gyro_scale", np.ones(3)), *IRON], True, [1, 2, 3]),
        (IRON, False, None),  # nothing would be told of what they were
        (IRON[:2], True, None),  # put on and taken off
        (named("hard_iron_step", *np.eye(3)), True, None),
        (named("soft_iron_step", ALONG, ALONG, ALONG), True, None),
        ([*IRON[:2], ("field_step", ALONG)], True, None),
    ],
)
def test_steps_along_one_line_are_one_unknown(monkeypatch, steps, left, gone) -> None:
    taken = []
    rest = SimpleNamespace()

    def dropped(_state, _surveys, which, _left):
        taken.append(which)
        return "slim", ["without"], rest

    monkeypatch.setattr(levels, "dropped", dropped)
    monkeypatch.setattr(levels, "formed_basis_of", lambda _: None)
    monkeypatch.setattr(levels, "framed", lambda _, one, __: one)
    monkeypatch.setattr(unknown, "detected", lambda *_: left)
    state, given = state_of(*steps), SimpleNamespace()
    found = without_levels(state, ["with"], given)
    if gone is None:
        assert found == (state, ["with"], given)
    else:
        assert found == ("slim", ["without"], rest)
        assert taken == [gone]
