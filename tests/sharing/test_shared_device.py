"""Clients of the daemon, on units that share no code with it: what they receive and cannot do.

Judged by what the units hold and were sent (`cabled_units`), and by the answers.
"""

from __future__ import annotations

import pytest
from cabled_run import FIRST, CabledRun, estimate, two_units
from drivers_at_start import (
    ARDUPILOT,
    NTNU_BEHIND_THE_RESET,
    NTNU_UP_TO_THE_RESET,
    ROS2_DAWONN,
    SDK,
)
from planted_calibrator import PlantedCalibrator

from ahrsd import inputs
from ahrsd.core.core import Core
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.writeback.policy import StillPolicy
from ahrsd.writeback.states import Mode

OWNER, LOG = SharePolicy("owner", owner=True), SharePolicy("log")
ONE = ("1,0,0,0,1,0,0,0,1,0,0,0",) * 2
NEW = ("1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005")
#: values in the test's units of the registers that drivers set
KNOWN = {0: "", 32: "3,0,0,0,0,0,0,100000000,0"}


def shared(**options) -> CabledRun:
    cable = two_units(binary=True)
    for unit in cable.units.values():
        unit.flash.update(KNOWN)
        unit.ram.update(KNOWN)
    return CabledRun(cable, shares=(OWNER, LOG), **options)


def start(run: CabledRun, lines: tuple[str, ...], client: str = "owner") -> list[str]:
    """The start of a driver: each line is sent after the answer to the previous one."""
    answers = []
    for line in lines:
        run.say(client, line)
        assert run.until(lambda: run.heard[client], 3.0), (line, run.notes[-3:])
        answers += run.answers(client)
    return answers


@pytest.mark.parametrize("lines", [ROS2_DAWONN, SDK, ARDUPILOT], ids=["dawonn", "sdk", "ardupilot"])
def test_every_command_of_a_driver_start_is_answered_correctly(lines):
    run = shared(planted=False, mode=Mode.OBSERVE)
    answers = start(run, lines)
    unit = run.cable.unit
    assert len(answers) == len(lines)
    for line, answer in zip(lines, answers, strict=True):
        word, number, *_ = line.split(",")
        if word == "VNRRG":
            known = f"{FIRST:010d}" if number == "03" else unit.ram[int(number)]
            assert answer == f"VNRRG,{number},{known}"
        else:
            assert answer.split(",")[:2] == [word, number]
            assert "ERR" not in answer
    assert unit.held() == unit.held("flash") == ONE
    assert unit.saves == []


def test_two_drivers_at_once_get_their_own_answers():
    run = shared(planted=False, mode=Mode.OBSERVE)
    for line in ROS2_DAWONN:
        run.say("owner", line)
    for line in ("VNRRG,01", "VNRRG,23", "VNRRG,30", "VNWRG,06,0"):
        run.say("log", line)
    run.run(3.0)
    assert run.answers("log")[:3] == ["VNRRG,01,VN-100T-CR", "VNERR,09", f"VNRRG,23,{ONE[0]}"]
    answers = run.answers("owner")
    assert len(answers) == len(ROS2_DAWONN)
    assert not any("ERR" in answer for answer in answers)


def test_checks_of_the_daemon_continue_with_a_busy_client():
    run = shared(planted=False, mode=Mode.OBSERVE)
    for k in range(400):
        run.say("log", f"VNRRG,{(30, 75, 85)[k % 3]}")
        run.run(0.1)
    assert run.cable.unit.log.count("VNRRG,84") >= 2  # the check, every ten seconds
    assert set(run.answers("log")) == {f"VNRRG,{n},{run.cable.unit.ram[n]}" for n in (30, 75, 85)}


def test_owner_settings_are_not_saved_with_a_calibration_and_are_restored():
    # each command takes a whole step of this cable, fifty times what it takes on a wire
    run = shared(still=StillPolicy(gyro_rad_s=0.02, max_age_s=20.0))
    unit = run.cable.unit
    users = dict(unit.flash)
    start(run, ("VNWRG,07,40", "VNWRG,85,0,8,8,8,8,0,3,3,3,0"))
    run.approve()
    assert run.until("TRIAL", 30.0), run.notes
    run.safe = False
    assert run.until("PROVEN"), run.notes
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    (saved,) = unit.saves
    assert (unit.held("flash"), saved[7], saved[85]) == (NEW, users[7], users[85])
    assert (unit.ram[7], unit.ram[85]) == ("40", "0,8,8,8,8,0,3,3,3,0")


def test_settings_saved_by_the_owner_become_those_of_the_user():
    run = shared()
    unit = run.cable.unit
    assert start(run, ("VNWRG,07,40", "VNWNV")) == ["VNWRG,07,40", "VNWNV"]
    assert unit.flash[7] == "40"
    assert "CLIENT_SAVED" in run.kinds()
    run.proven()
    run.park(30.0)
    assert run.state == "COMMITTED", run.notes
    assert unit.flash[7] == "40"
    assert unit.held("flash") == NEW


@pytest.mark.parametrize("state", ["TRIAL", "PROVEN"])
def test_owner_save_contains_no_unproven_values(state):
    """A driver that saves at every start, in the middle of a trial."""
    run = shared()
    unit = run.cable.unit
    run.approve()
    assert run.until("TRIAL", 30.0)
    if state == "PROVEN":
        run.safe = False
        assert run.until("PROVEN")
    assert unit.held() == NEW
    run.say("owner", "VNWNV")
    assert run.until(lambda: run.heard["owner"], 2.5), run.notes
    assert run.answers("owner") == ["VNWNV"]
    assert [unit.held("flash"), unit.held()] == [ONE, ONE]
    assert run.kinds()[-3:] == ["ROLLBACK", "ROLLED_BACK", "CLIENT_SAVED"]


def test_owner_save_is_refused_while_the_device_holds_unproven_values():
    """Somebody wrote one register in a trial: the other still holds a value that is not proven."""
    run = shared()
    unit = run.cable.unit
    run.approve()
    assert run.until("TRIAL", 30.0)
    unit.ram[23] = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"
    assert run.until("LOCKED", 40.0), run.notes
    assert start(run, ("VNWNV",)) == ["VNERR,09"]
    assert unit.saves == []
    assert run.told("nothing is saved for a client")


@pytest.mark.parametrize("times", [30, pytest.param(100, marks=pytest.mark.slow)])
def test_driver_that_saves_and_resets_often_leaves_the_registers_unchanged(times):
    run = shared(planted=False, mode=Mode.OBSERVE)
    unit = run.cable.unit
    before = dict(unit.flash)
    for _ in range(times):
        answers = start(run, NTNU_UP_TO_THE_RESET)
        assert answers == [
            "VNWRG,05,115200", "VNRRG,01,VN-100T-CR", "VNWNV", "VNRST",
        ]  # fmt: skip
        run.run(1.0)
        assert len(start(run, NTNU_BEHIND_THE_RESET)) == len(NTNU_BEHIND_THE_RESET)
        run.feed(inputs.ClientLeft(run.now_ns, "owner"))
    assert len(unit.saves) == times
    changed = {n for n, text in unit.flash.items() if text != before[n]}
    assert changed <= {6, 75, 76, 77, 85}  # what the driver itself sets
    assert unit.held("flash") == ONE
    assert run.kinds().count("CLIENT_SAVED") == times


@pytest.mark.parametrize(
    "at",
    [pytest.param(at, marks=[] if at % 4 == 3 else pytest.mark.slow) for at in range(1, 60, 3)],
)
def test_owner_save_at_any_command_of_a_write_contains_no_unproven_values(at):
    run, heard = shared(), []
    unit = run.cable.unit

    def hear(line: str) -> None:
        heard.append(line)
        if len(heard) == at:
            asked.append(line)

    asked: list[str] = []
    assert run.until("QUALIFIED")
    unit.before = hear
    run.approve()
    for _ in range(900):
        run.step()
        if asked:
            asked.clear()
            run.say("owner", "VNWNV")
    assert len(heard) >= at
    allowed = [ONE] if "COMMITTED" not in run.states else [ONE, NEW]
    for save in unit.saves:
        held = tuple(",".join(f"{float(v):.6g}" for v in save[n].split(",")) for n in (23, 84))
        assert held in allowed, run.notes
    assert run.core.device_session.phase.value == "ready"


@pytest.mark.parametrize("mode", [Mode.PASSIVE, Mode.OBSERVE, Mode.COMMIT])
@pytest.mark.parametrize("client", ["owner", "log"])
def test_register_scan_of_the_vendor_sdk_changes_nothing(mode, client):
    """It reads each register and writes it back; the configuration decides what may be written."""
    run = shared(planted=False, mode=mode)
    kept = {}
    for number in (23, 25, 26, 30, 44, 75, 84, 85):
        (read,) = start(run, (f"VNRRG,{number}",), client)
        tokens = read.split(",", 2)[2]
        assert start(run, (f"VNWRG,{number},{tokens}",), client) == [f"VNWRG,{number},{tokens}"]
        kept[number] = tokens
    assert kept == {number: run.cable.unit.ram[number] for number in kept}
    guarded = {number for number, _ in run.cable.unit.writes} - {30, 75, 85}
    assert guarded == set()
    if client == "log":
        assert run.cable.unit.writes == []


def test_write_of_another_value_is_refused_and_reported():
    run = shared(planted=False)
    assert start(run, (f"VNWRG,23,{ONE[0]}", f"VNWRG,23,{NEW[0]}")) == [
        f"VNWRG,23,{ONE[0]}", "VNERR,09",
    ]  # fmt: skip
    assert run.told("what calibrates is ahrsd's")
    assert run.cable.unit.held() == ONE


def test_client_write_is_compared_with_the_present_register():
    """During a trial the register holds the new values, and the old ones would undo it."""
    run = shared()
    run.approve()
    assert run.until("TRIAL", 30.0), run.notes
    assert start(run, (f"VNWRG,23,{NEW[0]}", f"VNWRG,23,{ONE[0]}")) == [
        f"VNWRG,23,{NEW[0]}", "VNERR,09",
    ]  # fmt: skip
    assert run.cable.unit.held() == NEW


@pytest.mark.parametrize("mode", [Mode.PASSIVE, Mode.OBSERVE])
def test_no_client_changes_calibration_registers(mode):
    run = shared(planted=False, mode=mode)
    values = "2,0,0,0,1,0,0,0,1,0.1,0.1,0.1"
    for client in ("owner", "log"):
        answers = start(
            run,
            (*(f"VNWRG,{n},{values}" for n in (23, 25, 84)), "VNTAR", "VNSGB", "VNRFS"),
            client,
        )
        assert answers == ["VNERR,09"] * 6
    assert run.cable.unit.writes == []
    assert not any(line.startswith(("VNWRG", "VNT", "VNS", "VNRFS")) for line in run.cable.unit.log)


def test_only_client_commands_are_sent_in_passive():
    run = shared(planted=False, mode=Mode.PASSIVE)
    run.run(30.0)
    assert run.cable.unit.log == []
    assert start(run, ("VNRRG,01", "VNRRG,23"), "log") == [
        "VNRRG,01,VN-100T-CR", f"VNRRG,23,{ONE[0]}",
    ]  # fmt: skip
    assert run.cable.unit.log == ["VNRRG,01", "VNRRG,23"]


def test_owner_reset_in_a_trial_is_noticed():
    run = shared()
    run.approve()
    assert run.until("TRIAL", 30.0)
    assert start(run, ("VNRST",)) == ["VNRST"]
    assert run.told("owner reset it")
    assert run.cable.unit.held() == ONE
    assert run.kinds()[-3:] == ["ROLLBACK", "ROLLED_BACK", "CLIENT_RESET"]


def test_lost_link_with_a_pending_command_blocks_nothing():
    run = shared(planted=False, mode=Mode.OBSERVE)
    run.cable.unit.before = lambda _: setattr(run.cable, "_silent_s", 0.3)
    run.say("log", "VNRRG,30")
    run.feed(inputs.LinkLost(run.now_ns, "unplugged"))
    run.cable.unit.before = lambda _: None
    run.run(1.0)
    run.feed(inputs.LinkOpened(run.now_ns, "cable", 115200))
    run.run(5.0)
    assert start(run, ("VNRRG,30",), "log") == [f"VNRRG,30,{run.cable.unit.ram[30]}"]


def test_replay_decides_the_same():
    run = shared()
    start(run, ROS2_DAWONN)
    run.approve()
    assert run.until("TRIAL", 30.0)
    start(run, ("VNWNV",))
    run.run(5.0)
    again, heard = Core(run.core.settings), {"owner": b"", "log": b""}
    for number, item in enumerate(run.taken):
        if number == run.planted_at:
            again.calibrator = PlantedCalibrator(again.calibrator, estimate())
        for event in again.handle(item):
            if type(event).__name__ == "SendToClient":
                heard[event.client] += event.data
    assert again.decisions.sha256 == run.core.decisions.sha256
    assert heard["owner"].endswith(b"$VNWNV*57\r\n")
