"""A calibration that is no longer valid never reaches the flash, whenever that is found.

Judged by the unit's own record of what it was sent (`cabled_units`).
"""

from __future__ import annotations

import numpy as np
import pytest
from cabled_run import FIRST, IRON, CabledRun, estimate, lenient_gates, two_units
from planted_calibrator import PlantedCalibrator

from ahrsd.config.config import check_config, core_settings
from ahrsd.core.estimation import Calibrator
from ahrsd.events import GateResult
from ahrsd.gates import GATES
from ahrsd.writeback.policy import Safeguards, WriteBackPolicy

STEP = np.array([0.06, 0.0, 0.0])
OLD = ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2


def undone(run: CabledRun) -> None:
    """Nothing was saved and the old values are in RAM again."""
    unit = run.cable.units[FIRST]
    assert unit.saves == []
    assert unit.held("flash") == OLD
    assert unit.held() == OLD


def voided(run: CabledRun, words: str = "the hard iron changed: the calibration in force is void"):
    """What the calibrator returns when it has seen a step."""
    run.core.calibrator._void = words


@pytest.mark.parametrize("when", ["trial", "proven"])
def test_step_of_the_iron_rolls_back_unsaved_values(when):
    run = CabledRun(two_units())
    if when == "trial":
        run.approve()
        assert run.until("TRIAL")
    else:
        run.proven()
    voided(run)
    assert run.until("ROLLED_BACK", 20.0)
    run.park()
    undone(run)
    assert run.journal[FIRST][-2]["facts"]["cause"] == "void"
    assert (
        run.core.writeback.history.rollbacks == 0
    )  # the values were correct when they were written


@pytest.mark.parametrize(
    "at",
    [pytest.param(at, marks=[] if at % 3 == 1 else pytest.mark.slow) for at in range(1, 36, 5)],
)
def test_step_of_the_iron_at_any_command_of_the_save(at):
    run, heard = CabledRun(two_units()), []
    run.proven()

    def step(line: str) -> None:
        if run.state == "SAVING":
            heard.append(line)
            if len(heard) == at:
                run.core._action_queue.add(run.core.writeback.on_void("a step", 0.0, run.now_s))

    run.cable.unit.before = step
    run.park(30.0)
    assert len(heard) >= at
    undone(run)


@pytest.mark.parametrize("at", [1, 12, pytest.param(30, marks=pytest.mark.slow)])
def test_save_is_decided_again_when_its_checks_take_too_long(at, monkeypatch):
    """No sample arrives during the checks, so a change of the vehicle would not be seen."""
    monkeypatch.setattr("ahrsd.writeback.flow.RETRY_SAVE_S", 12.0)  # not ten minutes
    run, heard, held_s = CabledRun(two_units(rate_hz=50.0)), [], []
    run.proven()

    def silence(line: str) -> None:
        if run.state == "SAVING" and not held_s:
            heard.append(line)
            if len(heard) == at:
                run.cable.fall_silent(0.6)
                held_s.append(run.now_s)

    run.cable.unit.before = silence
    run.park(10.0)
    unit = run.cable.units[FIRST]
    assert held_s
    assert unit.saves == []
    assert run.state == "PROVEN"
    assert run.told("not saved", "answers were late", "1.1 s are allowed")
    assert run.until("COMMITTED", 20.0)
    assert len(unit.saves) == 1
    assert run.kinds().count("FLASH_SENT") == 2


def test_slow_line_does_not_prevent_a_save():
    """One answer per 50 ms: the checks of a save last two seconds and more."""
    run, begun_s = CabledRun(two_units()), []
    run.proven()

    def first(line: str) -> None:
        if run.state == "SAVING" and not begun_s:
            begun_s.append(run.now_s)

    run.cable.unit.before = first
    run.cable.moving, run.safe = False, True
    assert run.until(lambda: run.cable.units[FIRST].saves, 20.0)
    assert run.now_s - begun_s[0] > 1.0


def test_clearly_different_estimate_ends_the_proof():
    run = CabledRun(two_units())
    run.proven()
    run.core.calibrator = PlantedCalibrator(
        run.core.calibrator, estimate(hard_iron_gauss=IRON + STEP)
    )
    run.run(15.0)
    assert any("asks for another" in text for text in run.core.writeback.obstacles())
    run.park(120.0)
    undone(run)


def test_slightly_different_estimate_only_delays_the_save():
    run = CabledRun(two_units())
    run.proven()
    slightly = PlantedCalibrator(
        run.core.calibrator, estimate(hard_iron_gauss=IRON + np.array([0.003, 0.0, 0.0]))
    )
    run.core.calibrator = slightly
    run.park(120.0)
    assert run.state == "PROVEN"
    assert run.cable.unit.saves == []
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
    run.run(15.0)
    assert run.state == "COMMITTED"


class OneClosedGate(PlantedCalibrator):
    """One gate is closed."""

    def judge_estimate(self, at_s: float, *_: object) -> tuple[GateResult, ...]:
        super().judge_estimate(at_s)
        bad = GateResult(GATES[0].gate, 2.0, 1.0, False, at_s, "", "look at the wire")
        self.gates = (bad, *self.gates[1:])
        return self.gates


def test_closed_gate_delays_the_save_and_ends_the_proof_if_it_stays_closed():
    run = CabledRun(two_units())
    run.proven()
    green, red = run.core.calibrator, OneClosedGate(run.core.calibrator, estimate())
    run.core.calibrator = red
    run.park(30.0)
    assert run.state == "PROVEN"
    run.safe = False
    run.core.calibrator = green
    run.run(30.0)
    assert run.state == "PROVEN"
    run.core.calibrator = red
    run.park(100.0)
    undone(run)


def test_jump_of_the_readings_at_rest_requires_a_new_proof():
    """A magnet is mounted while the vehicle stands, so that no motion shows it to the estimator."""
    run = CabledRun(two_units())
    run.proven()
    run.cable.moving = False
    run.run(3.0)
    run.cable.iron = STEP
    run.park(15.0)
    assert run.cable.unit.saves == []
    assert run.told("jumped")
    again = any("on trial again" in text for text in run.core.writeback.obstacles())
    assert again or "ROLLED_BACK" in run.states  # or the trial has already found it worse


def test_proof_without_recent_samples_is_undone():
    run = CabledRun(two_units())
    run.proven()
    run.cable.unit.ram[6] = "0"
    measure, run.cable.unit.measure = run.cable.unit.measure, lambda *_: b""
    run.run(620.0)
    assert run.cable.unit.saves == []
    assert run.cable.unit.held() == OLD, run.notes[-5:]
    run.cable.unit.measure = measure


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_step_seen_by_the_real_estimator_prevents_the_save():
    """The real estimator from the first sample; the vehicle permits the save after it has
    converged again.
    """
    config = check_config({"gates": lenient_gates()}, "test")
    run = CabledRun(two_units(binary=True), planted=False)
    run.core.calibrator = Calibrator(
        core_settings(config).calibrator, run.core.calibrator.present, np.zeros(3)
    )
    run.cable.moving = False
    run.run(15.0)
    run.cable.moving = True
    assert run.until("QUALIFIED", 400.0), run.core.writeback.obstacles()
    run.proven()
    written = run.cable.unit.held()
    assert written != OLD
    run.cable.iron = STEP
    assert run.until(lambda: run.told("void") or run.told("iron changed"), 200.0)
    run.run(1.0)
    assert run.state in ("ROLLING_BACK", "ROLLED_BACK", "CANDIDATE"), run.states
    run.run(100.0)
    run.park()
    undone(run)


@pytest.mark.parametrize(
    ("reply_timeout_s", "max_age_s", "most_s"),
    [(0.4, 1.0, 0.5), (0.4, 60.0, 0.5), (2.0, 60.0, 2.0), (2.0, 1.0, 1.0), (60.0, 1.0, 1.0)],
)
def test_checks_of_a_save_have_a_time_limit(reply_timeout_s, max_age_s, most_s):
    policy = WriteBackPolicy(reply_timeout_s=reply_timeout_s, interlock_max_age_s=max_age_s)
    safe = Safeguards(policy)
    safe.save_from_s = 100.0
    assert safe.save_too_late(100.0 + most_s - 0.01) == ""
    assert f"{most_s:.1f} s are allowed" in safe.save_too_late(100.0 + most_s + 0.01)
