"""Power cuts at every point of a write: before and after each command and each record.

After each cut, whatever is lost, journal and device agree or there is an alarm. The old values are
in the journal as long as the device does not hold them, and recovery never writes the flash.
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
POINTS = 260  # more points than a whole write has, which the first test checks


def same_registers(one, two):
    return all(one[n] == pytest.approx(two[n], abs=1e-6) for n in one)


def assert_agreed(rig, old, new):
    """The machine's state agrees with what the device holds, or there is an alarm."""
    device, state = rig.device.held(), rig.wb.state
    if state in HOLDS_OLD:
        left = rig.wb.history.holds  # the result of the last transaction according to the journal
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
    """Old values, new values, and the number of points of a whole write."""
    rig = make_rig()
    old = rig.device.held()
    rig.whole_way()
    assert rig.wb.state is State.COMMITTED
    return old, rig.device.held(), rig.points


def test_whole_write_has_between_100_and_the_maximum_of_points(reference):
    assert 100 < reference[2] < POINTS


@pytest.mark.parametrize(
    ("mode", "lost"),
    [
        *((Mode.COMMIT, lost) for lost in ("all", "device", "program")),
        (Mode.STAGE, "all"),
        *(pytest.param(Mode.STAGE, lost, marks=pytest.mark.slow) for lost in ("device", "program")),
    ],
)
def test_power_cut_at_any_point_ends_in_agreement(make_rig, reference, lost, mode):
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


def rejected_write(rig):
    """A whole write with a calibration that the trial rejects."""
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live(field_spread=0.5)


@pytest.mark.parametrize("lost", ["all", "device", "program"])
def test_power_cut_in_a_rollback_ends_with_the_old_values(make_rig, reference, lost):
    old, new, _ = reference
    for at in range(1, POINTS):
        rig = make_rig(Mode.STAGE)
        if not rig.cut(at, lambda rig=rig: rejected_write(rig)):
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
def test_second_power_cut_during_recovery_ends_in_agreement(make_rig, reference, way):
    old, new, _ = reference
    recoveries = 0
    for at in range(1, POINTS, 2):
        for again in range(1, 12):
            rig = make_rig()
            act = rig.whole_way if way == "whole" else lambda rig=rig: rejected_write(rig)
            if not rig.cut(at, act):
                assert recoveries > 50
                return
            if not rig.cut(again, lambda rig=rig: rig.back("program")):
                break
            recoveries += 1
            rig.back("all" if again % 2 else "program")
            assert_agreed(rig, old, new)


@pytest.mark.parametrize("half", ["one of two", "garbage"])
def test_flash_torn_by_a_cut_during_vnwnv_is_an_alarm(make_rig, reference, half):
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
    rig.back("all")  # it stays torn until a person intervenes
    assert rig.wb.state is State.FLASH_TORN
    rig.verdict()
    assert rig.wb.state is State.FLASH_TORN
    rig.do(rig.wb.on_operator("unlock", "old values typed in and checked", rig.now_s))
    assert rig.wb.state is State.OBSERVING
    assert JournalHistory.of(rig.journal).torn is False


@pytest.mark.parametrize("number", [23, 84])
def test_first_register_is_restored_when_killed_between_two_registers(make_rig, reference, number):
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


def test_interrupted_write_is_only_an_alarm_in_mode_observe(make_rig, reference):
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
def test_restart_seen_only_by_device_time_confirms_a_save(make_rig, acknowledged):
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


def test_reconciliation_table_is_total_and_its_signals_are_handled():
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


def test_contradictions_are_alarms_and_old_values_before_a_save_are_not():
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
def test_device_contents_are_classified(device, restarted, expected):
    assert compare_contents({23: OLD, 84: OLD}, {23: NEW, 84: NEW}, device, restarted) is expected


def test_foreign_values_lock_until_unlocked(make_rig):
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


def test_change_by_another_program_is_noticed_at_the_next_start(make_rig):
    rig = make_rig()
    rig.whole_way()
    rig.back("all")
    assert rig.wb.state is State.CONFIRMED
    rig.device.flash[23] = OTHER
    rig.back("all")
    assert rig.wb.state is State.OBSERVING
    assert "register 23 changed" in rig.notes("error")[-1]
