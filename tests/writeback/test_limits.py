"""Budgets, locks, stops, and the history that is derived from the journal."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.samples import SampleBlock
from ahrsd.writeback.journal_history import JournalHistory, Now, Stamp, StoredRecord
from ahrsd.writeback.policy import Stillness, StillPolicy, WriteBackPolicy, flash_budget, ram_budget
from ahrsd.writeback.states import Mode, Purpose, State
from drivers.vn100.commands import Word, Write

DAY_S = 86400.0


def another(rig, shift_gauss=0.0):
    """One more transaction with another hard iron, as far as it goes."""
    rig.pass_time(0.1)
    rig.verdict(hard_iron_gauss=np.array([0.03 + shift_gauss, 0.04, -0.02]))
    if rig.wb.state is State.QUALIFIED:
        rig.approve()


def rolled_back(make_rig, **policy):
    rig = make_rig(Mode.STAGE, **policy)
    rig.connect()
    another(rig)
    rig.live(field_spread=0.5)
    assert rig.wb.state is State.ROLLED_BACK
    return rig


def at(boot_s, boot_id="one", wall_s=None):
    return Stamp(1.8e9 + boot_s if wall_s is None else wall_s, boot_id, boot_s)


def test_ram_writes_are_limited_by_interval_and_number():
    policy = WriteBackPolicy()
    history = JournalHistory(ram_writes_at=(at(1000.0),))
    assert "599 s ago" in ram_budget(policy, history, Now(at(1599.0)))[0]
    assert ram_budget(policy, history, Now(at(1600.0))) == []
    many = JournalHistory(ram_writes_at=tuple(at(1000.0 + 700.0 * k) for k in range(6)))
    assert ram_budget(policy, many, Now(at(10_000.0))) == ["6 RAM writes in a day, limit 6"]
    assert ram_budget(policy, many, Now(at(1000.1 + DAY_S))) == []


@pytest.mark.parametrize(
    ("now", "granted"),
    [
        (at(9.0 + DAY_S), True),
        (at(9.0 + DAY_S, wall_s=1.8e9 + 9.0 + DAY_S - 3600.0), False),  # one hour behind
        (at(9.0 + DAY_S, wall_s=1.8e9 + 9.0 + 2 * DAY_S), True),
        (at(9.0 + 3600.0, wall_s=1.8e9 + 9.0 + 2 * DAY_S), False),  # set forward by a day
        (at(9.0 + DAY_S, wall_s=1e6), True),  # in 1970, which says nothing; boottime does
        (at(8.0, wall_s=2e9), False),  # boottime never decreases: not understood
        (at(50.0, "two", wall_s=1e6), False),
        (at(50.0, "two", wall_s=1.8e9 + 9.0 + DAY_S + 3600.0), False),  # may be an hour ahead
        (at(50.0, "two", wall_s=1.8e9 + 9.0 + DAY_S + 7500.0), True),
        (at(DAY_S, "two", wall_s=1e6), True),  # up for a day
        (at(DAY_S, "", wall_s=1e6), False),
        (at(DAY_S, "", wall_s=1.9e9), True),
    ],
)
def test_wrong_or_set_clock_grants_no_budget(now, granted):
    history = JournalHistory(ram_writes_at=(at(9.0),) * 6, flashes_at=(at(9.0),), flashes=1)
    assert (ram_budget(WriteBackPolicy(), history, Now(now)) == []) is granted
    assert (flash_budget(WriteBackPolicy(), history, Now(now)) == []) is granted
    cooling = JournalHistory(rollback_at=at(9.0))
    assert (ram_budget(WriteBackPolicy(), cooling, Now(now)) == []) is granted


@pytest.mark.parametrize("wall_s", [1e6, None, 1.8e9])
def test_records_without_clocks_count_until_the_run_is_a_day_old(wall_s):
    history = JournalHistory(flashes_at=(Stamp(wall_s),), flashes=1)
    present = at(9 * DAY_S, wall_s=1.8e9 + 3600.0)
    assert flash_budget(WriteBackPolicy(), history, Now(present, DAY_S - 1.0)) != []
    assert flash_budget(WriteBackPolicy(), history, Now(present, DAY_S)) == []


def test_record_dated_1970_is_as_old_as_the_next_record():
    early = Stamp(4000.0, "one", 30.0)
    history = JournalHistory(flashes_at=(early,), flashes=1, newest_at=at(90.0))
    assert flash_budget(WriteBackPolicy(), history, Now(at(5.0, "two"))) != []
    later = at(5.0, "two", wall_s=1.8e9 + 2 * DAY_S)
    assert flash_budget(WriteBackPolicy(), history, Now(later)) == []


def test_flash_writes_are_limited_per_day_and_per_lifetime():
    policy = WriteBackPolicy()
    one = JournalHistory(flashes=1, flashes_at=(at(0.0),))
    assert flash_budget(policy, one, Now(at(DAY_S))) == []
    today = flash_budget(policy, one, Now(at(DAY_S - 1.0)))
    assert today == ["1 flash writes in a day, limit 1"]
    worn = flash_budget(policy, JournalHistory(flashes=200), Now(at(DAY_S)))
    assert worn == ["200 flash writes of this device, limit 200"]


def test_saves_by_hand_and_by_clients_count_in_the_flash_budget():
    policy = WriteBackPolicy(flash_writes_lifetime=3)
    by_hand = StoredRecord("HAND_FLASH_SENT", at(50.0).facts())
    history = JournalHistory.of([by_hand])
    assert flash_budget(policy, history, Now(at(60.0))) == ["1 flash writes in a day, limit 1"]
    assert flash_budget(policy, history, Now(at(51.0 + DAY_S))) == []
    client = StoredRecord("CLIENT_SAVED", {"client": "ros", "serial": 1, **at(60.0).facts()})
    assert flash_budget(policy, JournalHistory.of([client]), Now(at(70.0))) == []
    worn = JournalHistory.of([by_hand, client, client])
    assert flash_budget(policy, worn, Now(at(61.0 + DAY_S))) == [
        "3 flash writes of this device, limit 3"
    ]


def test_flash_budget_holds_over_thirty_days_of_changing_iron(make_rig):
    rig = make_rig()
    rig.connect()
    for hour in range(30 * 24):
        rig.now_s += 3600.0
        another(rig, 0.02 * (hour % 5))
        if rig.wb.state in (State.TRIAL, State.PROVEN):
            rig.live()
        if rig.wb.state is State.PROVEN:
            rig.stand_still()
    # an outdated iron is not saved, so slightly less than one per day
    assert 20 <= rig.device.flash_writes <= 30
    times = [stamp.boot_s for stamp in rig.wb.history.flashes_at]
    assert rig.wb.history.flashes == rig.device.flash_writes
    assert np.diff(times).min() >= DAY_S


def test_rollback_requires_a_day_of_rest_and_twice_the_margin(make_rig):
    rig = rolled_back(make_rig)
    assert rig.wb.margin == 2.0
    another(rig, 0.02)
    assert rig.wb.state is State.QUALIFIED
    assert any("a rollback was" in text for text in rig.wb.obstacles())
    sent = len(rig.sent)
    rig.now_s += DAY_S
    small = {"soft_iron": np.eye(3), "gyro_bias_rad_s": np.zeros(3)}
    rig.verdict(**small, hard_iron_gauss=np.array([0.003, 0.0, 0.0]))  # 0.7 deg: no longer enough
    assert rig.wb.state is State.OBSERVING
    another(rig)
    assert rig.wb.state is State.TRIAL
    assert len(rig.sent) == sent + 2


def test_two_rollbacks_lock_permanently(make_rig):
    rig = rolled_back(make_rig, cooldown_s=0.0, min_interval_s=0.0)
    another(rig)
    rig.live(field_spread=0.5)
    assert rig.wb.state is State.LOCKED
    assert rig.kinds[-3:] == ["ROLLBACK", "ROLLED_BACK", "LOCKED"]
    rig.back("all")
    assert rig.wb.state is State.LOCKED
    sent = len(rig.sent)
    another(rig)
    assert len(rig.sent) == sent
    rig.do(rig.wb.on_operator("unlock", "magnet removed", rig.now_s))
    another(rig)
    assert rig.wb.state is State.TRIAL


def test_proven_write_clears_an_earlier_rollback(make_rig):
    rig = rolled_back(make_rig, cooldown_s=0.0, min_interval_s=0.0)
    another(rig)
    rig.live()
    assert rig.wb.state is State.PROVEN
    assert rig.wb.history.rollbacks == 0


@pytest.mark.parametrize("when", ["resting", "trial"])
def test_lock_undoes_values_that_are_only_in_ram(make_rig, when):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    if when == "trial":
        another(rig)
        assert rig.wb.state is State.TRIAL
    rig.do(rig.wb.on_operator("lock", "race day", rig.now_s))
    assert rig.wb.state is State.LOCKED
    assert rig.device.held() == rig.device.held("flash")
    assert any("locked: race day" in text for text in rig.wb.obstacles())


def test_lock_does_not_interrupt_a_save(make_rig):
    rig = make_rig()

    def lock(command):
        if rig.wb.state is State.SAVING and "LOCKED" not in rig.kinds:
            rig.do(rig.wb.on_operator("lock", "enough", rig.now_s))

    rig.device.refuse = lock
    rig.whole_way()
    assert rig.device.flash_writes == 1
    assert rig.wb.state is State.LOCKED


def test_unknown_command_is_answered_with_the_possible_ones(make_rig):
    rig = make_rig()
    rig.do(rig.wb.on_operator("explode", "", rig.now_s))
    assert "possible: arm, disarm, approve, lock, unlock, rollback" in rig.notes("warning")[-1]
    rig.do(rig.wb.on_operator("rollback", "", rig.now_s))
    assert "nothing to roll back" in rig.notes("warning")[-1]


# -- stopping --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keep", "prove", "kept"), [(False, True, False), (True, False, False), (True, True, True)]
)
def test_stop_undoes_ram_unless_proven_and_configured_to_keep(make_rig, keep, prove, kept):
    rig = make_rig(Mode.STAGE, keep_on_stop=keep)
    rig.connect()
    another(rig)
    if prove:
        rig.live()
    rig.do(rig.wb.on_stop(rig.now_s))
    assert rig.wb.idle
    assert (rig.device.held() != rig.device.held("flash")) is kept
    assert rig.wb.history.rollbacks == 0  # a stop is no verdict on the values
    if kept:
        rig.back("program")
        assert rig.wb.state is State.PROVEN


def test_stop_before_the_write_sends_nothing(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.verdict()
    rig.approve()
    rig.do(rig.wb.on_stop(rig.now_s))
    rig.pass_time(0.1)
    assert rig.wb.idle
    assert rig.sent == []


# -- refusals of the device ------------------------------------------------------------------------


@pytest.mark.parametrize("code", [2, 3, 4, 5, 6, 7, 8, 9, 0x0C])
@pytest.mark.parametrize("number", [23, 84])
def test_refused_write_leaves_the_device_unchanged(make_rig, code, number):
    rig = make_rig(Mode.STAGE)
    before = rig.device.held()
    refusals = iter([code])

    def refuse(command):
        if isinstance(command, Write) and command.register == number:
            return next(refusals, None)
        return None

    rig.device.refuse = refuse
    rig.whole_way()
    assert rig.device.held() == before
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.wb.history.rollbacks == 0
    assert rig.device.asynchronous


def test_failed_rollback_is_a_fault_with_the_commands_to_type(make_rig):
    rig = make_rig(Mode.STAGE)
    writes = []

    def breaks(command):
        if isinstance(command, Write):
            writes.append(command)
            return 9 if len(writes) > 1 else None
        return None

    rig.device.refuse = breaks
    rig.whole_way()
    assert rig.wb.state is State.FAULT
    assert "$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*" in rig.notes("error")[-1]
    rig.device.refuse = lambda _: None
    rig.do(rig.wb.on_operator("rollback", "", rig.now_s))
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.device.held() == rig.device.held("flash")


def test_foreign_write_before_ours_aborts_the_transaction(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.device.ram[23] = (1.5,) * 9 + (0.0,) * 3
    rig.approve()
    assert rig.wb.state is State.OBSERVING
    assert rig.sent == []
    assert rig.kinds == ["PREPARED", "ABORTED"]
    assert rig.in_force[-1] is None
    assert rig.asked_again == 1


def test_foreign_write_between_check_and_write_is_a_fault(make_rig):
    rig = make_rig(Mode.STAGE)

    def writes(command):
        if rig.wb.state is State.STAGING:
            rig.device.ram[84] = (1.5,) * 9 + (0.0,) * 3

    rig.device.refuse = writes
    rig.whole_way()
    assert rig.sent == []
    assert rig.wb.state is State.FAULT
    rig.do(rig.wb.on_stop(rig.now_s))  # a stop does not overwrite foreign values
    assert rig.sent == []
    assert rig.wb.idle


def test_unreadable_journal_in_a_trial_is_a_fault_with_the_commands_to_type(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    another(rig)
    assert rig.wb.state is State.TRIAL
    rig.do(rig.wb.on_link_lost(rig.now_s))
    rig.connect(journal=None)
    assert rig.wb.state is State.FAULT
    assert "$VNWRG,23,1,0,0" in rig.notes("error")[-1]
    rig.do(rig.wb.on_operator("rollback", "", rig.now_s))
    assert rig.device.held() == rig.device.held("flash")


def test_command_gate_checks_all_conditions_itself(make_rig):
    rig = make_rig()
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()  # with the gyro bias, without which it would not count as still
    rig.stand_still()
    safe, now_s = rig.wb._safe, rig.now_s
    write, save = Write(23, rig.device.ram[23]), Word("VNWNV")
    assert not safe.allow(write, Purpose.STAGE, now_s)  # no approval in this run
    assert not safe.allow(save, Purpose.SAVE, now_s)
    rig.do(rig.wb.on_operator("arm", "", now_s))
    assert safe.allow(write, Purpose.STAGE, now_s)
    assert not safe.allow(save, Purpose.SAVE, now_s)  # no save was decided
    safe.save_from_s = now_s
    assert safe.allow(save, Purpose.SAVE, now_s)
    assert not safe.allow(write, Purpose.STAGE, now_s + 1.1)
    assert not safe.allow(save, Purpose.SAVE, now_s + 1.1)
    assert safe.allow(write, Purpose.ROLL_BACK, now_s + 1.1)
    safe.journal_ok = False
    assert not safe.allow(save, Purpose.SAVE, now_s)
    assert safe.write_obstacles(JournalHistory(), now_s, Now(Stamp()))[-1].startswith(
        "the journal cannot be written"
    )
    safe.gates = rig.RED
    assert "gate observability: turn more" in safe.write_obstacles(
        JournalHistory(), now_s, Now(Stamp())
    )


def test_samples_are_unusable_while_registers_are_in_doubt(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    another(rig)
    assert [r is None for r in rig.in_force] == [False, True, False]
    assert rig.in_force[2][84][9:] == pytest.approx((0.01, -0.02, 0.005))


# -- history ---------------------------------------------------------------------------------------


def test_history_from_the_journal_equals_that_of_the_run(make_rig):
    rig = rolled_back(make_rig, cooldown_s=0.0, min_interval_s=0.0)
    another(rig)
    rig.live()
    assert JournalHistory.of(rig.journal) == rig.wb.history


def row(value: float) -> list[float]:
    """The value of register 23 or 84 with this last element."""
    return [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, value]


def writes(value: float) -> dict[str, object]:
    return {"old": {"23": row(0)}, "new": {"23": row(value)}}


@pytest.mark.parametrize(
    ("more", "tried"),
    [
        ([], True),
        ([("FLASH_SENT", {}), ("FLASH_ACKED", {})], False),
        ([("ROLLBACK", {}), ("ROLLED_BACK", {})], True),
        ([("ROLLBACK", {}), ("ROLLED_BACK", {}), ("UNLOCKED", {})], False),
        ([("ROLLED_BACK", {}), ("HAND_PREPARED", writes(2))], False),
        ([("ROLLED_BACK", {}), ("CLIENT_WRITES", writes(2))], False),
        ([("ROLLED_BACK", {}), ("CLIENT_WRITES", writes(3))], True),
        ([("ROLLED_BACK", {}), ("CLIENT_WRITES", {"new": {"23": ["x"]}})], True),
    ],
)
def test_trial_values_are_recognised(more, tried):
    """Values that were neither saved, nor written by hand, nor accepted as correct; an unchanged
    value is none of them.
    """
    facts = {
        "txn": "x", "serial": 1, "firmware": "3.1.0.0", "old": {"23": row(1), "84": row(5)},
        "new": {"23": row(2), "84": row(5)}, "snapshot": {}, "heading_change_deg": 1.0,
        "approver": "auto",
    }  # fmt: skip
    records = [("PREPARED", facts), ("RAM_VERIFIED", {}), *more]
    history = JournalHistory.of(SimpleNamespace(kind=k, facts=f) for k, f in records)
    assert history.is_trial_value(23, tuple(row(2))) == tried
    assert not history.is_trial_value(23, tuple(row(1)))
    assert not history.is_trial_value(84, tuple(row(5)))


@pytest.mark.parametrize("old", [{"23": [1]}, {}])
def test_journal_record_with_invalid_registers_forbids_writing(old):
    facts = {
        "txn": "x", "serial": 1, "firmware": "3.1.0.0", "old": old, "new": {"23": [2]},
        "snapshot": {}, "heading_change_deg": 1.0, "approver": "auto",
    }  # fmt: skip
    assert JournalHistory.of([SimpleNamespace(kind="PREPARED", facts=facts)]).broken == "PREPARED"


def test_incomprehensible_journal_record_forbids_writing(make_rig):
    record = SimpleNamespace(kind="PREPARED", facts={"txn": "x"})
    history = JournalHistory.of([record])
    assert history.broken == "PREPARED"
    assert "cannot be understood" in ram_budget(WriteBackPolicy(), history, Now(Stamp()))[0]


# -- stillness -------------------------------------------------------------------------------------


def block(time_s, rate=0.0, shake=0.0, accel=True, gap=False):
    count = len(time_s)
    gyro = np.full((count, 3), 0.01)
    gyro[:, 0] += rate
    force = np.tile([0.0, 0.0, -9.8], (count, 1)) if accel else np.full((count, 3), np.nan)
    force[:, 0] += shake * (-1.0) ** np.arange(count)
    return SampleBlock(
        time_s, np.full(count, 0.01), time_s, np.zeros((count, 3)), gyro, force, gap_before=gap
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"rate": 0.011}, "still for 0.0 s"),
        ({"shake": 0.06}, "specific force varies by 0.060"),
        ({"shake": 0.04}, None),
        ({"accel": False}, "still for 0.0 s"),
    ],
)
def test_motion_is_detected_in_field_and_rates(changes, reason):
    still = Stillness(StillPolicy())
    for k in range(10):
        still.update(block(k * 0.4 + 0.01 * np.arange(40), **changes), np.full(3, 0.01))
    why = still.find_motion(4.0)
    assert why is None if reason is None else reason in (why or "")


def test_stillness_needs_recent_samples_without_a_gap():
    still = Stillness(StillPolicy())
    assert still.find_motion(0.0) is not None
    still.update(block(0.01 * np.arange(400)), np.full(3, 0.01))
    assert still.find_motion(4.0) is None
    assert "old" in (still.find_motion(6.1) or "")
    still.update(block(10.0 + 0.01 * np.arange(100), gap=True), np.full(3, 0.01))
    assert "still for 1.0 s" in (still.find_motion(11.0) or "")


def test_motion_ends_stillness_until_it_is_long_enough_ago():
    still = Stillness(StillPolicy())
    still.update(block(0.01 * np.arange(400), shake=0.5), np.full(3, 0.01))
    assert "varies" in (still.find_motion(4.0) or "")
    still.update(block(4.0 + 0.01 * np.arange(400)), np.full(3, 0.01))
    assert still.find_motion(8.0) is None
    still.update(block(8.0 + 0.01 * np.arange(10), rate=0.1), np.full(3, 0.01))
    assert still.find_motion(8.1) is not None


def test_nothing_is_saved_without_a_verdict_of_the_flash_gates(make_rig):
    rig = make_rig()
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict(flash_gates=())
    rig.approve()
    rig.live()
    rig.stand_still()
    assert rig.wb.state is State.PROVEN
    assert rig.device.flash_writes == 0
    assert any("no gate has judged" in text for text in rig.wb.obstacles())


def test_new_process_saves_nothing_before_its_own_gates_and_proof(make_rig):
    rig = make_rig()
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict(flash_gates=rig.RED)
    rig.approve()
    rig.live()
    rig.back("program")
    assert rig.wb.state is State.PROVEN
    rig.stand_still()
    assert rig.device.flash_writes == 0
    rig.verdict()
    rig.stand_still()
    assert rig.device.flash_writes == 0  # nor before it has proven the values itself
    assert any("on trial again" in text for text in rig.wb.obstacles())
    rig.live()
    rig.stand_still()
    assert rig.device.flash_writes == 1


def test_gate_verdicts_from_before_a_reconciliation_do_not_allow_a_save(make_rig):
    rig = make_rig()
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live()
    rig.do(rig.wb.on_link_lost(rig.now_s))
    rig.connect()
    rig.stand_still()
    assert rig.wb.state is State.PROVEN
    assert rig.device.flash_writes == 0
