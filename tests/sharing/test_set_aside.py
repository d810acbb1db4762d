"""A client saves in the middle of a trial: undone, saved, written again. Judged by the units.

`cabled_units` shares no code with the project; what is asserted is what a unit holds and was sent.
"""

from __future__ import annotations

import numpy as np
import pytest
from cabled_run import FIRST, IRON, SPARE, CabledRun, estimate, two_units
from planted_calibrator import PlantedCalibrator

from ahrsd import inputs
from ahrsd.core.core import Core
from ahrsd.events import Estimated
from ahrsd.sharing.client_commands import SharePolicy

SHARES = (SharePolicy("owner", owner=True), SharePolicy("log"))
ONE = ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2
NEW = ("1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005")
UNDONE = ["ROLLBACK", "ROLLED_BACK", "CLIENT_SAVED"]
AGAIN = ["PREPARED", "RAM_VERIFIED"]


def on_trial(*, binary=True, **options) -> CabledRun:
    run = CabledRun(two_units(binary=binary), shares=SHARES, **options)
    run.approve()
    assert run.until("TRIAL", 30.0), run.notes
    assert run.cable.unit.held() == NEW
    return run


def save(run: CabledRun) -> None:
    run.say("owner", "VNWNV")
    assert run.until(lambda: run.heard["owner"], 2.5), run.notes
    assert run.answers("owner") == ["VNWNV"]


def held(saved: dict[int, str]) -> tuple[str, str]:
    return saved[23], saved[84]


@pytest.mark.parametrize("binary", [True, False])
def test_the_trial_goes_on_behind_the_save(binary):
    run = on_trial(binary=binary)
    unit = run.cable.unit
    run.run(10.0)
    save(run)
    assert [unit.held("flash"), unit.held()] == [ONE, ONE]
    assert run.state == "SET_ASIDE"
    assert run.until("TRIAL", 10.0), run.notes
    assert (unit.held(), unit.held("flash")) == (NEW, ONE)
    assert run.kinds()[-5:] == [*UNDONE, *AGAIN]
    first, second = [r["facts"] for r in run.journal[FIRST] if r["kind"] == "PREPARED"]
    assert second["again"] == first["txn"] != second["txn"]
    assert [second[key] for key in ("old", "new", "approver", "heading_change_deg")] == [
        first[key] for key in ("old", "new", "approver", "heading_change_deg")
    ]
    begun_s = run.now_s
    run.safe = False
    assert run.until("PROVEN"), run.notes
    assert run.now_s - begun_s > 25.0  # a whole trial: none of the ten seconds before count
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    assert unit.held("flash") == NEW
    assert [held(one) for one in unit.saves][:1] == [ONE]


def test_what_was_proven_is_on_trial_again():
    run = on_trial()
    run.run(1.0)
    assert run.until(lambda: "PROVEN" in run.states), run.notes
    run.safe = False  # nothing is saved meanwhile
    run.run(1.0)
    run.safe = True
    save(run)
    assert run.until("TRIAL", 10.0), run.notes
    assert run.kinds()[-5:] == [*UNDONE, *AGAIN]
    assert run.cable.unit.held("flash") == ONE


def test_a_second_save_sets_it_aside_again_until_the_days_writes_are_used_up():
    run = on_trial()
    for _ in range(5):
        run.run(3.0)
        save(run)
        assert run.until("TRIAL", 10.0), run.notes
    run.run(3.0)
    save(run)
    run.run(60.0)
    assert run.states[-1] != "TRIAL"
    assert run.cable.unit.held() == ONE
    assert [number for number, _ in run.cable.unit.writes].count(23) == 12  # six, each undone
    assert any("6 RAM writes in a day" in reason for reason in run.core.writeback.holds())


@pytest.mark.parametrize("what", ["unsafe", "unheard", "disarm", "gone", "killed link", "stop"])
def test_where_a_write_would_not_begin_the_trial_is_over(what):
    run = on_trial()
    save(run)
    if what == "unsafe":
        run.safe = False
    elif what == "unheard":
        run.feed(inputs.Interlock(run.now_ns, True))
        feed, run.feed = run.feed, lambda it: None if isinstance(it, inputs.Interlock) else feed(it)
    elif what == "disarm":
        run.feed(inputs.Operator(run.now_ns, "disarm", ""))
    elif what == "gone":
        run.cable.swap(SPARE, silent_s=0.1)
    elif what == "killed link":
        run.feed(inputs.LinkLost(run.now_ns, "unplugged"))
        run.feed(inputs.LinkOpened(run.now_ns, "cable", 115200))
    else:
        run.feed(inputs.Stop(run.now_ns, "SIGTERM"))
    written = {serial: len(unit.writes) for serial, unit in run.cable.units.items()}
    states = len(run.states)
    run.run(40.0)
    assert "PREPARING" not in run.states[states:]
    assert {serial: len(u.writes) for serial, u in run.cable.units.items()} == written
    assert run.cable.units[FIRST].held("flash") == ONE


def test_an_operator_who_wants_it_back_has_it_back_for_good():
    run = on_trial()
    save(run)
    assert run.state == "SET_ASIDE"
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    assert run.core.writeback.operator_answer[0]
    run.run(40.0)
    assert run.cable.unit.held() == ONE
    assert run.core.writeback.history.rollbacks == 1  # and no write for a day
    assert "PREPARING" not in run.states[run.states.index("SET_ASIDE") :]


def test_a_rollback_by_hand_while_it_is_being_undone_counts_too():
    run = on_trial()
    run.say("owner", "VNWNV")
    assert run.until("ROLLING_BACK", 2.0)
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    run.run(40.0)
    assert run.core.writeback.history.rollbacks == 1
    assert run.states.count("PREPARING") == 1
    assert run.cable.unit.held() == ONE


def test_a_lock_in_between_stays():
    run = on_trial()
    save(run)
    run.feed(inputs.Operator(run.now_ns, "lock", "because"))
    run.run(40.0)
    assert (run.state, run.cable.unit.held()) == ("LOCKED", ONE)


def test_a_reset_behind_the_save_ends_it_before_anything_is_written_again():
    """As ntnu's driver does at every start."""
    run = on_trial()
    writes = len(run.cable.unit.writes)
    save(run)
    run.say("owner", "VNRST")
    run.run(20.0)
    assert run.cable.unit.held() == ONE
    assert len(run.cable.unit.writes) == writes + 2  # the two that undid it
    assert run.state in ("OBSERVING", "CANDIDATE", "QUALIFIED")


def test_another_program_that_writes_in_between_is_not_written_over():
    run = on_trial()
    theirs = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"
    save(run)
    run.cable.unit.ram[23] = theirs
    run.run(40.0)
    assert run.cable.unit.ram[23] == theirs
    assert "PREPARING" not in run.states[run.states.index("SET_ASIDE") :]


@pytest.mark.parametrize("asked", [False, True])
def test_a_unit_that_comes_back_with_values_on_trial_is_not_saved_for_a_client(asked):
    """It kept its power while another one had the cable, and nobody has asked who is there now."""
    run = on_trial()
    first, spare = run.cable.units[FIRST], run.cable.units[SPARE]
    run.cable.unit = spare
    assert run.until(lambda: run.told("another device, VN-100T-CR serial 555"), 40.0)
    assert run.until("OBSERVING", 5.0)
    assert first.held() == NEW
    run.cable.unit = first
    if asked:
        run.run(1.0)
    run.say("owner", "VNWNV")
    run.run(20.0)
    assert [held(one) for one in first.saves] in ([], [ONE])
    assert first.held("flash") == ONE
    assert spare.saves == []


def test_a_save_that_the_device_refuses_ends_the_trial():
    run = on_trial()
    unit, answer = run.cable.unit, run.cable.unit.answer

    def refused(line: bytes) -> bytes:
        if line.startswith(b"$VNWNV"):
            return b"$VNERR,05*74\r\n"
        return answer(line)

    unit.answer = refused
    run.say("owner", "VNWNV")
    run.run(40.0)
    assert any(line.startswith("VNERR") for line in run.answers("owner"))
    assert run.cable.unit.held() == ONE
    assert run.states[run.states.index("SET_ASIDE") + 1] == "ROLLED_BACK"
    assert run.states.count("PREPARING") == 1


def test_a_client_that_is_gone_before_its_save_leaves_the_old_values():
    run = on_trial()
    run.say("owner", "VNWNV")
    assert run.until("ROLLING_BACK", 2.0)
    run.feed(inputs.ClientLeft(run.now_ns, "owner"))
    run.run(40.0)
    assert (run.cable.unit.held(), run.cable.unit.saves) == (ONE, [])
    assert run.states.count("PREPARING") == 1


def test_what_speaks_against_the_values_is_not_forgotten_by_a_save():
    """A trial that a figure speaks against when the client comes is over."""
    run, heard = on_trial(), []
    moved = IRON + np.array([0.03, 0.0, 0.0])
    run.core.calibrator = PlantedCalibrator(
        run.core.calibrator.anew(), estimate(hard_iron_gauss=moved)
    )
    run.listeners.append(lambda event: heard.append(event) if isinstance(event, Estimated) else 0)
    assert run.until(lambda: heard, 20.0)
    assert run.state == "TRIAL"
    save(run)
    run.run(40.0)
    assert "ROLLED_BACK" in run.states
    assert "SET_ASIDE" not in run.states


def test_registers_that_the_owner_saved_are_the_users_in_the_second_write():
    run = on_trial()
    run.say("owner", "VNWRG,07,40")
    run.run(1.0)
    run.answers("owner")
    save(run)
    assert run.until("TRIAL", 10.0), run.notes
    run.safe = False
    assert run.until("PROVEN"), run.notes
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    assert run.cable.unit.flash[7] == "40"


def test_a_replay_takes_the_same_decisions():
    run = on_trial()
    save(run)
    assert run.until("TRIAL", 10.0), run.notes
    run.run(5.0)
    again = Core(run.core.settings)
    for number, item in enumerate(run.taken):
        if number == run.planted_at:
            again.calibrator = PlantedCalibrator(again.calibrator, estimate())
        again.handle(item)
    assert again.decisions.sha256 == run.core.decisions.sha256
    assert again.writeback.state.value == "TRIAL"
