"""What rings for a second or two, again and again: bursts without a mean."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.data_quality.facts import spans_of
from ahrsd.diagnosis.rules.ringing import ringing_rows

TIMES_S = np.array([21.0, 62.0, 85.5, 120.0, 171.0, 203.0])


def rung(time_s: np.ndarray) -> np.ndarray:
    """(N,) swings at 0.8 Hz that die down within some seconds."""
    since = time_s[:, None] - TIMES_S
    swing = np.exp(-np.maximum(since, 0.0) / 1.5) * np.cos(2 * np.pi * 0.8 * since)
    return np.where(since > 0, swing, 0.0).sum(axis=1)


def test_a_swing_is_loud_and_noise_that_is_louder_slower_or_wilder_is_not() -> None:
    rng = np.random.default_rng(2)
    left = rng.standard_normal((2400, 3))
    assert not ringing_rows(left, 10.0).any()
    noisy = left.copy()
    noisy[600:640] *= 8.0
    noisy[1400:1500] *= 4.0
    assert len(spans_of(ringing_rows(noisy, 10.0), 10)) < 2
    assert not ringing_rows(rng.standard_t(3, (2400, 3)), 10.0).any()
    slow = np.zeros((2400, 3))
    for k in range(1, 2400):
        slow[k] = 0.9 * slow[k - 1] + 0.3 * left[k]
    assert not ringing_rows(left + slow, 10.0).any()
    swung = left + np.outer(rung(0.1 * np.arange(2400)), [6.0, -5.0, 2.0])
    found = spans_of(ringing_rows(swung, 10.0), 10)
    assert len(found) == len(TIMES_S)
    assert np.abs(np.array(found)[:, 0] / 10.0 - TIMES_S).max() < 1.5
