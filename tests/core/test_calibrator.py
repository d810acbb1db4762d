"""From samples to a judged estimate: what the estimator receives, and the scale of the field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pieces
import pytest
from streams import binary_device, emitted, inputs

from ahrsd.calibration import Affine
from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.core.estimation import Calibrator
from ahrsd.core.settings import CalibratorSettings
from ahrsd.estimator import locked
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.events import Event, SamplesSeen
from ahrsd.evidence.values import BasisFacts, HealthFacts
from ahrsd.samples import SampleBlock
from ahrsd.world_field import world_field
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode

HEALTH = HealthFacts(crc_error_rate=0.0, drop_rate=0.0, saturated=0, negative_dt=0, rate_hz=40.0)
BASIS = BasisFacts(
    registers_read=True,
    changed=False,
    hsi_applied=False,
    compensated_only=False,
    firmware_known=True,
)
DEVICE = binary_device(12, {})


@pytest.fixture(scope="module")
def blocks() -> list[SampleBlock]:
    """60 s of a tumbling sensor."""
    seen: list[Event] = []
    core = Core(core_settings(Config(), policy=WriteBackPolicy(mode=Mode.PASSIVE)))
    for item in inputs([emitted(DEVICE, 60.0)]):
        seen += core.handle(item)
    return [event.block for event in seen if isinstance(event, SamplesSeen)]


def settings(**changes: object) -> CalibratorSettings:
    config = Config()
    plain = CalibratorSettings(config.estimator.parameters(), config.gates.limits())
    return replace(plain, **changes)


def run(blocks: list[SampleBlock], **changes: object) -> Calibrator:
    calibrator = Calibrator(settings(**changes), Affine.identity(), np.zeros(3))
    for block in blocks:
        calibrator.take(block)
    return calibrator


def test_calibrator_finds_the_calibration_of_the_emulated_device(blocks):
    estimate = run(blocks).finish()
    assert estimate is not None
    assert estimate.converged
    truth = DEVICE.truth
    assert (
        np.abs((estimate.hard_iron_gauss - truth.hard_iron_gauss) / estimate.sigma[6:9]).max() < 4
    )
    assert np.abs((estimate.gyro_bias_rad_s - truth.gyro_bias_rad_s) / estimate.sigma[9:]).max() < 4


@pytest.mark.slow
def test_held_out_samples_never_reach_the_estimator(blocks):
    """Changes of held-out samples do not change the estimate (a step would: `monitoring`)."""
    plain, other = (Calibrator(settings(), Affine.identity(), np.zeros(3)) for _ in range(2))
    held, rng = 0, np.random.default_rng(1)
    for block in later(blocks, 3):
        plain.take(block)
        kept_out = all(role == "heldout" for role, _ in other.collector.split(block))
        held += len(block) * kept_out
        raw = block.raw_b_gauss + 0.2 * rng.standard_normal(block.raw_b_gauss.shape)
        other.take(replace(block, raw_b_gauss=raw) if kept_out else block)
    assert 300 < held < 3 * 2400
    assert plain.estimate is not None
    assert other.estimate is not None
    assert np.array_equal(plain.estimate.hard_iron_gauss, other.estimate.hard_iron_gauss)
    assert np.array_equal(plain.estimate.covariance, other.estimate.covariance)


def later(blocks: list[SampleBlock], times: int) -> list[SampleBlock]:
    """The same minute repeated, a minute apart."""
    return [
        replace(block, time_s=block.time_s + 60.0 * k, host_s=block.host_s + 60.0 * k)
        for k in range(times)
        for block in blocks
    ]


def test_drift_is_followed_across_a_restart_of_the_device(blocks):
    """Its time falls there, and no run may be taken for one at the same time as another."""
    estimator = Estimator(Config().estimator.parameters(), at_once=WHOLE)
    for run_, starts_s in enumerate((900.0, 20.0)):
        for number, block in enumerate(blocks):
            since_s = block.time_s - blocks[0].time_s[0]
            behind_s = 63.0 * run_ + since_s
            drift = behind_s[:, None] * np.array([4e-5, -3e-5, 3e-5])
            dt_s = block.dt_s.copy()
            dt_s[0] = dt_s[0] if number else np.nan
            estimator.add(
                replace(
                    block,
                    time_s=starts_s + since_s,
                    host_s=behind_s,
                    dt_s=dt_s,
                    gyro_b_rad_s=block.gyro_b_rad_s + drift,
                    gap_before=block.gap_before or not number,
                )
            )
    estimate = estimator.finish()
    assert estimate is not None
    assert estimate.sigma[9:].max() < 1.5e-3
    now = DEVICE.truth.gyro_bias_rad_s + 123.0 * np.array([4e-5, -3e-5, 3e-5])
    assert np.abs((estimate.gyro_bias_rad_s - now) / estimate.sigma[9:]).max() < 4


def test_batch_has_no_held_out_samples_and_loses_no_step(blocks):
    samples = sum(len(block) for block in blocks)
    seen: list[SampleBlock] = []
    calibrator = Calibrator(settings(held_out=False), Affine.identity(), np.zeros(3))
    add = calibrator.estimator.add

    def spy(block: SampleBlock) -> bool:
        seen.append(block)
        return add(block)

    calibrator.estimator.add = spy  # type: ignore[method-assign]
    for block in blocks:
        calibrator.take(block)
    assert sum(len(block) for block in seen) == samples
    assert (
        sum(int(np.count_nonzero(np.isnan(block.dt_s))) for block in seen) == 1
    )  # the first sample
    estimate = calibrator.finish()
    assert estimate is not None
    assert estimate.samples == samples


def test_known_field_sets_the_scale(blocks):
    field = world_field(37.8, -122.4, 0.0, 2025.5)
    plain, known = run(blocks).estimate, run(blocks, world_field=field).estimate
    assert plain is not None
    assert known is not None
    assert (plain.field_known, known.field_known) == (False, True)
    assert known.field_gauss == field.total_gauss
    factor = plain.field_gauss / field.total_gauss
    assert known.soft_iron == pytest.approx(plain.soft_iron * factor)
    assert known.sigma[:6] == pytest.approx(plain.sigma[:6] * factor)
    assert known.hard_iron_gauss == pytest.approx(plain.hard_iron_gauss)
    assert known.sigma[6:] == pytest.approx(plain.sigma[6:])
    inside = blocks[40].raw_b_gauss
    strength = np.linalg.norm(known.correction.apply(inside), axis=1)
    assert strength.mean() == pytest.approx(field.total_gauss, rel=0.01)


def test_nothing_is_judged_without_an_estimate():
    calibrator = Calibrator(settings(), Affine.identity(), np.zeros(3))
    assert calibrator.judge_estimate(0.0, HEALTH, BASIS) == ()
    assert calibrator.finish() is None


def test_estimate_is_judged_by_every_gate(blocks):
    calibrator = run(blocks)
    gates = calibrator.judge_estimate(60.0, HEALTH, BASIS)
    assert len(gates) > 30
    assert len({gate.gate for gate in gates}) == len(gates)
    verdicts = {gate.gate: gate.ok for gate in gates}
    assert verdicts["observability.converged"]
    assert verdicts["stream_health.errors"]
    worse = replace(HEALTH, crc_error_rate=0.5)
    assert not {g.gate: g.ok for g in calibrator.judge_estimate(61.0, worse, BASIS)}[
        "stream_health.errors"
    ]


def test_restarted_calibrator_is_empty_and_keeps_the_calibration_in_force(blocks):
    present = Affine(np.eye(3), np.array([0.1, 0.0, 0.0]))
    calibrator = Calibrator(settings(), present, np.array([0.01, 0.0, 0.0]))
    for block in blocks[:100]:
        calibrator.take(block)
    assert calibrator.estimate is not None
    fresh = calibrator.make_fresh()
    assert fresh.estimate is None
    assert not fresh.started
    assert fresh.present is present
    assert fresh.present_gyro_bias_rad_s.tolist() == [0.01, 0.0, 0.0]


def test_remaining_residual_is_reported_once_and_judged():
    """A field that follows the attitude, half of the magnetometer's noise on each axis."""
    motion = (("circles", 40.0), ("roll", 30.0), ("pitch", 30.0), ("circles", 40.0), ("roll", 30.0))
    made = pieces.drive(motion, 700)
    draw = np.random.default_rng(700).normal(size=(12, 3))
    more = locked.harmonics(made.field_b_gauss) @ draw * np.sqrt(3.0) / np.linalg.norm(draw)
    told, places = {}, {}
    for size_gauss in (0.0, 5e-4):
        whole = replace(made.block, raw_b_gauss=made.block.raw_b_gauss + size_gauss * more)
        cut = [whole.part(slice(a, a + 40), gap_before=a == 0) for a in range(0, len(whole), 40)]
        calibrator = run(cut)
        calibrator.finish()
        told[size_gauss] = [note.text for note in calibrator.take_notes(0.0)]
        gates = {gate.gate: gate for gate in calibrator.judge_estimate(170.0, HEALTH, BASIS)}
        places[size_gauss] = gates["field.place"]
    assert told[0.0] == []
    (text,) = told[5e-4]
    assert text.startswith("the residual follows the attitude: 0.")
    assert text.endswith(" mG; run `ahrsd diagnose` on the recording")
    assert places[0.0].ok
    assert not places[5e-4].ok
