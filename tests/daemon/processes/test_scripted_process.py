"""`ahrsd run` as a program on a scripted device: exchange, second master, clocks, changed iron.

Each promise of tests/writeback/histories/test_write_moments.py once with real processes, files and
time, half a minute to two minutes each (`pytest -m slow`).
"""

from __future__ import annotations

import numpy as np
import pytest
from scripted_process import SERIAL, Program

pytestmark = [pytest.mark.timeout(400), pytest.mark.slow]


@pytest.fixture
def program(tmp_path):
    """`with program(...) as running`; the options are those of `Program`."""

    def make(**options: object) -> Program:
        return Program(tmp_path, **options)

    return make


def test_whole_write_to_flash_and_confirmation_after_a_restart(program):
    with program() as running:
        running.start()
        running.until_record("FLASH_ACKED")
        running.for_s(1.0)
        running.served.act(lambda cable, now_s: cable.unit.restart(now_s, off_s=0.5))
        running.until_record("CONFIRMED")
        assert running.stop() == 0
        assert running.observer.violations == []
        held = running.unit.memory.floats(23, "flash")
        assert np.abs(np.array(held) - running.unit.iron.correction()).max() < 0.01


@pytest.mark.parametrize("stream", ["binary", "imu"])
def test_approval_for_one_unit_writes_nothing_to_another(program, stream):
    with program(stream=stream, approval="operator") as running:
        running.start()
        running.until(lambda: "candidate" in running.said)
        candidate = running.candidate()
        running.swap(silent_s=2.0)
        running.operate("approve", candidate)
        running.for_s(6.0)
        assert running.writes(555) == []
        running.stop()
        running.look()
        assert running.observer.violations == []


def test_unit_exchanged_in_a_trial_is_not_changed(program):
    with program(stream="imu", trial_s=6.0) as running:
        running.start()
        running.until_record("RAM_VERIFIED")
        other = running.swap(silent_s=0.3)
        before = dict(other.memory.flash)
        running.for_s(8.0)
        running.stop()
        running.look()
        assert running.observer.violations == []
        assert other.memory.flash == before


def test_calibration_void_before_the_vehicle_is_safe_is_not_saved(program):
    with program(trial_s=3.0, trial_interlock=False) as running:
        running.start()
        running.until_record("RAM_VERIFIED")
        running.word = "no"
        running.until_record("PROVEN")
        assert "FLASH_SENT" not in running.kinds
        by = np.array([0.04, -0.03, 0.035])
        running.served.act(lambda cable, now_s: running.vehicle.move_iron(by, now_s))
        running.until(lambda: "is void" in running.said)
        running.for_s(8.0)  # recalibrated in between
        running.word = "safe"
        running.for_s(12.0)
        running.stop()
        running.look()
        assert running.observer.violations == []


@pytest.mark.parametrize("behind_s", [-1.7e9, -3600.0])
def test_setting_the_wall_clock_confirms_nothing(program, behind_s):
    """The save is only acknowledged. The program starts again in the same boot with the clock
    corrected.
    """
    with program() as running:
        running.set_wall(behind_s)
        running.unit.lies.not_saved = True
        running.start()
        running.until_record("FLASH_ACKED")
        running.for_s(0.5)
        running.kill()
        running.set_wall(0.0)
        length = len(running.said)
        running.start()
        running.until(lambda: "RECONCILING -> " in running.said[length:])
        running.for_s(6.0)
        running.stop()
        running.look()
        assert "CONFIRMED" not in running.kinds
        assert running.observer.violations == []


def test_foreign_write_in_proven_is_noticed_before_a_save(program):
    with program(trial_s=3.0, trial_interlock=False) as running:
        running.start()
        running.until_record("RAM_VERIFIED")
        running.word = "no"
        running.until_record("PROVEN")
        foreign = "VNWRG,23,1,0,0,0,1,0,0,0,1,0.2,0.1,-0.1"
        running.served.act(lambda cable, now_s: cable.other_master(foreign, now_s))
        length = len(running.said)
        running.until(lambda: "PROVEN -> " in running.said[length:])
        running.word = "safe"
        running.for_s(5.0)
        running.stop()
        running.look()
        assert "FLASH_ACKED" not in running.kinds
        assert running.unit.memory.ram[23] == "1,0,0,0,1,0,0,0,1,0.2,0.1,-0.1"
        assert running.observer.violations == []


def test_restart_between_two_registers_is_not_proven(program):
    with program(stream="imu", trial_s=2.0) as running:
        done = []

        def restart_once(label: str) -> None:
            if label == "before VNWRG,84" and not done:
                done.append(label)
                running.unit.restart(running.served.now_s())

        running.cable.moment = restart_once
        running.start()
        running.until(lambda: done)
        running.for_s(12.0)
        running.stop()
        running.look()
        assert running.observer.violations == []


def test_journal_and_device_agree_after_random_kills(program):
    draw = np.random.default_rng(3)
    with program() as running:
        for _ in range(5):
            running.start()
            running.for_s(float(draw.uniform(6.0, 14.0)))
            running.kill()
        running.start()
        running.until(lambda: "FLASH_ACKED" in running.kinds or "CONFIRMED" in running.kinds)
        running.stop()
        running.look()
        assert running.observer.violations == []
        assert {serial for serial, _, _ in running.records} == {SERIAL}
