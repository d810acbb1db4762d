"""Noise that forgets within seconds: its law, and no unknown where it is all there is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.signal import lfilter

from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import exam
from ahrsd.diagnosis.rules.coloured import Coloured, Law, coloured
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.track import Track

RATE_HZ, COUNT = 10.0, 4000


def slow(rng: np.random.Generator, count: int, rate_hz: float, time_s: float) -> np.ndarray:
    """First-order noise (count, 3) of unit deviation."""
    keep = np.exp(-1.0 / (rate_hz * time_s))
    white = rng.standard_normal((count, 3)) * np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


def turning(count: int) -> np.ndarray:
    """Unit vectors (count, 3) that go around twice."""
    angle = np.linspace(0.0, 4 * np.pi, count)
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])


def test_the_law_of_slow_noise_is_found_without_its_lowest_frequencies() -> None:
    rng = np.random.default_rng(2)
    noise = 0.7 * rng.standard_normal((COUNT, 3)) + 0.6 * slow(rng, COUNT, RATE_HZ, 1.5)
    trend = 5.0 * np.sin(np.linspace(0.0, 6 * np.pi, COUNT))[:, None] * np.ones(3)
    found = coloured(noise + trend, turning(COUNT), RATE_HZ, 0.05)
    f = np.array([0.0, 0.05, 0.2, 1.0, 4.0])
    keep = np.exp(-1.0 / (RATE_HZ * 1.5))
    truth = 0.49 + 0.36 * (1 - keep**2) / np.abs(1 - keep * np.exp(-2j * np.pi * f / RATE_HZ)) ** 2
    for law in (found.along, found.across):
        assert law.power(f) / truth == pytest.approx(np.ones(5), abs=0.35)


def test_white_noise_has_no_slow_part() -> None:
    noise = np.random.default_rng(3).standard_normal((COUNT, 3))
    found = coloured(noise, turning(COUNT), RATE_HZ, 0.05)
    for law in (found.along, found.across):
        assert law.white == pytest.approx(1.0, abs=0.05)
        assert law.slow < 0.3


def test_whitened_noise_is_white_along_and_across() -> None:
    rng = np.random.default_rng(4)
    unit = turning(COUNT)
    noise = Coloured(Law(1.0, 40.0, 1.0), Law(0.5, 3.0, 0.3), unit, RATE_HZ)
    e = rng.standard_normal((COUNT, 3))
    part = np.sum(e * unit, axis=1, keepdims=True) * unit
    f = np.fft.rfftfreq(COUNT, 1 / RATE_HZ)

    def loud(values: np.ndarray, law: Law) -> np.ndarray:
        seen = np.fft.rfft(values, axis=0) * np.sqrt(law.power(f))[:, None]
        return np.fft.irfft(seen, n=COUNT, axis=0)

    left = noise.whitened(
        loud(np.sum(e * unit, axis=1, keepdims=True), noise.along) * unit
        + loud(e - part, noise.across)
    )
    assert np.mean(left**2) == pytest.approx(1.0, abs=0.05)
    many = np.stack([e, 2 * e], axis=2)
    assert noise.whitened(many)[:, :, 1] == pytest.approx(2 * noise.whitened(e))


@pytest.fixture(scope="module")
def quiet() -> Track:
    return replace(made(Trial(seed=8)).track, covariates={})


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_noise_that_forgets_in_two_seconds_is_no_unknown(quiet: Track, seed: int) -> None:
    noise = 5e-4 * slow(np.random.default_rng(seed), len(quiet), 25.0, 2.0)
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + noise))
    assert answer.findings == ()
    assert not answer.unexplained.detected


@pytest.mark.slow
def test_a_name_holds_beside_slow_noise_that_seen_as_white_would_be_a_rest() -> None:
    """Seen as white, what such noise leaves is a rest that no name of this size stands out of."""
    one = made(Trial(12, (("gyro_scale", 1.0),), samples=10_000, rate_hz=40.0, noise="red"))
    answer = diagnose(one.track)
    assert [found.effect for found in answer.findings] == ["gyro_scale"]
    assert not answer.unexplained.detected
    values = answer.findings[0].parameters
    z = [(v.value - t) / v.std for v, t in zip(values, one.truth[0][1], strict=True)]
    assert np.abs(z).max() < 3.0


@pytest.mark.parametrize(
    ("name", "nats", "is_noise"),
    [
        ("gyro_scale", 20.0, True),
        ("gyro_scale", 9.0, False),
        ("hard_iron_step", 20.0, False),  # sought at many moments
        ("hard_iron_step", 139.7, True),
        ("hysteresis", 20.0, False),  # half of any course looks so
    ],
)
def test_what_a_name_must_be_worth_beside_slow_noise(monkeypatch, name, nats, is_noise) -> None:
    setting = {"onset_s": 9.0} if name == "hard_iron_step" else {}
    candidate = SimpleNamespace(name=name, setting=setting)
    fit = SimpleNamespace(made={"rest": SimpleNamespace(nats=42.0, unknown=42.0)})
    problem = SimpleNamespace(limits=LIMITS)
    named = (SimpleNamespace(candidate=candidate),)
    state = SimpleNamespace(fit=fit, problem=problem, named=named, names=(name,))
    monkeypatch.setattr(exam, "lawful", lambda *_: None)
    monkeypatch.setattr(exam.unknown, "remainder", lambda *_, **__: None)
    monkeypatch.setattr(exam, "without_term", lambda *_: None)
    monkeypatch.setattr(exam, "evidence_of", lambda *_: nats)
    monkeypatch.setattr(exam, "discrepancy", lambda _: SimpleNamespace(nats=3.0))
    found = exam.rest_of(state, SimpleNamespace(colour=3.0))
    assert (found is None) is is_noise
