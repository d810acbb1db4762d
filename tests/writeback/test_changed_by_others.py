"""Registers changed by another program: data un-mapped through the old values prove nothing."""

from __future__ import annotations

import numpy as np
import pytest
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun

from ahrsd.calibration import Estimate, Observability
from ahrsd.config.config import Config, core_settings
from ahrsd.core.write_back import DeviceRecord
from ahrsd.writeback.policy import ROTATION_WAITS, WriteBackPolicy
from ahrsd.writeback.states import Mode
from drivers.vn100.emulator.scenarios import Setup, build

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
OTHER = (*IDENTITY[:9], 0.05, 0.0, 0.0)


def estimate() -> Estimate:
    return Estimate(
        np.diag([1.1, 1.0, 1 / 1.1]), np.array([0.03, 0.04, -0.02]), np.zeros(3),
        0.48, False, np.eye(12) * 1e-6, 1e-3, 1e-3, 1.0, 0.1,
        Observability(np.full(12, 0.01), (), 10.0), 10_000, 300.0, True,
    )  # fmt: skip


@pytest.fixture(params=["imu"])
def observing(request) -> VirtualRun:
    """A run that would write the estimate of its calibrator as soon as a person approves it."""
    policy = WriteBackPolicy(mode=Mode.STAGE, armed_at_start=True, max_change_auto_deg=180.0)
    device = build(Setup("rov", seed=3, output=request.param, rate_hz=50))
    run = VirtualRun(device, core_settings(Config(), policy=policy), step_s=0.1)
    assert run.until(lambda: run.core.writeback.state.value == "OBSERVING", 10.0), run.notes
    run.run(3.0)
    return run


def test_check_before_a_write_finds_a_foreign_change_and_restarts_the_calibration(observing):
    run = observing
    planted = PlantedCalibrator(run.core.calibrator, estimate())
    run.core.calibrator = planted
    assert run.until(lambda: run.core.writeback.state.value == "QUALIFIED", 20.0), run.states
    run.emulator.memory.ram[23, 0] = OTHER
    run.emulator.sensor.changed()
    run.operate("approve", run.core.writeback.proposal.id)
    assert "CHECKING" in run.states
    assert run.until(lambda: run.core.calibrator is not planted, 20.0), run.states
    assert ("warning", "somebody changed registers [23]: calibrated anew") in run.notes
    assert run.writes == 0
    assert run.core.registers[23] == pytest.approx(OTHER)
    run.run(15.0)  # the registers are read again before the samples count
    assert run.core.calibrator.started


def test_change_explained_by_a_restart_does_not_restart_the_calibration(observing):
    run = observing
    before = run.core.calibrator
    run.emulator.memory.ram[23, 0] = OTHER
    run.emulator.restart(run.now_s)
    run.run(10.0)
    assert run.core.calibrator is before
    assert not [text for _, text in run.notes if "somebody" in text]


@pytest.mark.parametrize("observing", ["binary"], indirect=True)
def test_rotation_that_does_not_act_yet_allows_no_sample_and_no_write(observing):
    run, turned = observing, (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    run.emulator.memory.ram[26, 0] = turned  # the device goes on with the one before
    run.run(15.0)
    waits = [text for text in run.core.writeback.obstacles() if text.startswith("register 26")]
    assert waits == [ROTATION_WAITS]
    assert run.core.writeback.mode is Mode.OBSERVE
    run.run(15.0)
    assert not run.core.calibrator.started
    run.emulator.memory.save()
    run.emulator.restart(run.now_s)
    run.run(25.0)
    assert run.core.registers[26] == turned
    assert run.core.writeback.mode is Mode.STAGE
    assert run.core.calibrator.started


def test_values_that_differ_only_by_printing_are_equal():
    record = DeviceRecord()
    written = (1.0569499731063843, *IDENTITY[1:])
    printed = (1.05695, *IDENTITY[1:])
    assert record.on_registers_read({23: written}, {}, 1) == []
    assert record.on_registers_read({23: printed, 84: IDENTITY}, {23: written}, 1) == []
    assert record.on_registers_read({23: OTHER}, {23: printed}, 1) == [23]
    assert (
        record.on_registers_read({23: IDENTITY}, {23: OTHER}, 2) == []
    )  # the link was lost in between
