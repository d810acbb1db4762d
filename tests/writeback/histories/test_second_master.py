"""Somebody else writes through the device's other port, or it restarts unseen.

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


def theirs_stays(run: CabledRun) -> None:
    """What somebody wrote is in RAM, nothing is in flash, and it was told."""
    unit = run.cable.units[FIRST]
    assert unit.held()[0] == THEIRS
    assert unit.held("flash") == OLD
    assert unit.saves == []
    assert [n for n, _ in unit.writes] == [23, 84]  # ours, once; nothing over theirs
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
def test_their_value_is_found_within_the_interval_and_stays(binary, when):
    run = CabledRun(two_units(binary=binary))
    if when == "trial":
        run.approve()
        assert run.until("TRIAL")
    else:
        run.proven()
    run.cable.unit.ram[23] = THEIRS
    assert run.until("LOCKED", 40.0), run.notes
    run.park()
    theirs_stays(run)


@pytest.mark.parametrize(
    ("at", "binary"),
    [
        pytest.param(at, how, marks=[] if (at, how) in QUICK_SAVE else pytest.mark.slow)
        for at in range(1, 33, 5)
        for how in (False, True)
    ],
)
def test_just_before_the_save(binary, at):
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
    theirs_stays(run)


def test_a_rollback_does_not_write_over_it():
    run = CabledRun(two_units())
    run.approve()
    assert run.until("TRIAL")
    run.cable.unit.ram[23] = THEIRS
    run.feed(Operator(run.now_ns, "rollback"))
    run.run(10.0)
    theirs_stays(run)


@pytest.mark.parametrize(
    ("binary", "nth"),
    [
        pytest.param(binary, nth, marks=[] if (binary, nth) == (False, 1) else pytest.mark.slow)
        for binary in (False, True)
        for nth in (1, 3, 5, 7, 9)
    ],
)
def test_a_restart_between_the_two_registers_leaves_no_half_a_calibration(binary, nth):
    """After 23 was written; its time goes on in a text stream, which carries none."""
    run = CabledRun(two_units(binary=binary))
    unit, after = run.cable.unit, []
    assert run.until("QUALIFIED")

    def restart(line: str) -> None:
        if after or line.startswith("VNWRG,23"):
            after.append(line)
        if len(after) == nth + 1:
            unit.restart()
            unit.paused = True  # as if it came up so quickly that nobody missed a sample

    unit.before = restart
    run.approve()
    run.run(40.0)
    unit.before = lambda _: None
    run.park(40.0)
    assert len(after) > nth
    assert unit.held() in (OLD, NEW), run.notes
    assert unit.held("flash") in (OLD, NEW)


def test_a_restart_that_no_time_tells_does_not_double_the_hard_iron():
    """RAM had another calibration than flash; un-mapped through it, the iron would come out wrong.

    No silence either: the unit is back before the next sample. Only the readings jump.
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


def test_a_change_too_small_to_jump_is_found_at_the_interval():
    unit = Unit(FIRST, IRON, BIAS)
    unit.ram[23] = "1,0,0,0,1,0,0,0,1,0.01,0,0"
    run = CabledRun(Cable(unit, Unit(SPARE, IRON, BIAS)), planted=False, mode=Mode.OBSERVE)
    run.run(10.0)
    unit.restart()
    assert run.until(lambda: run.core.registers[23][9] == 0.0, 40.0)
    assert all(line.split(",")[0] == "VNRRG" for line in unit.log)  # reads only, no pause


def test_passive_asks_nothing():
    run = CabledRun(two_units(), planted=False, mode=Mode.PASSIVE)
    run.run(100.0)
    assert run.cable.unit.log == []


def test_the_reads_are_rare_and_the_stream_goes_on():
    run = CabledRun(two_units(binary=True), planted=False, mode=Mode.OBSERVE)
    heard, samples = len(run.cable.unit.log), run.core.stream.facts.samples
    run.run(100.0)
    reads = run.cable.unit.log[heard:]
    assert 9 * 9 <= len(reads) <= 11 * 9  # who, what it holds, and again who; every 10 s
    assert {line.split(",")[0] for line in reads} == {"VNRRG"}
    assert run.core.stream.facts.samples - samples >= 100.0 * 20 - 20
    assert run.core.stream.gaps == []


@pytest.mark.parametrize("binary", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_capture_replays_to_the_same_decisions(binary):
    """Every doubt and every look is of the inputs."""
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


def test_what_they_changed_in_ram_is_not_saved_along():
    """Register 25 is none of ours and what is proven stays right, but VNWNV would save it, too."""
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
