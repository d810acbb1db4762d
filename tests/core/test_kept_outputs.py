"""The user's output settings survive a kill, a full disk, and changes in between."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import pytest
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun
from writeback_rig import estimate

from ahrsd.config.config import Config, core_settings
from ahrsd.core.device_session import KeptOutputs, Phase, open_record
from ahrsd.events import Send
from ahrsd.offline.replay import replay
from ahrsd.writeback.journal_history import StoredRecord
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.calibration_stream import left_by_session
from drivers.vn100.emulator.scenarios import Setup, build

OURS = (1, 8, 6, 1, 0x83F)
USERS = {75: (2, 16, 1, 8), 76: (0, 1, 0), 77: (0, 1, 0), 7: (40,), 6: (14,)}
PLACES = (5, 6, 7, 75, 76, 77)


def outputs(memory):
    return {key: values for key, values in memory.items() if key[0] in PLACES}


def world(mode=Mode.OBSERVE, configure=True, **setup):
    policy = WriteBackPolicy(
        mode=mode, configure_stream=configure, approval="auto",
        armed_at_start=True, commit_unattended=True,
        max_change_auto_deg=180.0, min_interval_s=0.0,
        trial=TrialPolicy(duration_s=3.0, max_spread_percent=100.0, worse_percent=1e6),
    )  # fmt: skip
    device = build(Setup(output=setup.pop("output", "ascii"), **setup))
    return VirtualRun(device, core_settings(Config(), policy=policy), step_s=0.02)


def kinds(run):
    return [record["kind"] for record in run.journal.get(run.emulator.serial, [])]


def end(run):
    run.stop()
    assert run.until(lambda: run.finished, 2.5)


def records(*facts):
    return [StoredRecord(kind, body) for kind, body in facts]


KEPT = ("OUTPUTS_KEPT", {"serial": 5, "old": {str(n): list(v) for n, v in USERS.items()}})


@pytest.mark.parametrize(
    ("register", "users", "present", "left"),
    [
        (6, (14,), (0,), True),
        (6, (14,), (14,), False),
        (6, (14,), (1,), False),
        (6, (0,), (1,), True),
        (6, (0,), (0,), False),
        (7, (40,), (20,), False),
        (75, (0, 1, 0), OURS, True),
        (75, (1, 8, 1, 8), (2, 40, 6, 1, 0x3F), True),
        (75, (1, 8, 1, 8), (0, 1, 0), True),
        (75, (3, 8, 1, 8), (2, 8, 1, 8), True),
        (75, (3, 8, 1, 8), (2, 9, 1, 8), False),
        (75, (1, 8, 1, 8), (1, 8, 1, 9), False),
        (75, OURS, OURS, False),
        (75, OURS, (1, 16, 6, 1, 0x83F), True),
    ],
)
def test_outputs_left_by_a_session_are_distinguished_from_those_of_a_person(
    register, users, present, left
):
    assert left_by_session(register, {register: users}, present) is left


def test_output_in_a_free_register_belongs_to_the_session():
    users = {75: (3, 40, 0x29, 0x7FFF, 0x0210, 0x000C), 76: (0, 1, 0)}
    assert left_by_session(76, users, (2, *users[75][1:]))
    assert not left_by_session(76, users, (2, 8, *users[75][2:]))
    assert not left_by_session(76, {76: (0, 1, 0)}, (2, *users[75][1:]))


def test_outputs_of_the_user_are_determined_per_register():
    kept = KeptOutputs()
    found = {**USERS, 6: (0,), 75: OURS, 7: (20,), 23: (1.0,) * 12}
    kept.update(5, found, records(KEPT))
    assert kept.users == {**USERS, 7: (20,)}  # 7 is not set by the session: somebody wrote it
    assert kept.left == (75, 6)
    assert "$VNWRG,06,14*" in kept.describe_left(put_back=False)
    kept.update(5, found, [])
    assert kept.users == {n: found[n] for n in USERS}
    assert kept.left == ()


def test_only_an_open_record_of_this_device_counts():
    assert open_record(records(KEPT), 5) == USERS
    assert open_record(records(KEPT), 6) is None
    assert open_record(records(KEPT, ("OUTPUTS_BACK", {"serial": 5})), 5) is None


def test_outputs_kept_by_this_run_are_used_without_a_trusted_journal():
    kept = KeptOutputs()
    kept.update(5, {**USERS, 6: (0,)}, records(KEPT))
    kept.update(5, {**USERS, 6: (0,)}, None)
    assert kept.users == USERS
    kept.update(6, {**USERS, 6: (0,)}, None)
    assert kept.users == {**USERS, 6: (0,)}


def test_outputs_are_journaled_before_the_first_and_after_the_last_change():
    run = world()
    sent = []
    run.listen = sent.append
    assert run.until(lambda: run.emulator.memory.get(75)[0] == 1, 10.0)
    assert kinds(run) == ["OUTPUTS_KEPT"]
    names = [type(event).__name__ for event in sent]
    first = next(i for i, e in enumerate(sent) if b"VNWRG" in getattr(e, "data", b""))
    assert names.index("JournalAppend") < first
    end(run)
    assert kinds(run) == ["OUTPUTS_KEPT", "OUTPUTS_BACK"]
    assert outputs(run.emulator.memory.ram) == outputs(run.emulator.memory.flash)


@pytest.mark.parametrize("output", [pytest.param("ascii", marks=pytest.mark.slow), "binary"])
def test_outputs_of_the_user_survive_a_kill_at_any_moment_of_the_set_up(output):
    """A run is killed after n steps, for consecutive n; each following run ends in order."""
    run = world(output=output, rate_hz=20)
    users, found = outputs(run.emulator.memory.ram), set()
    for steps in range(10, 70, 2):
        for _ in range(steps):
            run.step()
        found.add(tuple(outputs(run.emulator.memory.ram).items()))
        run.restart()
        if steps % 4 == 0:  # otherwise killed twice
            run.run(0.1)
            assert run.until(lambda: run.core.device_session.phase is Phase.READY, 3.0)
            end(run)
            assert outputs(run.emulator.memory.ram) == users, steps
            assert kinds(run)[-1:] == ["OUTPUTS_BACK"]
            run.restart()
            run.finished = False
    assert len(found) > 2  # killed before, while and after they were changed


def test_outputs_written_after_the_kill_belong_to_the_user():
    run = world()
    run.run(3.0)
    run.emulator.memory.ram[75, 0] = (1, 80, 1, 8)
    run.emulator.memory.ram[6, 1] = (19,)
    run.restart()
    run.run(3.0)
    end(run)
    assert run.emulator.memory.get(75) == (1, 80, 1, 8)
    assert run.emulator.memory.get(6, 1) == (19,)


def test_device_restarted_after_the_kill_already_has_the_outputs_of_the_user():
    run = world()
    run.run(3.0)
    flash = outputs(run.emulator.memory.flash)
    run.emulator.memory.flash[6, 1] = (19,)  # saved by somebody in between
    run.emulator.memory.start()
    run.restart()
    run.run(3.0)
    end(run)
    assert outputs(run.emulator.memory.ram) == {**flash, (6, 1): (19,)}


def test_outputs_are_unchanged_while_the_disk_is_full():
    run = world()
    run.disk_full = True
    run.run(5.0)
    assert run.sent["VNWRG 75"] == run.sent["VNWRG 06"] == 0
    assert any("cannot be journalled" in text for _, text in run.notes)
    assert run.samples > 0
    run.disk_full = False
    assert run.until(lambda: run.emulator.memory.get(75)[0] == 1, 40.0)
    run.disk_full = True  # the record exists: a reset needs no other
    run.emulator.memory.start()
    assert run.until(lambda: run.emulator.memory.get(75)[0] == 0, 1.0)
    assert run.until(lambda: run.emulator.memory.get(75)[0] == 1, 20.0)


def test_failed_save_sets_up_only_journaled_outputs():
    """The disk was full at the start, and is no longer when the outputs would be set up again."""
    run = world(
        Mode.COMMIT, motion=(("static", 1000.0),), faults=("power_cut_wnv@1",),
        output="ascii", rate_hz=20,
    )  # fmt: skip
    users = outputs(run.emulator.memory.ram)
    run.disk_full = True
    run.run(4.0)
    run.disk_full = False
    for verb in ("lock", "unlock"):  # written, so the write-back need not wait for the disk
        run.operate(verb, "test")
    planted(run)
    assert run.until(lambda: "FLASH_SENT" in kinds(run), 15.0)
    assert "OUTPUTS_KEPT" not in kinds(run)
    before = []

    def listen(event):
        if b"VNWRG,06" in getattr(event, "data", b""):
            before.append(kinds(run))

    run.listen = listen
    assert run.until(lambda: run.emulator.memory.get(75)[0] == 1, 8.0)
    assert "OUTPUTS_KEPT" in before[0]
    end(run)
    assert outputs(run.emulator.memory.ram) == users


def planted(run):
    truth = run.emulator.truth
    values = estimate(
        soft_iron=truth.soft_iron, hard_iron_gauss=truth.hard_iron_gauss,
        gyro_bias_rad_s=truth.gyro_bias_rad_s,
    )  # fmt: skip
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, values)


@pytest.mark.parametrize("configure", [True, False])
def test_save_never_includes_the_outputs_of_a_killed_session(configure):
    """They are restored before VNWNV if permitted; otherwise there is no VNWNV."""
    run = world(Mode.COMMIT, configure, motion=(("static", 1000.0),), output="binary", rate_hz=20)
    users = outputs(run.emulator.memory.ram)
    if not configure:
        killed = world(motion=(("static", 1000.0),), output="binary", rate_hz=20)
        run.emulator = killed.emulator
        killed.run(3.0)
        run.journal, run.now_s = killed.journal, killed.now_s
    else:
        run.run(3.0)
        run.restart()
    run.run(1.5)
    planted(run)
    assert run.until(lambda: "PROVEN" in run.states, 40.0)
    run.run(20.0)
    assert run.saves == (1 if configure else 0)
    assert outputs(run.emulator.memory.flash) == users
    told = [text for _, text in run.notes if "outputs of a killed session" in text]
    assert len(told) == 1
    assert ("$VNWRG,75," in told[0]) and ("nothing is saved" in told[0]) is not configure


def wait_for(condition, seconds=30.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def sent_in(capture):
    """What the replay of a run computes that it sends and reports."""
    sent, texts = [], []

    def listen(event):
        if isinstance(event, Send):
            sent.append(event.data)
        texts.append(getattr(event, "text", ""))

    replay(capture, Config(), listeners=[listen])
    return b"".join(sent), texts


def test_next_run_restores_the_outputs_of_a_killed_program(emulated, tmp_path):
    """kill -9 on a real port. The replay of the next run gives the same bytes for the device."""
    config = tmp_path / "ahrsd.toml"
    config.write_text(
        f'state_directory = "{tmp_path}"\n[device]\nbaud = 115200\nconfigure_stream = true\n'
    )
    with emulated(output="ascii") as (emulator, path):
        users, heard, receive = dict(emulator.memory.ram), bytearray(), emulator.receive

        def listen(data, now_s):
            heard.extend(data)
            return receive(data, now_s)

        emulator.receive = listen
        command = [sys.executable, "-m", "ahrsd", "run", "--config", str(config), "--port", path]
        for number in (signal.SIGKILL, signal.SIGTERM):
            heard.clear()
            with subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            ) as running:
                try:
                    wait_for(lambda: b"$VNWRG,75,1,8,06,0001,083F" in heard)
                    seen = emulator.counters["messages"]
                    wait_for(lambda: emulator.counters["messages"] > seen + 200)  # noqa: B023
                finally:
                    running.send_signal(number)
                    err = running.communicate()[1]
            restored = emulator.memory.ram == users
            assert restored is (number is signal.SIGTERM)
        assert running.returncode == 0
        assert b"still has the outputs of a killed session" in err
    (journal,) = tmp_path.glob("journal-*.jsonl")
    written = [json.loads(line)["kind"] for line in journal.read_text().splitlines()]
    assert written == ["OUTPUTS_KEPT", "OUTPUTS_BACK"]
    capture = max(tmp_path.glob("captures/*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    sent, texts = sent_in(capture)
    assert any("still has the outputs of a killed session" in text for text in texts)
    assert b"$VNWRG,06,14" in sent
    assert bytes(heard).endswith(sent)
