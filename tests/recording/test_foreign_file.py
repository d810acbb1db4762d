"""Foreign files: irregular files are refused, and a permission is recent only after an observed
change.
"""

from __future__ import annotations

import os
import socket
import threading
import time

import pytest
from patience import PATIENCE_S

from ahrsd.config.config import load_config
from ahrsd.daemon.vehicle_files import ColumnsFile, InterlockFile
from ahrsd.errors import ConfigError
from ahrsd.foreign_file import (
    Changes,
    Contents,
    FileWatch,
    ForeignFileError,
    boot_s,
    read_regular,
    text_within,
)


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


def rewrite(path, text):
    """As a vehicle does it: never seen half, another writing each time."""
    draft = path.with_name(f".{path.name}")
    draft.write_text(text)
    draft.rename(path)


def odd(path, kind):
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    elif kind == "missing":
        pass
    return path


ODD = [
    ("FIFO", "is a FIFO, not a regular file"),
    ("folder", "is a folder, not a regular file"),
    ("socket", "is a socket, not a regular file"),
    ("device", "is a device, not a regular file"),
    ("huge", "is larger than 64 bytes"),
    ("missing", "cannot be read: No such file or directory"),
]


@pytest.mark.parametrize(("kind", "words"), ODD)
def test_irregular_or_large_file_is_refused_in_one_line(tmp_path, kind, words):
    with pytest.raises(ForeignFileError, match=words):
        read_regular(odd(tmp_path / "word", kind), 64)


def test_a_link_is_followed_only_where_it_may_be(tmp_path):
    (tmp_path / "real").write_text("safe")
    (tmp_path / "link").symlink_to("real")
    assert read_regular(tmp_path / "link", 64).data == b"safe"
    with pytest.raises(ForeignFileError, match="is a symbolic link"):
        read_regular(tmp_path / "link", 64, follow=False)


@pytest.mark.parametrize(("kind", "words"), ODD)
def test_such_a_configuration_is_one_line(tmp_path, kind, words):
    words = words.replace("64", str(1 << 20))
    with pytest.raises(ConfigError) as caught:
        load_config(odd(tmp_path / "a.toml", kind))
    assert caught.value.lines == [f"{tmp_path / 'a.toml'}: {words}"]


def test_hanging_disk_is_reported_and_not_awaited(tmp_path, monkeypatch):
    monkeypatch.setattr("ahrsd.foreign_file.read_regular", lambda *_: threading.Event().wait())
    with pytest.raises(ForeignFileError, match="did not answer within 0 s: its disk hangs"):
        text_within(tmp_path / "a", 64, 0.05)


def contents(data=b"safe", mtime_ns=1, inode=7):
    return Contents(data, (1, inode, mtime_ns, len(data)))


def test_change_is_dated_to_the_previous_check():
    seen = Changes()
    assert seen.seen(contents(), 10.0).writings == 0
    assert seen.sight.since_s == float("-inf")
    assert seen.seen(contents(), 11.0).since_s == float("-inf")
    assert seen.seen(contents(mtime_ns=2), 12.0).since_s == 11.0
    assert seen.seen(contents(mtime_ns=2), 20.0).since_s == 11.0
    assert seen.seen(contents(mtime_ns=2, inode=8), 21.0).since_s == 20.0
    assert seen.seen(contents(b"no", mtime_ns=2, inode=8), 22.0).since_s == 21.0
    assert seen.sight.writings == 3


def test_reappearing_file_counts_as_seen_for_the_first_time():
    seen = Changes()
    seen.seen(contents(), 1.0)
    seen.seen(contents(mtime_ns=2), 2.0)
    assert seen.unreadable("cannot be read").data is None
    assert seen.sight.since_s == float("-inf")
    assert seen.seen(contents(mtime_ns=3), 4.0).since_s == float("-inf")
    assert seen.seen(contents(mtime_ns=4), 5.0).since_s == 4.0


def test_hanging_check_does_not_make_an_old_permission_recent():
    """Written right after the look at 1 s, found by the one that hung until 11 s."""
    seen = Changes()
    seen.seen(contents(), 1.0)
    assert seen.seen(contents(mtime_ns=2), 1.1).since_s == 1.0
    assert seen.seen(contents(mtime_ns=3), 11.0).since_s == 1.1


class Host:
    """A clock that a test sets, and a file that it writes, with any time stamp."""

    def __init__(self):
        self.now_s, self.file, self.reading = 1000.0, contents(b"", 0), threading.Event()
        self.reading.set()
        self.looks = 0

    def read(self, _path, _most):
        self.reading.wait(PATIENCE_S)
        self.looks += 1
        return self.file

    def look(self):
        """Let it be looked at from now on, twice: one may be under way."""
        before = self.looks
        until(lambda: self.looks >= before + 2)


@pytest.fixture
def host():
    made = Host()
    yield made
    made.reading.set()


@pytest.fixture
def word(host, tmp_path):
    made = InterlockFile(tmp_path / "safe", 1.0, read=host.read, now_s=lambda: host.now_s)
    yield made
    made.close()


def test_permission_is_recent_for_a_limited_time_after_a_change(host, word):
    host.look()
    host.file = contents(b"safe", 1)
    until(word.safe)
    host.now_s += 0.9
    assert word.safe()
    host.now_s += 0.2
    assert not word.safe()
    host.look()
    host.file = contents(b"safe", 2)
    until(word.safe)
    host.file = contents(b"not", 3)
    until(lambda: not word.safe())


@pytest.mark.parametrize("stamp_ns", [10**30, -(10**18), 30 * 10**9])
def test_file_time_stamps_do_not_affect_a_permission(host, tmp_path, stamp_ns):
    host.file = contents(b"safe", stamp_ns)  # it lies there when the daemon starts
    word = InterlockFile(tmp_path / "safe", 1.0, read=host.read, now_s=lambda: host.now_s)
    host.look()
    for _ in range(50):  # whatever the clock says meanwhile
        host.now_s += 1.0
        assert not word.safe()
    host.look()
    host.file = contents(b"safe", stamp_ns + 1)
    until(word.safe)
    word.close()


def test_permission_from_before_the_start_does_not_count(tmp_path):
    path = tmp_path / "safe"
    path.write_text("safe")
    future = time.time() + 30.0
    os.utime(path, (future, future))
    word = InterlockFile(path, 1.0)
    until(lambda: word._watch.sight.data is not None)
    for _ in range(20):
        assert not word.safe()
        time.sleep(0.01)
    rewrite(path, "safe")
    until(word.safe)
    until(lambda: not word.safe())  # nobody wrote it again
    word.close()


def test_hanging_disk_does_not_block_and_ends_the_permission(host, word):
    host.look()
    host.file = contents(b"safe", 1)
    until(word.safe)
    host.reading.clear()
    before = time.monotonic()
    host.now_s += 1.5
    assert not word.safe()
    assert time.monotonic() - before < 10.0

    def said():
        host.now_s += 10.0
        return "does not answer: its disk hangs" in word.fault

    until(said)
    host.reading.set()


@pytest.mark.parametrize(("kind", "words"), ODD)
def test_errors_name_the_file_of_the_vehicle(tmp_path, kind, words):
    path = odd(tmp_path / "word", kind)
    word, columns = InterlockFile(path, 1.0), ColumnsFile(path)
    until(lambda: words in word.fault)
    until(lambda: words.replace("64", "4096") in columns.fault)
    assert not word.safe()
    assert columns.news() is None
    word.close()
    columns.close()


def test_columns_read_late_are_not_used(host, tmp_path):
    file = ColumnsFile(tmp_path / "columns", 0.5, read=host.read, now_s=lambda: host.now_s)
    host.file = contents(b'{"a": 1}', 1)
    until(lambda: file.news() == {"a": 1.0} or file._watch.sight.data == host.file.data)
    host.reading.clear()
    host.file = contents(b'{"a": 2}', 2)
    host.now_s += 3.0
    host.reading.set()
    host.look()
    assert file.news() is None
    host.file = contents(b'{"a": 3}', 3)
    until(lambda: file.news() == {"a": 3.0})
    file.close()


def test_file_checks_use_the_monotonic_clock(tmp_path):
    path = tmp_path / "word"
    path.write_text("1")
    watch = FileWatch(path, 64, 0.01)
    until(lambda: watch.sight.data == b"1")
    began_s = boot_s()
    rewrite(path, "2")
    until(lambda: watch.sight.writings == 1)
    assert began_s - 5.0 < watch.sight.since_s <= boot_s()
    watch.close()
