"""What is left over and follows attitude, rate or time: seen, named, and in the sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pieces
import pytest
from scipy.signal import lfilter

from ahrsd.estimator import locked
from ahrsd.estimator.model_checks import ResidualComponent, widen_covariance
from ahrsd.estimator.online import WHOLE, Estimator

RICH = (("circles", 40.0), ("roll", 30.0), ("pitch", 30.0), ("circles", 40.0), ("roll", 30.0))
LEVEL = (("circles", 120.0), ("roll", 40.0))
SEEDS = range(700, 706)


def answer(made, more=0.0):
    """With this much more on the field, (n, 3) gauss."""
    estimator = Estimator(at_once=WHOLE)
    block = replace(made.block, raw_b_gauss=made.block.raw_b_gauss + more)
    for a in range(0, len(block), 400):
        estimator.add(block.part(slice(a, a + 400), gap_before=a == 0))
    return estimator.finish()


def by_attitude(made, seed, size_gauss):
    """Harmonics of degree 2 and 3, `size_gauss` on each axis over the sphere."""
    draw = np.random.default_rng(seed).normal(size=(12, 3))
    draw *= size_gauss * np.sqrt(3.0) / np.linalg.norm(draw)
    return locked.harmonics(made.field_b_gauss) @ draw


def by_rate(made, seed, size_gauss):
    """The field by the rate, `size_gauss` in all."""
    more = made.rate_b_rad_s @ np.random.default_rng(seed).normal(size=(3, 3))
    return more * size_gauss / np.std(more)


def by_time(made, seed, size_gauss):
    """A hard iron that goes away and comes back, once and a half, `size_gauss` in all."""
    course = locked.cosine_modes(made.block.time_s, 3)[:, 2:]
    way = np.random.default_rng(seed).normal(size=3)
    return size_gauss * np.sqrt(3.0) * course * way / np.linalg.norm(way)


def beyond(made, found):
    """Largest error of any number, in its sigmas."""
    return float(np.max(np.abs(made.errors(found) / found.sigma)))


def named_mg(found):
    """What the answer's only warning says: what is followed, and the size in mG."""
    (text,) = found.warnings
    head, tail = text.split(": ")
    assert tail.endswith(" mG; run `ahrsd diagnose` on the recording")
    return head, float(tail.split()[0])


@pytest.mark.parametrize(
    ("trouble", "follows", "motion"),
    [
        pytest.param(trouble, follows, motion, marks=() if quick else pytest.mark.slow)
        for trouble, follows in (
            (by_attitude, "the attitude"), (by_rate, "the rate of turn"), (by_time, "the time")
        )
        for motion, quick in ((LEVEL, True), (RICH, trouble is by_attitude))
    ],
)  # fmt: skip
def test_what_is_left_is_named_and_within_the_sigmas(motion, trouble, follows):
    """A milligauss; what passes for iron of it is not seen."""
    for seed in SEEDS[:3]:
        made = pieces.drive(motion, seed)
        found = answer(made, trouble(made, seed, 1e-3))
        what, size_mg = named_mg(found)
        assert what == f"the residual follows {follows}"
        assert 0.15 < size_mg < 2.0
        assert beyond(made, found) < 3.5


@pytest.mark.parametrize(
    "motion", [pytest.param(RICH, marks=pytest.mark.slow), LEVEL], ids=["rich", "level"]
)
def test_a_little_that_follows_the_attitude_holds_the_gate_for_flash(motion):
    """Half of the magnetometer's noise: it makes more of the heading than may be saved."""
    for seed in SEEDS:
        made = pieces.drive(motion, seed)
        found = answer(made, by_attitude(made, seed, 5e-4))
        assert found.place_deg > 0.1
        assert beyond(made, found) < 3.5


@pytest.mark.parametrize(
    "motion", [pytest.param(RICH, marks=pytest.mark.slow), LEVEL], ids=["rich", "level"]
)
def test_nothing_is_named_where_nothing_is_left(motion):
    for seed in SEEDS:
        found = answer(pieces.drive(motion, seed))
        assert found.warnings == ()
        assert found.place_deg < 0.05


def test_noise_that_is_slow_follows_nothing():
    """Forgotten after two seconds and as large as the white noise: no visit is like the other."""
    for seed in SEEDS:
        made = pieces.drive(RICH, seed)
        kept = np.exp(-1.0 / (40.0 * 2.0))
        white = np.random.default_rng(seed).normal(size=made.field_b_gauss.shape)
        slow = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], white, axis=0)
        assert answer(made, pieces.MAG_GAUSS * slow).warnings == ()


def test_a_stream_names_it_as_a_recording_does():
    made = pieces.drive(RICH, 700)
    block = made.block
    block = replace(block, raw_b_gauss=block.raw_b_gauss + by_attitude(made, 700, 1e-3))
    estimator, said = Estimator(), []
    for a in range(0, len(block), 400):
        if estimator.add(block.part(slice(a, a + 400), gap_before=a == 0)):
            found = estimator.estimate()
            said.append(bool(found.warnings))
    assert said[-1]
    assert not any(said[:2])  # of directions that were seen once nobody can tell
    assert named_mg(estimator.finish())[0] == "the residual follows the attitude"


def test_an_answer_is_no_less_wide_than_what_is_left_makes_it():
    """By hand: what misfit makes already counts, and what is more is added."""
    plain, tempered = np.eye(12), 3.0 * np.eye(12)
    added = np.diag([*[1.0] * 6, *[7.0] * 6])
    left = ResidualComponent("attitude", 20.0, 1e-3, added)
    wider = widen_covariance(tempered, plain, left)
    np.testing.assert_allclose(wider, np.diag([*[3.0] * 6, *[8.0] * 6]), atol=1e-12)
    assert widen_covariance(tempered, plain, None) is tempered
    assert left.words == (
        "the residual follows the attitude: 1 mG; run `ahrsd diagnose` on the recording"
    )
    assert replace(left, nats=11.0).words == ""


def test_columns_by_hand():
    change = np.array([[0.1, -0.2, 0.3]])
    by_change = locked.change_columns(change)[0]
    np.testing.assert_allclose(by_change[:, 0], [0.1, 0.0, -0.3])  # xx - zz
    np.testing.assert_allclose(by_change[:, 2], [-0.2, 0.1, 0.0])  # xy
    turn = np.array([1.0, 2.0, 3.0])
    turned = np.cross(turn, change[0])
    np.testing.assert_allclose(by_change[:, 5:] @ turn, turned, atol=1e-12)
    each = locked.on_each_axis(np.array([[2.0, 5.0]]))[0]
    np.testing.assert_allclose(each, [[2, 0, 0, 5, 0, 0], [0, 2, 0, 0, 5, 0], [0, 0, 2, 0, 0, 5]])
    cosines = locked.cosine_modes(np.linspace(3.0, 9.0, 2001), 3)
    np.testing.assert_allclose(cosines.T @ cosines / 2001, np.eye(3), atol=2e-3)
    np.testing.assert_allclose(cosines[0], np.sqrt(2.0))
