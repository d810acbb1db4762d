"""`ahrsd registers lock|unlock|export`: what nobody may write, and what anybody can type."""

from __future__ import annotations

import json
import threading

import pytest
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun
from writeback_rig import estimate

from ahrsd.config.config import Config, core_settings
from ahrsd.daemon.journal import Journal, journal_path
from ahrsd.daemon.operator_inbox import OperatorAnswer, OperatorBox, OperatorInbox
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.registers import same

SERIAL = 100130608
BAUD = ("--baud", "115200")
NEW = "1.1,0,0,0,1,0,0,0,0.9,0.125,-0.0625,0.03"
OLD_LINE = "$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76"


def journal(folder, serial=SERIAL):
    return Journal.open(journal_path(folder, serial))


def kinds(folder):
    return [record.kind for record in journal(folder).records()]


@pytest.fixture
def here(run, tmp_path):
    return lambda *words: run(*words, "--state-directory", tmp_path)


def test_lock_forbids_writes_and_permits_a_rollback(here, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        write = ("registers", "write", path, 23, NEW, "--yes", *BAUD)
        assert here(*write) == 0
        assert here("registers", "lock", "crew aboard") == 0
        changed = emulator.memory.get(23)
        capsys.readouterr()
        assert here("registers", "write", path, 84, NEW, "--yes", *BAUD) == 1
        assert "locked: crew aboard" in capsys.readouterr().err
        assert emulator.memory.get(23) == changed
        assert here("registers", "rollback", path, "--yes", *BAUD) == 0
        assert emulator.memory.get(23) != changed
        assert here("registers", "unlock", "nobody aboard") == 0
        assert here(*write) == 0
    hand = ["HAND_PREPARED", "HAND_VERIFIED"]
    assert kinds(tmp_path) == [*hand, "LOCKED", *hand, "UNLOCKED", *hand]


def test_daemon_starts_locked_after_an_earlier_lock(here, tmp_path):
    assert here("registers", "lock", "dry dock", "--serial", SERIAL) == 0
    policy = WriteBackPolicy(
        mode=Mode.STAGE, approval="auto", armed_at_start=True, max_change_auto_deg=180.0
    )
    device = build(Setup(output="imu", rate_hz=20, motion=(("static", 1000.0),)))
    world = VirtualRun(device, core_settings(Config(), policy=policy))
    world.journal[SERIAL] = [vars_of(record) for record in journal(tmp_path).records()]
    truth = device.truth
    planted = estimate(
        soft_iron=truth.soft_iron, hard_iron_gauss=truth.hard_iron_gauss,
        gyro_bias_rad_s=truth.gyro_bias_rad_s,
    )  # fmt: skip
    assert world.until(lambda: "LOCKED" in world.states, 5.0)
    world.core.calibrator = PlantedCalibrator(world.core.calibrator, planted)
    world.run(20.0)
    assert world.core.writeback.state.value == "LOCKED"
    assert world.writes == 0
    world.operate("unlock", "launched")
    world.run(20.0)
    assert world.writes > 0


def vars_of(record):
    return {"kind": record.kind, "facts": record.facts}


def test_lock_is_sent_to_a_running_daemon_and_its_journal_is_unchanged(here, tmp_path, capsys):
    box, words, done = OperatorBox(tmp_path), [], threading.Event()
    box.prepare()
    inbox = OperatorInbox(box)
    while inbox._looked_s is None:
        done.wait(0.01)

    def daemon():
        while not done.wait(0.01):
            for word in inbox.take():
                words.append((word.verb, word.argument))
                inbox.answer(word.name, OperatorAnswer(word.argument != "again", "said"))

    thread = threading.Thread(target=daemon)
    thread.start()
    try:
        assert here("registers", "lock", "crew aboard") == 0
        assert here("registers", "unlock", "gone") == 0
        assert here("registers", "lock", "again") == 1
    finally:
        done.set()
        thread.join()
        inbox.close(10.0)
    assert words == [("lock", "crew aboard"), ("unlock", "gone"), ("lock", "again")]
    assert list(tmp_path.glob("*.jsonl")) == []
    said = capsys.readouterr()
    assert "the daemon accepted it" in said.out
    assert "the daemon refused: said" in said.err


def test_lock_is_not_sent_to_a_daemon_with_another_device(here, tmp_path, monkeypatch, capsys):
    def answers(serial):
        class Daemon:
            def __init__(self, path):
                assert path == tmp_path / "socket"

            def __enter__(self):
                return self

            def __exit__(self, *_):
                pass

            def ask(self, what):
                return {"status": {"device": {"serial": serial}}}[what]

        return Daemon

    OperatorBox(tmp_path).prepare()
    (tmp_path / "socket").touch()
    monkeypatch.setattr("ahrsd.cli.device.registers._daemon_heard", lambda *_: True)
    monkeypatch.setattr("ahrsd.cli.device.registers.DaemonConnection", answers(77))
    assert here("registers", "lock", "crew aboard", "--serial", SERIAL) == 0
    assert kinds(tmp_path) == ["LOCKED"]
    monkeypatch.setattr("ahrsd.cli.device.registers.DaemonConnection", answers(SERIAL))
    assert here("registers", "unlock", "gone", "--serial", SERIAL) == 0
    assert "the daemon accepted it" in capsys.readouterr().out
    assert kinds(tmp_path) == ["LOCKED"]


def test_lock_is_journaled_when_the_daemon_is_gone(here, tmp_path, monkeypatch):
    monkeypatch.setattr("ahrsd.cli.device.registers._WAIT_S", 0.1)
    OperatorBox(tmp_path).prepare()
    assert here("registers", "lock", "crew aboard", "--serial", SERIAL) == 0
    assert kinds(tmp_path) == ["LOCKED"]
    assert list(OperatorBox(tmp_path).folder.iterdir()) == []


def test_one_of_several_devices_must_be_named(here, tmp_path, capsys):
    assert here("registers", "lock", "crew aboard") == 1
    assert "there is no journal" in capsys.readouterr().err
    for serial in (1, 2):
        assert here("registers", "lock", "crew aboard", "--serial", serial) == 0
    assert here("registers", "unlock", "gone") == 1
    assert "say which by --serial" in capsys.readouterr().err
    assert here("registers", "unlock", "gone", "--serial", 2) == 0
    assert [r.kind for r in journal(tmp_path, 1).records()] == ["LOCKED"]
    assert [r.kind for r in journal(tmp_path, 2).records()] == ["LOCKED", "UNLOCKED"]
    assert here("registers", "unlock", "gone", "--serial", 2) == 0
    assert "it is not locked" in capsys.readouterr().out


def test_exported_lines_are_accepted_by_the_device(here, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        assert here("registers", "write", path, 23, NEW, "--yes", *BAUD) == 0
        capsys.readouterr()
        assert here("registers", "export", "1", "23") == 0
        assert capsys.readouterr().out == OLD_LINE + "\n"
        assert here("registers", "export", path, "-o", tmp_path / "lines.txt", *BAUD) == 0
        lines = (tmp_path / "lines.txt").read_text().splitlines()
        wanted = dict(emulator.memory.ram)
    assert all(line.startswith("$VNWRG,") for line in lines)
    assert not any(line.startswith("$VNWRG,05") for line in lines)
    assert len(lines) > 12
    other = build(Setup())
    now_s = 2.0
    for line in lines:
        other.receive(line.encode() + b"\r\n", now_s)
        now_s += 0.1
        assert b"VNERR" not in other.advance(now_s)
    held = other.memory.ram
    assert [key for key in wanted if key[0] != 2 and not same(key[0], wanted[key], held[key])] == []
    assert held[23, 0] == pytest.approx([float(value) for value in NEW.split(",")])


def test_exported_json_is_read_by_diff(here, emulated, tmp_path, capsys):
    file = tmp_path / "now.json"
    with emulated() as (_, path):
        assert here("registers", "export", path, "23", "84", "--json", "-o", file, *BAUD) == 0
        assert here("registers", "diff", path, file, *BAUD) == 0
    assert "2 registers compared, 0 differ" in capsys.readouterr().out
    assert json.loads(file.read_text())["schema"] == "ahrsd.registers/1"
    assert here("registers", "export", file, "26") == 2
    assert "has no register 26" in capsys.readouterr().err
