"""The test of a single direction: silent on noise of any colour, loud on one source."""

from __future__ import annotations

import numpy as np

from ahrsd.mismatch.one_source import ALONG, along_field, sphericity, whitened_scores


def test_noise_has_no_direction_however_coloured() -> None:
    rng = np.random.default_rng(3)
    p_values = np.array([sphericity(7.0 * rng.standard_normal((80, 3)))[1] for _ in range(400)])
    assert p_values.min() > 1e-4
    assert 0.4 < np.mean(p_values) < 0.6


def test_a_source_has_one() -> None:
    rng = np.random.default_rng(4)
    scores = rng.standard_normal((80, 3)) + np.outer(
        4.0 * rng.standard_normal(80), [0.6, 0.0, -0.8]
    )
    nats, p_value, share = sphericity(scores)
    assert nats > 40.0
    assert p_value < 1e-12
    assert 0.8 < share < 1.0


def test_scores_are_made_white_by_their_own_information() -> None:
    rng = np.random.default_rng(5)
    count = 4000
    root = np.array([[3.0, 0.0, 0.0], [1.0, 0.2, 0.0], [0.5, 0.1, 5.0]])
    own = root @ root.T
    score = rng.standard_normal((count, 3)) @ root.T
    information = np.zeros((3 * 40, 3 * 40))
    for k in range(40):
        information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = own
    parts = [whitened_scores(information, score[k : k + 40].ravel()) for k in range(0, count, 40)]
    white = np.concatenate(parts)
    assert np.abs(white.T @ white / count - np.eye(3)).max() < 0.08


def test_slow_noise_along_a_steady_field_is_told_from_a_source() -> None:
    rng = np.random.default_rng(6)
    field = np.array([0.2, 0.0, 0.4]) + 0.02 * rng.standard_normal((500, 3))
    noise = rng.standard_normal((80, 3)) + np.outer(3 * rng.standard_normal(80), [0.45, 0.0, 0.89])
    source = rng.standard_normal((80, 3)) + np.outer(3 * rng.standard_normal(80), [0.0, 1.0, 0.0])
    assert along_field(field, noise) > 0.9
    assert along_field(field, source) < 0.1
    turning = rng.standard_normal((500, 3))
    assert along_field(turning, noise) < 0.4 < ALONG
