"""What a strong name leaves of its own form is no other name, and no unknown."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import own_form


def named(name: str, evidence: float, **setting: object) -> SimpleNamespace:
    candidate = SimpleNamespace(name=name, effect=EFFECTS[name], setting=setting)
    return SimpleNamespace(candidate=candidate, evidence=evidence)


def state_of(*names: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(named=names, problem=SimpleNamespace(limits=LIMITS))


@pytest.mark.parametrize(
    ("strong", "nats", "weak", "stays"),
    [
        ("hysteresis", 31_121.0, 76.0, False),  # play that is sampled misses its turning points
        ("hysteresis", 3_000.0, 76.0, True),
        ("mag_time_lag", 31_121.0, 76.0, True),
        ("hard_iron_step", 5e6, 76.0, True),  # a magnet; beside it a delay
        ("gyro_nonorthogonality", 1.3e6, 104.0, False),  # its second order
    ],
)
def test_a_trifle_beside_a_strong_name(monkeypatch, strong, nats, weak, stays) -> None:
    state = state_of(named(strong, 100.0), named("gyro_scale", weak))
    monkeypatch.setattr(own_form, "strengths", lambda _: [nats, weak])
    gone = []
    monkeypatch.setattr(
        own_form, "dropped", lambda s, u, k, left: (gone.extend(k), (s, u, left))[1]
    )
    monkeypatch.setattr(own_form.unknown, "beside_names", lambda left, *_: left)
    own_form.without_trifles(state, [], SimpleNamespace())
    assert gone == ([] if stays else [1])


def test_a_free_form_is_held_to_a_hundredth_of_the_strongest_name(monkeypatch) -> None:
    monkeypatch.setattr(own_form, "strengths", lambda s: [500.0] * len(s.named))
    state = state_of(named("gyro_scale", 500.0))
    assert own_form.price_of(state) == pytest.approx(0.5)
    assert own_form.free_price_of(state) == pytest.approx(5.0)
    assert own_form.free_price_of(state_of()) == 0.0
