"""Names of the outside field that show for seconds, beside what comes and goes by itself."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import passing
from ahrsd.diagnosis.rules.name import LONELY_BLOCKS
from ahrsd.diagnosis.rules.passing import LIKELIER, without_passing


def remainder(frame: str, nats: float) -> SimpleNamespace:
    strongest = SimpleNamespace(frame=frame, evidence=nats, p_value=1e-9)
    return SimpleNamespace(strongest=strongest, bins=(), stood_in=None, one_source=False)


def state_of(family: str, nats: float, blocks: float) -> SimpleNamespace:
    candidate = SimpleNamespace(effect=SimpleNamespace(family=family))
    what = SimpleNamespace(effective_blocks=blocks)
    named = (SimpleNamespace(candidate=candidate, evidence=nats, what=what),)
    return SimpleNamespace(named=named, problem=SimpleNamespace(limits=LIMITS))


BRIEF, LONG = LONELY_BLOCKS - 0.1, LONELY_BLOCKS + 0.1


@pytest.mark.parametrize(
    ("state", "left", "bursts", "after", "gone"),
    [
        (state_of("world", 40.0, BRIEF), ("sensor", 30.0), 0.0, 60.0, True),
        (state_of("world", 30.0 * LIKELIER + 1, BRIEF), ("sensor", 30.0), 0.0, 60.0, False),
        (state_of("world", 40.0, LONG), ("sensor", 30.0), 0.0, 60.0, False),
        (state_of("sensor", 40.0, BRIEF), ("sensor", 30.0), 0.0, 60.0, False),
        # of the same frame, it is no part of another thing; nor of what is not there
        (state_of("world", 40.0, BRIEF), ("world", 30.0), 0.0, 60.0, False),
        (state_of("world", 10.0, BRIEF), ("sensor", 11.0), 0.0, 60.0, False),
        # without the name something must be left to be told of
        (state_of("world", 40.0, BRIEF), ("sensor", 30.0), 0.0, 5.0, False),
        # bursts have no frame's course, and are there whatever is left
        (state_of("world", 40.0, BRIEF), ("world", 5.0), 30.0, 5.0, True),
    ],
)
def test_what_is_passed_by_is_a_part_of_what_comes_and_goes(
    monkeypatch, state, left, bursts, after, gone
) -> None:
    slim, given, rest = SimpleNamespace(), remainder(*left), remainder("sensor", after)
    monkeypatch.setattr(passing, "dropped", lambda *_: (slim, ["without"], rest))
    monkeypatch.setattr(passing, "formed_basis_of", lambda _: None)
    monkeypatch.setattr(passing, "framed", lambda _, one, __: one)
    found = without_passing(state, ["with"], given, bursts)
    assert found == ((slim, ["without"], rest) if gone else (state, ["with"], given))
