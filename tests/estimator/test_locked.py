"""Residuals that follow attitude, rate or time are found, named, and included in the sigmas."""

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
    """Estimate with this field (n, 3) gauss added."""
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
    """A field proportional to the rate, of size `size_gauss`."""
    more = made.rate_b_rad_s @ np.random.default_rng(seed).normal(size=(3, 3))
    return more * size_gauss / np.std(more)


def by_time(made, seed, size_gauss):
    """A hard iron that disappears and returns, one and a half times, of size `size_gauss`."""
    course = locked.cosine_modes(made.block.time_s, 3)[:, 2:]
    way = np.random.default_rng(seed).normal(size=3)
    return size_gauss * np.sqrt(3.0) * course * way / np.linalg.norm(way)


def beyond(made, found):
    """Largest error of any parameter in units of its sigma."""
    return float(np.max(np.abs(made.errors(found) / found.sigma)))


def named_mg(found):
    """Cause and size in mG from the only warning of the estimate."""
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
def test_remaining_residual_is_named_and_errors_are_within_the_sigmas(motion, trouble, follows):
    """One milligauss. The part that looks like iron is not seen."""
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
def test_small_residual_by_attitude_closes_the_flash_gate(motion):
    """Half of the magnetometer's noise: its effect on the heading is more than may be saved."""
    for seed in SEEDS:
        made = pieces.drive(motion, seed)
        found = answer(made, by_attitude(made, seed, 5e-4))
        assert found.place_deg > 0.1
        assert beyond(made, found) < 3.5


@pytest.mark.parametrize(
    "motion", [pytest.param(RICH, marks=pytest.mark.slow), LEVEL], ids=["rich", "level"]
)
def test_no_residual_is_named_when_there_is_none(motion):
    for seed in SEEDS:
        found = answer(pieces.drive(motion, seed))
        assert found.warnings == ()
        assert found.place_deg < 0.05


def test_slow_noise_is_not_named_as_a_residual():
    """Correlated over two seconds and as large as the white noise: it differs at each visit of
    an attitude.
    """
    for seed in SEEDS:
        made = pieces.drive(RICH, seed)
        kept = np.exp(-1.0 / (40.0 * 2.0))
        white = np.random.default_rng(seed).normal(size=made.field_b_gauss.shape)
        slow = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], white, axis=0)
        assert answer(made, pieces.MAG_GAUSS * slow).warnings == ()


def test_stream_and_recording_name_the_same_residual():
    made = pieces.drive(RICH, 700)
    block = made.block
    block = replace(block, raw_b_gauss=block.raw_b_gauss + by_attitude(made, 700, 1e-3))
    estimator, said = Estimator(), []
    for a in range(0, len(block), 400):
        if estimator.add(block.part(slice(a, a + 400), gap_before=a == 0)):
            found = estimator.estimate()
            said.append(bool(found.warnings))
    assert said[-1]
    assert not any(said[:2])  # not decidable for directions that were seen only once
    assert named_mg(estimator.finish())[0] == "the residual follows the attitude"


def test_covariance_is_widened_to_the_effect_of_the_residual():
    """A small example: the effect of the misfit counts already, and only the excess is added."""
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


def test_residual_columns_in_a_small_example():
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
