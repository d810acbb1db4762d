"""Estimates from imperfect instruments: sigmas that hold, and little loss for a perfect one.

The errors are added to the gyro's readings, so that iron and bias of the truth are unchanged.
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

#: rolls, pitches and turns at once, as a diver makes them
RICH = (("circles", 40.0), ("roll", 30.0), ("pitch", 30.0), ("circles", 40.0), ("roll", 30.0))
LEVEL = (("circles", 120.0), ("roll", 40.0))


def answer(made, gyro=None, parameters=None):
    estimator = Estimator(parameters, at_once=WHOLE)
    block = made.block if gyro is None else replace(made.block, gyro_b_rad_s=gyro)
    for a in range(0, len(block), 400):
        estimator.add(block.part(slice(a, a + 400), gap_before=a == 0))
    return estimator.finish()


def troubled(made, matrix):
    """The gyro's readings with this matrix (3, 3) applied to the true rate."""
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
    """Largest error of the hard iron in units of its sigma."""
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
def test_errors_with_an_imperfect_instrument_are_within_the_sigmas(trouble, motion, seeds):
    """If the instrument is assumed perfect, errors are many sigmas.

    Not in every run: scale errors that the motion does not separate from a hard iron are not found,
    and the prior then says that a factory-calibrated instrument has none of that size.
    """
    perfect, known = [], []
    for seed in range(seeds):
        made = pieces.drive(motion, seed)
        gyro = troubled(made, trouble(seed))
        perfect.append(beyond(made, answer(made, gyro, pieces.IDEAL)))
        known.append(beyond(made, answer(made, gyro)))
    assert sum(np.array(perfect) > 3.0) >= seeds / 2
    assert sum(np.array(known) > 3.0) <= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion",
    [
        (("roll", 100.0),),
        (("roll", 60.0), ("circles", 60.0)),
        (("circles", 100.0), ("pitch", 40.0)),
    ],
    ids=["roll", "roll, circles", "circles, pitch"],
)
def test_scale_errors_that_the_motion_hardly_determines_are_within_the_sigmas(motion):
    """The motion shows that the gyro's axes are orthogonal, which has no information on the
    scales. With one common size for both, the worst errors were 4.4, 8.5 and 10 sigmas.
    """
    off = []
    for seed in range(12):
        made = pieces.drive(motion, seed)
        off.append(beyond(made, answer(made, troubled(made, scales(seed)))))
    assert max(off) < 3.5


def test_unknown_gyro_has_the_prior_of_the_worst_kind():
    """Prior sigmas of scale and angle for each possible kind of gyro, and its prior probability."""
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
def test_level_turns_of_a_perfect_instrument_still_converge(after):
    """They determine one scale of three. The others widen the heading by their prior."""
    for seed in range(3):
        found = answer(pieces.drive((("circles", 80.0), (after, 60.0)), seed))
        assert found.converged
        assert 0.02 < found.heading_sigma_deg < 0.5


@pytest.mark.slow
def test_misalignment_alone_is_within_the_sigmas():
    """A misaligned sensor without delay or scale error, in level circles."""
    perfect, known = [], []
    for seed in range(6):
        made = pieces.drive((("circles", 160.0),), seed)
        gyro = troubled(made, turned(seed))
        perfect.append(beyond(made, answer(made, gyro, pieces.IDEAL)))
        known.append(beyond(made, answer(made, gyro)))
    assert sum(np.array(perfect) > 3.0) >= 3
    assert max(known) < 3.0


def test_gyro_error_is_removed_from_its_angles():
    """The estimate is as good as with a perfect gyro. Assuming a perfect gyro gives much larger
    errors.
    """
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


def test_field_that_depends_on_attitude_is_not_a_gyro_error():
    """It would need scale errors and misalignments that do not explain it, so nothing is
    removed.
    """
    made = pieces.drive(RICH, 1)
    field = made.block.raw_b_gauss + 0.02 * np.sin(3.0 * made.block.raw_b_gauss / 0.1)
    found = answer(replace(made, block=replace(made.block, raw_b_gauss=field)))
    perfect = answer(
        replace(made, block=replace(made.block, raw_b_gauss=field)), None, pieces.IDEAL
    )
    assert np.array_equal(found.hard_iron_gauss, perfect.hard_iron_gauss)
    assert np.all(found.sigma > 0.999 * perfect.sigma)


@pytest.mark.parametrize("noise_rad_s", [pytest.param(5e-3, marks=pytest.mark.slow), 1e-2])
def test_gyro_noise_is_not_taken_for_a_scale_error(noise_rad_s):
    """In slow motion the noise is large compared with the rates. Tested: each axis' scale
    divided by its sigma.
    """
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


def test_largest_contribution_to_sigma_is_named_with_advice():
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


def test_misalignment_counts_by_its_effect_on_the_heading():
    """It is removed from the gyro's angles, but remains in the heading of a misaligned sensor."""
    made = pieces.drive(RICH, 1)
    found = answer(made, troubled(made, turned(1)))
    assert 0.7 < found.heading_sigma_deg < 3.0
    assert "axes are turned against the gyro's: mount them alike" in found.widened_by


def test_rotation_about_the_vertical_is_an_equal_heading_error():
    down = np.array([[0.0, 0.0, 1.0]])
    about_down = misalignment_heading_deg(np.radians([0.0, 0.0, 1.0]), down, np.radians(60.0))
    assert about_down == pytest.approx(1.0)
    across = misalignment_heading_deg(np.radians([1.0, 0.0, 0.0]), down, np.radians(60.0))
    assert across == pytest.approx(np.tan(np.radians(60.0)), rel=0.01)  # for a steep field


def wandering(made, size_gauss):
    """The drive in a field that differs between places: a new value every 9 s, linear in
    between.
    """
    time_s, period_s = made.block.time_s, 9.0
    knots_s = np.arange(0.0, time_s[-1] + 2 * period_s, period_s)
    at_knots = np.random.default_rng(0).normal(0.0, size_gauss, (len(knots_s), 3))
    course = np.column_stack([np.interp(time_s, knots_s, one) for one in at_knots.T])
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + course))


def test_sigma_due_to_missing_motion_is_not_attributed_to_the_field():
    """A field that differs between places contributes little here; with another motion it
    dominates.
    """
    names = {}
    for name, motion in (("level", "circles"), ("straight", "straight"), ("rolling", "roll")):
        found = answer(wandering(pieces.drive(((motion, 160.0),), 3), 0.01))
        assert found.misfit > 5.0
        names[name] = found.widened_by
    assert "the motion so far does not determine enough: roll by 30 deg" in names["level"]
    assert "the motion so far does not determine enough: " in names["straight"]
    assert "or the field differs along the way" in names["rolling"]


def slowly_noisy(made, size_gauss, forgets_s, *, at_rest):
    """The drive with correlated magnetometer noise, independent on each axis."""
    time_s = made.block.time_s
    keep = np.exp(-np.median(np.diff(time_s)) / forgets_s)
    drawn = np.random.default_rng(2).normal(0.0, size_gauss, (len(time_s), 3))
    slow = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], drawn, axis=0)
    moves = np.linalg.norm(made.rate_b_rad_s, axis=1) > 1e-3
    slow = slow if at_rest else slow * moves[:, None]
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + slow))


PAUSED = (("circles", 60.0), ("roll", 40.0), ("rest", 60.0), ("pitch", 40.0), ("roll", 60.0))


def test_coloured_noise_is_not_attributed_to_places():
    """It continues at rest, where no place is passed. A disturbance that stops at rest may be a
    place.
    """
    noisy = answer(slowly_noisy(pieces.drive(PAUSED, 1), 0.006, 1.0, at_rest=True))
    assert noisy.heading_sigma_deg > 0.5
    assert "the magnetometer's noise is not white" in noisy.widened_by
    assert "another place does not help" in noisy.widened_by
    placed = answer(slowly_noisy(pieces.drive(PAUSED, 1), 0.006, 1.0, at_rest=False))
    assert "the field differs with place or attitude" in placed.widened_by
    moving = answer(slowly_noisy(pieces.drive(RICH, 1), 0.006, 1.0, at_rest=True))
    assert "a minute at rest shows which" in moving.widened_by


def test_shares_of_motion_and_misfit_in_a_small_example():
    """Twelve parameters with a prior of 1: two are known to 0.1, one of them limited by a
    varying field. A third is left at its prior, and would be known to 0.3 if the model
    explained the data.
    """
    plain, found = np.full(12, 1e-4), np.full(12, 1e-4)
    plain[:3], found[:3] = (0.01, 1e-4, 0.09), (0.01, 0.01, 0.9)
    shares = motion_and_misfit(np.diag(plain), np.diag(found), np.eye(12))
    assert np.diag(shares["motion"])[:4] == pytest.approx([0.01, 1e-4, 0.9, 1e-4])
    assert np.diag(shares["misfit"])[:4] == pytest.approx([0.0, 0.01 - 1e-4, 0.0, 0.0])


LEVEL_IRON = np.eye(12)[6]
UNSEEN_LEVEL = np.eye(12)[5] - np.sin(np.radians(60.0)) * np.eye(12)[8]  # M zz and b z


@pytest.mark.parametrize(
    ("unknown", "manoeuvre"),
    [(LEVEL_IRON, "turn through all headings"), (UNSEEN_LEVEL, " by 30 deg both ways")],
)
def test_advised_manoeuvre_determines_the_unknown_direction(unknown, manoeuvre):
    """The second direction changes no reading of a level turn at a dip of 60 deg."""
    c = np.r_[0.5 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), np.zeros(3)]
    down = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 0.87], [0.5, 0.0, 0.87]])
    advice = HeadingAdvice(c, down, np.radians(60.0), 1e-3)
    covariance = 1e-8 * np.eye(12) + 0.1**2 * np.outer(unknown, unknown)
    assert manoeuvre in advice.best_manoeuvre(covariance)


@pytest.mark.parametrize(
    "motion", [pytest.param(RICH, marks=pytest.mark.slow), LEVEL], ids=["rich", "level"]
)
def test_estimate_of_a_drifting_gyro_bias_is_that_of_the_end(motion):
    """The bias changes by a tenth of a degree per second. If it is assumed constant, the
    estimate is the mean of the drift, and the misfit shows it.
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


def test_bias_drift_is_fitted_from_the_times_of_the_epochs():
    """Epochs only contain the bias that fits them: the remaining drift until the last epoch."""
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
def test_sigmas_grow_little_with_a_perfect_instrument_and_rich_motion(motion):
    run = simulate(ScenarioSettings("wam", motion, seed=3))
    found = []
    for parameters in (pieces.IDEAL, None):
        estimator = Estimator(parameters, at_once=WHOLE)
        for block in run.blocks(1000):
            estimator.add(block)
        found.append(estimator.finish())
    ideal, ours = found
    assert np.array_equal(ideal.hard_iron_gauss, ours.hard_iron_gauss)  # the estimate is the same
    ratio = ours.sigma / ideal.sigma
    assert ratio.min() >= 1.0 - 1e-9
    assert np.median(ratio) <= 1.03


def test_widening_is_positive_semidefinite():
    made = pieces.drive(LEVEL, 5)
    added = answer(made).covariance - answer(made, parameters=pieces.IDEAL).covariance
    size = np.sqrt(np.diag(answer(made).covariance))
    values = np.linalg.eigvalsh(added / np.outer(size, size))
    assert values.min() > -1e-7 * values.max()


def test_sigmas_grow_with_the_imperfections_of_the_instrument():
    made = pieces.drive(LEVEL, 6)
    sigmas = [
        answer(made, parameters=EstimatorParameters(imperfections=kinds)).sigma[6:9]
        for kinds in ((), (AS_SPECIFIED,), (AS_SPECIFIED, ASSEMBLED), (ASSEMBLED,))
    ]
    for better, worse in pairwise(sigmas):
        assert np.all(better <= worse * (1.0 + 1e-9))
    assert sigmas[3].max() > 2.0 * sigmas[1].max()


def test_folded_epochs_still_inform_the_imperfections():
    """Motion that determined the instrument's imperfections and is folded by now still counts."""
    made = pieces.drive((*RICH, ("circles", 400.0)), 7, rate_hz=20.0)
    parameters = EstimatorParameters(window_steps=1024, epoch_steps=256)
    folded = answer(made, parameters=parameters)
    whole = answer(made)
    assert np.all(folded.sigma[6:9] < 2.0 * whole.sigma[6:9])


def at_a_place(made, seed, size_gauss):
    """The same drive in a field that depends on the heading: six coefficients of this size."""
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
def test_errors_with_a_field_by_heading_are_within_the_sigmas(motion, seeds):
    """The part that is equal on all headings is taken for hard iron, and no fit shows it."""
    off = []
    for seed in range(seeds):
        made = at_a_place(pieces.drive(motion, seed), seed, 5e-3)
        found = answer(made)
        off.append(beyond(made, found))
        assert 1e-3 < found.place_gauss < 2e-2
    assert max(off) < 3.0


@pytest.mark.parametrize("motion", [LEVEL, LEVEL_AND_LEANING], ids=["l", "ll"])
def test_uniform_field_is_recognised_from_the_data(motion):
    for seed in range(4):
        found = answer(pieces.drive(motion, seed))
        assert found.place_gauss < 2e-4


def test_field_that_varies_otherwise_is_misfit_and_counts_as_places():
    """In degrees of heading; zero in a uniform field."""
    made = pieces.drive(LEVEL_AND_LEANING, 2)
    assert answer(made).place_deg < 0.01
    found = answer(wandering(made, 2e-3))
    assert 0.1 < found.place_deg < found.heading_sigma_deg


def test_effect_of_places_has_its_prior_size_when_the_motion_does_not_determine_it():
    """Without gravity the heading of the sensor is not known."""
    made = pieces.drive(LEVEL, 1)
    nowhere = replace(made.block, accel_b_m_s2=np.full_like(made.block.accel_b_m_s2, np.nan))
    found = answer(replace(made, block=nowhere))
    assert found.place_gauss == pytest.approx(np.sqrt(np.mean(np.square(PLACES))), rel=1e-3)


def test_places_widen_the_sigmas_little_with_rich_motion():
    run = simulate(ScenarioSettings("wam", "rov", seed=3))
    sigmas = []
    for places in ((1e-6,), PLACES):
        estimator = Estimator(EstimatorParameters(places=places), at_once=WHOLE)
        for block in run.blocks(1000):
            estimator.add(block)
        sigmas.append(estimator.finish().sigma)
    assert np.max(sigmas[1] / sigmas[0]) < 1.03


def test_prior_sizes_of_places_cover_those_of_real_recordings():
    """Of the field's variation by place or attitude: the median is within the sizes, and so is
    the least.
    """
    for name in ("world_course", "by_direction"):
        size = ORDINARY[name]
        least = size.median / np.exp(1.645 * size.spread)
        assert PLACES[0] < least < PLACES[1]
        assert PLACES[1] < size.median < PLACES[-1]
