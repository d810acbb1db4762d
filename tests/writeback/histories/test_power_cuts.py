"""The power goes at every point of the whole way: before and after each command and each record.

After each cut, whatever is lost, the journal and the device agree or there is an alarm; the old
values are in the journal as long as the device does not hold them; and flash is never written by
what follows the cut.
"""

from __future__ import annotations

import pytest

from ahrsd.writeback.journal_history import JournalHistory, RecordKind
from ahrsd.writeback.reconcile import TABLE, DeviceContents, compare_contents
from ahrsd.writeback.states import TABLE as TRANSITIONS
from ahrsd.writeback.states import Mode, Signal, State
from drivers.vn100.commands import Word, Write

HOLDS_OLD = {
    State.OBSERVING,
    State.CANDIDATE,
    State.QUALIFIED,
    State.ROLLED_BACK,
}
HOLDS_NEW = {State.STAGED, State.TRIAL, State.PROVEN, State.COMMITTED, State.CONFIRMED}
POINTS = 260  # more than the whole way has, which the first test checks


def same_registers(one, two):
    return all(one[n] == pytest.approx(two[n], abs=1e-6) for n in one)


def assert_agreed(rig, old, new):
    """What the machine believes is what the device holds, or it cries."""
    device, state = rig.device.held(), rig.wb.state
    if state in HOLDS_OLD:
        left = rig.wb.history.holds  # what the last transaction left, by the journal
        assert same_registers(device, old if left is None else left)
    elif state in HOLDS_NEW:
        assert same_registers(device, new)
    else:
        assert state in (State.FAULT, State.FLASH_TORN, State.LOCKED)
        assert rig.notes("error")
    if not same_registers(device, old):
        prepared = next(r for r in rig.journal if r.kind == "PREPARED")
        assert all(prepared.facts["old"][str(n)] == pytest.approx(old[n]) for n in old)
        assert prepared.facts["lines_old"][0].startswith("$VNWRG,23,1,0,0")


@pytest.fixture
def reference(make_rig):
    """Old values, new values, and how many points the whole way has."""
    rig = make_rig()
    old = rig.device.held()
    rig.whole_way()
    assert rig.wb.state is State.COMMITTED
    return old, rig.device.held(), rig.points


def test_the_way_has_many_points(reference):
    assert 100 < reference[2] < POINTS


@pytest.mark.parametrize(
    ("mode", "lost"),
    [
        *((Mode.COMMIT, lost) for lost in ("all", "device", "program")),
        (Mode.STAGE, "all"),
        *(pytest.param(Mode.STAGE, lost, marks=pytest.mark.slow) for lost in ("device", "program")),
    ],
)
def test_every_cut_ends_in_agreement(make_rig, reference, lost, mode):
    old, new, _ = reference
    ends = set()
    for at in range(1, POINTS):
        rig = make_rig(mode)
        if not rig.cut(at, rig.whole_way):
            break
        writes = rig.device.flash_writes
        rig.back(lost)
        ends.add(rig.wb.state)
        assert_agreed(rig, old, new)
        assert rig.device.flash_writes == writes
        if lost != "program":
            assert rig.device.ram == rig.device.flash or rig.wb.state is State.ROLLED_BACK
        rig.back("all")
        assert_agreed(rig, old, new)
    else:
        pytest.fail("the way had no end")
    assert State.OBSERVING in ends
    if lost == "program":
        assert {State.TRIAL, State.PROVEN} <= ends
    if mode is Mode.COMMIT and lost != "program":
        assert State.CONFIRMED in ends
        assert State.FAULT not in ends


def bad_way(rig):
    """The whole way with a calibration that the trial throws out."""
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live(field_spread=0.5)


@pytest.mark.parametrize("lost", ["all", "device", "program"])
def test_every_cut_of_a_rollback_ends_with_the_old_values(make_rig, reference, lost):
    old, new, _ = reference
    for at in range(1, POINTS):
        rig = make_rig(Mode.STAGE)
        if not rig.cut(at, lambda rig=rig: bad_way(rig)):
            assert at > 80
            break
        rolling = "ROLLBACK" in rig.kinds
        rig.back(lost)
        assert_agreed(rig, old, new)
        if rolling:
            assert same_registers(rig.device.held(), old)
            assert rig.wb.state in HOLDS_OLD
    else:
        pytest.fail("the way had no end")


@pytest.mark.parametrize("way", ["whole", "bad"])
def test_a_second_cut_in_the_recovery_changes_nothing(make_rig, reference, way):
    old, new, _ = reference
    recoveries = 0
    for at in range(1, POINTS, 2):
        for again in range(1, 12):
            rig = make_rig()
            act = rig.whole_way if way == "whole" else lambda rig=rig: bad_way(rig)
            if not rig.cut(at, act):
                assert recoveries > 50
                return
            if not rig.cut(again, lambda rig=rig: rig.back("program")):
                break
            recoveries += 1
            rig.back("all" if again % 2 else "program")
            assert_agreed(rig, old, new)


@pytest.mark.parametrize("half", ["one of two", "garbage"])
def test_a_cut_inside_vnwnv_that_tears_the_flash_is_an_alarm(make_rig, reference, half):
    rig = make_rig()
    old, _, points = reference

    def tear(command):
        if isinstance(command, Word) and command.word == "VNWNV":
            rig.device.flash[23] = rig.device.ram[23]
            rig.device.flash[84] = second
            rig.points = 10 * points - 1
            rig._point()

    second = old[84] if half == "one of two" else (*old[84][:9], 9.0, 9.0, 9.0)
    rig.device.refuse = tear
    assert rig.cut(10 * points, rig.whole_way)
    rig.device.refuse = lambda _: None
    rig.back("all")
    assert rig.wb.state is State.FLASH_TORN
    assert "FLASH TORN" in rig.notes("error")[-1]
    assert rig.sent[-1] == "VNWNV"
    rig.back("all")  # it stays torn until a person says otherwise
    assert rig.wb.state is State.FLASH_TORN
    rig.verdict()
    assert rig.wb.state is State.FLASH_TORN
    rig.do(rig.wb.on_operator("unlock", "old values typed in and checked", rig.now_s))
    assert rig.wb.state is State.OBSERVING
    assert JournalHistory.of(rig.journal).torn is False


@pytest.mark.parametrize("number", [23, 84])
def test_a_program_killed_between_the_registers_puts_the_first_back(make_rig, reference, number):
    old, _, _ = reference
    for at in range(1, POINTS):
        rig = make_rig(Mode.STAGE)
        if not rig.cut(at, rig.whole_way):
            break
        held = rig.device.held()
        mixed = [n for n in held if held[n] != pytest.approx(old[n])]
        rig.back("program")
        if mixed == [23]:
            assert rig.wb.state is State.ROLLED_BACK
            assert rig.device.held()[number] == pytest.approx(old[number])
            assert [c.register for c in rig.device.log if isinstance(c, Write)] == [23, 23]
            return
    pytest.fail("no cut fell between the two writes")


def test_in_observe_an_interrupted_write_is_an_alarm_and_nothing_is_sent(make_rig, reference):
    old, _, _ = reference
    alarms = 0
    for at in range(1, POINTS):
        rig = make_rig(Mode.STAGE)
        if not rig.cut(at, rig.whole_way):
            break
        rig.policy = make_rig(Mode.OBSERVE).policy
        said = len(rig.device.log)
        rig.back("program")
        assert len(rig.device.log) == said
        if not same_registers(rig.device.held(), old) and rig.kinds[-1] != "PROVEN":
            alarms += 1
            assert rig.wb.state is State.FAULT
            assert any("$VNWRG,23,1,0,0" in text for text in rig.notes("error"))
    assert alarms > 5


@pytest.mark.parametrize("acknowledged", [True, False])
def test_a_restart_that_only_the_streams_time_tells_confirms_a_save(make_rig, acknowledged):
    rig = make_rig()
    if not acknowledged:
        rig.device.mute = lambda command: command == Word("VNWNV")
    rig.whole_way()
    waiting = State.COMMITTED if acknowledged else State.FAULT
    rig.now_s += 60.0
    rig.device.restart()
    rig.start()
    rig.connect()  # the registers are read before the first sample
    assert rig.wb.state is waiting
    rig.do(rig.wb.on_uptime(3600.0, rig.now_s))
    assert (rig.wb.state, rig.asked_again) == (waiting, 0)
    rig.do(rig.wb.on_uptime(5.0, rig.now_s))
    assert rig.asked_again == 1
    rig.connect()
    assert rig.wb.state is State.CONFIRMED
    rig.do(rig.wb.on_uptime(5.0, rig.now_s))
    assert rig.asked_again == 1


# -- the table -------------------------------------------------------------------------------------


def test_the_table_is_total_and_its_signals_are_taken():
    from ahrsd.writeback.journal_history import OPEN

    assert set(TABLE) == set(OPEN)
    for row in TABLE.values():
        assert set(row) == set(DeviceContents)
        for resolution in row.values():
            target = TRANSITIONS[State.RECONCILING][resolution.signal]
            assert target is not State.RECONCILING
            assert resolution.text
            closes = resolution.signal in (Signal.NOTHING_OPEN, Signal.READ_CONFIRMED, Signal.TORN)
            assert closes <= (resolution.record is not None)
            if closes:
                assert resolution.record not in OPEN


def test_contradictions_are_alarms_and_old_values_never_are_before_a_save():
    for last, row in TABLE.items():
        assert row[DeviceContents.NEITHER].level in ("error", "warning")
        assert row[DeviceContents.NEITHER].signal not in (
            Signal.NOTHING_OPEN,
            Signal.READ_CONFIRMED,
        )
        for held in (DeviceContents.OLD, DeviceContents.OLD_AFTER_RESTART):
            assert row[held].signal is Signal.NOTHING_OPEN
        assert {RecordKind.LOST, RecordKind.NOT_SAVED}.isdisjoint(
            row[held].record
            for held in DeviceContents
            if held is not DeviceContents.OLD_AFTER_RESTART
        )
        if last not in (RecordKind.FLASH_SENT, RecordKind.FLASH_ACKED):
            assert row[DeviceContents.NEITHER].record is RecordKind.FOREIGN
            assert row[DeviceContents.MIXED_AFTER_RESTART].record is RecordKind.FOREIGN
            if last is not RecordKind.PROVEN:
                assert row[DeviceContents.NEW_AFTER_RESTART].record is RecordKind.FOREIGN
        confirming = {held for held in DeviceContents if row[held].record is RecordKind.CONFIRMED}
        assert confirming <= {DeviceContents.NEW_AFTER_RESTART}
        if last is not RecordKind.FLASH_ACKED:
            assert row[DeviceContents.OLD].level != "error"


OLD, NEW = (1.0,) * 9 + (0.0,) * 3, (1.0,) * 9 + (0.5,) * 3
OTHER = (2.0,) * 12


@pytest.mark.parametrize(
    ("device", "restarted", "expected"),
    [
        ({23: OLD, 84: OLD}, False, DeviceContents.OLD),
        ({23: OLD, 84: OLD}, True, DeviceContents.OLD_AFTER_RESTART),
        ({23: NEW, 84: NEW}, False, DeviceContents.NEW),
        ({23: NEW, 84: NEW}, True, DeviceContents.NEW_AFTER_RESTART),
        ({23: NEW, 84: OLD}, False, DeviceContents.MIXED),
        ({23: NEW, 84: OLD}, True, DeviceContents.MIXED_AFTER_RESTART),
        ({23: NEW, 84: OTHER}, True, DeviceContents.NEITHER),
        ({23: NEW}, True, DeviceContents.NEITHER),
        ({23: (float("nan"),) * 12, 84: NEW}, False, DeviceContents.NEITHER),
    ],
)
def test_found(device, restarted, expected):
    assert compare_contents({23: OLD, 84: OLD}, {23: NEW, 84: NEW}, device, restarted) is expected


def test_foreign_values_lock_until_a_person_looked(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.device.ram[23] = OTHER
    rig.back("program")
    assert rig.wb.state is State.LOCKED
    assert rig.kinds[-2:] == ["LOCKED", "FOREIGN"]
    assert rig.device.ram[23] == OTHER
    rig.back("program")
    assert rig.wb.state is State.LOCKED
    rig.do(rig.wb.on_operator("unlock", "it was me", rig.now_s))
    assert rig.wb.state is State.OBSERVING


def test_a_change_behind_our_back_is_noticed_at_the_next_start(make_rig):
    rig = make_rig()
    rig.whole_way()
    rig.back("all")
    assert rig.wb.state is State.CONFIRMED
    rig.device.flash[23] = OTHER
    rig.back("all")
    assert rig.wb.state is State.OBSERVING
    assert "register 23 changed" in rig.notes("error")[-1]
