"""One random effect, by the formula of a single coefficient."""

from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.diagnosis.rules import random_effect
from ahrsd.diagnosis.rules.random_effect import effect_nats


@pytest.mark.parametrize("colour", [0.8, 1.0, 4.0])
@pytest.mark.parametrize("z", [3.0, 6.0, 10.0])
def test_nats_of_a_single_coefficient(monkeypatch, colour, z) -> None:
    """(z^2 - 1 - ln z^2) / 2, of z standard deviations in noise that is no quieter than white.

    The marginal likelihood of a normal coefficient, at the prior deviation at which it is largest;
    and 0 where z is less than one.
    """
    monkeypatch.setattr(
        random_effect, "projected", lambda *_: (np.array([[50.0]]), np.array([z * np.sqrt(50.0)]))
    )
    square = z**2 / max(1.0, colour)
    expected = (square - 1 - np.log(square)) / 2
    found = effect_nats(SimpleNamespace(colour=colour), np.zeros((1, 3, 1)))
    assert found == pytest.approx(expected, abs=1e-3)


def test_what_is_less_than_noise_is_nothing(monkeypatch) -> None:
    given = np.array([[50.0]]), np.array([0.5 * np.sqrt(50.0)])
    monkeypatch.setattr(random_effect, "projected", lambda *_: given)
    found = effect_nats(SimpleNamespace(colour=1.0), np.zeros((1, 3, 1)))
    assert found == pytest.approx(0.0, abs=2e-3)
