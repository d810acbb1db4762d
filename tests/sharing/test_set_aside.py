"""A client saves or resets in the middle of a trial: values undone, saved, and written again.

Judged by the units. `cabled_units` shares no code with the project; asserted is what a unit holds
and was sent.
"""

from __future__ import annotations

import numpy as np
import pytest
from cabled_run import FIRST, IRON, SPARE, CabledRun, estimate, two_units
from drivers_at_start import NTNU_BEHIND_THE_RESET, NTNU_UP_TO_THE_RESET
from planted_calibrator import PlantedCalibrator

from ahrsd import inputs
from ahrsd.core.core import Core
from ahrsd.events import Estimated
from ahrsd.sharing.arbiter import SharePolicy

SHARES = (SharePolicy("owner", owner=True), SharePolicy("log"))
ONE = ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2
NEW = ("1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005")
SLOW = pytest.mark.slow
QUICK = ((None, True), (1.5, False), (6.0, True))
TROUBLE = ("power", "swap", "theirs", "silent", "unsafe")
UNDONE = ["ROLLBACK", "ROLLED_BACK", "CLIENT_SAVED"]
RESTING = ("OBSERVING", "CANDIDATE", "QUALIFIED", "ROLLED_BACK", "LOCKED")
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


@pytest.mark.parametrize("binary", [True, pytest.param(False, marks=SLOW)])
def test_trial_restarts_after_a_client_save(binary):
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


def test_proven_values_are_on_trial_again():
    run = on_trial()
    run.run(1.0)
    assert run.until(lambda: "PROVEN" in run.states), run.notes
    run.safe = False  # nothing is saved in between
    run.run(1.0)
    run.safe = True
    save(run)
    assert run.until("TRIAL", 10.0), run.notes
    assert run.kinds()[-5:] == [*UNDONE, *AGAIN]
    assert run.cable.unit.held("flash") == ONE


def test_repeated_saves_set_the_trial_aside_within_the_daily_budget():
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
    assert any("6 RAM writes in a day" in reason for reason in run.core.writeback.obstacles())


@pytest.mark.parametrize("what", ["unsafe", "unheard", "disarm", "gone", "killed link", "stop"])
def test_trial_ends_when_a_write_would_not_be_permitted(what):
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


def test_rollback_by_an_operator_ends_the_trial():
    run = on_trial()
    save(run)
    assert run.state == "SET_ASIDE"
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    assert run.core.writeback.operator_answer[0]
    run.run(40.0)
    assert run.cable.unit.held() == ONE
    assert run.core.writeback.history.rollbacks == 1  # and no write for a day
    assert "PREPARING" not in run.states[run.states.index("SET_ASIDE") :]


def test_rollback_by_an_operator_during_the_undo_counts():
    run = on_trial()
    run.say("owner", "VNWNV")
    assert run.until("ROLLING_BACK", 2.0)
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    run.run(40.0)
    assert run.core.writeback.history.rollbacks == 1
    assert run.states.count("PREPARING") == 1
    assert run.cable.unit.held() == ONE


def test_lock_while_set_aside_stays():
    run = on_trial()
    save(run)
    run.feed(inputs.Operator(run.now_ns, "lock", "because"))
    run.run(40.0)
    assert (run.state, run.cable.unit.held()) == ("LOCKED", ONE)


def reset(run: CabledRun) -> None:
    run.say("owner", "VNRST")
    assert run.until(lambda: run.heard["owner"], 2.5), run.notes
    assert run.answers("owner") == ["VNRST"]


@pytest.mark.parametrize(
    ("saved_s", "binary"),
    [
        pytest.param(saved_s, binary, marks=() if (saved_s, binary) in QUICK else SLOW)
        for saved_s in (None, 0.0, 1.5, 6.0)
        for binary in (True, False)
    ],
)
def test_trial_restarts_after_a_client_reset(binary, saved_s):
    """As ntnu's driver saves and resets at every start; another one may only reset."""
    run = on_trial(binary=binary)
    unit = run.cable.unit
    if saved_s is not None:
        save(run)
        run.run(saved_s)
    reset(run)
    assert (unit.held(), unit.held("flash")) == (ONE, ONE)
    assert run.until("TRIAL", 20.0), run.notes
    assert (unit.held(), unit.held("flash")) == (NEW, ONE)
    assert run.kinds()[-3:] == ["CLIENT_RESET", *AGAIN]
    assert run.states[-6:] == ["SET_ASIDE", "PREPARING", "CHECKING", "STAGING", "STAGED", "TRIAL"]
    begun_s = run.now_s
    run.safe = False
    assert run.until("PROVEN"), run.notes
    assert run.now_s - begun_s > 25.0  # a whole trial, from zero
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    assert unit.held("flash") == NEW
    unit.restart()
    assert not binary or run.until("CONFIRMED", 20.0), run.notes  # a text stream tells no time


@pytest.mark.parametrize("by", ["a client", "a client behind a save", "nobody"])
def test_only_a_restart_that_no_client_requested_counts_against_the_stream(by):
    """Gate stream_health.time: no calibration qualifies in a run with such a restart."""
    run = CabledRun(two_units(binary=True), shares=SHARES)
    run.run(5.0)
    if by == "nobody":
        run.cable.unit.restart()
    else:
        if by == "a client behind a save":
            save(run)
            run.run(1.5)
        reset(run)
    run.run(5.0)
    assert run.core.stream.restarts == 1
    assert run.core.stream.health().negative_dt == (by == "nobody")


def test_device_is_read_and_judged_again_before_a_write_after_a_reset():
    run = on_trial()
    save(run)
    since = len(run.cable.unit.log)
    reset(run)
    assert run.until("TRIAL", 20.0), run.notes
    lines = run.cable.unit.log[since:]
    lines = lines[lines.index("VNRST") + 1 :]
    first = next(k for k, line in enumerate(lines) if line.startswith("VNWRG,23"))
    asked = [line for line in lines[:first] if line.startswith("VNRRG")]
    assert asked.count("VNRRG,23") >= 4  # the reading twice, the look, the check before the write
    assert {f"VNRRG,{n}" for n in ("01", "03", "04", 26, 44, 84)} <= set(asked)
    assert lines[first - 1] == "VNRRG,03"


@pytest.mark.parametrize("starts", [10, pytest.param(100, marks=SLOW)])
def test_driver_that_saves_and_resets_often_keeps_the_old_values(starts):
    """Six writes a day; then the old values stay, whatever the driver does."""
    run = on_trial(rollbacks_to_lock=10**6)
    unit = run.cable.unit
    for _ in range(starts):
        for line in NTNU_UP_TO_THE_RESET:
            run.say("owner", line)
            assert run.until(lambda: run.heard["owner"], 2.5), run.notes
            answer = run.answers("owner")
            assert [one.split(",")[0] for one in answer] == [line.split(",")[0]]
        assert (unit.held(), unit.held("flash")) == (ONE, ONE)
        run.run(1.0)
        for line in NTNU_BEHIND_THE_RESET:
            run.say("owner", line)
        run.feed(inputs.ClientLeft(run.now_ns, "owner"))
        run.run(9.0)  # the trial goes on
        run.answers("owner")
    kinds = run.kinds()
    assert kinds.count("CLIENT_SAVED") == kinds.count("CLIENT_RESET") == len(unit.saves) == starts
    assert kinds.count("RAM_VERIFIED") == kinds.count("ROLLED_BACK") == 6
    assert [held(one) for one in unit.saves] == [ONE] * starts
    assert unit.held() == unit.held("flash") == ONE


@pytest.mark.parametrize(
    "what",
    ["unsafe", "disarm", "lock", "rollback", "stop", "link", "power", "void", "swap", "frame"],
)
@pytest.mark.parametrize(
    "after_s", [pytest.param(0.05, marks=SLOW), 0.4, pytest.param(1.2, marks=SLOW)]
)
def test_events_that_end_a_trial_set_aside_by_a_reset(what, after_s):
    run = on_trial()
    unit = run.cable.unit
    save(run)
    if what == "frame":  # in flash, and not what was in RAM
        unit.flash[26] = "0,1,0,-1,0,0,0,0,1"
    reset(run)
    run.run(after_s)
    if what == "unsafe":
        run.safe = False
    elif what in ("disarm", "lock", "rollback"):
        run.feed(inputs.Operator(run.now_ns, what, ""))
    elif what == "stop":
        run.feed(inputs.Stop(run.now_ns, "SIGTERM"))
    elif what == "link":
        run.feed(inputs.LinkLost(run.now_ns, "unplugged"))
        run.feed(inputs.LinkOpened(run.now_ns, "cable", 115200))
    elif what == "power":
        run.run(3.0)  # later than the device's own start behind VNRST
        unit.restart()
    elif what == "void":
        run.core.process_events([])
        more = run.core.writeback.on_void("something stepped", run.core.at_s, run.now_s)
        run.core._action_queue.add(more)
    elif what == "swap":
        run.cable.swap(SPARE, silent_s=0.1)
    run.run(45.0)
    first = run.cable.units[FIRST]
    assert (first.held(), first.held("flash")) == (ONE, ONE), run.notes
    assert first.writes.count((23, NEW[0])) == 1
    assert run.cable.units[SPARE].writes == []
    assert run.kinds().count("PREPARED") == 1
    assert what == "stop" or run.state in RESTING, run.state


@pytest.mark.parametrize(
    ("saved", "answer"),
    [
        (True, b""),
        (False, b"$VNERR,05*74\r\n"),
        pytest.param(True, b"$VNERR,05*74\r\n", marks=SLOW),
        pytest.param(False, b"", marks=SLOW),
    ],
)
def test_refused_or_unanswered_reset_ends_the_trial(saved, answer):
    run = on_trial()
    unit, usual = run.cable.unit, run.cable.unit.answer
    unit.answer = lambda line: answer if line.startswith(b"$VNRST") else usual(line)
    if saved:
        save(run)
    run.say("owner", "VNRST")
    run.run(45.0)
    assert (unit.held(), unit.held("flash")) == (ONE, ONE)
    assert run.kinds().count("PREPARED") == 1
    assert "CLIENT_RESET" not in run.kinds()


def test_trial_ends_when_the_device_is_absent_for_thirty_seconds():
    run = on_trial()
    save(run)
    reset(run)
    run.cable.fall_silent(40.0)
    run.run(60.0)
    assert run.cable.unit.held() == ONE
    assert run.kinds().count("PREPARED") == 1


def test_reset_loop_ends_the_trial():
    run = on_trial()
    save(run)
    for _ in range(20):
        reset(run)
        run.run(2.0)
    run.run(20.0)
    assert run.cable.unit.held() == ONE
    assert run.kinds().count("PREPARED") == 1
    assert run.state in RESTING


@pytest.mark.parametrize(
    ("what", "at"),
    [
        pytest.param(what, at, marks=[] if at - k == 6 + 30 * (k % 3) else SLOW)
        for k, what in enumerate(TROUBLE)
        for at in range(1 + k, 75, 5)
    ],
)
def test_no_unproven_value_is_saved_for_events_after_a_save_and_reset(what, at):
    """Never a write of other than the journaled values, and nothing unproven in any flash."""
    run, heard, done = on_trial(), [], []
    unit = run.cable.unit
    theirs = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"

    def before(line: str) -> None:
        heard.append(line)
        if len(heard) != at:
            return
        done.append(line)
        if what == "power":
            unit.restart()
        elif what == "swap":
            run.cable.swap(SPARE, silent_s=0.5)
        elif what == "theirs":
            unit.ram[23] = theirs
        elif what == "silent":
            run.cable.fall_silent(1.0)
        else:
            run.safe = False

    unit.before = before
    run.say("owner", "VNWNV", "VNRST")
    written = len(unit.writes)
    run.run(60.0)
    assert done
    assert {values for n, values in unit.writes[written:] if n == 23} <= {NEW[0], ONE[0]}
    assert run.cable.units[SPARE].writes == []
    assert all(held(one)[1] == ONE[1] for one in unit.saves if held(one) != NEW)
    if what == "theirs" and run.kinds().count("PREPARED") == 1:
        assert unit.ram[23] in (theirs, ONE[0])


def test_foreign_value_written_while_set_aside_is_not_overwritten():
    run = on_trial()
    theirs = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"
    save(run)
    run.cable.unit.ram[23] = theirs
    run.run(40.0)
    assert run.cable.unit.ram[23] == theirs
    assert "PREPARING" not in run.states[run.states.index("SET_ASIDE") :]


@pytest.mark.parametrize("asked", [False, True])
def test_returning_unit_with_trial_values_is_not_saved_for_a_client(asked):
    """It kept its power while another unit had the cable, and its identity has not been read
    again.
    """
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


def test_refused_save_ends_the_trial():
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


def test_client_that_left_before_its_save_leaves_the_old_values():
    run = on_trial()
    run.say("owner", "VNWNV")
    assert run.until("ROLLING_BACK", 2.0)
    run.feed(inputs.ClientLeft(run.now_ns, "owner"))
    run.run(40.0)
    assert (run.cable.unit.held(), run.cable.unit.saves) == (ONE, [])
    assert run.states.count("PREPARING") == 1


def test_save_does_not_clear_evidence_against_the_values():
    """A trial with a bad figure is over when the client saves."""
    run, heard = on_trial(), []
    moved = IRON + np.array([0.03, 0.0, 0.0])
    run.core.calibrator = PlantedCalibrator(
        run.core.calibrator.make_fresh(), estimate(hard_iron_gauss=moved)
    )
    run.listeners.append(lambda event: heard.append(event) if isinstance(event, Estimated) else 0)
    assert run.until(lambda: heard, 20.0)
    assert run.state == "TRIAL"
    save(run)
    run.run(40.0)
    assert "ROLLED_BACK" in run.states
    assert "SET_ASIDE" not in run.states


def test_registers_saved_by_the_owner_are_kept_in_the_second_write():
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


def opened_again(run: CabledRun) -> None:
    run.feed(inputs.LinkLost(run.now_ns, "unplugged"))
    run.feed(inputs.LinkOpened(run.now_ns, "cable", 115200))
    run.run(5.0)


def test_nothing_is_saved_before_a_restart_when_the_journal_was_lost():
    cable = on_trial().cable  # and killed there
    run = CabledRun(cable, shares=SHARES, planted=False, journal_error="it is gone")
    run.say("owner", "VNWNV")
    run.run(2.0)
    assert run.answers("owner") == ["VNERR,09"]
    assert run.told("nothing is saved for a client", "the journal cannot be read", "off and on")
    assert (run.cable.unit.held(), run.cable.unit.saves) == (NEW, [])
    run.cable.unit.restart()
    run.run(6.0)
    assert run.cable.unit.held() == ONE
    save(run)
    assert run.cable.unit.held("flash") == ONE


def test_reappearing_trial_values_are_not_saved_for_a_client():
    """The device reported the old values but still holds a new one, as a later read shows."""
    run = on_trial()
    unit = run.cable.unit
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    assert run.until("ROLLED_BACK", 10.0)
    run.run(2.0)
    unit.ram[84] = "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005"
    opened_again(run)
    run.say("owner", "VNWNV")
    run.run(2.0)
    assert run.answers("owner") == ["VNERR,09"]
    assert run.told("nothing is saved for a client", "register 84", "a trial that was undone")
    unit.restart()
    run.run(6.0)
    save(run)
    assert unit.held("flash") == ONE


def test_committed_values_may_be_saved_for_a_client():
    run = on_trial()
    assert run.until("PROVEN"), run.notes
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    opened_again(run)
    save(run)
    assert [held(one) for one in run.cable.unit.saves] == [NEW, NEW]


def test_replay_decides_the_same():
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
