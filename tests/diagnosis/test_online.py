"""Steps of hard iron and gyro bias during the running estimate: reported once, correctly, or not
at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pieces
import pytest
from tracks import RECORDINGS, experiment

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.core.estimation import Calibrator
from ahrsd.core.settings import CalibratorSettings
from ahrsd.estimator.epoch import GYRO_BASIS, InstrumentCorrection
from ahrsd.estimator.step_detector import (
    KEPT,
    ReferenceCalibration,
    Scorer,
    Step,
    StepDetector,
    Thinned,
    accumulate_rotations,
)
from ahrsd.events import Judged, Noted
from ahrsd.evidence.values import BasisFacts, HealthFacts
from ahrsd.inputs import Samples
from ahrsd.recording.table import read_table
from ahrsd.samples import Array, SampleBlock
from ahrsd.simulation import Experiment
from ahrsd.telemetry.status import LinkFacts, StatusMaker
from ahrsd.telemetry.words import explain_json, explain_lines, mismatch_line
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode

MAGNET = np.array([0.018, -0.009, 0.022])  # 30 mG
BLOCK_S = 128 * 2 / 25.0
SIGMA = np.r_[np.full(6, 1e-3), np.full(3, 5e-4), np.full(3, 1e-4)]


def estimate_of(made: Experiment, seed: int = 0, *, converged: bool = True) -> Estimate:
    """An estimate that differs from the truth by a draw from its covariance."""
    truth, off = made.truth, np.random.default_rng(seed).standard_normal(12) * SIGMA
    A = truth.soft_iron.copy()
    upper = np.triu_indices(3)
    A[upper] += off[:6]
    A.T[upper] = A[upper]
    return Estimate(
        soft_iron=A,
        hard_iron_gauss=truth.hard_iron_gauss + off[6:9],
        gyro_bias_rad_s=truth.gyro_bias_rad_s + off[9:],
        field_gauss=truth.field_gauss,
        field_known=False,
        covariance=np.diag(SIGMA**2),
        noise_mag_gauss=truth.noise_mag_gauss,
        noise_gyro_rad_s=truth.noise_gyro_rad_s,
        misfit=1.0,
        heading_sigma_deg=0.3,
        observability=Observability(np.zeros(12), (), 2.0),
        samples=5000,
        duration_s=200.0,
        converged=converged,
    )


def stepped(
    made: Experiment, at_s: float, mag: Array | float = 0.0, gyro: Array | float = 0.0
) -> Experiment:
    """The recording with a step of hard iron or gyro bias added."""
    s = made.samples
    on = (s.time_s > at_s)[:, None]
    return replace(
        made,
        samples=replace(
            s, raw_b_gauss=s.raw_b_gauss + on * mag, gyro_b_rad_s=s.gyro_b_rad_s + on * gyro
        ),
    )


def parked(made: Experiment, row: int, rest: int, seed: int = 9) -> Experiment:
    """The same motion with `rest` samples of standing still inserted after a row."""
    rng, s, truth = np.random.default_rng(seed), made.samples, made.truth
    step_s = float(s.time_s[1] - s.time_s[0])
    still = made.field_b[row] @ truth.soft_iron.T + truth.hard_iron_gauss
    raw = still + truth.noise_mag_gauss * rng.standard_normal((rest, 3))
    rate = truth.gyro_bias_rad_s + truth.noise_gyro_rad_s * rng.standard_normal((rest, 3))
    time_s = s.time_s[0] + step_s * np.arange(len(s) + rest)
    cut = row + 1
    accel = np.repeat(s.accel_b_m_s2[row : row + 1], rest, axis=0)
    samples = SampleBlock(
        time_s=time_s,
        dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
        host_s=time_s,
        raw_b_gauss=np.concatenate([s.raw_b_gauss[:cut], raw, s.raw_b_gauss[cut:]]),
        gyro_b_rad_s=np.concatenate([s.gyro_b_rad_s[:cut], rate, s.gyro_b_rad_s[cut:]]),
        accel_b_m_s2=np.concatenate([s.accel_b_m_s2[:cut], accel, s.accel_b_m_s2[cut:]]),
        gap_before=True,
    )
    attitude = np.repeat(made.R_nb[row : row + 1], rest, axis=0)
    return replace(
        made, samples=samples, R_nb=np.concatenate([made.R_nb[:cut], attitude, made.R_nb[cut:]])
    )


def watched(
    blocks: Iterable[SampleBlock], estimate: Estimate, detector: StepDetector | None = None
) -> Step | None:
    """The step that a detector reports in a stream, with one constant estimate."""
    detector = detector or StepDetector()
    found = [step for block in blocks if (step := detector.add(block, estimate)) is not None]
    assert len(found) <= 1
    return found[0] if found else None


@pytest.mark.parametrize("scenario", ["wam", "mam", "lam"])
@pytest.mark.parametrize("at_s", [150.0, 203.7])
def test_added_magnet_is_reported_with_time_and_size(scenario, at_s):
    made = stepped(experiment(scenario, samples=7500, seed=3), at_s, MAGNET)
    step = watched(made.blocks(25), estimate_of(made))
    assert step is not None
    assert (step.what, step.frame, step.unit) == ("hard iron", "sensor", "gauss")
    assert step.at_s == pytest.approx(at_s, abs=1.0)
    assert step.told_s - at_s < 3 * BLOCK_S + 0.1  # the block in which it was added, and two more
    assert np.all(np.abs(step.size - MAGNET) < 4 * step.sigma + 1e-3)
    assert np.all(step.sigma < 3e-3)
    assert step.words.startswith(f"the hard iron changed by ({step.size[0] * 1e3:+.1f}, ")
    assert f" mG at {step.at_s:.0f} s: the calibration in force is void" in step.words


def test_gyro_bias_step_is_reported_as_such():
    jump = np.array([0.0, 0.004, -0.006])
    made = stepped(experiment("mam", samples=7500, seed=4), 160.0, gyro=jump)
    step = watched(made.blocks(25), estimate_of(made))
    assert step is not None
    assert (step.what, step.frame, step.unit) == ("gyro bias", "gyro", "rad/s")
    assert np.all(np.abs(step.size - jump) < 4 * step.sigma + 3e-4)
    assert abs(step.at_s - 160.0) < 2 * BLOCK_S


@pytest.mark.parametrize(
    ("scenario", "seed"),
    [
        ("mam", 1),
        *(
            pytest.param(scenario, seed, marks=pytest.mark.slow)
            for scenario, seed in (("wam", 1), ("lam", 1), ("wam", 2), ("mam", 2), ("lam", 2))
        ),
    ],
)
def test_no_step_is_reported_in_an_hour_without_a_change(scenario, seed):
    made = experiment(scenario, samples=45000, rate_hz=12.5, seed=seed)
    detector = StepDetector()
    assert watched(made.blocks(512), estimate_of(made, seed), detector) is None
    assert detector.armed
    assert detector.scored == 45000 // 128


def turning(seed: int, wrong: Array) -> tuple[SampleBlock, Estimate, Estimate, Estimate]:
    """Circles in one sense and then the other, with the gyro distorted by this matrix.

    Three estimates: one that knows the matrix; one that assumed a perfect gyro in the first circles
    and so found another bias; and the latter with the covariance of someone who cannot separate
    bias and matrix.
    """
    made = pieces.drive((("circles", 300.0), ("roll", 60.0), ("circles", 300.0)), seed)
    rate = made.rate_b_rad_s
    gyro = made.block.gyro_b_rad_s + rate @ (wrong - np.eye(3)).T
    known = Estimate(
        soft_iron=pieces.SOFT_IRON,
        hard_iron_gauss=pieces.HARD_IRON_GAUSS,
        gyro_bias_rad_s=pieces.GYRO_BIAS_RAD_S,
        field_gauss=0.49,
        field_known=False,
        covariance=np.diag(SIGMA**2),
        noise_mag_gauss=pieces.MAG_GAUSS,
        noise_gyro_rad_s=pieces.GYRO_RAD_S,
        misfit=1.0,
        heading_sigma_deg=0.3,
        observability=Observability(np.zeros(12), (), 2.0),
        samples=5000,
        duration_s=200.0,
        converged=True,
        gyro_correction=np.linalg.inv(wrong),
    )
    mean = rate[made.block.time_s < 200.0].mean(axis=0)
    passes = (wrong - np.eye(3)) @ mean
    perfect = replace(
        known, gyro_correction=np.eye(3), gyro_bias_rad_s=known.gyro_bias_rad_s + passes
    )
    # only the sum of bias and matrix at that rate is known
    own = np.r_[np.full(3, 0.02), np.full(6, 0.01)] ** 2
    spread = np.vstack([np.zeros((9, 9)), (GYRO_BASIS @ mean).T, np.eye(9)])
    covariance = spread @ np.diag(own) @ spread.T
    covariance[:12, :12] += known.covariance
    doubting = replace(perfect, gyro_covariance=covariance)
    return replace(made.block, gyro_b_rad_s=gyro), known, perfect, doubting


def test_gyro_scale_known_to_the_estimator_is_not_a_bias_step():
    """When the sense of rotation changes, an unknown scale error of 1 % looks like another bias."""
    wrong = np.eye(3) + np.array([[0.004, 0.0, 0.01], [0.0, -0.006, 0.0], [0.0, 0.005, 0.01]])
    jump = np.array([0.0, 0.004, -0.006])
    told = 0
    for seed in (4, 5):
        block, known, perfect, doubting = turning(seed, wrong)
        parts = [block.part(slice(a, a + 40), gap_before=a == 0) for a in range(0, len(block), 40)]
        assert watched(parts, known) is None
        assert watched(parts, doubting) is None
        step = watched(parts, perfect)
        told += step is not None and step.what == "gyro bias"
        on = (block.time_s > 200.0)[:, None]
        other = replace(block, gyro_b_rad_s=block.gyro_b_rad_s + on * jump)
        parts = [other.part(slice(a, a + 40), gap_before=a == 0) for a in range(0, len(block), 40)]
        step = watched(parts, known)
        assert step is not None
        assert step.what == "gyro bias"
        assert np.all(np.abs(step.size - jump) < 4 * step.sigma + 3e-4)
    assert told == 2


def test_no_step_is_reported_for_heavy_tails_colour_and_a_delay():
    made = experiment("mam", samples=45000, rate_hz=12.5, seed=3)
    rng, raw = np.random.default_rng(3), made.samples.raw_b_gauss.copy()
    raw += 1e-3 * np.clip(rng.standard_t(3, raw.shape), -15, 15)
    wander = np.cumsum(rng.standard_normal((len(raw) // 125 + 2, 3)), axis=0)
    at = np.arange(len(raw)) / 125.0
    knots = np.arange(len(wander))
    raw += 1e-4 * np.column_stack([np.interp(at, knots, wander[:, k] % 7) for k in range(3)])
    late = raw[1:] + 0.2 * (raw[:-1] - raw[1:])  # 16 ms
    raw = np.concatenate([raw[:1], late])
    other = replace(made, samples=replace(made.samples, raw_b_gauss=raw))
    detector = StepDetector()
    assert watched(other.blocks(512), estimate_of(made), detector) is None
    assert detector.scored == 45000 // 128


def test_magnet_added_at_rest_is_reported_after_the_next_turns_with_its_time():
    plain = parked(experiment("mam", samples=7500, seed=5), 5000, 1000)
    at_s = float(plain.samples.time_s[5500])
    made = stepped(plain, at_s, MAGNET)
    moves_s = float(plain.samples.time_s[6001])
    step = watched(made.blocks(25), estimate_of(made))
    assert step is not None
    assert moves_s < step.told_s < moves_s + 3 * BLOCK_S
    assert step.at_s == pytest.approx(at_s, abs=1.0)
    assert np.all(np.abs(step.size - MAGNET) < 4 * step.sigma + 1e-3)


def test_no_step_is_reported_at_rest_and_for_a_step_of_the_world_field():
    made = parked(experiment("mam", samples=7500, seed=6), 4000, 3000)
    s = made.samples
    car = np.einsum("nji,j->ni", made.R_nb, np.array([0.03, 0.02, -0.02]))
    for at in (3500, 5000):  # while it moves, and while it stands
        on = (np.arange(len(s)) > at)[:, None]
        raw = s.raw_b_gauss + on * car @ made.truth.soft_iron.T
        other = replace(made, samples=replace(s, raw_b_gauss=raw))
        assert watched(other.blocks(25), estimate_of(made)) is None


def broken(made: Experiment) -> Iterator[SampleBlock]:
    """Blocks with gaps, a device restart and a register change between them."""
    for number, block in enumerate(made.blocks(25)):
        if number % 37 == 5:
            continue
        yield replace(
            block,
            time_s=block.time_s - (100.0 if number > 200 else 0.0),
            epoch=number // 90,
            gap_before=number % 37 == 6,
        )


def test_step_is_reported_and_gaps_restarts_and_register_changes_are_not():
    made = experiment("mam", samples=12000, seed=7)
    detector = StepDetector()
    assert watched(broken(made), estimate_of(made), detector) is None
    assert detector.scored > 30
    step = watched(broken(stepped(made, 300.0, MAGNET)), estimate_of(made))
    assert step is not None
    assert np.all(np.abs(step.size - MAGNET) < 4 * step.sigma + 1e-3)


def test_step_does_not_depend_on_the_block_size():
    made = stepped(experiment("lam", samples=7500, seed=8), 170.0, MAGNET)
    steps = [watched(made.blocks(rows), estimate_of(made)) for rows in (1, 10, 10, 400)]
    assert steps[0] is not None
    assert len({step.words for step in steps if step is not None}) == 1
    assert all(step is not None and np.array_equal(step.size, steps[0].size) for step in steps)


def test_bad_readings_invalidate_only_their_block():
    made = stepped(experiment("mam", samples=7500, seed=3), 150.0, MAGNET)
    raw = made.samples.raw_b_gauss.copy()
    raw[1000], raw[2000] = np.nan, 1e30
    made = replace(made, samples=replace(made.samples, raw_b_gauss=raw))
    detector = StepDetector()
    assert watched(made.blocks(25), estimate_of(made), detector) is not None
    assert detector.scored == round(detector.found.told_s / BLOCK_S) - 2


def test_no_step_before_a_converged_estimate_and_memory_is_bounded():
    made = stepped(experiment("mam", samples=20000, rate_hz=12.5, seed=3), 700.0, MAGNET)
    detector = StepDetector()
    assert watched(made.blocks(64), estimate_of(made, converged=False), detector) is None
    assert (detector.scored, detector.armed) == (0, False)
    plain = experiment("mam", samples=20000, rate_hz=12.5, seed=3)
    watched(plain.blocks(64), estimate_of(plain), detector)
    assert detector.scored == 156
    assert len(detector._blocks) == KEPT
    assert len(detector._single_gains) < 2 * KEPT + 1
    assert detector._builder._count < 128


def test_score_and_information_of_a_block_predict_a_change_of_the_parameters():
    """Columns compared with finite differences."""
    made = experiment("mam", samples=400, seed=2)
    s = made.samples
    angle = np.cumsum(s.gyro_b_rad_s * np.nan_to_num(s.dt_s)[:, None], axis=0)
    rows = Thinned(s.time_s[:128], s.raw_b_gauss[:128], angle[:128], 1)
    right = replace(estimate_of(made), covariance=np.diag(SIGMA**2))
    scorer = Scorer()
    base = scorer.score(rows, ReferenceCalibration.of(right))
    theta = np.r_[np.zeros(6), 2e-4, -1e-4, 1e-4, 3e-5, -2e-5, 4e-5, np.zeros(9)]
    theta[[1, 3]] = 3e-4, -2e-4
    theta[12:] = 1e-4 * np.array([3.0, -2.0, 4.0, 2.0, -3.0, 1.0, 2.0, -2.0, 1.0])
    off = ReferenceCalibration.of(right).theta - theta
    A = np.zeros((3, 3))
    A[np.triu_indices(3)] = off[:6]
    A = A + A.T - np.diag(np.diag(A))
    moved = replace(
        right,
        soft_iron=A,
        hard_iron_gauss=off[6:9],
        gyro_bias_rad_s=off[9:12],
        gyro_correction=InstrumentCorrection.identity().with_gyro(off[12:]).gyro,
    )
    found = scorer.score(rows, ReferenceCalibration.of(moved)).score[:21] - base.score[:21]
    expected = base.information[:21, :21] @ theta
    assert np.allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_rotations_are_accumulated():
    turns = np.linalg.qr(np.random.default_rng(0).standard_normal((37, 3, 3)))[0]
    expected = np.eye(3)
    for turn, one in zip(turns, accumulate_rotations(turns), strict=True):
        expected = expected @ turn
        assert np.allclose(one, expected, atol=1e-12)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("01_undisturbed_slow_rotation_A", marks=pytest.mark.slow),
        "02_undisturbed_slow_rotation_B",
    ],
)
@pytest.mark.recordings
def test_injected_step_in_a_real_recording_is_reported_and_nothing_without_it(name):
    path = RECORDINGS / "broad" / f"{name}.csv.gz"
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    blocks = [part for block in read_table(path).blocks() for part in cut(block, 100)]
    notes, calibrator = calibrated(blocks)
    assert notes == []
    estimate = calibrator.finish()
    assert estimate is not None
    assert estimate.converged
    at_s = float(blocks[0].time_s[0]) + 105.0
    assert watched(blocks, estimate) is None
    step = watched([magnet_on(block, at_s) for block in blocks], estimate)
    assert step is not None
    assert step.at_s == pytest.approx(at_s, abs=2.0)
    assert np.all(np.abs(step.size - MAGNET) < 4 * step.sigma + 2e-3)
    assert np.all(step.sigma < 8e-3)


def cut(block: SampleBlock, rows: int) -> Iterator[SampleBlock]:
    for at in range(0, len(block), rows):
        part = slice(at, at + rows)
        yield SampleBlock(
            block.time_s[part],
            block.dt_s[part],
            block.host_s[part],
            block.raw_b_gauss[part],
            block.gyro_b_rad_s[part],
            block.accel_b_m_s2[part],
            gap_before=block.gap_before and at == 0,
        )


def magnet_on(block: SampleBlock, at_s: float) -> SampleBlock:
    on = (block.time_s > at_s)[:, None]
    return replace(block, raw_b_gauss=block.raw_b_gauss + on * MAGNET)


def calibrated(blocks: Iterable[SampleBlock]) -> tuple[list[str], Calibrator]:
    config = Config()
    settings = CalibratorSettings(config.estimator.parameters(), config.gates.limits())
    calibrator = Calibrator(settings, Affine.identity(), np.zeros(3))
    notes = []
    for block in blocks:
        calibrator.take(block)
        notes += [note.text for note in calibrator.take_notes(0.0)]
    return notes, calibrator


# -- in the daemon ---------------------------------------------------------------------------------


HEALTH = HealthFacts(0.0, 0.0, 0, 0, 40.0)
BASIS = BasisFacts(True, False, False, False, True)


def gate_of(calibrator: Calibrator) -> bool:
    gates = {gate.gate: gate.ok for gate in calibrator.judge_estimate(0.0, HEALTH, BASIS)}
    return gates["stationarity.step"]


def test_step_closes_the_gate_until_the_estimator_has_restarted(monkeypatch):
    """The estimator is prevented from restarting by itself, so that the calibrator restarts it."""
    monkeypatch.setattr("ahrsd.core.estimation._PATIENCE_S", 20.0)
    monkeypatch.setattr("ahrsd.estimator.online._CHANGED_EPOCHS", 1_000)
    made = stepped(experiment("mam", samples=18000, rate_hz=40.0, seed=5), 300.0, 0.27 * MAGNET)
    config = Config()
    settings = CalibratorSettings(config.estimator.parameters(), config.gates.limits())
    calibrator = Calibrator(settings, Affine.identity(), np.zeros(3))
    notes: list[Noted] = []
    shut: list[float] = []
    for block in made.blocks(10):
        if calibrator.take(block) and not gate_of(calibrator):
            shut.append(float(block.time_s[-1]))
        notes += calibrator.take_notes(7.0)
    assert [note.text[:16] for note in notes] == ["the hard iron ch", "calibrated anew "]
    assert [(note.level, note.host_s) for note in notes] == [("warning", 7.0)] * 2
    assert shut[0] == pytest.approx(notes[0].at_s, abs=0.3)
    assert shut[-1] <= notes[1].at_s < shut[0] + 21.0
    estimate = calibrator.estimate
    assert estimate is not None
    assert gate_of(calibrator)
    truth = made.truth.hard_iron_gauss + 0.27 * MAGNET
    assert np.all(np.abs(estimate.hard_iron_gauss - truth) < 5 * estimate.sigma[6:9])


def test_step_warning_reaches_log_status_and_explain():
    made = stepped(experiment("mam", samples=16000, rate_hz=40.0, seed=5), 300.0, MAGNET)
    core = Core(core_settings(Config(), policy=WriteBackPolicy(mode=Mode.PASSIVE)))
    warnings: list[Noted] = []
    shut: list[float] = []
    texts: list[str] = []
    said: dict[str, object] = {}
    for number, block in enumerate(made.blocks(10)):
        for event in core.handle(Samples(number, block)):
            if isinstance(event, Noted) and event.level == "warning":
                warnings.append(event)
            elif isinstance(event, Judged):
                gates = {gate.gate: gate for gate in event.gates}
                shut += [] if gates["stationarity.step"].ok else [event.at_s]
        if core.calibrator.step_open and not said:
            said = StatusMaker(0.0).make(core, LinkFacts("/dev/vn100", 115200, True), 1.0)
            texts = explain_lines(explain_json(said))
    told = core.calibrator.step
    assert told is not None
    assert warnings[0].text == told.words
    assert warnings[1].text.endswith(
        "calibrated anew from there"
    )  # the restart by the estimator itself
    assert len(warnings) == 2
    assert shut
    assert said["mismatch"]["open"] is True
    assert said["mismatch"]["step"]["at_s"] == pytest.approx(300.0, abs=1.0)
    assert mismatch_line(said) == f"mismatch: {told.words}"
    assert f"mismatch: {told.words}" in texts
    after = StatusMaker(0.0).make(core, LinkFacts("/dev/vn100", 115200, True), 1.0)
    assert mismatch_line(after).endswith(" (calibrated anew since)")
    assert core.calibrator.estimate is not None
    assert core.calibrator.estimate.converged
