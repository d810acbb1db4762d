"""Shared ports as seen by programs: opened, closed, killed, blocked, flooding, or with an
occupied name.
"""

from __future__ import annotations

import fcntl
import os
import select
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cabled_units import sentence
from patience import PATIENCE_S

from ahrsd.config.sections import ShareSection
from ahrsd.daemon.shares import SharedPorts, Shares
from ahrsd.errors import ConfigError
from ahrsd.events import SendToClient
from ahrsd.inputs import ClientLeft, ClientSent

TEXT = sentence("VNYMR,+006.271,+000.031,-002.000,+0.2,-0.1,+0.4,+0.1,-0.2,-9.8,+0.1,+0.2,+0.3")


class Program:
    """A driver on a shared port."""

    def __init__(self, path: Path) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def read(self, wanted: int, longest_s: float = PATIENCE_S) -> bytes:
        got, end_s = b"", time.monotonic() + longest_s
        while len(got) < wanted and time.monotonic() < end_s:
            if select.select([self.fd], [], [], 0.05)[0]:
                got += os.read(self.fd, 65536)
        return got

    def close(self) -> None:
        os.close(self.fd)


class Shared:
    """Two ports, and the bytes received from the programs on them."""

    def __init__(self, folder: Path) -> None:
        self.paths = [folder / "vn100", folder / "log"]
        self.said: list[ClientSent | ClientLeft] = []
        shares = [ShareSection(pty=path, owner=path.name == "vn100") for path in self.paths]
        self.ports = Shares(shares, self.said.append, time.monotonic_ns)

    def opened(self, number: int = 0) -> Program:
        program = Program(self.paths[number])
        until(lambda: self.ports.facts()[number].readers)
        return program

    def text(self, number: int = 0) -> str:
        name = str(self.paths[number])
        return "".join(
            it.text for it in list(self.said) if isinstance(it, ClientSent) and it.client == name
        )


def until(what: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.005)


@pytest.fixture
def shared(tmp_path: Path) -> Iterator[Shared]:
    shared = Shared(tmp_path)
    yield shared
    shared.ports.close()
    assert not any(os.path.lexists(path) for path in shared.paths)


def test_measurements_go_to_all_programs_and_an_answer_to_one(shared):
    one, two = shared.opened(0), shared.opened(1)
    shared.ports.heard(TEXT[:20])
    shared.ports.heard(TEXT[20:] + sentence("VNRRG,23,1") + TEXT)
    shared.ports.send(SendToClient(str(shared.paths[0]), sentence("VNRRG,01,VN-100")))
    answer = sentence("VNRRG,01,VN-100")
    assert one.read(2 * len(TEXT) + len(answer)) == TEXT + TEXT + answer
    assert two.read(2 * len(TEXT)) == TEXT + TEXT
    os.write(one.fd, b"$VNRRG,0")
    os.write(one.fd, b"1*72\r\n")
    until(lambda: shared.text(0) == "$VNRRG,01*72\r\n")
    assert shared.text(1) == ""
    one.close()
    two.close()


def test_port_is_in_raw_mode_before_it_is_opened(shared):
    """Echo would send the stream back as commands, and a newline would become two characters."""
    one = shared.opened()
    shared.ports.heard(b"".join(bytes([k]) for k in range(256)) + TEXT)
    assert one.read(256 + len(TEXT)) == bytes(range(256)) + TEXT
    time.sleep(0.2)
    assert shared.text() == ""
    one.close()


def test_program_that_paused_its_output_gets_only_answers(shared):
    one, name = shared.opened(), str(shared.paths[0])
    shared.ports.send(SendToClient(name, b"$VNASY,0*4F\r\n", stream=False))
    shared.ports.heard(TEXT)
    shared.ports.send(SendToClient(name, b"$VNASY,1*4E\r\n", stream=True))
    shared.ports.heard(TEXT)
    assert one.read(26 + len(TEXT)) == b"$VNASY,0*4F\r\n$VNASY,1*4E\r\n" + TEXT
    one.close()


def test_port_reopened_at_once_is_the_same(shared):
    """As by a driver that changes its baud rate."""
    one = shared.opened()
    target = shared.paths[0].readlink()
    one.close()
    again = Program(shared.paths[0])
    assert shared.paths[0].readlink() == target
    until(lambda: shared.ports.facts()[0].readers)
    shared.ports.heard(TEXT)
    assert TEXT in again.read(len(TEXT))
    again.close()
    until(lambda: any(isinstance(it, ClientLeft) for it in shared.said))


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to be another user")
def test_name_stays_usable_after_a_program_is_killed(shared):
    """TIOCEXCL of the dead program stays with its pty, so a new one is made after a while."""
    target = shared.paths[0].readlink()
    target.chmod(0o666)
    code = (
        "import os,sys,fcntl,termios,time\n"
        "os.setuid(65534)\nfd=os.open(sys.argv[1],os.O_RDWR|os.O_NOCTTY)\n"
        "fcntl.ioctl(fd,termios.TIOCEXCL)\nprint('mine',flush=True)\ntime.sleep(60)\n"
    )
    command = [sys.executable, "-c", code, str(target)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"mine\n"
        until(lambda: shared.ports.facts()[0].readers)
        first.kill()
    until(lambda: shared.paths[0].readlink() != target)
    again = shared.opened()
    fcntl.ioctl(again.fd, termios.TIOCEXCL)
    shared.ports.heard(TEXT)
    assert again.read(len(TEXT)) == TEXT
    again.close()


def test_blocked_program_loses_only_its_own_messages(shared):
    idle, reader = shared.opened(0), shared.opened(1)
    got = b""
    for _ in range(2000):
        shared.ports.heard(TEXT)
        got += reader.read(len(TEXT))
    assert got == TEXT * 2000
    lost = [fact.lost_bytes for fact in shared.ports.facts()]
    assert lost[1] == 0
    assert len(idle.read(1 << 20, 1.0)) == len(got) - lost[0] > 0
    idle.close()
    reader.close()


def test_slow_reader_gets_whole_messages(shared):
    slow = shared.opened()
    for _ in range(4000):
        shared.ports.heard(TEXT)
    got = slow.read(1 << 20, 1.0)
    assert got == TEXT * (len(got) // len(TEXT))
    slow.close()


def test_flood_is_throttled_to_the_rate_of_a_real_line(shared):
    one = shared.opened()
    os.set_blocking(one.fd, False)
    begun_s, sent = time.monotonic(), 0
    while time.monotonic() - begun_s < 1.5:
        try:
            sent += os.write(one.fd, b"x" * 1000)
        except BlockingIOError:
            time.sleep(0.001)
    took_s = time.monotonic() - begun_s
    assert 1000 < len(shared.text()) <= 4096 + 11_520 * (took_s + 0.1)
    one.close()


@pytest.mark.parametrize("what", ["file", "folder", "link to a file"])
def test_occupied_name_is_refused_and_kept(tmp_path, what):
    path = tmp_path / "vn100"
    if what == "file":
        path.write_text("mine")
    elif what == "folder":
        path.mkdir()
    else:
        (tmp_path / "other").write_text("mine")
        path.symlink_to(tmp_path / "other")
    with pytest.raises(ConfigError, match="something of that name"):
        SharedPorts([ShareSection(pty=path)], print, time.monotonic_ns)
    assert os.path.lexists(path)


@pytest.mark.parametrize("raw", [True, False])
def test_link_to_a_live_pty_is_kept_only_if_it_is_a_raw_port(tmp_path, raw):
    """It may be a device on a pty, or a terminal that reuses the number of a killed program's
    pty.
    """
    master, slave = os.openpty()
    if raw:
        tty.setraw(slave)
    path = tmp_path / "vn100"
    path.symlink_to(os.ttyname(slave))
    os.close(slave)
    if raw:
        with pytest.raises(ConfigError, match="something of that name"):
            SharedPorts([ShareSection(pty=path)], print, time.monotonic_ns)
    else:
        SharedPorts([ShareSection(pty=path)], print, time.monotonic_ns).close()
    assert os.path.lexists(path) == raw
    os.close(master)


def test_link_of_a_killed_run_whose_number_came_again_is_replaced(tmp_path):
    """The pty of that number is another program's raw port by now, and younger than the link."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = tmp_path / "vn100"
    path.symlink_to(os.ttyname(slave))
    before_s = os.fstat(slave).st_ctime - 60.0
    os.utime(path, (before_s, before_s), follow_symlinks=False)
    ports = SharedPorts([ShareSection(pty=path)], print, time.monotonic_ns)
    assert str(path.readlink()) != os.ttyname(slave)
    ports.close()
    os.close(slave)
    os.close(master)


def test_name_taken_during_the_run_is_reported_and_other_ports_continue(shared, caplog):
    one = shared.opened(0)
    shared.paths[0].unlink()
    shared.paths[0].write_text("theirs")
    one.close()
    until(lambda: shared.ports.facts()[0].fault)
    assert "something of that name" in shared.ports.facts()[0].fault
    two = shared.opened(1)
    shared.ports.heard(TEXT)
    assert two.read(len(TEXT)) == TEXT
    os.write(two.fd, b"$VNRRG,01*72\r\n")
    until(lambda: shared.text(1))
    shared.paths[0].unlink()
    until(lambda: not shared.ports.facts()[0].fault)
    shared.opened(0).close()
    two.close()
    assert caplog.text.count("something of that name") == 1


@pytest.mark.parametrize("taker", ["another run", "a file", "nobody"])
def test_name_taken_by_another_program_is_not_removed(tmp_path, taker):
    path = tmp_path / "vn100"
    ports = SharedPorts([ShareSection(pty=path)], print, time.monotonic_ns)
    path.unlink()
    if taker == "another run":
        path.symlink_to("/dev/pts/99999")
    elif taker == "a file":
        path.write_text("theirs")
    ports.close()
    assert os.path.lexists(path) == (taker != "nobody")


def test_port_renewed_after_a_program_left_is_removed_at_the_end(shared):
    target = shared.paths[0].readlink()
    shared.opened().close()
    until(lambda: shared.paths[0].readlink() != target)
    shared.ports.close()
    assert not os.path.lexists(shared.paths[0])


def test_remains_of_a_killed_run_are_replaced(tmp_path):
    (tmp_path / "vn100").symlink_to("/dev/pts/99999")
    shared = Shared(tmp_path)
    one = shared.opened()
    shared.ports.heard(TEXT)
    assert one.read(len(TEXT)) == TEXT
    one.close()
    shared.ports.close()


@pytest.mark.parametrize(
    ("share", "words"),
    [
        ({"pty": Path("/nowhere/vn100")}, "No such file or directory; the folder must exist"),
        ({"pty": Path("/proc/vn100")}, "the folder must exist and be the daemon's to write"),
        ({"group": "no such group"}, "there is no group no such group"),
    ],
)
def test_impossible_port_is_a_one_line_error(tmp_path, share, words):
    good = ShareSection(pty=tmp_path / "good")
    with pytest.raises(ConfigError) as error:
        SharedPorts(
            [good, ShareSection(**{"pty": tmp_path / "bad", **share})], print, time.monotonic_ns
        )
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not os.path.lexists(tmp_path / "good")  # nothing remains
