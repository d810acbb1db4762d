"""`ahrsd watch` on a real terminal of 80x24: what it draws, and its keys."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from patience import PATIENCE_S

from ahrsd.errors import EXIT_BUSY
from ahrsd.telemetry.unix_socket import SocketServer

STATUS = Path(__file__).parents[1] / "page" / "gathering.json"


@pytest.fixture
def terminal(tmp_path):
    """What `watch` draws until a condition holds, and a way to press keys."""
    server = SocketServer(tmp_path / "socket")
    status = json.loads(STATUS.read_text())
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    before = termios.tcgetattr(theirs)
    process = subprocess.Popen(
        [sys.executable, "-m", "ahrsd", "watch", "--state-directory", str(tmp_path)],
        stdin=theirs, stdout=theirs, stderr=theirs,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "", "LINES": ""},
    )  # fmt: skip

    def drawn(pattern: str) -> str:
        text, end_s = "", time.monotonic() + PATIENCE_S
        while not re.search(pattern, text):
            assert time.monotonic() < end_s, f"{pattern!r} was not drawn: {text[-3000:]}"
            for _ in range(20):  # faster than a terminal draws
                status["at_s"] += 1.0
                server.status(status)
            if select.select([ours], [], [], 0.2)[0]:
                text += os.read(ours, 1 << 16).decode(errors="replace")
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)

    drawn.server = server
    yield drawn, lambda keys: os.write(ours, keys), process
    process.kill()
    process.wait()
    assert termios.tcgetattr(theirs) == before  # echo and lines are back
    os.close(ours)
    os.close(theirs)
    server.close()


def test_watch_fits_scrolls_and_ends_by_a_key(terminal):
    drawn, press, process = terminal
    text = drawn("arrows scroll, q ends")
    assert "0 of 2 held-out segments are usable" in text
    assert "heading: " in text
    assert "40 of 49 gates are green" in text
    assert re.search(r"lines 1-23 of \d+", text)
    press(b"\x1b[B")
    drawn(r"lines 2-24 of \d+")
    press(b"\x1b[6~")
    assert "stream: " in drawn(r"-(\d+) of \1:")
    press(b"q")
    assert process.wait(PATIENCE_S) == 0


def test_keys_count_one_by_one_however_they_come_and_while_records_pour(terminal):
    drawn, press, process = terminal
    drawn("arrows scroll, q ends")
    press(b"\x1b[B\x1b[B\x1b[Aj")  # a key held down: several in one piece
    drawn(r"lines 3-25 of \d+")
    press(b"\x1b")
    drawn(r"lines 3-25 of \d+")
    press(b"[A")  # a slow line: one key in two pieces
    drawn(r"lines 2-24 of \d+")
    press(b"q")
    assert process.wait(PATIENCE_S) == 0


def test_watch_reports_the_end_of_the_daemon_and_ends(terminal):
    drawn, _, process = terminal
    drawn("arrows scroll, q ends")
    drawn.server.close()
    assert process.wait(PATIENCE_S) == EXIT_BUSY
