"""Another unit takes over the cable: a decision about one unit never reaches another.

Judged by the units' own records (`cabled_units`), which share no code with the project.
"""

from __future__ import annotations

import numpy as np
import pytest
from cabled_run import FIRST, SPARE, CabledRun, two_units

from ahrsd.inputs import Operator

STREAMS = pytest.mark.parametrize("binary", [False, True], ids=["VNIMU", "packets"])
#: which command, and whether the stream is binary: both kinds alternately
QUICK_WRITE = ((1, False), (17, True), (33, False), (49, True))
QUICK_SAVE = ((1, False), (16, True), (31, False))


def untouched(run: CabledRun) -> None:
    """The spare unit is in factory state, and both serial numbers were reported."""
    spare = run.cable.units[SPARE]
    assert spare.writes == []
    assert spare.saves == []
    assert run.told(str(SPARE), str(FIRST)), run.notes


@STREAMS
def test_whole_write_on_one_unit(binary):
    run = CabledRun(two_units(binary=binary))
    unit = run.cable.unit
    run.proven()
    assert unit.held("flash") == ("1,0,0,0,1,0,0,0,1,0,0,0", "1,0,0,0,1,0,0,0,1,0,0,0")
    run.park()
    assert run.state == "COMMITTED", (run.notes, run.core.writeback.obstacles())
    assert unit.held("flash") == unit.held()
    assert unit.held()[0].endswith(",0.05,-0.03,0.04")
    assert [n for n, _ in unit.writes] == [23, 84]
    by = {r["kind"]: r["facts"].get("serial") for r in run.journal[FIRST]}
    assert by["RAM_VERIFIED"] == by["FLASH_ACKED"] == FIRST


@STREAMS
@pytest.mark.parametrize("bound", [None, FIRST])
def test_exchange_before_the_approval_leaves_the_spare_unit_untouched(binary, bound):
    run = CabledRun(two_units(binary=binary), serial=bound)
    assert run.until("QUALIFIED")
    wanted = run.core.writeback.proposal.id
    run.cable.swap(SPARE)
    run.run(2.2)
    run.feed(Operator(run.now_ns, "approve", wanted))
    run.run(20.0)
    untouched(run)
    assert run.cable.units[FIRST].writes == []
    assert run.kinds(SPARE) == []
    assert run.told("another device", str(SPARE), str(FIRST), "begins anew")


@pytest.mark.parametrize(
    ("at", "binary", "silent_s"),
    [
        pytest.param(at, *how, marks=[] if (at, how[0]) in QUICK_WRITE else pytest.mark.slow)
        for at in range(1, 57, 4)
        for how in ((False, 0.6), (True, 2.0))
    ],
)
def test_exchange_at_any_command_of_the_write_leaves_the_spare_unit_untouched(binary, at, silent_s):
    """The cable is moved at the n-th command after the approval."""
    run = CabledRun(two_units(binary=binary))
    first, heard = run.cable.unit, []
    assert run.until("QUALIFIED")

    def pull(line: str) -> None:
        heard.append(line)
        if len(heard) == at:
            run.cable.swap(SPARE, silent_s)

    first.before = pull
    run.approve()
    run.run(25.0)
    assert len(heard) >= at
    untouched(run)
    assert run.journal.get(SPARE, []) == []
    assert {r["facts"].get("serial", FIRST) for r in run.journal[FIRST]} == {FIRST}
    assert first.saves == []


@pytest.mark.parametrize(
    ("when", "binary"),
    [
        ("trial", False),
        ("proven", True),
        pytest.param("trial", True, marks=pytest.mark.slow),
        pytest.param("proven", False, marks=pytest.mark.slow),
    ],
)
def test_exchange_in_trial_or_proven_leaves_the_spare_unit_untouched(binary, when):
    run = CabledRun(two_units(binary=binary))
    if when == "trial":
        run.approve()
        assert run.until("TRIAL")
    else:
        run.proven()
    run.cable.swap(SPARE)
    run.run(10.0)
    run.park()
    untouched(run)
    assert run.cable.units[FIRST].saves == []
    run.cable.swap(FIRST)
    run.run(15.0)
    # it restarted with its old values; a stream without device time does not prove that
    assert run.kinds()[-1] in ("LOST", "REVERTED", "ROLLED_BACK")
    assert len(run.cable.units[FIRST].writes) == 2


@pytest.mark.parametrize(
    ("binary", "at"),
    [
        pytest.param(binary, at, marks=[] if (at, binary) in QUICK_SAVE else pytest.mark.slow)
        for binary in (False, True)
        for at in range(1, 36, 5)
    ],
)
def test_exchange_at_any_command_of_the_save_leaves_the_spare_unit_untouched(binary, at):
    run = CabledRun(two_units(binary=binary))
    run.proven()
    first, heard = run.cable.unit, []

    def pull(line: str) -> None:
        if run.state == "SAVING":
            heard.append(line)
            if len(heard) == at:
                run.cable.swap(SPARE)

    first.before = pull
    run.park(30.0)
    assert len(heard) >= at
    untouched(run)
    assert first.held("flash") in ((first.held()), ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2)


@STREAMS
@pytest.mark.parametrize(
    "at",
    [pytest.param(at, marks=[] if at % 8 == 1 else pytest.mark.slow) for at in range(1, 22, 4)],
)
def test_rollback_writes_nothing_to_another_unit(binary, at):
    run = CabledRun(two_units(binary=binary))
    run.approve()
    assert run.until("TRIAL")
    first, spare, heard = run.cable.unit, run.cable.units[SPARE], []
    for number, text in ((23, "1.1,0,0,0,1,0,0,0,1,0.2,0,0"), (84, "1,0,0,0,1,0,0,0,1,0.01,0,0")):
        spare.flash[number] = text  # its own calibration
    spare.ram = dict(spare.flash)

    def pull(line: str) -> None:
        heard.append(line)
        if len(heard) == at:
            run.cable.swap(SPARE, 0.6)

    first.before = pull
    run.feed(Operator(run.now_ns, "rollback"))
    run.run(15.0)
    assert len(heard) >= at
    untouched(run)
    assert np.allclose(float(spare.held()[0].split(",")[9]), 0.2)


@pytest.mark.parametrize(
    "steps",
    [pytest.param(n, marks=[] if n in (16, 28) else pytest.mark.slow) for n in range(16, 30)],
)
def test_unit_connected_during_the_end_of_a_save_confirms_nothing(steps):
    """The spare unit starts there, so the device time decreases, while the first unit did not
    restart and returns. Up to the end of the window after VNWNV in which the identity is not
    read.
    """
    run, saved = CabledRun(two_units(binary=True)), []
    first, spare = run.cable.units[FIRST], run.cable.units[SPARE]
    first.before = lambda line: saved.append(line) if line.startswith("VNWNV") else None
    run.proven()
    run.cable.moving, run.safe = False, True
    assert run.until(lambda: saved, 60.0), run.notes
    run.run(0.2)
    run.cable.unit = spare
    for _ in range(steps):
        run.step()
    spare.uptime_s = 0.1
    run.step()
    run.cable.unit = first
    run.run(40.0)
    assert run.state in ("COMMITTED", "FAULT")  # FAULT: the spare unit answered during the save
    assert spare.writes == spare.saves == []
    first.restart()  # now the first unit did restart
    assert run.until("CONFIRMED", 40.0), run.notes
