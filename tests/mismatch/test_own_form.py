"""What a strong name leaves of its own form is no other name, and no unknown."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ahrsd.mismatch import many_names, own_form
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.limits import LIMITS


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


def remainder(evidence: float) -> SimpleNamespace:
    strongest = SimpleNamespace(evidence=evidence, p_value=1e-20, frame="world")
    return SimpleNamespace(strongest=strongest, bins=(), stood_in=None, one_source=False)


MANY = (
    named("viscous_magnetisation", 42.6),
    named("earth_rotation", 30.9),
    named("hysteresis", 10.8, radius_gauss=0.04),
)


@pytest.mark.parametrize(
    ("names", "source", "left", "one"),
    [
        (MANY, 63.2, -9.0, True),
        (MANY[:2], 63.2, -9.0, False),  # two effects are seen on vehicles
        (MANY, 40.0, -9.0, False),
        # beside a rest it must be likelier than all of them and the rest
        (MANY, 63.2, 30.0, False),
        (MANY[:1], 42.6 + 30.0 + 6.9, 30.0, False),
        (MANY[:1], 42.6 + 30.0 + 7.1, 30.0, True),
        ((), 80.0, 30.0, False),
        ((*MANY[:2], named("motor_current_field", 9.0, covariate="i")), 63.2, -9.0, False),
        ((*MANY[:2], named("hard_iron_step", 9.0, onset_s=9.0)), 63.2, -9.0, False),
    ],
)
def test_one_source_for_many_names(monkeypatch, names, source, left, one) -> None:
    found = remainder(source)
    monkeypatch.setattr(many_names, "refitted", replace_named)
    monkeypatch.setattr(many_names, "formed_basis_of", lambda s: s)
    monkeypatch.setattr(many_names.unknown, "remainder", lambda _: found)
    state, given = state_of(*names), remainder(left)
    slim, _, rest = many_names.one_for_many(state, [], given)
    assert (slim.named == () and rest is found) is one
    assert (slim is state and rest is given) is not one


def replace_named(state: SimpleNamespace, names: tuple) -> SimpleNamespace:
    return SimpleNamespace(named=names, problem=state.problem)
