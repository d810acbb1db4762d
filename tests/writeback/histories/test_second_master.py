"""Another program writes through the device's second port, or the device restarts unseen.

Judged by what the unit holds and what it was sent (`cabled_units`).
"""

from __future__ import annotations

import numpy as np
import pytest
from cabled_run import BIAS, FIRST, IRON, SPARE, CabledRun, two_units
from cabled_units import Cable, Unit

from ahrsd.inputs import Operator
from ahrsd.writeback.states import Mode

THEIRS = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"
OLD = ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2
NEW = ("1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005")
#: which command, and whether the stream is binary
QUICK_SAVE = ((1, False), (21, True))


def foreign_value_stays(run: CabledRun) -> None:
    """The foreign value stays in RAM, nothing is in flash, and it was reported."""
    unit = run.cable.units[FIRST]
    assert unit.held()[0] == THEIRS
    assert unit.held("flash") == OLD
    assert unit.saves == []
    assert [n for n, _ in unit.writes] == [
        23,
        84,
    ]  # ours, once; the foreign value is not overwritten
    assert run.state == "LOCKED"
    assert run.kinds()[-1] == "FOREIGN"
    assert run.told("values that nobody here wrote")


@pytest.mark.parametrize(
    ("when", "binary"),
    [
        ("trial", False),
        ("proven", True),
        pytest.param("trial", True, marks=pytest.mark.slow),
        pytest.param("proven", False, marks=pytest.mark.slow),
    ],
)
def test_foreign_value_is_found_within_the_check_interval_and_stays(binary, when):
    run = CabledRun(two_units(binary=binary))
    if when == "trial":
        run.approve()
        assert run.until("TRIAL")
    else:
        run.proven()
    run.cable.unit.ram[23] = THEIRS
    assert run.until("LOCKED", 40.0), run.notes
    run.park()
    foreign_value_stays(run)


@pytest.mark.parametrize(
    ("at", "binary"),
    [
        pytest.param(at, how, marks=[] if (at, how) in QUICK_SAVE else pytest.mark.slow)
        for at in range(1, 33, 5)
        for how in (False, True)
    ],
)
def test_foreign_value_written_just_before_the_save_is_not_saved(binary, at):
    run, heard = CabledRun(two_units(binary=binary)), []
    run.proven()

    def write(line: str) -> None:
        if run.state == "SAVING":
            heard.append(line)
            if len(heard) == at:
                run.cable.unit.ram[23] = THEIRS

    run.cable.unit.before = write
    run.park(30.0)
    assert len(heard) >= at
    foreign_value_stays(run)


def test_rollback_does_not_overwrite_a_foreign_value():
    run = CabledRun(two_units())
    run.approve()
    assert run.until("TRIAL")
    run.cable.unit.ram[23] = THEIRS
    run.feed(Operator(run.now_ns, "rollback"))
    run.run(10.0)
    foreign_value_stays(run)


@pytest.mark.parametrize(
    ("binary", "nth"),
    [
        pytest.param(binary, nth, marks=[] if (binary, nth) == (False, 1) else pytest.mark.slow)
        for binary in (False, True)
        for nth in (1, 3, 5, 7, 9)
    ],
)
def test_restart_between_two_registers_leaves_no_partial_calibration(binary, nth):
    """After register 23 was written. A text stream carries no device time, so none decreases."""
    run = CabledRun(two_units(binary=binary))
    unit, after = run.cable.unit, []
    assert run.until("QUALIFIED")

    def restart(line: str) -> None:
        if after or line.startswith("VNWRG,23"):
            after.append(line)
        if len(after) == nth + 1:
            unit.restart()
            unit.paused = True  # as if it restarted so quickly that no sample is missing

    unit.before = restart
    run.approve()
    run.run(40.0)
    unit.before = lambda _: None
    run.park(40.0)
    assert len(after) > nth
    assert unit.held() in (OLD, NEW), run.notes
    assert unit.held("flash") in (OLD, NEW)


def test_restart_without_device_time_does_not_double_the_hard_iron():
    """RAM held another calibration than flash, so un-mapping through it would give a wrong iron.
    There is no silence either, because the unit is back before the next sample. Only the
    readings jump.
    """
    unit = Unit(FIRST, IRON, BIAS)
    unit.ram[23] = f"1,0,0,0,1,0,0,0,1,{IRON[0]},{IRON[1]},{IRON[2]}"
    run = CabledRun(Cable(unit, Unit(SPARE, IRON, BIAS)), planted=False)
    assert run.core.registers[23][9] == pytest.approx(IRON[0])
    run.run(20.0)
    before = run.core.calibrator
    unit.restart()
    assert run.until(lambda: run.core.registers[23][9] == 0.0, 10.0), run.notes
    run.run(2.0)
    assert run.core.calibrator is not before
    assert run.told("calibrated anew", "23")
    run.run(90.0)
    found = run.core.calibrator.estimate
    assert found is not None
    assert np.allclose(found.hard_iron_gauss, IRON, atol=0.01)


def test_small_register_change_is_found_at_the_check_interval():
    unit = Unit(FIRST, IRON, BIAS)
    unit.ram[23] = "1,0,0,0,1,0,0,0,1,0.01,0,0"
    run = CabledRun(Cable(unit, Unit(SPARE, IRON, BIAS)), planted=False, mode=Mode.OBSERVE)
    run.run(10.0)
    unit.restart()
    assert run.until(lambda: run.core.registers[23][9] == 0.0, 40.0)
    assert all(line.split(",")[0] == "VNRRG" for line in unit.log)  # only reads, no pause


def test_passive_sends_no_checks():
    run = CabledRun(two_units(), planted=False, mode=Mode.PASSIVE)
    run.run(100.0)
    assert run.cable.unit.log == []


def test_checks_are_rare_and_do_not_interrupt_the_stream():
    run = CabledRun(two_units(binary=True), planted=False, mode=Mode.OBSERVE)
    heard, samples = len(run.cable.unit.log), run.core.stream.facts.samples
    run.run(100.0)
    reads = run.cable.unit.log[heard:]
    assert 9 * 9 <= len(reads) <= 11 * 9  # identity, registers, and identity again; every 10 s
    assert {line.split(",")[0] for line in reads} == {"VNRRG"}
    assert run.core.stream.facts.samples - samples >= 100.0 * 20 - 20
    assert run.core.stream.gaps == []


@pytest.mark.parametrize("binary", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_replay_of_the_capture_decides_the_same(binary):
    """Every doubt and every check follows from the inputs."""
    from ahrsd.core.core import Core

    run = CabledRun(two_units(binary=binary), planted=False)
    run.run(40.0)
    run.cable.swap(SPARE)
    run.run(40.0)
    again = Core(run.core.settings)
    for item in run.taken:
        again.handle(item)
    assert again.decisions.sha256 == run.core.decisions.sha256
    assert again.device_session.identity == run.core.device_session.identity
    assert again.device_session.identity.serial == SPARE


def test_foreign_change_in_ram_is_not_saved():
    """Register 25 is not one of ours and the proven values stay valid, but VNWNV would save it
    as well.
    """
    run = CabledRun(two_units(binary=True))
    run.proven()
    unit = run.cable.units[FIRST]
    unit.ram[25] = THEIRS
    run.park(60.0)
    assert run.told("register 25 changed")
    assert unit.saves == []
    assert any(
        "somebody else changed register 25" in text for text in run.core.writeback.obstacles()
    )
