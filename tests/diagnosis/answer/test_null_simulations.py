"""What is told beside a gyro that is louder than the magnetometer is beyond chance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Unexplained, Where
from ahrsd.diagnosis.answer.null_simulations import (
    FittedDiagnosis,
    calibration_bend,
    diagnose_beyond_chance,
    gyro_to_mag_noise,
    noise_free_motion,
    required_ratio,
    simulated_copy,
)
from ahrsd.diagnosis.answer.text import verdict
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.repaired_model.forward import model_noise
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.simulation import Experiment

STEP_GAUSS = np.array([1.6e-3, -1.2e-3, 0.0])


@pytest.fixture
def few_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is tested here needs no sixteen of them."""
    monkeypatch.setattr(priors, "CHANCE_FITS", 5)


def _made(
    sigma_mag: float, sigma_gyro: float, scenario: str = "wam", seed: int = 0, samples: int = 3000
) -> Experiment:
    return experiment(
        scenario,
        motion="slow",
        seed=seed,
        samples=samples,
        sigma_mag=sigma_mag,
        sigma_gyro=sigma_gyro,
    )


def _stepped() -> tuple[Track, Callable[[float], FittedDiagnosis]]:
    """A track with a step, and an answer that tells something unknown in it of so many nats."""
    track = track_of(_made(1e-4, 5e-2, samples=1000))
    since = (np.arange(len(track)) >= 500)[:, None]
    track = replace(track, mag_b_gauss=track.mag_b_gauss + since * STEP_GAUSS)
    problem, cold = build_problem(track, Spec())
    start = fit_null(problem.track, problem.spec, cold)
    where = Where(((60.0, 120.0),), ("x", "y"), "sensor")

    def answered(nats: float) -> FittedDiagnosis:
        left = Unexplained(True, where, evidence_nats=nats)
        return FittedDiagnosis(
            Diagnosis("step.csv", None, True, 1e-9, (), left, {}), problem, start
        )

    return track, answered


@pytest.mark.usefixtures("few_fits")
def test_where_a_simulation_cannot_be_diagnosed_neither_yes_nor_no_is_said() -> None:
    """How much of such chance makes is then not known either."""
    track, answered = _stepped()

    def ask(asked: Track) -> FittedDiagnosis:
        if asked is not track:
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return answered(2000.0)

    found = diagnose_beyond_chance(track, ask)
    assert not found.unexplained.detected
    assert verdict(found) == (
        "no verdict: a simulation of the calibration model alone, with this noise, cannot be "
        "diagnosed"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("few_fits")
@pytest.mark.parametrize(
    ("nats", "is_told", "chance", "asked"),
    [
        (30.0, False, 48, 1),
        (100.0, True, 48, 5),
        (300.0, True, 194, 3),
        (2000.0, True, 519, 2),
    ],
)
def test_what_simulations_show_is_said_beside_what_is_told(
    nats: float, is_told: bool, chance: int, asked: int
) -> None:
    """Four times what five of them show may be chance, 16 times what three do, 43 times two."""
    track, answered = _stepped()
    copies = list[Track]()

    def ask(one: Track) -> FittedDiagnosis:
        if one is track:
            return answered(nats)
        copies.append(one)
        return answered(12.0)

    found = diagnose_beyond_chance(track, ask)
    assert found.unexplained.detected == is_told
    assert len(copies) == asked
    (note,) = found.notes[:1]
    beside = "" if is_told else ", so nothing is reported"
    assert note.endswith(f" an effect of up to 12 nats; up to {chance} nats may be chance{beside}")


@pytest.mark.parametrize(
    ("copies", "chance", "times"), [(1, 1e-3, 999.0), (2, 1e-3, 43.2), (5, 1 / 126, 4.0)]
)
def test_times_beyond_the_largest_of_several(copies: int, chance: float, times: float) -> None:
    """Of exponential draws: n! / ((1 + t) ... (n + t))."""
    assert required_ratio(copies, chance) == pytest.approx(times, rel=1e-3)


def test_with_every_early_look_one_in_94_of_what_chance_makes_is_told() -> None:
    """Of exponential draws beside five others: 1 in 126 at the last, 1 in 1000 at each before."""
    told, *others = np.random.default_rng(5).exponential(size=(6, 500_000))
    largest = np.maximum.accumulate(others)
    early = [required_ratio(count, priors.CHANCE_EARLY_P) for count in (1, 2, 3, 4)]
    beyond = told > np.array([*early, required_ratio(5, priors.CHANCE_P)])[:, None] * largest
    assert np.mean(beyond[-1]) == pytest.approx(1 / 126, rel=0.05)
    assert np.mean(beyond.any(axis=0)) == pytest.approx(1 / 94, rel=0.05)


@pytest.mark.parametrize(
    ("sigma_mag", "sigma_gyro", "ratio"), [(1e-3, 5e-3, 0.1), (1e-4, 5e-2, 10.0)]
)
def test_how_loud_a_gyro_is(sigma_mag: float, sigma_gyro: float, ratio: float) -> None:
    """Of half a gauss, 25 times a second: 50 mrad/s turn it by 1 mG."""
    made = _made(sigma_mag, sigma_gyro)
    assert gyro_to_mag_noise(track_of(made), true_model(made)) == pytest.approx(ratio, rel=0.1)


@pytest.mark.parametrize(("scenario", "is_bent"), [("lam", True), ("wam", False), ("mam", False)])
def test_the_noise_bends_a_calibration_that_the_motion_hardly_shows(
    scenario: str, is_bent: bool
) -> None:
    """Slow turns with a tilt of a few degrees; the same noise beside larger ones moves nothing."""
    problem, cold = build_problem(track_of(_made(1e-3, 5e-3, scenario, 2)), Spec())
    moved = calibration_bend(fit_null(problem.track, problem.spec, cold, walk=False))
    assert moved == pytest.approx(0.62, abs=0.1) if is_bent else moved < 0.1


def test_a_copy_has_the_motion_the_noise_and_the_stamps() -> None:
    made = _made(1e-4, 5e-2)
    track, model = track_of(made), true_model(made)
    truth = noise_free_motion(track, model)
    clean = track_of(_made(0.0, 0.0)).gyro_b_rad_s
    assert np.std(truth.gyro_b_rad_s - clean) < 0.1 * 5e-2
    one = simulated_copy(track, truth, model_noise(model), seed=3)
    assert np.array_equal(one.time_s, track.time_s)
    assert np.std(one.gyro_b_rad_s - truth.gyro_b_rad_s) == pytest.approx(5e-2, rel=0.03)
    assert np.std(one.mag_b_gauss - truth.mag_b_gauss) == pytest.approx(1e-4, rel=0.03)
    assert np.array_equal(
        one.mag_b_gauss, simulated_copy(track, truth, model_noise(model), 3).mag_b_gauss
    )
