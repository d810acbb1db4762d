"""Foreign files under a running daemon: FIFOs, `/dev/full`, owners, modes, control codes.

At every path that the daemon opens there is something that never answers or is no regular file. The
device is read on, a stop ends the run, and a trial is undone when the vehicle's permission ends.
"""

from __future__ import annotations

import os
import stat
import subprocess
import time
from pathlib import Path

import pytest
from scripted_process import PATIENCE_S, Program

pytestmark = pytest.mark.timeout(400)
STRANGER = 65534
LOCATION = "[location]\nlatitude_deg = 48.0\nlongitude_deg = 11.0\n"
root_only = pytest.mark.skipif(os.geteuid() != 0, reason="only root can act for another user")


@pytest.fixture
def program(tmp_path):
    """`with program(...) as running`; the options are those of `Program`."""

    def make(**options: object) -> Program:
        return Program(tmp_path, **options)

    return make


def captured(running: Program) -> int:
    """Bytes of the captures so far."""
    return sum(path.stat().st_size for path in running.state.rglob("*.mcap"))


def goes_on(running: Program, bytes_more: int = 20_000) -> None:
    """The device is still read and recorded."""
    before = captured(running)
    running.until(lambda: captured(running) > before + bytes_more)


def replace_by_fifo(path: Path) -> None:
    """Puts a FIFO in the place of the file; nobody writes to it."""
    draft = path.with_suffix(".fifo")
    os.mkfifo(draft)
    draft.rename(path)


# -- files that never answer -----------------------------------------------------------------------


@pytest.mark.slow
def test_fifo_as_interlock_does_not_stop_the_run(program):
    with program() as running:
        running.word = None
        os.mkfifo(running.interlock)
        running.start()
        running.until(lambda: "OBSERVING" in running.said)
        goes_on(running)
        assert running.stop(30.0) == 0
        assert running.writes(running.unit.serial) == []


def test_fifo_as_interlock_undoes_a_trial(program):
    with program(trial_s=60.0) as running:
        running.start()
        running.until_record("RAM_VERIFIED")
        running.word = None
        time.sleep(0.3)
        replace_by_fifo(running.interlock)
        running.until_record("ROLLED_BACK", 30.0)
        goes_on(running)
        assert running.unit.memory.ram[23] == running.unit.memory.flash[23]
        assert running.stop(30.0) == 0


def test_ended_permission_undoes_a_trial_although_other_files_hang(program, tmp_path):
    """The vehicle's columns hang and an operator command is a FIFO when the vehicle falls
    silent.
    """
    columns = tmp_path / "columns.json"
    columns.write_text("{}")
    more = f'[terms]\nfile = "{columns}"\n'
    with program(trial_s=60.0, more=more) as running:
        running.start()
        running.until_record("RAM_VERIFIED")
        replace_by_fifo(columns)
        os.mkfifo(running.state / "operator" / "1.json")
        running.for_s(2.0)
        running.word = None
        running.until_record("ROLLED_BACK", 30.0)
        assert running.stop(30.0) == 0


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("columns", "operator's word")),
        "journal",
    ],
)
def test_fifo_at_any_foreign_path_blocks_neither_stream_nor_stop(program, tmp_path, name):
    columns = tmp_path / "columns.json"
    with program(more=f'[terms]\nfile = "{columns}"\n') as running:
        if name == "columns":
            os.mkfifo(columns)
        elif name == "operator's word":
            (running.state / "operator").mkdir(mode=0o700)
            os.mkfifo(running.state / "operator" / "1.json")
        else:
            os.mkfifo(running.state / f"journal-{running.unit.serial}.jsonl")
        running.start()
        running.until(lambda: captured(running) > 20_000)
        goes_on(running)
        if name == "journal":
            assert "journal" in running.said
            assert running.writes(running.unit.serial) == []
        assert running.stop(30.0) == 0


def test_dev_full_as_journal_prevents_writes_and_does_not_stop_the_run(program):
    with program() as running:
        (running.state / f"journal-{running.unit.serial}.jsonl").symlink_to("/dev/full")
        running.start()
        running.until(lambda: captured(running) > 60_000)
        goes_on(running, 60_000)
        assert running.stop(30.0) == 0
        assert running.writes(running.unit.serial) == []


@pytest.mark.parametrize(
    "place",
    [
        "state directory",
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ("capture directory", "config", "model")
        ),
    ],
)
def test_fifo_read_at_the_start_is_a_one_line_error(program, tmp_path, place):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    more = {
        "capture directory": f'[capture]\ndirectory = "{fifo}"\n',
        "model": f'[terms]\nmodel = "{fifo}"\n',
    }.get(place, "")
    with program(more=more) as running:
        config = running.config
        if place == "state directory":
            text = config.read_text().replace(str(running.state), str(fifo))
            config.write_text(text)
        done = subprocess.run(
            running.command("run", "--config", fifo if place == "config" else config),
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.returncode == 2, done.stderr
        last = done.stderr.strip().splitlines()[-1]
        assert str(fifo) in last
        assert "Traceback" not in done.stderr


def test_bundle_follows_no_link_and_waits_for_no_fifo(program, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("nobody's business")
    secret.chmod(0o600)
    with program() as running:
        (running.state / "captures").mkdir()
        (running.state / "journal-1.jsonl").symlink_to(secret)
        os.mkfifo(running.state / "journal-2.jsonl")
        os.mkfifo(running.state / "captures" / "z.mcap")
        archive = tmp_path / "b.tar.gz"
        done = running.ask("bundle", "-o", archive, "--config", running.config)
    assert done.returncode == 0, done.stderr
    listed = subprocess.run(
        ["tar", "xzOf", str(archive)], capture_output=True, check=True, timeout=PATIENCE_S
    ).stdout
    assert b"nobody's business" not in listed


# -- permissions -----------------------------------------------------------------------------------


@root_only
@pytest.mark.parametrize(
    ("owner", "mode"),
    [
        (STRANGER, 0o777),
        pytest.param(STRANGER, 0o700, marks=pytest.mark.slow),
        pytest.param(0, 0o777, marks=pytest.mark.slow),
    ],
)
def test_command_folder_writable_by_others_is_refused(program, owner, mode):
    with program(approval="operator") as running:
        box = running.state / "operator"
        box.mkdir()
        os.chown(box, owner, owner)
        box.chmod(mode)
        running.start()
        running.until(lambda: "candidate" in running.said)
        word = f'{{"verb": "approve", "argument": "{running.candidate()}"}}'
        (box / ".w").write_text(word)
        os.chown(box / ".w", STRANGER, STRANGER)
        (box / ".w").rename(box / "1.json")
        running.for_s(6.0)
        assert running.writes(running.unit.serial) == []
        assert str(box) in running.said
        running.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    "umask", [0o777, *(pytest.param(one, marks=pytest.mark.slow) for one in (0o077, 0o022))]
)
def test_commands_work_with_any_umask(program, umask):
    with program() as running:
        running.start()
        running.until(lambda: "OBSERVING" in running.said)
        assert running.operate("lock", "maintenance", umask=umask) == 0
        running.until(lambda: "maintenance" in running.said)
        running.stop()


@pytest.mark.parametrize("umask", [pytest.param(0o022, marks=pytest.mark.slow), 0o000])
def test_captures_are_readable_only_by_the_owner(program, umask):
    with program(more=LOCATION) as running:
        running.start(umask=umask)
        running.until(lambda: captured(running) > 10_000)
        running.stop()
        for path in running.state.rglob("*.mcap"):
            assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path


def test_operator_text_cannot_forge_log_lines(program):
    with program() as running:
        running.start()
        running.until(lambda: "OBSERVING" in running.said)
        running.operate("lock", "so\n<7>forged: all is well\x1b[2J")
        running.until(lambda: "so" in running.said and "forged" in running.said)
        running.stop()
        assert not [line for line in running.said.splitlines() if line.startswith("<7>forged")]
        assert "\x1b" not in running.said


@pytest.mark.slow
def test_folder_in_place_of_a_command_is_reported_once(program):
    with program() as running:
        running.start()
        running.until(lambda: "OBSERVING" in running.said)
        (running.state / "operator" / "folder.json").mkdir()
        running.for_s(6.0)
        running.stop()
        assert len([line for line in running.said.splitlines() if "folder.json" in line]) <= 2


# -- a permission is recent when it changes --------------------------------------------------------


def stamped(running: Program, ahead_s: float) -> None:
    """The vehicle's last permission with a time stamp in the future; nothing is written
    afterwards.
    """
    running.word = None
    time.sleep(0.3)
    draft = running.folder / "late"
    draft.write_text("safe")
    at_s = time.time() + ahead_s
    os.utime(draft, (at_s, at_s))
    draft.rename(running.interlock)


@pytest.mark.slow
@pytest.mark.parametrize(
    "ahead_s", [0.8, *(pytest.param(s, marks=pytest.mark.slow) for s in (8.0, 30.0))]
)
def test_old_permission_with_a_future_stamp_never_becomes_valid(program, ahead_s):
    with program(approval="operator") as running:
        running.start()
        running.until(lambda: "candidate" in running.said)
        stamped(running, ahead_s)
        running.for_s(min(ahead_s, 8.0) + 3.0)
        begun = time.monotonic()
        running.operate("approve", running.candidate())
        while time.monotonic() - begun < max(ahead_s - 8.0, 0.0) + 6.0 and ahead_s > 8.0:
            running.for_s(1.0)
        assert running.writes(running.unit.serial) == []
        running.stop()


def test_setting_the_clock_back_revives_no_permission(program):
    with program(approval="operator") as running:
        running.start()
        running.until(lambda: "candidate" in running.said)
        running.word = None
        running.for_s(4.0)
        running.set_wall(-4.5)
        running.operate("approve", running.candidate())
        running.for_s(4.0)
        assert running.writes(running.unit.serial) == []
        running.stop()
