"""Commands of a person reach the daemon once, complete and in time, or not at all, and are
answered.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
from patience import PATIENCE_S
from planted_operator import estimate

from ahrsd.core.core import Core
from ahrsd.daemon.operator_inbox import (
    LONGEST_S,
    OperatorAnswer,
    OperatorBox,
    OperatorCommand,
    OperatorFolderError,
    OperatorInbox,
)
from ahrsd.events import Answered, GateResult
from ahrsd.inputs import Journalled, Operator

VERY_LONG_S = 60.0


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


@pytest.fixture
def box(tmp_path):
    box = OperatorBox(tmp_path)
    box.prepare()
    return box


@pytest.fixture
def inbox(box):
    made = OperatorInbox(box)
    until(lambda: made._looked_s is not None)
    yield made
    made.close(10.0)


def heard(inbox, count=1):
    words = []
    until(lambda: words.extend(inbox.take()) or len(words) >= count)
    return words


def answer_of(box, name):
    path = box.folder / f"{name}.answer"
    until(path.exists)
    return json.loads(path.read_text())


def test_command_is_taken_once_and_in_order(box, inbox):
    first, second = box.put("approve", "ae188205"), box.put("lock", "crew aboard")
    assert heard(inbox, 2) == [
        OperatorCommand(first, "approve", "ae188205"),
        OperatorCommand(second, "lock", "crew aboard"),
    ]
    assert inbox.take() == []
    assert list(box.folder.iterdir()) == []


def test_of_two_daemons_with_one_folder_only_the_first_takes_commands(box, inbox):
    second = OperatorInbox(box)
    try:
        until(lambda: second.fault)
        assert "another daemon takes the commands; give each daemon" in second.fault
        box.put("lock", "crew aboard")
        assert [word.argument for word in heard(inbox)] == ["crew aboard"]
        assert second.take() == []
        inbox.close(10.0)
        until(lambda: not second.fault)
        box.put("unlock", "nobody aboard")
        assert [word.argument for word in heard(second)] == ["nobody aboard"]
    finally:
        second.close(10.0)


def test_sender_of_a_command_gets_the_answer(box, inbox):
    answers = []
    caller = threading.Thread(
        target=lambda: answers.append(box.say("approve", "ae188205", VERY_LONG_S))
    )
    caller.start()
    (word,) = heard(inbox)
    inbox.answer(word.name, OperatorAnswer(False, "it is b0b1b2b3"))
    caller.join(VERY_LONG_S)
    assert answers == [OperatorAnswer(False, "it is b0b1b2b3")]
    assert list(box.folder.iterdir()) == []


def test_command_from_before_the_start_is_dropped_and_answered(box, caplog):
    name = box.put("approve", "ae188205")
    future = time.time() + 20.0
    os.utime(box.folder / f"{name}.json", (future, future))  # no stamp makes it one of this run
    inbox = OperatorInbox(box)
    found = answer_of(box, name)
    assert found["accepted"] is False
    assert "before this run of the daemon started" in found["text"]
    assert inbox.take() == []
    inbox.close(10.0)


def test_command_is_recent_if_the_folder_was_checked_in_time(box, inbox, monkeypatch):
    inbox._looked_s -= 2 * LONGEST_S  # a disk that hung
    monkeypatch.setattr("ahrsd.daemon.operator_inbox._EVERY_S", 0.01)
    inbox.close(10.0)
    name = box.put("approve", "ae188205")
    with box.open() as folder:
        inbox._looked_s -= 2 * LONGEST_S
        inbox._look(folder, inbox._looked_s + 2 * LONGEST_S)
    assert "the daemon read no commands for more than 30 s" in answer_of(box, name)["text"]
    assert inbox.take() == []


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", b'{"verb": "approve"}', b'{"verb": "commit", "argument": ""}',
     b'{"verb": "approve", "argument": 3}', b"\xff" * 4000],
)  # fmt: skip
def test_invalid_command_file_is_removed_without_effect(box, inbox, body, caplog):
    (box.folder / ".1").write_bytes(body)
    (box.folder / ".1").rename(box.folder / "1.json")
    assert "is not a command" in answer_of(box, "1")["text"]
    assert inbox.take() == []
    assert not (box.folder / "1.json").exists()
    assert "is not a command" in caplog.text


@pytest.mark.parametrize("kind", ["folder", "FIFO", "link"])
def test_odd_folder_entry_is_reported_once_and_kept(box, inbox, tmp_path, kind, caplog):
    path = box.folder / "x.json"
    if kind == "folder":
        path.mkdir()
    elif kind == "FIFO":
        os.mkfifo(path)
    else:
        (tmp_path / "secret").write_text('{"verb": "arm", "argument": ""}')
        path.symlink_to(tmp_path / "secret")
    until(lambda: "x.json is not a command" in caplog.text)
    for _ in range(3):  # turns later
        before = inbox._looked_s
        until(lambda before=before: inbox._looked_s > before)
    assert caplog.text.count("x.json is not a command") == 1
    assert inbox.take() == []
    assert path.is_symlink() or path.exists()
    box.put("lock", "it goes on")
    assert heard(inbox)[0].verb == "lock"


def test_missing_command_folder_is_reported(tmp_path):
    inbox = OperatorInbox(OperatorBox(tmp_path / "nowhere"))
    until(lambda: "nobody can approve" in inbox.fault)
    assert inbox.take() == []
    inbox.close(10.0)


# -- who may speak ---------------------------------------------------------------------------------


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_only_the_user_of_the_daemon_may_command_with_any_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        box = OperatorBox(tmp_path)
        box.prepare()
        name = box.put("arm")
    finally:
        os.umask(before)
    assert box.folder.stat().st_mode & 0o777 == 0o700
    assert (box.folder / f"{name}.json").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_command_folder_writable_by_others_is_refused(tmp_path, mode, run, capsys):
    box = OperatorBox(tmp_path)
    box.folder.mkdir()
    box.folder.chmod(mode)
    words = f"{box.folder}: others than its owner may write there (mode {mode:04o})"
    with pytest.raises(OperatorFolderError) as refused:
        box.prepare()
    assert str(refused.value).startswith(words)
    assert f"chmod 700 {box.folder}" in str(refused.value)
    inbox = OperatorInbox(box)
    (box.folder / "1.json").write_text('{"verb": "arm", "argument": ""}')
    until(lambda: inbox.fault.startswith(words))
    assert inbox.take() == []
    assert run("operator", "arm", "--state-directory", tmp_path) == 1
    assert words in capsys.readouterr().err
    box.folder.chmod(0o700)
    until(lambda: inbox.fault == "")
    assert inbox.take() == []  # it lay there when the folder came to be trusted
    inbox.close(10.0)


def test_command_folder_made_writable_during_the_run_is_refused(box, inbox):
    box.folder.chmod(0o777)
    until(lambda: "others than its owner may write there" in inbox.fault)
    (box.folder / "1.json").write_text('{"verb": "arm", "argument": ""}')
    for _ in range(3):
        time.sleep(0.1)
        assert "others than its owner may write there" in inbox.fault
    box.folder.chmod(0o700)
    assert "before this run of the daemon started to read commands" in answer_of(box, "1")["text"]
    assert inbox.take() == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_command_folder_of_another_user_is_refused(box):
    os.chown(box.folder, 12345, 12345)
    with pytest.raises(OperatorFolderError, match="belongs to user 12345, who could approve"):
        box.prepare()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_command_of_root_with_any_umask_is_accepted(box, tmp_path):
    """The reader runs as the folder's owner, in a process of its own."""
    top = Path(tempfile.gettempdir())
    for folder in (tmp_path, *tmp_path.parents):
        if folder.is_relative_to(top) and folder != top:
            folder.chmod(0o755)
    os.chown(box.folder, 12345, 12345)
    before = os.umask(0o077)
    try:
        name = box.put("rollback")
    finally:
        os.umask(before)
    path = box.folder / f"{name}.json"
    code = f"import os; os.setgid(12345); os.setuid(12345); print(open({str(path)!r}).read())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(found.stdout) == {"verb": "rollback", "argument": ""}
    assert path.stat().st_uid == 12345


def test_link_as_command_folder_is_refused(tmp_path):
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "operator").symlink_to("elsewhere")
    with pytest.raises(OperatorFolderError, match="is not a folder"):
        OperatorBox(tmp_path).prepare()


# -- what is answered ------------------------------------------------------------------------------


def answers(core, verb, argument="", *, journal_error=None):
    out = core.handle(Operator(core_ns(core), verb, argument, "word"))
    if journal_error is not None:
        out += core.handle(Journalled(core_ns(core), "LOCKED", journal_error))
    return [(e.word, e.accepted, e.text) for e in out if isinstance(e, Answered)]


def core_ns(core):
    return int(core._host_s * 1e9)


@pytest.fixture
def core(live):
    """Of a daemon that has read its device and has a candidate."""
    with live({"output": "imu"}, mode="stage") as daemon:
        daemon.until(lambda: "OBSERVING" in daemon.states)
        daemon.stop()
        made: Core = daemon.core
        made.writeback._safe.stopping = False
        yield made


def qualify(core):
    green = (GateResult("observability", 3.0, 1.0, True, 0.0, "", ""),)
    core.writeback.on_verdict(estimate(), green, 1.0, core._host_s)
    return core.writeback.proposal.id


def test_each_command_is_answered_with_a_reason(core):
    assert answers(core, "approve", "ae188205") == [
        ("word", False, "no candidate to approve in OBSERVING")
    ]
    assert answers(core, "rollback") == [
        ("word", False, "nothing to roll back in OBSERVING; for values that are in flash use "
         "the registers rollback command")
    ]  # fmt: skip
    assert answers(core, "arm") == [("word", True, "armed: this run may write")]
    identifier = qualify(core)
    assert answers(core, "approve", "WRONG") == [
        ("word", False, f"'WRONG' is not the candidate, it is {identifier}")
    ]
    assert answers(core, "approve", identifier.upper()) == []  # PREPARED is not on the disk
    out = core.handle(Journalled(core_ns(core), "PREPARED"))
    assert [(e.accepted, e.text) for e in out if isinstance(e, Answered)] == [
        (True, f"{identifier} approved")
    ]


def test_a_lock_is_answered_once_it_is_in_the_journal(core):
    assert answers(core, "lock", "crew aboard") == []  # not before
    out = core.handle(Journalled(core_ns(core), "LOCKED"))
    assert [(e.accepted, e.text) for e in out if isinstance(e, Answered)] == [
        (True, "locked: crew aboard")
    ]


def test_a_lock_that_the_journal_did_not_take_is_refused(core):
    assert answers(core, "lock", "crew aboard", journal_error="no space") == [
        ("word", False, "not in the journal: no space; it holds for this run only")
    ]


# -- the command -----------------------------------------------------------------------------------


def test_missing_daemon_is_reported(run, tmp_path, box, capsys, monkeypatch):
    monkeypatch.setattr("ahrsd.cli.running.daemon._WAIT_S", 0.1)
    assert run("operator", "lock", "--state-directory", tmp_path) == 75
    assert capsys.readouterr().err == "ahrsd: no daemon took the command within 0 s\n"
    assert list(box.folder.iterdir()) == []  # nothing is left that a later daemon might take
    assert run("operator", "lock", "--state-directory", tmp_path / "other") == 75


@pytest.mark.parametrize(
    ("answer", "code", "printed"),
    [
        (OperatorAnswer(True, "ae188205 approved"), 0, "accepted: ae188205 approved\n"),
        (OperatorAnswer(False, "it is b0b1b2b3"), 1, "ahrsd: refused: it is b0b1b2b3\n"),
    ],
)
def test_the_command_prints_the_answer(run, tmp_path, inbox, capsys, answer, code, printed):
    words = []

    def daemon():
        words.extend(heard(inbox))
        inbox.answer(words[0].name, answer)

    listener = threading.Thread(target=daemon)
    listener.start()
    assert run("operator", "approve", "ae188205", "--state-directory", tmp_path) == code
    listener.join()
    assert [(word.verb, word.argument) for word in words] == [("approve", "ae188205")]
    said = capsys.readouterr()
    assert said.out + said.err == printed


def test_approve_needs_an_id(run):
    assert run("operator", "approve") == 2


def test_a_running_daemon_answers(emulated, tmp_path):
    config, log = tmp_path / "a.toml", tmp_path / "log"

    def ahrsd(*words):
        done = subprocess.run(
            [sys.executable, "-m", "ahrsd", *words, "--state-directory", str(tmp_path)],
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    with emulated(output="imu") as (_, port), log.open("wb") as file:
        config.write_text(
            f'mode = "stage"\nstate_directory = "{tmp_path}"\n[device]\nbaud = 115200\n'
            f'port = "{port}"\n'
        )
        command = [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)]
        process = subprocess.Popen(command, stdout=file, stderr=file, umask=0o077)
        try:
            end = time.monotonic() + PATIENCE_S
            while "OBSERVING" not in log.read_text():
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.05)
            refused = "ahrsd: refused: no candidate to approve in "
            code, text = ahrsd("operator", "approve", "ae188205")
            assert (code, text.startswith(refused)) == (1, True), text
            assert ahrsd("operator", "arm") == (0, "accepted: armed: this run may write\n")
            locked = (0, "accepted: locked: crew aboard\n")
            assert ahrsd("operator", "lock", "crew aboard") == locked
        finally:
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    (journal,) = tmp_path.glob("journal-*.jsonl")
    assert "crew aboard" in journal.read_text()
