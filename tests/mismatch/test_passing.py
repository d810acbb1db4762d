"""Names of what is passed by that are parts of a source that switches."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ahrsd.mismatch import passing
from ahrsd.mismatch.limits import LIMITS
from ahrsd.mismatch.passing import without_passing
from ahrsd.mismatch.rivals import MORE_NATS

SETTINGS = {"switched_device": {"covariate": "lamp_on"}}


def remainder(nats: float, *, one_source: bool = True) -> SimpleNamespace:
    quick = SimpleNamespace(frame="sensor", evidence=nats, p_value=1e-5)
    return SimpleNamespace(
        strongest=quick, quick={"sensor": quick}, one_source=one_source, bins=(), stood_in=None
    )


def state_of(*names: tuple[str, float]) -> SimpleNamespace:
    judged = [
        SimpleNamespace(
            candidate=SimpleNamespace(
                name=name, setting=SETTINGS.get(name, {}), effect=SimpleNamespace(family="world")
            ),
            evidence=nats,
            what=SimpleNamespace(effective_blocks=8.0),
        )
        for name, nats in names
    ]
    return SimpleNamespace(
        names=tuple(name for name, _ in names),
        named=tuple(judged),
        problem=SimpleNamespace(limits=LIMITS),
    )


TWO = (("field_anomaly", 31.7), ("field_anomaly", 27.7))


@pytest.mark.parametrize(
    ("names", "left", "alone", "gone"),
    [
        # 59.4 nats of bumps and 6.6 of the rest, for 119.8 of a current that is on now and then
        (TWO, remainder(6.6), remainder(119.8), [0, 1]),
        (TWO, remainder(6.6), remainder(66.0 + MORE_NATS + 0.1), [0, 1]),
        (TWO, remainder(6.6), remainder(66.0 + MORE_NATS - 0.1), []),
        (TWO, remainder(6.6), remainder(119.8, one_source=False), []),
        (TWO, remainder(6.6, one_source=False), remainder(119.8), []),
        ((("mag_scale", 59.4),), remainder(6.6), remainder(119.8), []),
        ((("mag_scale", 59.4), *TWO), remainder(6.6), remainder(119.8), [1, 2]),
        # a speed that nobody logged: 15.5 of a step and 13.1 of the rest, for 39.6
        ((("hard_iron_step", 15.5),), remainder(13.1), remainder(39.6), [0]),
        ((("hard_iron_step", 115.5),), remainder(13.1), remainder(129.6), []),
        # what is logged is no part of what is not
        ((("switched_device", 15.5),), remainder(13.1), remainder(39.6), []),
    ],
)
def test_courses_beside_a_quick_source(monkeypatch, names, left, alone, gone) -> None:
    taken: list[int] = []

    def dropped(state, surveys, terms, rest):
        taken.extend(terms)
        return SimpleNamespace(), ["without"], rest

    monkeypatch.setattr(passing, "dropped", dropped)
    monkeypatch.setattr(passing, "formed_basis_of", lambda state: None)
    monkeypatch.setattr(passing, "framed", lambda *_: alone)
    state = state_of(*names)
    after, surveys, rest = without_passing(state, ["with"], left)
    if gone:
        assert (taken, surveys) == (gone, ["without"])
        assert rest is alone
    else:
        assert (after, surveys) == (state, ["with"])
        assert rest is left
