"""A person's word reaches the daemon once, whole, and in time, or not at all."""

import os
import threading
import time

import pytest

from ahrsd.operator_box import LONGEST_S, OperatorBox


@pytest.fixture
def box(tmp_path):
    box = OperatorBox(tmp_path)
    box.prepare()
    return box


def test_a_word_is_taken_once(box):
    box.put("approve", "ae188205")
    box.put("lock", "crew aboard")
    assert box.take() == [("approve", "ae188205"), ("lock", "crew aboard")]
    assert box.take() == []
    assert list(box.folder.iterdir()) == []


def test_only_the_daemons_user_may_speak(box):
    assert box.folder.stat().st_mode & 0o777 == 0o700


def test_an_old_word_was_said_to_another_run(box, caplog):
    file = box.put("approve", "ae188205")
    then = time.time() - LONGEST_S - 1
    os.utime(file, (then, then))
    assert box.take() == []
    assert not file.exists()
    assert "too old" in caplog.text


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", b'{"verb": "approve"}', b'{"verb": "commit", "argument": ""}',
     b'{"verb": "approve", "argument": 3}', b"\xff" * 4000],
)  # fmt: skip
def test_what_is_not_a_word_does_nothing_and_goes(box, body, caplog):
    (box.folder / "1.json").write_bytes(body)
    assert box.take() == []
    assert list(box.folder.iterdir()) == []
    assert "is not a word" in caplog.text


def test_no_folder_is_no_word(tmp_path):
    assert OperatorBox(tmp_path / "nowhere").take() == []


def test_the_command_says_that_nobody_listens(run, tmp_path, box, capsys, monkeypatch):
    monkeypatch.setattr("ahrsd.commands.operator._WAIT_S", 0.1)
    assert run("operator", "lock", "--state-directory", tmp_path) == 75
    assert capsys.readouterr().err == "ahrsd: no daemon took the word within 0 s\n"
    assert box.take() == []  # and nothing is left that a later daemon might take
    assert run("operator", "lock", "--state-directory", tmp_path / "other") == 75


def test_the_command_waits_until_it_was_heard(run, tmp_path, box, capsys):
    heard = []

    def daemon():
        until = time.monotonic() + 10.0
        while not heard and time.monotonic() < until:
            heard.extend(box.take())

    listener = threading.Thread(target=daemon)
    listener.start()
    assert run("operator", "approve", "ae188205", "--state-directory", tmp_path) == 0
    listener.join()
    assert heard == [("approve", "ae188205")]
    assert "the daemon heard: approve ae188205" in capsys.readouterr().out


def test_approve_needs_an_id(run):
    assert run("operator", "approve") == 2
