"""Answers where the instrument is not the model's: sigmas that hold, at little price where it is.

The trouble is put into the gyro's readings, so iron and bias of the truth stay.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pieces
import pytest
from scipy.signal import lfilter

from ahrsd import so3
from ahrsd.diagnosis.priors import ORDINARY
from ahrsd.estimator.epoch import add_bias_drift
from ahrsd.estimator.online import (
    WHOLE,
    Estimator,
    HeadingAdvice,
    misalignment_heading_deg,
    motion_and_misfit,
)
from ahrsd.estimator.parameters import (
    AS_SPECIFIED,
    ASSEMBLED,
    PLACES,
    EstimatorParameters,
    possible_instruments,
)
from ahrsd.montecarlo import nuisances
from ahrsd.montecarlo.cramer_rao import Trajectory
from ahrsd.simulation import ScenarioSettings, simulate

#: rolls, pitches and turns at once, as a diver does
RICH = (("circles", 40.0), ("roll", 30.0), ("pitch", 30.0), ("circles", 40.0), ("roll", 30.0))
LEVEL = (("circles", 120.0), ("roll", 40.0))


def answer(made, gyro=None, parameters=None):
    estimator = Estimator(parameters, at_once=WHOLE)
    block = made.block if gyro is None else replace(made.block, gyro_b_rad_s=gyro)
    for a in range(0, len(block), 400):
        estimator.add(block.part(slice(a, a + 400), gap_before=a == 0))
    return estimator.finish()


def troubled(made, matrix):
    """The gyro's readings with this matrix (3, 3) on the true rate."""
    noise = made.block.gyro_b_rad_s - made.rate_b_rad_s - pieces.GYRO_BIAS_RAD_S
    return made.rate_b_rad_s @ np.asarray(matrix).T + noise + pieces.GYRO_BIAS_RAD_S


def scales(seed):
    return np.diag(1.0 + np.random.default_rng(seed).uniform(-0.01, 0.01, 3))


def shears(seed):
    e = np.random.default_rng(seed).uniform(-0.005, 0.005, (3, 3))
    return np.eye(3) + (e + e.T) / 2


def turned(seed):
    axis = np.random.default_rng(seed).normal(size=3)
    return so3.exp(np.radians(1.0) * axis[None] / np.linalg.norm(axis))[0]


def beyond(made, found):
    """Largest error of the hard iron, in its sigmas."""
    return float(np.max(np.abs(made.errors(found)[6:9]) / found.sigma[6:9]))


@pytest.mark.parametrize("seeds", [4, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("trouble", "motion"),
    [
        pytest.param(scales, RICH, id="scales-rich"),
        pytest.param(shears, RICH, id="shears-rich", marks=pytest.mark.slow),
        pytest.param(turned, RICH, id="turned-rich", marks=pytest.mark.slow),
        pytest.param(scales, LEVEL, id="scales-level", marks=pytest.mark.slow),
        pytest.param(shears, LEVEL, id="shears-level"),
        pytest.param(turned, LEVEL, id="turned-level"),
    ],
)
def test_what_the_instrument_has_is_within_the_sigmas(trouble, motion, seeds):
    """Taken for perfect, it makes answers that are wrong by many of their sigmas.

    Not in each: scales that the motion cannot tell from a hard iron stay unseen, and that an
    instrument as its maker calibrated it has none of that size is believed then.
    """
    perfect, known = [], []
    for seed in range(seeds):
        made = pieces.drive(motion, seed)
        gyro = troubled(made, trouble(seed))
        perfect.append(beyond(made, answer(made, gyro, pieces.IDEAL)))
        known.append(beyond(made, answer(made, gyro)))
    assert sum(np.array(perfect) > 3.0) >= seeds / 2
    assert sum(np.array(known) > 3.0) <= 1


@pytest.mark.parametrize(
    "motion",
    [
        (("roll", 100.0),),
        pytest.param((("roll", 60.0), ("circles", 60.0)), marks=pytest.mark.slow),
        pytest.param((("circles", 100.0), ("pitch", 40.0)), marks=pytest.mark.slow),
    ],
    ids=["roll", "roll, circles", "circles, pitch"],
)
def test_wrong_scales_that_the_motion_hardly_tells(motion):
    """The gyro's axes are at right angles, which the motion does tell: that says nothing of its
    scales. When both were of one size, the worst of these were 4.4, 8.5 and 10 sigmas off."""
    off = []
    for seed in range(12):
        made = pieces.drive(motion, seed)
        off.append(beyond(made, answer(made, troubled(made, scales(seed)))))
    assert max(off) < 3.5


def test_a_gyro_that_nothing_is_known_of_is_of_the_worst_kind():
    """Sigmas of scale and angle of each gyro that may be, and how likely it is before the data."""
    gyros, places = possible_instruments((AS_SPECIFIED, ASSEMBLED), PLACES), 4
    shares = np.exp(gyros.log_prior) / np.sum(np.exp(gyros.log_prior))
    found = {}
    for sigmas, share in zip(gyros.sigmas, shares, strict=True):
        assert np.all(sigmas[4:7] == sigmas[4])
        assert np.all(sigmas[7:10] == sigmas[7])
        found[sigmas[4], sigmas[7]] = found.get((sigmas[4], sigmas[7]), 0.0) + share
    assert len(gyros.sigmas) == 2**3 * 3 * places
    assert found == {
        (3e-4, 3e-4): pytest.approx(1 / 42),
        (0.01, 3e-4): pytest.approx(1 / 42),
        (0.01, 0.01): pytest.approx(40 / 42),
    }
    alone = possible_instruments((ASSEMBLED,), (1e-3,))
    assert alone.sigmas[:, 4].tolist() == [0.01]


@pytest.mark.parametrize("after", ["rest", "circles"])
def test_level_turns_of_a_perfect_instrument_are_of_use_still(after):
    """They tell one scale of three; what the others may be widens the heading, by how much."""
    for seed in range(3):
        found = answer(pieces.drive((("circles", 80.0), (after, 60.0)), seed))
        assert found.converged
        assert 0.02 < found.heading_sigma_deg < 0.5


def test_axes_that_are_turned_and_nothing_else():
    """A sensor mounted askew that is neither late nor wrong in scale, in level circles."""
    perfect, known = [], []
    for seed in range(6):
        made = pieces.drive((("circles", 160.0),), seed)
        gyro = troubled(made, turned(seed))
        perfect.append(beyond(made, answer(made, gyro, pieces.IDEAL)))
        known.append(beyond(made, answer(made, gyro)))
    assert sum(np.array(perfect) > 3.0) >= 3
    assert max(known) < 3.0


def test_what_is_wrong_with_a_gyro_is_taken_out_of_its_angles():
    """The answer is as good as with a perfect gyro; taken for perfect, it is wrong by far more."""
    matrix = turned(3) @ scales(3) @ shears(3)
    for seed in range(3):
        made = pieces.drive(RICH, seed)
        ours, perfect = (
            np.linalg.norm(made.errors(answer(made, troubled(made, matrix), parameters))[6:9])
            for parameters in (None, pieces.IDEAL)
        )
        best = pieces.bound_sigmas(made, kind=ASSEMBLED)[6:9]
        assert ours < 3.0 * np.linalg.norm(best)
        assert perfect > 5.0 * ours


def test_a_field_that_differs_by_attitude_is_no_gyro():
    """It asks for scales and turned axes, and is not explained by them: nothing is taken out."""
    made = pieces.drive(RICH, 1)
    field = made.block.raw_b_gauss + 0.02 * np.sin(3.0 * made.block.raw_b_gauss / 0.1)
    found = answer(replace(made, block=replace(made.block, raw_b_gauss=field)))
    perfect = answer(
        replace(made, block=replace(made.block, raw_b_gauss=field)), None, pieces.IDEAL
    )
    assert np.array_equal(found.hard_iron_gauss, perfect.hard_iron_gauss)
    assert np.all(found.sigma > 0.999 * perfect.sigma)


@pytest.mark.parametrize("noise_rad_s", [pytest.param(5e-3, marks=pytest.mark.slow), 1e-2])
def test_noise_of_the_gyro_asks_for_no_scale(noise_rad_s):
    """On slow motion it is large beside the rates: each axis' scale, over its announced sigma."""
    found = []
    for seed in range(4):
        run = simulate(ScenarioSettings("lam", "rov", seed, noise_gyro_rad_s=noise_rad_s))
        estimator = Estimator(at_once=WHOLE)
        for block in run.blocks(1000):
            estimator.add(block)
        truth = run.truth
        answered = estimator.finish()
        assert answered.gyro_misscaled == 0.0
        found.append((answered.hard_iron_gauss - truth.hard_iron_gauss) / answered.sigma[6:9])
    assert np.max(np.abs(found)) < 3.5


def test_what_makes_the_most_of_the_sigma_is_named_with_what_would_shrink_it():
    short = pieces.drive((("circles", 40.0), ("rest", 30.0)), 1)
    found = answer(short, parameters=EstimatorParameters(imperfections=(ASSEMBLED,)))
    assert found.heading_sigma_deg > 0.5
    assert "scales may be off by a percent: turn about every axis" in found.widened_by
    rich = pieces.drive(RICH, 1)
    found = answer(rich)
    assert found.heading_sigma_deg < 0.5
    assert found.widened_by == ""
    field = rich.block.raw_b_gauss + 0.02 * np.sin(3.0 * rich.block.raw_b_gauss / 0.1)
    place = answer(replace(rich, block=replace(rich.block, raw_b_gauss=field)))
    assert "the field differs with place or attitude" in place.widened_by
    assert "run `ahrsd diagnose` on the recording to find the cause" in place.widened_by


def test_axes_that_are_turned_count_as_what_they_make_of_the_heading():
    """Taken out of the gyro's angles, they are still in the heading of a sensor that is askew."""
    made = pieces.drive(RICH, 1)
    found = answer(made, troubled(made, turned(1)))
    assert 0.7 < found.heading_sigma_deg < 3.0
    assert "axes are turned against the gyro's: mount them alike" in found.widened_by


def test_a_turn_about_down_is_an_error_of_the_heading():
    down = np.array([[0.0, 0.0, 1.0]])
    about_down = misalignment_heading_deg(np.radians([0.0, 0.0, 1.0]), down, np.radians(60.0))
    assert about_down == pytest.approx(1.0)
    across = misalignment_heading_deg(np.radians([1.0, 0.0, 0.0]), down, np.radians(60.0))
    assert across == pytest.approx(np.tan(np.radians(60.0)), rel=0.01)  # of the steep field


def wandering(made, size_gauss):
    """With a field that is another at every place, a new one each 9 s, straight in between."""
    time_s, period_s = made.block.time_s, 9.0
    knots_s = np.arange(0.0, time_s[-1] + 2 * period_s, period_s)
    at_knots = np.random.default_rng(0).normal(0.0, size_gauss, (len(knots_s), 3))
    course = np.column_stack([np.interp(time_s, knots_s, one) for one in at_knots.T])
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + course))


def test_what_no_motion_has_told_is_not_blamed_on_the_field():
    """A field that differs by place hides little there: on another motion it is what counts."""
    names = {}
    for name, motion in (("level", "circles"), ("straight", "straight"), ("rolling", "roll")):
        found = answer(wandering(pieces.drive(((motion, 160.0),), 3), 0.01))
        assert found.misfit > 5.0
        names[name] = found.widened_by
    assert "the motion so far does not determine enough: roll by 30 deg" in names["level"]
    assert "the motion so far does not determine enough: " in names["straight"]
    assert "or the field differs along the way" in names["rolling"]


def slowly_noisy(made, size_gauss, forgets_s, *, at_rest):
    """With noise of the magnetometer that forgets, one of its own on each axis."""
    time_s = made.block.time_s
    keep = np.exp(-np.median(np.diff(time_s)) / forgets_s)
    drawn = np.random.default_rng(2).normal(0.0, size_gauss, (len(time_s), 3))
    slow = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], drawn, axis=0)
    moves = np.linalg.norm(made.rate_b_rad_s, axis=1) > 1e-3
    slow = slow if at_rest else slow * moves[:, None]
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + slow))


PAUSED = (("circles", 60.0), ("roll", 40.0), ("rest", 60.0), ("pitch", 40.0), ("roll", 60.0))


def test_noise_that_is_not_white_is_no_place():
    """It goes on at rest, where no place is passed by; what stops there may be one."""
    noisy = answer(slowly_noisy(pieces.drive(PAUSED, 1), 0.006, 1.0, at_rest=True))
    assert noisy.heading_sigma_deg > 0.5
    assert "the magnetometer's noise is not white" in noisy.widened_by
    assert "another place does not help" in noisy.widened_by
    placed = answer(slowly_noisy(pieces.drive(PAUSED, 1), 0.006, 1.0, at_rest=False))
    assert "the field differs with place or attitude" in placed.widened_by
    moving = answer(slowly_noisy(pieces.drive(RICH, 1), 0.006, 1.0, at_rest=True))
    assert "a minute at rest shows which" in moving.widened_by


def test_shares_of_motion_and_misfit_by_hand():
    """Twelve numbers with a prior of 1: two are known to .1, one of them by a field that wanders;
    a third is left at the prior, and was known to .3 had the model explained the data."""
    plain, found = np.full(12, 1e-4), np.full(12, 1e-4)
    plain[:3], found[:3] = (0.01, 1e-4, 0.09), (0.01, 0.01, 0.9)
    shares = motion_and_misfit(np.diag(plain), np.diag(found), np.eye(12))
    assert np.diag(shares["motion"])[:4] == pytest.approx([0.01, 1e-4, 0.9, 1e-4])
    assert np.diag(shares["misfit"])[:4] == pytest.approx([0.0, 0.01 - 1e-4, 0.0, 0.0])


LEVEL_IRON = np.eye(12)[6]
UNSEEN_LEVEL = np.eye(12)[5] - np.sin(np.radians(60.0)) * np.eye(12)[8]  # M zz against b z


@pytest.mark.parametrize(
    ("unknown", "asked"),
    [(LEVEL_IRON, "turn through all headings"), (UNSEEN_LEVEL, " by 30 deg both ways")],
)
def test_the_manoeuvre_that_is_asked_for_tells_what_is_not_known(unknown, asked):
    """The second moves no reading of a level turn at a dip of 60 deg."""
    c = np.r_[0.5 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), np.zeros(3)]
    down = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 0.87], [0.5, 0.0, 0.87]])
    advice = HeadingAdvice(c, down, np.radians(60.0), 1e-3)
    covariance = 1e-8 * np.eye(12) + 0.1**2 * np.outer(unknown, unknown)
    assert asked in advice.best_manoeuvre(covariance)


@pytest.mark.parametrize(
    "motion", [pytest.param(RICH, marks=pytest.mark.slow), LEVEL], ids=["rich", "level"]
)
def test_a_gyro_that_warms_up_is_followed_to_the_end(motion):
    """Its bias goes by a tenth of a degree per second; the answer is that of the end.

    Taken for one that stays, it is the mean of the drift, and misfit says so.
    """
    errors, sigmas = {}, {}
    for name, parameters in (("stays", pieces.IDEAL), ("follows", None)):
        off = []
        for seed in range(4):
            made = pieces.drive(motion, seed)
            t = made.block.time_s
            course = 2e-3 * (np.exp(-2.0 * t / t[-1]) - np.exp(-2.0))
            gyro = made.block.gyro_b_rad_s + course[:, None] * [1.0, -0.7, 0.5]
            found = answer(made, gyro, parameters)
            off.append(np.abs(made.errors(found)[9:]))
            sigmas.setdefault(name, []).append(off[-1] / found.sigma[9:])
        errors[name] = float(np.mean(off))
    assert np.max(sigmas["stays"]) < 3.0
    assert np.max(sigmas["follows"]) < 3.0
    assert errors["follows"] < 0.7 * errors["stays"]


def test_a_drift_is_told_from_the_epochs_times():
    """Epochs know nothing but the bias they want: what is left of the drift until the last."""
    wanted = np.array([1e-3, 2e-3, -1e-3])
    times_s = np.array([0.0, 10.0, 25.0])
    H, g = np.zeros((3, 22, 22)), np.zeros((3, 22))
    for k, at in enumerate([-1.0, -0.6, 0.0]):
        H[k, 9:12, 9:12] = np.eye(3)
        g[k, 9:12] = -at * wanted
    both, gradient = add_bias_drift((H, g), times_s)
    found = -np.linalg.pinv(both.sum(axis=0)) @ gradient.sum(axis=0)
    assert np.allclose(found[9:12], 0.0)
    assert np.allclose(found[22:], wanted)


@pytest.mark.parametrize("motion", ["slow", "rov"])
def test_the_price_where_the_instrument_is_perfect_and_the_motion_rich(motion):
    run = simulate(ScenarioSettings("wam", motion, seed=3))
    found = []
    for parameters in (pieces.IDEAL, None):
        estimator = Estimator(parameters, at_once=WHOLE)
        for block in run.blocks(1000):
            estimator.add(block)
        found.append(estimator.finish())
    ideal, ours = found
    assert np.array_equal(ideal.hard_iron_gauss, ours.hard_iron_gauss)  # the answer is the same
    ratio = ours.sigma / ideal.sigma
    assert ratio.min() >= 1.0 - 1e-9
    assert np.median(ratio) <= 1.03


def test_the_widening_is_a_covariance():
    made = pieces.drive(LEVEL, 5)
    added = answer(made).covariance - answer(made, parameters=pieces.IDEAL).covariance
    size = np.sqrt(np.diag(answer(made).covariance))
    values = np.linalg.eigvalsh(added / np.outer(size, size))
    assert values.min() > -1e-7 * values.max()


def test_the_worse_the_kind_of_instrument_the_wider_the_answer():
    made = pieces.drive(LEVEL, 6)
    sigmas = [
        answer(made, parameters=EstimatorParameters(imperfections=kinds)).sigma[6:9]
        for kinds in ((), (AS_SPECIFIED,), (AS_SPECIFIED, ASSEMBLED), (ASSEMBLED,))
    ]
    for better, worse in pairwise(sigmas):
        assert np.all(better <= worse * (1.0 + 1e-9))
    assert sigmas[3].max() > 2.0 * sigmas[1].max()


def test_what_left_the_window_counts():
    """Motion that told the instrument's imperfections, and is folded by now, still does."""
    made = pieces.drive((*RICH, ("circles", 400.0)), 7, rate_hz=20.0)
    parameters = EstimatorParameters(window_steps=1024, epoch_steps=256)
    folded = answer(made, parameters=parameters)
    whole = answer(made)
    assert np.all(folded.sigma[6:9] < 2.0 * whole.sigma[6:9])


def at_a_place(made, seed, size_gauss):
    """The same drive where the field differs with the heading: six numbers of this size."""
    G = np.random.default_rng([seed, 5]).normal(0.0, size_gauss, (3, 2))
    attitude = nuisances.attitude(
        Trajectory(made.field_b_gauss, made.rate_b_rad_s, made.block.dt_s)
    )
    heading = np.arctan2(attitude[:, 1, 0], attitude[:, 0, 0])
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    more = np.einsum("nji,nj->ni", attitude, ahead @ G.T) @ pieces.SOFT_IRON
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + more))


LEVEL_AND_LEANING = (("circles", 120.0), ("roll", 40.0), ("pitch", 40.0), ("circles", 60.0))
CIRCLES = (("circles", 160.0),)


@pytest.mark.parametrize("seeds", [4, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "motion",
    [CIRCLES, pytest.param(LEVEL, marks=pytest.mark.slow), LEVEL_AND_LEANING],
    ids=["c", "l", "ll"],
)
def test_a_field_that_differs_with_the_heading_is_within_the_sigmas(motion, seeds):
    """What of it is the same on all headings is taken for hard iron, and no fit shows that."""
    off = []
    for seed in range(seeds):
        made = at_a_place(pieces.drive(motion, seed), seed, 5e-3)
        found = answer(made)
        off.append(beyond(made, found))
        assert 1e-3 < found.place_gauss < 2e-2
    assert max(off) < 3.0


@pytest.mark.parametrize("motion", [LEVEL, LEVEL_AND_LEANING], ids=["l", "ll"])
def test_where_the_field_is_the_same_everywhere_the_data_say_so(motion):
    for seed in range(4):
        found = answer(pieces.drive(motion, seed))
        assert found.place_gauss < 2e-4


def test_a_field_that_differs_otherwise_than_with_the_heading_is_misfit_and_counts_as_a_place():
    """In degrees of heading: nothing where the field is the same everywhere."""
    made = pieces.drive(LEVEL_AND_LEANING, 2)
    assert answer(made).place_deg < 0.01
    found = answer(wandering(made, 2e-3))
    assert 0.1 < found.place_deg < found.heading_sigma_deg


def test_what_no_motion_tells_of_a_place_is_as_large_as_places_are():
    """Without gravity nobody knows where the sensor heads."""
    made = pieces.drive(LEVEL, 1)
    nowhere = replace(made.block, accel_b_m_s2=np.full_like(made.block.accel_b_m_s2, np.nan))
    found = answer(replace(made, block=nowhere))
    assert found.place_gauss == pytest.approx(np.sqrt(np.mean(np.square(PLACES))), rel=1e-3)


def test_the_price_of_places_where_the_motion_is_rich():
    run = simulate(ScenarioSettings("wam", "rov", seed=3))
    sigmas = []
    for places in ((1e-6,), PLACES):
        estimator = Estimator(EstimatorParameters(places=places), at_once=WHOLE)
        for block in run.blocks(1000):
            estimator.add(block)
        sigmas.append(estimator.finish().sigma)
    assert np.max(sigmas[1] / sigmas[0]) < 1.03


def test_places_are_as_large_as_real_recordings_say():
    """Of what differs by place or attitude: the middle is among them, and what is small as well."""
    for name in ("world_course", "by_direction"):
        size = ORDINARY[name]
        least = size.median / np.exp(1.645 * size.spread)
        assert PLACES[0] < least < PLACES[1]
        assert PLACES[1] < size.median < PLACES[-1]
