"""A lost, foreign or blocked journal, and wrong clocks, through the whole core."""

from __future__ import annotations

import json
import os

import pytest
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun
from writeback_rig import estimate

from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.daemon import host_clock
from ahrsd.daemon.core_runner import JournalKeeper, journal_in
from ahrsd.daemon.journal import Journal, journal_path, receipt_path
from ahrsd.errors import JournalError
from ahrsd.events import JournalAppend
from ahrsd.inputs import Received, WallClock
from ahrsd.recording.capture import input_from_json, input_to_json
from ahrsd.writeback.journal_history import Stamp
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.emulator.physics import draw_truth
from drivers.vn100.emulator.scenarios import Setup, build

SERIAL = 100130608
REGISTERS = {"23": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0.1, 0.0, 0.0]}
POLICY = WriteBackPolicy(
    mode=Mode.COMMIT, approval="auto", armed_at_start=True, commit_unattended=True,
    max_change_auto_deg=180.0, min_interval_s=0.0,
    trial=TrialPolicy(duration_s=3.0, max_spread_percent=100.0, worse_percent=1e6),
)  # fmt: skip


class Recorded(VirtualRun):
    """A run that keeps its inputs."""

    def __init__(self, *arguments, **named):
        self.fed = []
        super().__init__(*arguments, **named)

    def feed(self, item):
        handle = self.core.handle

        def kept(one):
            self.fed.append(one)
            return handle(one)

        self.core.handle = kept
        super().feed(item)
        del self.core.handle

    def restart(self):
        self.fed.clear()
        super().restart()

    def plant(self):
        """The calibrator always returns the same values, and every gate is open."""
        truth = draw_truth(3)
        found = estimate(
            soft_iron=truth.soft_iron,
            hard_iron_gauss=truth.hard_iron_gauss,
            gyro_bias_rad_s=truth.gyro_bias_rad_s,
        )
        self.core.calibrator = PlantedCalibrator(self.core.calibrator, found)

    @property
    def state(self):
        return self.core.writeback.state

    @property
    def kinds(self):
        return [record["kind"] for record in self.journal.get(self.emulator.serial, [])]


def world(output="binary", mode=Mode.COMMIT):
    motion = (("static", 1000.0),)
    device = build(Setup("rov", seed=3, output=output, rate_hz=20, motion=motion))
    policy = POLICY if mode is Mode.COMMIT else WriteBackPolicy(mode=mode)
    return Recorded(device, core_settings(Config(), policy=policy))


def committed(output="binary"):
    run = world(output)
    assert run.until(lambda: run.state is State.OBSERVING, 10.0), run.notes
    run.run(6.0)
    run.plant()
    assert run.until(lambda: run.state is State.COMMITTED, 60.0), (run.states, run.notes[-3:])
    return run


# -- clocks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("clock", ["1970", "an hour behind"])
@pytest.mark.parametrize("reboot", [False, True])
def test_restart_confirms_a_save_and_a_set_clock_does_not(clock, reboot):
    run = committed()
    facts = run.journal[run.emulator.serial][-1]["facts"]
    assert facts["boot_id"] == "virtual boot"
    assert facts["boot_s"] == pytest.approx(run.now_s, abs=1.0)
    assert 0.0 < facts["device_s"] <= run.now_s
    behind_s = 3600.0 if clock == "an hour behind" else facts["wall_s"] - 100.0
    for record in run.journal[run.emulator.serial]:
        record["facts"]["wall_s"] -= behind_s
    if reboot:
        run.boot_id, run.boot_began_s = "another boot", run.now_s - 0.5
    run.restart()
    run.run(5.0)
    assert run.state is State.COMMITTED
    run.wall_s += 3600.0
    run.tell_clocks()
    run.run(5.0)
    assert run.state is State.COMMITTED
    assert run.kinds[-1] == "FLASH_ACKED"
    run.emulator.restart(run.now_s)
    assert run.until(lambda: run.kinds[-1] == "CONFIRMED", 20.0), run.notes[-4:]


@pytest.mark.parametrize("reboot", [False, True])
def test_restart_between_runs_is_shown_by_the_device_time(reboot):
    run = committed()
    run.emulator.restart(run.now_s + 0.5)
    run.now_s += 4.0
    if reboot:
        run.boot_id, run.boot_began_s = "another boot", run.now_s - 1.0
    run.restart()
    assert run.until(lambda: run.kinds[-1] == "CONFIRMED", 20.0), run.notes[-4:]


def test_stream_without_device_time_proves_no_restart():
    run = committed("imu")
    assert run.journal[run.emulator.serial][-1]["facts"]["device_s"] is None
    run.emulator.restart(run.now_s)
    run.run(15.0)
    run.restart()
    run.run(15.0)
    assert run.kinds[-1] == "FLASH_ACKED"


def test_replay_of_the_inputs_decides_the_same():
    run = committed()
    run.emulator.restart(run.now_s + 0.5)
    run.now_s += 4.0
    run.restart()
    assert run.until(lambda: run.state is State.CONFIRMED, 20.0)
    again = Core(run.core.settings)
    for item in run.fed:
        again.handle(item if isinstance(item, Received) else input_from_json(input_to_json(item)))
    assert again.writeback.state is State.CONFIRMED
    assert again.decisions.sha256 == run.core.decisions.sha256
    old = Core(run.core.settings)  # and as recorded by an older version: nothing is proven
    for item in run.fed:
        if isinstance(item, Received):
            old.handle(item)
            continue
        body = json.loads(input_to_json(item))
        for key in ("boot_id", "boot_s"):
            body.pop(key, None)
        for record in body.get("records", []):
            for key in ("boot_id", "boot_s", "device_s"):
                record["facts"].pop(key, None)
        old.handle(input_from_json(json.dumps(body).encode()))
    assert old.writeback.state is State.COMMITTED


def test_capture_without_boot_id_can_be_read():
    item = input_from_json(b'{"type":"WallClock","host_ns":5,"wall_s":1.8e9}')
    assert item == WallClock(5, 1.8e9, "", None)
    whole = WallClock(5, 1.8e9, "9d3a", 12.25)
    assert input_from_json(input_to_json(whole)) == whole


def test_every_record_has_the_time_of_every_clock(tmp_path):
    keeper = JournalKeeper(journal_in(tmp_path), lambda: 0)
    keeper.opened(SERIAL)
    assert keeper.append(JournalAppend("OUTPUTS_KEPT", {"serial": SERIAL})).error == ""
    core = {"wall_s": 1.8e9, "boot_id": "of the core", "boot_s": 3.0, "device_s": 2.0}
    assert keeper.append(JournalAppend("LOCKED", {"reason": "x", **core})).error == ""
    kept, locked = Journal.open(journal_path(tmp_path, SERIAL)).records()
    assert Stamp.of(kept.facts).boot_id == host_clock.boot_id() != ""
    assert 0.0 <= host_clock.boot_s() - kept.facts["boot_s"] < 600.0
    assert Stamp.of(locked.facts) == Stamp(1.8e9, "of the core", 3.0, 2.0)


# -- the journal -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "facts", [{"serial": 7, "old": REGISTERS, "new": REGISTERS}, {"device": {"serial": "7"}}]
)
def test_record_of_another_device_is_refused(tmp_path, facts):
    path = journal_path(tmp_path, SERIAL)
    journal = Journal.open(path)
    journal.append("PREPARED", txn="t", serial=SERIAL, old=REGISTERS, new=REGISTERS)
    journal.append("PREPARED", txn="u", **facts)
    keeper = JournalKeeper(journal_in(tmp_path), lambda: 0)
    answer = keeper.opened(SERIAL)
    assert answer.records == []
    assert answer.error.startswith(f"{path}: record 2 is of the device 7, and this is {SERIAL};")
    assert keeper.append(JournalAppend("PROVEN", {})).error == "no journal is open"
    assert len(Journal.open(path).records()) == 2


def test_record_of_another_device_only_permits_observing():
    first = committed()
    theirs = first.journal[first.emulator.serial][:2]  # PREPARED and RAM_VERIFIED
    theirs[0]["facts"]["serial"] = 7
    run = world(mode=Mode.STAGE)
    run.journal[run.emulator.serial] = theirs
    assert run.until(lambda: run.state is State.OBSERVING, 10.0)
    assert run.core.writeback.mode is Mode.OBSERVE
    assert run.writes == 0
    errors = [text for level, text in run.notes if level == "error"]
    assert "record 1 is of the device 7" in errors[0]
    run.run(5.0)
    assert run.samples > 50


@pytest.mark.parametrize("how", ["gone", "empty", "FIFO", "folder", "link", "device"])
def test_lost_or_blocked_journal_is_reported_and_the_run_continues(tmp_path, how):
    run = world(mode=Mode.STAGE)
    path = journal_path(tmp_path, run.emulator.serial)
    journal = Journal.open(path)
    journal.append("PREPARED", txn="t", serial=run.emulator.serial, old=REGISTERS, new=REGISTERS)
    journal.append("RAM_VERIFIED", txn="t")
    path.unlink()
    if how == "FIFO":
        os.mkfifo(path)
    elif how == "folder":
        path.mkdir()
    elif how == "empty":
        path.touch()
    elif how != "gone":
        path.symlink_to("/dev/full" if how == "device" else tmp_path / "elsewhere")
    keeper = JournalKeeper(journal_in(tmp_path), lambda: run.now_ns)
    opened = keeper.opened(run.emulator.serial)
    assert "\n" not in opened.error
    wanted = "record 2 (RAM_VERIFIED) was acknowledged" if how in ("gone", "empty") else "is a "
    assert wanted in opened.error
    carry_out = run._carry_out

    def with_keeper(event, waiting):
        carry_out(event, waiting)
        waiting[:] = [opened if hasattr(one, "records") else one for one in waiting]

    run._carry_out = with_keeper
    assert run.until(lambda: run.state is State.OBSERVING, 10.0)
    assert run.core.writeback.mode is Mode.OBSERVE
    assert any(opened.error in text for level, text in run.notes if level == "error")
    run.run(3.0)
    assert run.samples > 30
    assert run.writes == 0


def test_advice_for_a_lost_journal_works(tmp_path):
    path = journal_path(tmp_path, SERIAL)
    Journal.open(path).append("PREPARED")
    path.unlink()
    with pytest.raises(JournalError, match=f"then remove {receipt_path(path).name}"):
        Journal.open(path)
    receipt_path(path).unlink()
    assert Journal.open(path).append("PREPARED").seq == 1
