"""Proof of a restart, and what follows from the newest record of the journal with and without
it.
"""

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
    """The present, this many seconds after the record; another boot began at 0."""
    boot_s = 1000.0 + seconds if boot_id == "one" else seconds
    return Stamp(1.8e9 + seconds, boot_id, boot_s)


@pytest.mark.parametrize(
    ("record", "now", "uptime_s", "proven"),
    [
        (RECORD, later(60.0), 560.0, False),
        (RECORD, later(60.0), 5.0, True),
        (
            RECORD,
            later(60.0),
            59.8,
            True,
        ),  # its time decreased, by no more than the age of the record
        (RECORD, later(60.0), 61.0, False),  # it decreased by more: a clock that jumped
        (RECORD, later(60.0), 499.9, False),
        (Stamp(1.8e9, "one", 1000.0), later(60.0), 59.8, False),  # within the duration of a message
        (Stamp(1.8e9, "one", 1000.0), later(60.0), 59.0, True),
        (RECORD, later(-1.0), 0.0, False),  # boottime does not decrease
        (RECORD, later(1e6), 1e6 + 500.0 - 900.0, False),  # a clock that is slow by a thousandth
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
def test_device_time_proves_a_restart(record, now, uptime_s, proven):
    assert restarted_since(record, now, uptime_s) is proven


@pytest.mark.parametrize("wall_s", [0.0, 1.0, 1.8e9 - 3600.0, 4e9, None])
def test_wall_clock_proves_no_restart(wall_s):
    timeless = Stamp(1.8e9, "one", 1000.0)
    pairs = [(Stamp(wall_s), later(9.0)), (timeless, Stamp(wall_s)), (Stamp(wall_s), Stamp(wall_s))]
    for record, now in pairs:
        assert not any(restarted_since(record, now, u) for u in (0.0, 5.0, 499.9, 1e5))


@pytest.mark.parametrize(
    "facts",
    [{}, {"wall_s": "x", "boot_id": 7, "boot_s": [], "device_s": True}, {"boot_s": float("nan")}],
)
def test_invalid_stamp_is_empty(facts):
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


def test_observed_restart_counts_only_for_its_device(make_rig):
    rig = saved(make_rig, tells_time=False)
    rig.device.restart()
    rig.do(rig.wb.on_reset(rig.now_s))
    ours, rig.device.serial = rig.device.serial, 42
    rig.connect(journal=[])  # another unit took over the cable in between
    rig.device.serial = ours
    rig.connect()
    assert rig.wb.state is State.COMMITTED
    rig.do(rig.wb.on_reset(rig.now_s))
    rig.connect()
    assert rig.wb.state is State.CONFIRMED


def test_reported_restart_does_not_count_if_the_device_time_continues(make_rig):
    rig = saved(make_rig)
    rig.do(rig.wb.on_reset(rig.now_s))
    rig.connect()
    for _ in range(5):
        rig.pass_time(0.6)
    assert rig.wb.state is State.COMMITTED
    assert rig.asked_again == 0


@pytest.mark.parametrize("late_s", [3.0, 90.0])
def test_buffered_messages_prove_no_restart(make_rig, late_s):
    """The program was stopped: the first message is as old as the stop, the next ones are not."""
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


def test_backward_jump_of_device_time_causes_a_check_and_proves_no_restart(make_rig):
    rig = saved(make_rig)
    rig.pass_time(0.5)
    hear(rig, rig.now_s - rig.started_s - 300.0, 1.0)  # no restart: it has been running for 700 s
    assert rig.wb.state is State.RECONCILING
    assert rig.asked_again == 1
    rig.connect()
    assert rig.wb.state is State.COMMITTED


def test_journal_without_clocks_confirms_only_after_an_observed_restart(make_rig):
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
    rig.hear_time()  # its time decreased in this run, and the record is older
    rig.connect()
    assert rig.wb.state is State.CONFIRMED


# -- an old failed write ---------------------------------------------------------------------------


def failed(make_rig):
    """A write of which register 84 was refused, and nothing could be restored."""
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
def test_old_failed_write_is_not_undone_over_foreign_values(make_rig, lost, number):
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


def test_foreign_saved_values_are_not_overwritten_after_a_restart(make_rig):
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


def test_failed_write_still_in_ram_is_undone(make_rig):
    rig = failed(make_rig)
    assert rig.device.held()[23] != rig.device.held("flash")[23]
    rig.back("program")
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.device.held() == rig.device.held("flash")


# -- a rollback that was not journaled -------------------------------------------------------------


def on_trial(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    assert rig.wb.state is State.TRIAL
    return rig


def test_unjournaled_rollback_is_not_recorded_as_lost(make_rig):
    rig = on_trial(make_rig)
    rig.disk_full = True
    rig.live(field_spread=0.5)
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.kinds == ["PREPARED", "RAM_VERIFIED"]
    rig.disk_full = False
    rig.back("program")  # killed before it could retry
    assert rig.wb.state is State.OBSERVING
    assert rig.kinds[-1] == "REVERTED"
    assert "a rollback that could not be journaled" in rig.notes("warning")[-1]
    assert rig.wb.history.holds == JournalHistory.of(rig.journal).holds
    assert rig.wb.history.holds[23] == pytest.approx(rig.device.held()[23])


@pytest.mark.parametrize("when", ["time", "stop", "reread", "person"])
def test_unjournaled_rollback_is_journaled_later(make_rig, when):
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
        assert (
            rig.wb.state is State.OBSERVING
        )  # not LOST, although the file does not contain it yet
        rig.pass_time(31.0)
    wanted = ["PREPARED", "RAM_VERIFIED", "ROLLBACK", "ROLLED_BACK"]
    assert rig.kinds == wanted + (["LOCKED"] if when == "person" else [])
    assert rig.journal[2].facts["counts"] is True
    assert rig.journal[2].facts["boot_s"] < rig.now_s - rig.boot_began_s or when == "stop"
    assert JournalHistory.of(rig.journal).rollbacks == 1
    assert rig.wb.history == JournalHistory.of(rig.journal)
    assert not any("journal" in text for text in rig.wb.obstacles())


def test_unjournaled_write_leaves_the_previous_save_open(make_rig):
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


def test_pending_records_of_another_unit_are_dropped_with_an_error(make_rig):
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
def test_refused_register_does_not_stop_the_rollback_of_the_others(make_rig, what, how):
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
def test_write_that_never_arrived_leaves_foreign_values(make_rig, number, how):
    """They were written between the check and the first write; then the device did not answer."""
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
def test_value_altered_by_the_device_is_rolled_back(make_rig, number):
    """The device stores another value than it received, and reports it: neither the old nor the
    new one.
    """
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
    assert len(made) == 1  # a retry would give the same
    assert rig.device.held() == before
    assert rig.kinds == ["PREPARED", "RAM_FAILED", "ROLLBACK", "ROLLED_BACK"]


@pytest.mark.parametrize("echo", [True, False])
def test_foreign_saved_value_restored_by_a_restart_after_a_write_stays(make_rig, echo):
    """Foreign values are in flash, others in RAM. The write is not repeated over them."""
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


# -- unknown values --------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [23, 84])
def test_values_without_a_journal_record_are_reported(make_rig, number):
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


DONE, SENT = Record("HAND_VERIFIED", {"txn": 1}), Record("HAND_FLASH_SENT", {"txn": 1})


@pytest.mark.parametrize(
    ("ends", "reported"),
    [
        ([], True),
        ([Record("HAND_FAILED", {"txn": 1, "restored": False})], True),
        ([Record("HAND_FAILED", {"txn": 1, "restored": True})], False),
        ([DONE], False),
        ([DONE, SENT], True),
        ([DONE, SENT, Record("HAND_FLASH_ACKED", {"txn": 1})], False),
    ],
)
def test_write_by_hand_that_was_broken_off_is_reported(make_rig, ends, reported):
    """Also one whose save was: the flash then holds some of each."""
    rig = make_rig(Mode.STAGE)
    old = {str(n): list(rig.device.ram[n]) for n in (23, 84)}
    rig.device.ram[23] = OTHER  # and not 84
    prepared = Record("HAND_PREPARED", {"old": old, "new": {key: list(OTHER) for key in old}})
    rig.connect(journal=[prepared, *ends])
    said = [text for text in rig.notes("error") if "by hand of registers 23, 84, or its" in text]
    assert len(said) == reported


def test_write_by_hand_after_a_save_is_not_called_somebody_elses(make_rig):
    rig = saved(make_rig)
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED
    held = rig.device.ram[23]
    rig.device.ram[23] = rig.device.flash[23] = OTHER
    by_hand = {"old": {"23": list(held)}, "new": {"23": list(OTHER)}}
    rig.journal.append(Record("HAND_PREPARED", by_hand))
    rig.back("all")
    assert rig.notes("error") == []
    rig.device.ram[84] = rig.device.flash[84] = OTHER
    rig.back("all")
    assert "register 84 changed since the journal's last record" in rig.notes("error")[-1]


def test_values_of_an_own_save_are_not_reported(make_rig):
    rig = saved(make_rig)
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED
    rig.back("all")
    assert rig.notes("warning") == []
