"""The path from a verdict to a confirmed flash, and all that must stop it."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.events import RegisterWritten
from ahrsd.writeback.policy import NOT_ARMED
from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Word, Write

STAGED = ["PREPARED", "RAM_VERIFIED"]
COMMITTED = [*STAGED, "PROVEN", "FLASH_SENT", "FLASH_ACKED"]


def test_whole_path_to_confirmed(make_rig):
    rig = make_rig()
    rig.whole_way()
    assert rig.wb.state is State.COMMITTED
    assert rig.kinds == COMMITTED
    assert rig.states[:5] == ["OBSERVING", "CANDIDATE", "QUALIFIED", "PREPARING", "CHECKING"]
    assert rig.states[5:9] == ["STAGING", "STAGED", "TRIAL", "PROVEN"]
    assert rig.states[9:] == ["SAVE_PREPARING", "SAVING", "COMMITTED"]
    assert rig.sent == ["23", "84", "VNWNV"]
    assert rig.device.flash == rig.device.ram
    assert rig.device.flash[84][9:] == pytest.approx((0.01, -0.02, 0.005))
    assert rig.device.flash[23][9:] == pytest.approx((0.03, 0.04, -0.02))
    assert rig.device.flash_writes == 1
    assert rig.device.asynchronous
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED
    assert rig.kinds[-1] == "CONFIRMED"
    assert rig.notes("error") == []


def test_nothing_is_sent_before_the_record_is_journaled(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.verdict()
    rig.disk_full = True
    rig.pass_time(0.1)
    rig.approve()
    assert rig.wb.state is State.OBSERVING
    assert rig.device.log == []
    assert "could not be journalled" in rig.notes("error")[0]
    rig.verdict()
    rig.approve()
    assert rig.device.log == []  # as long as the journal is not writable
    assert "the journal cannot be written" in " ".join(rig.wb.obstacles())
    rig.disk_full = False
    rig.do(rig.wb.on_operator("unlock", "disk freed", rig.now_s))
    rig.pass_time(0.1)
    assert rig.wb.state is State.TRIAL


def test_observe_prints_the_exact_commands_and_sends_nothing(make_rig):
    rig = make_rig(Mode.OBSERVE, approval="auto", armed_at_start=True, max_change_auto_deg=90.0)
    rig.whole_way()
    assert rig.wb.state is State.QUALIFIED
    assert rig.device.log == []
    would = next(text for text in rig.notes("info") if "would write" in text)
    staged = make_rig(Mode.STAGE)
    staged.whole_way()
    lines = [f"${c.body}*" for c in staged.device.log if isinstance(c, Write)]
    assert len(lines) == 2
    for line in lines:
        assert line in would
    assert any("mode is observe" in reason for reason in rig.wb.obstacles())


def test_stage_proves_values_in_ram_and_never_saves(make_rig):
    rig = make_rig(Mode.STAGE)
    flash = rig.device.held("flash")
    rig.whole_way()
    assert rig.wb.state is State.PROVEN
    assert rig.sent == ["23", "84"]
    assert rig.device.held("flash") == flash
    assert rig.device.held()[84] != flash[84]


@pytest.mark.parametrize(
    ("limit", "reason"),
    [
        ({"serial": 7}, "writes are for"),
        ({"identity": "4.0.0.0"}, "unknown"),
        ({"journal": None}, "journal cannot be read"),
        ({"registers": 84}, "could not be read"),
    ],
)
def test_doubtful_device_is_only_observed(make_rig, limit, reason):
    from drivers.vn100.commands import Identity
    from drivers.vn100.registers import profile_of

    rig = make_rig(serial=limit.get("serial"))
    changes = {key: limit[key] for key in limit if key == "journal"}
    if "identity" in limit:
        version = limit["identity"]
        changes["identity"] = Identity("VN", 7, rig.device.serial, version, profile_of(version))
    if "registers" in limit:
        held = {n: v for n, v in rig.device.ram.items() if n != limit["registers"]}
        changes["registers"] = held
    rig.connect(**changes)
    rig.pass_time(0.1)
    rig.verdict()
    if rig.wb.proposal is not None:
        rig.approve()
    assert rig.wb.mode is Mode.OBSERVE
    assert rig.device.log == []
    assert any(reason in text for text in rig.wb.obstacles())


def test_device_with_another_serial_number_is_not_written(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.do(rig.wb.on_link_lost(rig.now_s))
    rig.device.serial = 42
    rig.connect(journal=[])
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    assert rig.device.log == []
    assert any("this is the device 42" in text for text in rig.wb.obstacles())


def test_applied_onboard_estimator_prevents_the_write(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.device.ram[44] = (1, 3, 5)
    rig.whole_way()
    assert rig.wb.state is State.QUALIFIED
    assert rig.device.log == []
    assert any("on-board estimator" in text for text in rig.wb.obstacles())


@pytest.mark.parametrize("gates", ["RED", "none"])
def test_no_write_with_a_closed_gate_or_without_gates(make_rig, gates):
    rig = make_rig(Mode.STAGE, approval="auto", armed_at_start=True, max_change_auto_deg=90.0)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict(gates=rig.RED if gates == "RED" else ())
    assert rig.wb.state is State.CANDIDATE
    rig.verdict()
    assert rig.wb.state is State.TRIAL


def test_unconverged_or_small_change_is_no_candidate(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.verdict(converged=False)
    assert rig.wb.state is State.OBSERVING
    small = {"soft_iron": np.eye(3), "gyro_bias_rad_s": np.zeros(3)}
    rig.verdict(**small, hard_iron_gauss=np.array([0.001, 0.0, 0.0]))
    assert rig.wb.state is State.OBSERVING
    rig.verdict(**small, hard_iron_gauss=np.array([0.003, 0.0, 0.0]))
    assert rig.wb.state is State.QUALIFIED
    rig.verdict(**small, hard_iron_gauss=np.array([np.nan, 0.0, 0.0]))
    assert rig.wb.state is State.OBSERVING
    assert "not finite" in rig.notes("warning")[-1]


# -- approval --------------------------------------------------------------------------------------


def test_approval_needs_the_id_of_the_proposal(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    for text in ("", "00000000"):
        rig.do(rig.wb.on_operator("approve", text, rig.now_s))
        rig.verdict()
        assert rig.wb.state is State.QUALIFIED
    rig.approve()
    assert rig.wb.state is State.TRIAL


def test_approved_values_are_written_although_the_estimate_drifts(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    seen = rig.wb.proposal
    rig.verdict(hard_iron_gauss=np.array([0.0301, 0.04, -0.02]))
    rig.approve()
    assert rig.device.held()[23] == pytest.approx(seen.new[23], abs=1e-6)


def test_changed_candidate_needs_a_new_approval(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    rig.verdict()
    first = rig.wb.proposal.id
    rig.do(rig.wb.on_operator("approve", first, rig.now_s))  # the vehicle has not permitted it yet
    rig.verdict(hard_iron_gauss=np.array([0.06, 0.04, -0.02]))
    rig.pass_time(0.1)
    assert rig.wb.state is State.QUALIFIED
    assert rig.wb.proposal.id != first
    assert rig.device.log == []


def test_approval_expires(make_rig):
    rig = make_rig(Mode.STAGE)
    rig.safe = False
    rig.connect()
    rig.verdict()
    rig.approve()
    rig.pass_time(601.0)
    assert rig.wb.state is State.CANDIDATE
    rig.safe = True
    rig.pass_time(0.1)
    rig.verdict()
    assert rig.wb.state is State.QUALIFIED
    assert rig.device.log == []


def test_auto_approves_only_small_changes(make_rig):
    large = make_rig(Mode.STAGE, approval="auto", armed_at_start=True)
    large.connect()
    large.pass_time(0.1)
    large.verdict()
    assert large.wb.state is State.QUALIFIED
    assert any("must approve" in text for text in large.wb.obstacles())
    small = make_rig(Mode.STAGE, approval="auto", armed_at_start=True)
    small.connect()
    small.pass_time(0.1)
    small.verdict(soft_iron=np.eye(3), hard_iron_gauss=np.array([0.01, 0.0, 0.0]))
    assert small.wb.state is State.TRIAL
    assert small.journal[0].facts["approver"] == "auto"


def test_automatic_write_needs_arming_by_a_person(make_rig):
    rig = make_rig(Mode.COMMIT, approval="auto", max_change_auto_deg=90.0, commit_unattended=True)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    assert rig.wb.state is State.QUALIFIED
    assert NOT_ARMED in rig.wb.obstacles()
    assert not any(isinstance(command, Write) for command in rig.device.log)
    rig.do(rig.wb.on_operator("arm", "", rig.now_s))
    assert rig.wb.state is State.TRIAL
    rig.do(rig.wb.on_operator("disarm", "", rig.now_s))  # still on trial, but nothing is saved
    rig.live(turns=2.5)
    rig.stand_still()
    assert rig.wb.state is State.PROVEN
    assert rig.wb.obstacles() == [NOT_ARMED]
    assert rig.device.flash_writes == 0
    rig.do(rig.wb.on_operator("arm", "", rig.now_s))
    rig.stand_still()
    assert rig.wb.state is State.COMMITTED
    assert rig.device.flash_writes == 1


def test_restart_disarms_and_an_approved_write_continues(make_rig):
    for approve in (False, True):
        auto = {} if approve else {"approval": "auto", "max_change_auto_deg": 90.0}
        rig = make_rig(Mode.COMMIT, commit_unattended=True, **auto)
        rig.connect()
        rig.pass_time(0.1)
        rig.verdict()
        rig.approve() if approve else rig.do(rig.wb.on_operator("arm", "", rig.now_s))
        assert rig.wb.state is State.TRIAL
        rig.back("program")
        rig.verdict()
        rig.live(turns=2.5)
        rig.stand_still()
        assert rig.wb.state is (State.COMMITTED if approve else State.PROVEN)


def test_save_needs_an_operator_or_the_explicit_setting(make_rig):
    for allowed in (False, True):
        rig = make_rig(
            approval="auto",
            armed_at_start=True,
            max_change_auto_deg=90.0,
            commit_unattended=allowed,
        )
        rig.whole_way()
        assert (rig.wb.state is State.COMMITTED) is allowed
        assert rig.device.flash_writes == int(allowed)


# -- the vehicle -----------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["none", "unsafe", "old", "future"])
def test_nothing_is_sent_without_a_recent_permission_of_the_vehicle(make_rig, word):
    rig = make_rig(Mode.STAGE)
    rig.connect()
    if word == "unsafe":
        rig.do(rig.wb.on_interlock(False, rig.now_s))
    elif word in ("old", "future"):
        rig.do(rig.wb.on_interlock(True, rig.now_s))
        rig.now_s += 1.01 if word == "old" else -1.0
    rig.verdict()
    rig.approve()
    assert rig.wb.state is State.QUALIFIED
    assert rig.device.log == []


def test_permission_withdrawn_between_two_registers_undoes_the_first(make_rig):
    rig = make_rig(Mode.STAGE)
    before = rig.device.held()

    def leaves(command):
        if isinstance(command, Write) and command.register == 23:
            rig.safe = False

    rig.device.refuse = leaves
    rig.whole_way()
    assert rig.sent == ["23", "23"]
    assert rig.device.held() == before
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.kinds == ["PREPARED", "RAM_FAILED", "ROLLBACK", "ROLLED_BACK"]
    assert rig.device.asynchronous


@pytest.mark.parametrize("how", ["unsafe", "silent"])
def test_permission_withdrawn_in_a_trial_rolls_back(make_rig, how):
    rig = make_rig(Mode.STAGE)
    before = rig.device.held()
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    assert rig.wb.state is State.TRIAL
    assert rig.wb.deadline_s <= rig.now_s + 1.0
    if how == "unsafe":
        rig.do(rig.wb.on_interlock(False, rig.now_s))
    else:
        rig.now_s += 1.1
        rig.do(rig.wb.tick(rig.now_s))
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.device.held() == before


def test_trial_may_be_configured_to_continue_while_driving(make_rig):
    rig = make_rig(Mode.STAGE, trial=TrialPolicy(interlock=False))
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.safe = False
    rig.pass_time(5.0)
    rig.live()
    assert rig.wb.state is State.PROVEN


# -- the trial -------------------------------------------------------------------------------------


def in_trial(make_rig, **policy):
    rig = make_rig(Mode.STAGE, **policy)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    assert rig.wb.state is State.TRIAL
    return rig


@pytest.mark.parametrize(
    "bad",
    [
        {"field_spread": 0.11},
        {"wrong": 0.01, "wrong_sigmas": 3.1},
        {"heading_jump_deg": 60.0},
        {"heading_jump_deg": float("nan")},
    ],
)
def test_bad_calibration_is_rolled_back_at_once(make_rig, bad):
    rig = in_trial(make_rig)
    rig.live(duration_s=10.0, **bad)
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.kinds[-2:] == ["ROLLBACK", "ROLLED_BACK"]
    assert rig.journal[-2].facts["counts"] is True
    assert rig.device.held() == rig.device.held("flash")
    undone = [e for e in rig.events if isinstance(e, RegisterWritten) and e.outcome == "undone"]
    assert [e.register for e in undone] == [23, 84]


def test_trial_fails_if_worse_for_a_minute_and_not_for_a_moment(make_rig):
    rig = in_trial(make_rig)
    worse = {"new_figure": 1.2, "old_figure": 1.0}
    rig.live(duration_s=100.0, **worse)
    rig.live(duration_s=159.0, **worse)
    rig.live(duration_s=160.0)
    rig.live(duration_s=161.0, **worse)
    assert rig.wb.state is State.TRIAL
    rig.live(duration_s=222.0, **worse)
    assert rig.wb.state is State.ROLLED_BACK


def test_trial_ends_by_time_or_turns_and_never_while_worse(make_rig):
    rig = in_trial(make_rig)
    rig.live(duration_s=599.0, turns=1.9)
    rig.live(duration_s=650.0, turns=2.5, new_figure=1.2, old_figure=1.0)
    assert rig.wb.state is State.TRIAL
    rig.live(duration_s=660.0, turns=1.0)
    assert rig.wb.state is State.PROVEN
    turned = in_trial(make_rig)
    turned.live(duration_s=100.0, turns=2.0, heading_jump_deg=9.0)
    assert turned.wb.state is State.PROVEN


def test_trial_without_a_verdict_is_rolled_back(make_rig):
    rig = in_trial(make_rig, trial=TrialPolicy(interlock=False))
    for _ in range(7):
        rig.now_s += 10.0
        rig.live(new_figure=float("nan"))
        rig.do(rig.wb.tick(rig.now_s))
    assert rig.wb.state is State.ROLLED_BACK


# -- the flash -------------------------------------------------------------------------------------


def proven(make_rig, **policy):
    rig = make_rig(**policy)
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live()
    assert rig.wb.state is State.PROVEN
    return rig


def test_save_waits_for_stillness(make_rig):
    rig = proven(make_rig)
    rig.stand_still(rate_rad_s=0.02)
    rig.stand_still(seconds=2.5)
    assert rig.wb.state is State.PROVEN
    assert any("still for" in text for text in rig.wb.obstacles())
    rig.stand_still()
    assert rig.wb.state is State.COMMITTED


def test_motion_at_the_last_moment_prevents_vnwnv(make_rig):
    """The check immediately before VNWNV: the latest proof of stillness is too old by then."""
    rig = proven(make_rig)

    def slow(command):
        if "save" in rig.wb._outbox.running and isinstance(command, Word):
            rig.now_s += 2.5

    rig.device.refuse = slow
    rig.stand_still()
    assert rig.device.flash_writes == 0
    assert rig.sent == ["23", "84"]
    assert rig.wb.state is State.PROVEN
    assert rig.kinds[-2:] == ["FLASH_SENT", "PROVEN"]
    assert rig.wb.history.flashes == 0


def test_closed_flash_gate_prevents_the_save(make_rig):
    rig = proven(make_rig)
    rig.verdict(flash_gates=rig.RED)
    rig.stand_still()
    assert rig.wb.state is State.PROVEN
    rig.verdict(flash_gates=rig.GREEN)
    assert rig.wb.state is State.COMMITTED


def test_foreign_setting_in_ram_is_never_saved(make_rig):
    rig = proven(make_rig)
    rig.device.ram[35] = (1, 0, 1, 1)
    rig.stand_still()
    assert rig.device.flash_writes == 0
    assert rig.wb.state is State.PROVEN
    assert "registers 35 differ" in " ".join(rig.notes("warning"))


def test_session_settings_are_restored_before_the_save_and_set_again_after(make_rig):
    keys = frozenset({6, 75})
    rig = make_rig(configure_stream=True)
    user = dict(rig.device.ram)
    rig.device.ram[75] = (1, 4, 0x06, 0x0001, 0x083F)
    rig.device.ram[6] = (0,)
    rig.connect(registers=user, session_keys=keys)
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live()
    rig.stand_still()
    assert rig.wb.state is State.COMMITTED
    assert rig.device.flash[75] == user[75]
    assert rig.device.flash[6] == user[6]
    assert rig.stream_set_up == 1


def test_unanswered_save_is_a_fault_until_a_restart_shows_the_result(make_rig):
    rig = proven(make_rig)
    rig.device.mute = lambda command: isinstance(command, Word) and command.word == "VNWNV"
    rig.stand_still()
    assert rig.wb.state is State.FAULT
    assert "$VNWRG,23,1,0,0" in rig.notes("error")[-1]
    assert rig.device.asynchronous
    rig.device.mute = lambda _: False
    rig.back("program")
    assert rig.wb.state is State.FAULT
    rig.back("device")
    assert rig.wb.state is State.CONFIRMED


def test_full_disk_prevents_the_save_and_not_the_rollback(make_rig):
    rig = proven(make_rig)
    rig.disk_full = True
    rig.stand_still()
    assert rig.wb.state is State.PROVEN
    assert rig.device.flash_writes == 0
    rig.do(rig.wb.on_operator("rollback", "", rig.now_s))
    assert rig.wb.state is State.ROLLED_BACK
    assert rig.device.held() == rig.device.held("flash")


def test_committed_values_are_not_proposed_again(make_rig):
    rig = make_rig()
    rig.whole_way()
    rig.verdict()
    assert rig.wb.state is State.COMMITTED
    assert rig.wb.proposal is None
