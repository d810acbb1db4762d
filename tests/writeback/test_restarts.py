"""A restart is proven or it is not; what follows from the journal's newest record either way."""

from __future__ import annotations

import numpy as np
import pytest
from writeback_rig import Record

from ahrsd.writeback.actions import IdentifyAgain
from ahrsd.writeback.journal_history import JournalHistory, RecordKind, Stamp, restarted_since
from ahrsd.writeback.reconcile import TABLE, DeviceContents
from ahrsd.writeback.states import Mode, State
from drivers.vn100.commands import Read, Word, Write

OTHER = (2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.1, 0.2, 0.3)
RECORD = Stamp(1.8e9, "one", 1000.0, 500.0)


def later(seconds, boot_id="one"):
    """The present, so many seconds after the record; another boot began at 0."""
    boot_s = 1000.0 + seconds if boot_id == "one" else seconds
    return Stamp(1.8e9 + seconds, boot_id, boot_s)


@pytest.mark.parametrize(
    ("record", "now", "uptime_s", "proven"),
    [
        (RECORD, later(60.0), 560.0, False),
        (RECORD, later(60.0), 5.0, True),
        (RECORD, later(60.0), 59.8, True),  # its time fell, and no further than the record is old
        (RECORD, later(60.0), 61.0, False),  # it fell further: a clock that jumped
        (RECORD, later(60.0), 499.9, False),
        (Stamp(1.8e9, "one", 1000.0), later(60.0), 59.8, False),  # within the time of a message
        (Stamp(1.8e9, "one", 1000.0), later(60.0), 59.0, True),
        (RECORD, later(-1.0), 0.0, False),  # boottime does not fall
        (RECORD, later(1e6), 1e6 + 500.0 - 900.0, False),  # a clock that is a thousandth slow
        (RECORD, later(60.0, "two"), 499.0, True),
        (RECORD, later(60.0, "two"), 499.9, False),
        (RECORD, later(60.0, "two"), 560.0, False),
        (RECORD, later(60.0, ""), 499.0, True),
        (Stamp(1.8e9, "", None, 500.0), later(60.0, ""), 499.0, True),
        (Stamp(1.8e9), later(60.0), 5.0, False),  # an old journal
        (Stamp(0.0), later(60.0), 5.0, False),
        (RECORD, later(60.0), None, False),
        (RECORD, later(60.0), float("nan"), False),
        (RECORD, later(60.0), -1.0, False),
    ],
)
def test_what_proves_a_restart(record, now, uptime_s, proven):
    assert restarted_since(record, now, uptime_s) is proven


@pytest.mark.parametrize("wall_s", [0.0, 1.0, 1.8e9 - 3600.0, 4e9, None])
def test_the_wall_clock_proves_nothing(wall_s):
    timeless = Stamp(1.8e9, "one", 1000.0)
    pairs = [(Stamp(wall_s), later(9.0)), (timeless, Stamp(wall_s)), (Stamp(wall_s), Stamp(wall_s))]
    for record, now in pairs:
        assert not any(restarted_since(record, now, u) for u in (0.0, 5.0, 499.9, 1e5))


@pytest.mark.parametrize(
    "facts",
    [{}, {"wall_s": "x", "boot_id": 7, "boot_s": [], "device_s": True}, {"boot_s": float("nan")}],
)
def test_a_stamp_that_is_none_says_nothing(facts):
    assert Stamp.of(facts) == Stamp()


def saved(make_rig, tells_time=True):
    rig = make_rig()
    rig.tells_time = tells_time
    rig.whole_way()
    assert rig.wb.state is State.COMMITTED
    return rig


def hear(rig, uptime_s, seconds=0.0):
    rig.now_s += seconds
    rig.do(rig.wb.on_uptime(uptime_s, rig.now_s))


def test_a_restart_that_is_seen_counts_for_this_device_only(make_rig):
    rig = saved(make_rig, tells_time=False)
    rig.device.restart()
    rig.do(rig.wb.on_reset(rig.now_s))
    ours, rig.device.serial = rig.device.serial, 42
    rig.connect(journal=[])  # another unit took over the cable meanwhile
    rig.device.serial = ours
    rig.connect()
    assert rig.wb.state is State.COMMITTED
    rig.do(rig.wb.on_reset(rig.now_s))
    rig.connect()
    assert rig.wb.state is State.CONFIRMED


def test_a_device_that_reports_a_restart_and_tells_a_time_that_runs_on_did_not(make_rig):
    rig = saved(make_rig)
    rig.do(rig.wb.on_reset(rig.now_s))
    rig.connect()
    for _ in range(5):
        rig.pass_time(0.6)
    assert rig.wb.state is State.COMMITTED
    assert rig.asked_again == 0


@pytest.mark.parametrize("late_s", [3.0, 90.0])
def test_messages_out_of_a_buffer_prove_nothing(make_rig, late_s):
    """The program was stopped: the first message is as old as that, the next ones are not."""
    rig = saved(make_rig)
    rig.start()
    rig.now_s += late_s
    rig.started_s = rig.now_s - late_s - 2.0  # the device started shortly before the save
    rig.journal[-1].facts["boot_s"] = rig.now_s - late_s
    rig.journal[-1].facts["device_s"] = None
    rig.connect()
    hear(rig, rig.now_s - rig.started_s - late_s)
    for _ in range(10):
        hear(rig, rig.now_s + 0.3 - rig.started_s, 0.3)
    assert rig.wb.state is State.COMMITTED
    assert rig.asked_again == 0


def test_a_time_that_jumps_back_has_the_device_read_again_and_proves_nothing(make_rig):
    rig = saved(make_rig)
    rig.pass_time(0.5)
    hear(rig, rig.now_s - rig.started_s - 300.0, 1.0)  # no restart: it runs for 700 s
    assert rig.wb.state is State.RECONCILING
    assert rig.asked_again == 1
    rig.connect()
    assert rig.wb.state is State.COMMITTED


def test_an_old_journal_confirms_nothing_until_a_restart_is_seen(make_rig):
    rig = saved(make_rig)
    for record in rig.journal:
        for key in ("boot_id", "boot_s", "device_s"):
            record.facts.pop(key)
    rig.back("all")
    assert rig.wb.state is State.COMMITTED
    rig.pass_time(1.0)
    rig.now_s += 20.0
    rig.device.restart()
    rig.started_s = rig.now_s - 1.0
    rig.hear_time()  # its time fell in this run, and the record is of before
    rig.connect()
    assert rig.wb.state is State.CONFIRMED


# -- an old failed write ---------------------------------------------------------------------------


def failed(make_rig):
    """A write of which register 84 was refused, and nothing could be put back."""
    rig = make_rig(Mode.STAGE)
    new = []

    def refuse(command):
        if isinstance(command, Write):
            new.append(command.register)
            return 9 if len(new) > 1 else None
        return None

    rig.device.refuse = refuse
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.device.refuse = lambda _: None
    del rig.journal[rig.kinds.index("RAM_FAILED") + 1 :]
    assert rig.kinds == ["PREPARED", "RAM_FAILED"]
    return rig


@pytest.mark.parametrize("number", [23, 84])
@pytest.mark.parametrize("lost", ["all", "program"])
def test_a_failed_write_of_weeks_ago_is_not_undone_over_somebodys_values(make_rig, lost, number):
    rig = failed(make_rig)
    rig.now_s += 21 * 86400.0
    rig.device.restart()
    rig.device.ram[number] = rig.device.flash[number] = OTHER  # by hand, and saved
    writes = len(rig.sent)
    rig.back(lost)
    assert rig.wb.state is State.LOCKED
    assert rig.kinds[-2:] == ["LOCKED", "FOREIGN"]
    assert len(rig.sent) == writes
    assert rig.device.ram[number] == rig.device.flash[number] == OTHER


def test_what_somebody_saved_is_not_written_over_after_a_restart(make_rig):
    for kind in (
        RecordKind.PREPARED,
        RecordKind.RAM_FAILED,
        RecordKind.RAM_VERIFIED,
        RecordKind.ROLLBACK,
    ):
        for held in (
            DeviceContents.NEW_AFTER_RESTART,
            DeviceContents.MIXED_AFTER_RESTART,
            DeviceContents.NEITHER,
        ):
            assert TABLE[kind][held].record is RecordKind.FOREIGN


def test_a_failed_write_that_is_still_in_ram_is_undone(make_rig):
    rig = failed(make_rig)
    assert rig.device.held()[23] != rig.device.held("flash")[23]
    rig.back("program")
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.device.held() == rig.device.held("flash")


# -- a rollback that the disk did not take ---------------------------------------------------------


def on_trial(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    assert rig.wb.state is State.TRIAL
    return rig


def test_a_rollback_that_could_not_be_journaled_is_not_called_lost(make_rig):
    rig = on_trial(make_rig)
    rig.disk_full = True
    rig.live(field_spread=0.5)
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.kinds == ["PREPARED", "RAM_VERIFIED"]
    rig.disk_full = False
    rig.back("program")  # killed before it could try again
    assert rig.wb.state is State.OBSERVING
    assert rig.kinds[-1] == "REVERTED"
    assert "a rollback that could not be journaled" in rig.notes("warning")[-1]
    assert rig.wb.history.holds == JournalHistory.of(rig.journal).holds
    assert rig.wb.history.holds[23] == pytest.approx(rig.device.held()[23])


@pytest.mark.parametrize("when", ["time", "stop", "reread", "person"])
def test_a_rollback_that_could_not_be_journaled_is_journaled_later(make_rig, when):
    rig = on_trial(make_rig)
    rig.disk_full = True
    rig.live(field_spread=0.5)
    assert any("the journal cannot be written" in text for text in rig.wb.obstacles())
    rig.disk_full = False
    if when == "time":
        rig.pass_time(29.0)
        assert rig.kinds == ["PREPARED", "RAM_VERIFIED"]
        rig.pass_time(1.1)
    elif when == "stop":
        rig.do(rig.wb.on_stop(rig.now_s))
    elif when == "person":
        rig.do(rig.wb.on_operator("lock", "look at it", rig.now_s))
    else:
        rig.do(rig.wb.on_link_lost(rig.now_s))
        rig.connect()
        assert rig.wb.state is State.OBSERVING  # not LOST, though the file does not say it yet
        rig.pass_time(31.0)
    wanted = ["PREPARED", "RAM_VERIFIED", "ROLLBACK", "ROLLED_BACK"]
    assert rig.kinds == wanted + (["LOCKED"] if when == "person" else [])
    assert rig.journal[2].facts["counts"] is True
    assert rig.journal[2].facts["boot_s"] < rig.now_s - rig.boot_began_s or when == "stop"
    assert JournalHistory.of(rig.journal).rollbacks == 1
    assert rig.wb.history == JournalHistory.of(rig.journal)
    assert not any("journal" in text for text in rig.wb.obstacles())


def test_a_write_that_could_not_be_announced_leaves_the_save_before_it_open(make_rig):
    rig = saved(make_rig)
    rig.now_s += 2 * 86400.0
    rig.disk_full = True
    rig.pass_time(0.1)
    rig.verdict(hard_iron_gauss=np.array([0.09, 0.04, -0.02]))
    rig.approve()
    assert rig.wb.state is State.OBSERVING
    rig.disk_full = False
    rig.pass_time(31.0)
    assert rig.kinds[-1] == "FLASH_ACKED"
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED
    assert rig.wb.history.holds[23] == pytest.approx(rig.device.held("flash")[23])


def test_records_of_another_unit_are_not_journaled_for_this_one(make_rig):
    rig = on_trial(make_rig)
    rig.disk_full = True
    rig.live(field_spread=0.5)
    rig.disk_full = False
    rig.device.serial, rig.journal = 42, []
    rig.do(rig.wb.on_link_lost(rig.now_s))
    rig.connect()
    rig.pass_time(31.0)
    assert rig.kinds == []
    assert any("lost: 2 records of" in text for text in rig.notes("error"))


# -- the rollback itself ---------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["refused", "silent"])
@pytest.mark.parametrize("what", [23, 84, "VNASY"])
def test_one_refusal_does_not_end_the_rollback_of_the_others(make_rig, what, how):
    rig = on_trial(make_rig)
    before, held = rig.device.held("flash"), rig.device.held()

    def hit(command):
        if what == "VNASY":
            return isinstance(command, Word) and command.word == what
        return isinstance(command, Write) and command.register == what

    if how == "refused":
        rig.device.refuse = lambda command: 9 if hit(command) else None
    else:
        rig.device.mute = hit
    rig.live(field_spread=0.5)
    back = {23, 84} - ({what} if how == "refused" else set())
    assert rig.device.held() == {n: (before if n in back else held)[n] for n in (23, 84)}
    assert rig.wb.state is (State.ROLLED_BACK if len(back) == 2 else State.FAULT)
    if len(back) == 1:
        fault = rig.notes("error")[-1]
        assert f"register {what}:" in fault
        assert "$VNWRG,23,1,0,0" in fault


@pytest.mark.parametrize("number", [23, 84])
@pytest.mark.parametrize("how", ["silent", "no end"])
def test_a_write_that_never_came_to_the_device_leaves_what_somebody_else_wrote(
    make_rig, number, how
):
    """Theirs came between the check and the first write; then the device said nothing."""
    rig = make_rig(Mode.STAGE)

    def silent(command):
        if rig.wb.state is not State.STAGING:
            return False
        rig.device.ram[number] = OTHER
        if how == "no end":
            rig.pass_time(60.0)
        return True

    rig.device.mute = silent
    rig.whole_way()
    assert rig.device.ram[number] == OTHER
    assert not any(isinstance(command, Write) for command in rig.device.log)
    assert rig.kinds[:3] == ["PREPARED", "RAM_FAILED", "ROLLBACK"]
    assert rig.asked[-1] == IdentifyAgain()
    rig.connect()
    assert rig.kinds[3:] == ["LOCKED", "FOREIGN"]
    assert rig.wb.state is State.LOCKED
    assert rig.device.ram[number] == OTHER


@pytest.mark.parametrize("number", [23, 84])
def test_what_the_device_made_of_a_value_of_ours_is_put_back(make_rig, number):
    """It stores something else than it was told, and says so: neither the old nor the new value."""
    rig = make_rig(Mode.STAGE)
    before, made = rig.device.held(), []

    def alters(command):
        ours = isinstance(command, Write) and command.register == number
        if ours and rig.wb.state is State.STAGING:
            rig.device.ram[number] = (*command.values[:-1], 1.5)
            made.append(command.values)
        return False

    rig.device.mute = alters
    rig.whole_way()
    assert len(made) == 1  # once more would bring the same
    assert rig.device.held() == before
    assert rig.kinds == ["PREPARED", "RAM_FAILED", "ROLLBACK", "ROLLED_BACK"]


@pytest.mark.parametrize("echo", [True, False])
def test_a_restart_right_behind_a_write_brings_back_what_somebody_saved_and_it_stays(
    make_rig, echo
):
    """Their values are in flash, others in RAM; the write is not repeated over them."""
    rig = make_rig(Mode.STAGE)
    rig.device.flash[84] = OTHER
    restarted = []

    def restarts(command):
        if isinstance(command, Write) and command.register == 84 and not restarted:
            if echo:
                return False
            rig.device.restart()
            restarted.append(command)
            return True
        if isinstance(command, Read) and command.register == 84 and writes(rig) and not restarted:
            rig.device.restart()
            restarted.append(command)
        return False

    rig.device.mute = restarts
    rig.whole_way()
    assert len(restarted) == 1
    assert [command.register for command in writes(rig)] == [23, 84]
    assert rig.device.ram[84] == OTHER
    rig.connect()
    assert rig.kinds[-2:] == ["LOCKED", "FOREIGN"]


def writes(rig):
    return [command for command in rig.device.log if isinstance(command, Write)]


# -- values of nobody ------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [23, 84])
def test_values_that_nobody_journaled_deserve_a_line(make_rig, number):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    assert rig.notes("warning") == []
    rig.device.ram[number] = rig.device.flash[number] = OTHER
    rig.back("all")
    assert f"register {number} holds values that are neither" in rig.notes("warning")[-1]
    rig = make_rig(Mode.STAGE)
    rig.device.ram[number] = rig.device.flash[number] = OTHER
    by_hand = {"old": {str(number): [1.0]}, "new": {str(number): list(OTHER)}}
    rig.connect(journal=[Record("HAND_PREPARED", by_hand)])
    assert rig.notes("warning") == []


def test_the_values_of_an_own_save_are_journaled(make_rig):
    rig = saved(make_rig)
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED
    rig.back("all")
    assert rig.notes("warning") == []
