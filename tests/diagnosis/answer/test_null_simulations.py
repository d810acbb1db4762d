"""With a noisy gyro or with rounded readings, only findings beyond chance are reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding, Unexplained, Where
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
from ahrsd.diagnosis.model import Noise, Term
from ahrsd.diagnosis.repaired_model.forward import model_noise
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.simulation import Experiment

STEP_GAUSS = np.array([1.6e-3, -1.2e-3, 0.0])


@pytest.fixture
def few_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five simulations instead of sixteen: enough for these tests."""
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
    """A track with a step, and an answer with an unknown cause of the given evidence in nats."""
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


@pytest.mark.slow
@pytest.mark.usefixtures("few_fits")
def test_no_verdict_when_a_simulation_of_the_null_model_cannot_be_diagnosed() -> None:
    """It is then unknown how much evidence chance alone produces."""
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
    ("nats", "is_reported", "chance", "asked"),
    [
        (30.0, False, 48, 1),
        (100.0, True, 48, 5),
        (300.0, True, 194, 3),
        (2000.0, True, 519, 2),
    ],
)
def test_note_reports_evidence_that_simulations_of_the_null_model_produce(
    nats: float, is_reported: bool, chance: int, asked: int
) -> None:
    """Chance may produce 4 times the largest evidence of five simulations, 16 times that of three,
    43 times that of two.
    """
    track, answered = _stepped()
    copies = list[Track]()

    def ask(one: Track) -> FittedDiagnosis:
        if one is track:
            return answered(nats)
        copies.append(one)
        return answered(12.0)

    found = diagnose_beyond_chance(track, ask)
    assert found.unexplained.detected == is_reported
    assert len(copies) == asked
    (note,) = found.notes[:1]
    beside = "" if is_reported else ", so nothing is reported"
    assert note.endswith(f" an effect of up to 12 nats; up to {chance} nats may be chance{beside}")


ROUNDED_STEP_GAUSS = 12e-3


def _rounded(jump_gauss: float) -> tuple[Track, FittedDiagnosis]:
    """A track in coarse steps, with a jump in the middle, answered with an unknown cause."""
    made = experiment("mam", motion="rov", samples=1500, sigma_mag=8e-4, sigma_gyro=3e-4)
    track = track_of(made)
    jump = (np.arange(len(track)) >= 750)[:, None] * jump_gauss * np.array([0.6, -0.64, 0.48])
    steps = np.round((track.mag_b_gauss + jump) / ROUNDED_STEP_GAUSS)
    track = replace(track, mag_b_gauss=ROUNDED_STEP_GAUSS * steps)
    problem, cold = build_problem(track, Spec())
    start = fit_null(problem.track, problem.spec, cold)
    left = Unexplained(True, Where(((0.0, 50.0),), ("x",), "sensor"), evidence_nats=60.0)
    found = Diagnosis("", None, True, 1e-9, (), left, {}, noise=Noise(8e-4, 3e-4))
    step = np.array([ROUNDED_STEP_GAUSS])
    rounding = (Term("mag_quantisation", step, np.zeros(1)),)
    return track, FittedDiagnosis(found, problem, start, rounding)


@pytest.mark.usefixtures("few_fits")
@pytest.mark.parametrize(("jump_gauss", "is_reported"), [(0.0, False), (30e-3, True)])
def test_source_in_rounded_readings_is_compared_with_rounded_simulations(
    jump_gauss: float, is_reported: bool
) -> None:
    """Rounding errors follow the motion, so noise of one spectrum does not explain them."""
    track, answered = _rounded(jump_gauss)
    none_found = replace(answered.found, unexplained=Unexplained(False))
    found = diagnose_beyond_chance(
        track, lambda one: answered if one is track else replace(answered, found=none_found)
    )
    assert found.unexplained.detected == is_reported
    assert found.notes[0].startswith("the readings come in steps that are coarser than their noise")


def _step_finding(nats: float) -> Finding:
    """A step that rests on a fit."""
    where = Where(((60.0, 120.0),), ("x", "y"), "sensor")
    return Finding(
        "hard_iron_step", 1.0, (), where, (), heldout=None, cost_if_left_out=None,
        separate_from=None, evidence_nats=nats, term=0,
    )  # fmt: skip


@pytest.mark.usefixtures("few_fits")
@pytest.mark.parametrize(("in_copies", "is_reported"), [(20.0, False), (0.0, True)])
def test_finding_stays_when_an_unknown_cause_may_be_rounding(
    in_copies: float, is_reported: bool
) -> None:
    """60 nats are less than 4 times 20, and more than 4 times the 9 that are assumed at least."""
    track, answered = _rounded(30e-3)
    found = replace(answered.found, findings=(_step_finding(10.0),))
    in_copy = replace(answered.found.unexplained, evidence_nats=in_copies)
    copy = replace(answered.found, unexplained=in_copy if in_copies else Unexplained(False))
    reported = diagnose_beyond_chance(
        track, lambda one: replace(answered, found=found if one is track else copy)
    )
    assert [one.effect for one in reported.findings] == ["hard_iron_step"]
    assert reported.unexplained.detected == is_reported
    assert ("so that is not reported" in reported.notes[0]) != is_reported
    assert "hard_iron_step" not in reported.notes[0]


@pytest.mark.usefixtures("few_fits")
def test_finding_with_a_noisy_gyro_is_compared_in_rounded_readings_too() -> None:
    track, answer_of = _stepped()
    step = np.array([1e-3])
    rounding = (Term("mag_quantisation", step, np.zeros(1)),)
    answered = replace(answer_of(30.0), rounding=rounding)
    noise = Noise(1e-4, 5e-2)
    found = replace(answered.found, findings=(_step_finding(30.0),), noise=noise)
    reported = diagnose_beyond_chance(
        track,
        lambda one: replace(answered, found=found) if one is track else answer_of(12.0),
    )
    assert reported.findings == ()
    assert reported.notes[0].startswith(
        "the gyro is noisier than the magnetometer: hard_iron_step, "
    )


@pytest.mark.parametrize(
    ("copies", "chance", "times"), [(1, 1e-3, 999.0), (2, 1e-3, 43.2), (5, 1 / 126, 4.0)]
)
def test_required_ratio_to_the_largest_of_several_simulations(
    copies: int, chance: float, times: float
) -> None:
    """For exponential draws the probability is n! / ((1 + t) ... (n + t))."""
    assert required_ratio(copies, chance) == pytest.approx(times, rel=1e-3)


def test_false_alarm_rate_of_sequential_test_is_one_in_94() -> None:
    """Exponential draws compared with five others: 1 in 126 at the last look, 1 in 1000 at each
    earlier look.
    """
    told, *others = np.random.default_rng(5).exponential(size=(6, 500_000))
    largest = np.maximum.accumulate(others)
    early = [required_ratio(count, priors.CHANCE_EARLY_P) for count in (1, 2, 3, 4)]
    beyond = told > np.array([*early, required_ratio(5, priors.CHANCE_P)])[:, None] * largest
    assert np.mean(beyond[-1]) == pytest.approx(1 / 126, rel=0.05)
    assert np.mean(beyond.any(axis=0)) == pytest.approx(1 / 94, rel=0.05)


@pytest.mark.parametrize(
    ("sigma_mag", "sigma_gyro", "ratio"), [(1e-3, 5e-3, 0.1), (1e-4, 5e-2, 10.0)]
)
def test_gyro_noise_as_ratio_of_magnetometer_noise(
    sigma_mag: float, sigma_gyro: float, ratio: float
) -> None:
    """At half a gauss and 25 Hz, 50 mrad/s turn the field by 1 mG in one step."""
    made = _made(sigma_mag, sigma_gyro)
    assert gyro_to_mag_noise(track_of(made), true_model(made)) == pytest.approx(ratio, rel=0.1)


@pytest.mark.parametrize(("scenario", "is_biased"), [("lam", True), ("wam", False), ("mam", False)])
def test_gyro_noise_biases_the_calibration_when_the_motion_is_small(
    scenario: str, is_biased: bool
) -> None:
    """With slow turns and a tilt of a few degrees the calibration is biased. With larger turns the
    same noise changes nothing.
    """
    problem, cold = build_problem(track_of(_made(1e-3, 5e-3, scenario, 2)), Spec())
    moved = calibration_bend(fit_null(problem.track, problem.spec, cold, walk=False))
    assert moved == pytest.approx(0.62, abs=0.1) if is_biased else moved < 0.1


def test_simulated_copy_has_same_motion_noise_and_time_stamps() -> None:
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
