"""The serial port on ptys: locks and holders, hang-ups, full buffers, the search for the rate."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import stat
import subprocess
import sys
import termios
import threading
import time
import tty
from types import SimpleNamespace

import psutil
import pytest
from patience import PATIENCE_S

from drivers import serial_port
from drivers.serial_port import (
    BaudNotFound,
    Holder,
    PortAbsent,
    PortBusy,
    PortForbidden,
    PortLost,
    PortUnusable,
    SerialPort,
    detect_baud,
    holders,
    latency_timer_ms,
)

YMR = (
    b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,"
    b"-00.000018,+00.001122,-00.000551*69\r\n"
)  # fdcl-gwu/vectornav
MODEL_REPLY = b"$VNRRG,01,VN-200T-CR*31\r\n"  # fdcl-gwu/vectornav
MODEL_REQUEST = b"$VNRRG,01*72\r\n"


class Pty:
    """The device's end of a pty. `slave` stays open until `hang_up`, as an emulator's does."""

    def __init__(self):
        self.master, slave = os.openpty()
        self.path = os.ttyname(slave)
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.slave = slave

    def rate(self):
        speed = termios.tcgetattr(self.master)[4]
        return {getattr(termios, f"B{b}"): b for b in (9600, 57600, 115200, 230400, 921600)}.get(
            speed
        )

    def received(self):
        try:
            return os.read(self.master, 4096)
        except BlockingIOError:
            return b""

    def hang_up(self):
        for descriptor in (self.slave, self.master):
            with contextlib.suppress(OSError):
                os.close(descriptor)


@pytest.fixture
def pty():
    pty = Pty()
    yield pty
    pty.hang_up()


@contextlib.contextmanager
def another_program(path, code):
    """A process that opens `path` as `fd`, runs `code` and stays."""
    script = (
        "import os, sys, fcntl, termios, time\n"
        "fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)\n"
        f"{code}\nprint('ready', flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script, path], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        try:
            yield process.pid
        finally:
            process.kill()


def test_bytes_are_transferred_in_both_directions(pty):
    with SerialPort(pty.path, 115200) as port:
        assert port.read() == b""
        os.write(pty.master, YMR)
        assert port.wait_readable(1.0)
        assert port.read() == YMR
        port.write(b"\x00\xfa$\r\n\xff")
        time.sleep(0.01)
        assert pty.received() == b"\x00\xfa$\r\n\xff"
        assert port.baud == pty.rate() == 115200
        port.set_baud(921600)
        assert port.baud == pty.rate() == 921600


def test_an_absent_port_is_one_clear_line():
    with pytest.raises(PortAbsent) as caught:
        SerialPort("/dev/ttyVN100-absent", 115200)
    assert "/dev/ttyVN100-absent does not exist" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_port_of_many_names_the_first_three():
    others = tuple(Holder(number, "gpsd") for number in range(1, 6))
    assert str(PortBusy("/dev/x", others)) == (
        "/dev/x is in use by process 1 (gpsd), process 2 (gpsd), process 3 (gpsd) and 2 more: "
        "stop it first"
    )


def test_a_file_is_no_serial_port(tmp_path):
    file = tmp_path / "recording.log"
    file.write_bytes(YMR)
    with pytest.raises(PortUnusable, match=r"recording\.log cannot be opened as a serial port"):
        SerialPort(file, 115200)
    assert file.read_bytes() == YMR


@pytest.mark.parametrize(
    "lock",
    [
        "fcntl.flock(fd, fcntl.LOCK_EX)",
        "fcntl.ioctl(fd, termios.TIOCEXCL)",
        "pass",
    ],
)
def test_port_in_use_is_refused_with_its_holder(pty, lock):
    settings = termios.tcgetattr(pty.master)
    with another_program(pty.path, lock) as pid:
        with pytest.raises(PortBusy) as caught:
            SerialPort(pty.path, 9600)
        assert [holder.pid for holder in caught.value.holders] == [pid]
        assert f"process {pid} (" in str(caught.value)
        assert "python" in str(caught.value)
        assert termios.tcgetattr(pty.master) == settings
    SerialPort(pty.path, 115200).close()


def test_second_opening_by_the_same_process_is_refused(pty):
    with SerialPort(pty.path, 115200), pytest.raises(PortBusy, match="in use"):
        SerialPort(pty.path, 115200)
    SerialPort(pty.path, 115200).close()


def test_both_locks_are_held_and_released(pty):
    def flag():
        return fcntl.ioctl(pty.slave, 0x80045440, b"\0\0\0\0")[0]

    other = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    try:
        with SerialPort(pty.path, 115200):
            assert flag() == 1
            with pytest.raises(BlockingIOError):
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert flag() == 0
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(other)


def test_server_of_a_pty_is_not_a_holder():
    serve = (
        "import os, time\nm, s = os.openpty()\nprint(os.ttyname(s), flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", serve], stdout=subprocess.PIPE) as process:
        path = process.stdout.readline().decode().strip()
        try:
            assert holders(path) == ()
            SerialPort(path, 115200).close()
        finally:
            process.kill()


def test_hang_up_is_link_lost_for_reading_and_writing(pty):
    port = SerialPort(pty.path, 115200)
    pty.hang_up()
    assert port.wait_readable(1.0)
    with pytest.raises(PortLost, match=pty.path):
        port.read()
    with pytest.raises(PortLost):
        port.write(b"$VNRRG,01*72\r\n")
    port.close()
    port.close()
    with pytest.raises(PortLost):
        port.read()


def test_write_waits_for_a_slow_reader_up_to_a_limit(pty):
    data = os.urandom(100_000)
    taken = bytearray()

    def slow_reader():
        os.set_blocking(pty.master, True)
        while len(taken) < len(data):
            taken.extend(os.read(pty.master, 4096))

    with SerialPort(pty.path, 115200) as port:
        reader = threading.Thread(target=slow_reader)
        reader.start()
        port.write(data, timeout_s=20.0)
        reader.join(PATIENCE_S)
        assert bytes(taken) == data
        begin_s = time.monotonic()
        with pytest.raises(PortLost, match="of 200000 bytes"):
            port.write(bytes(200_000), timeout_s=0.2)
        assert 0.15 < time.monotonic() - begin_s < 60.0


def test_opening_and_losing_a_port_leaks_nothing():
    def cycle():
        pty = Pty()
        port = SerialPort(pty.path, 115200)
        pty.hang_up()
        with pytest.raises(PortLost):
            while True:
                port.wait_readable(1.0)
                port.read()
        port.close()

    process = psutil.Process()
    cycle()
    before = process.num_fds(), process.num_threads()
    for _ in range(30):
        cycle()
    assert (process.num_fds(), process.num_threads()) == before


class Device(threading.Thread):
    """Talks at one rate; at any other the line carries garbage. Answers the model request."""

    def __init__(self, pty, rate, *, streams=True, answers=True, garbage=b"\xe0\x8c\xfa\x7f\x03"):
        super().__init__(daemon=True)
        self.pty, self.right, self.streams, self.answers = pty, rate, streams, answers
        self.garbage, self.heard, self.stop = garbage, b"", threading.Event()

    def run(self):
        while not self.stop.wait(0.01):
            right = self.pty.rate() == self.right
            self.heard += self.pty.received()
            answer = b""
            if right and self.answers and MODEL_REQUEST in self.heard:
                answer, self.heard = MODEL_REPLY, b""
            stream = (YMR if right else self.garbage * 20) if self.streams else b""
            with contextlib.suppress(BlockingIOError):
                os.write(self.pty.master, answer + stream)


@contextlib.contextmanager
def device(pty, rate, **options):
    thread = Device(pty, rate, **options)
    thread.start()
    try:
        yield thread
    finally:
        thread.stop.set()
        thread.join()


def test_the_last_good_rate_is_tried_first(pty):
    with device(pty, 230400) as talking:
        found = detect_baud(pty.path, last_good=230400, configured=57600)
    assert found.baud == 230400
    assert found.why == "heard at 230400 baud, the last good rate"
    assert [heard.baud for heard in found.tried] == [230400]
    assert talking.heard == b""


def test_right_rate_is_found_by_listening(pty):
    with device(pty, 921600) as talking:
        found = detect_baud(pty.path, configured=57600, may_query=True)
    assert found.baud == 921600
    assert [heard.baud for heard in found.tried] == [57600, 115200, 921600]
    assert all(heard.received > 100 for heard in found.tried)
    assert [heard.messages > 0 for heard in found.tried] == [False, False, True]
    assert talking.heard == b""


def test_silent_device_is_queried_only_if_permitted(pty):
    with device(pty, 57600, streams=False) as talking:
        with pytest.raises(BaudNotFound) as caught:
            detect_baud(pty.path, 57600, listen_s=0.03)
        assert caught.value.silent
        assert "57600: silence" in str(caught.value)
        assert talking.heard == b""
        found = detect_baud(pty.path, 115200, 57600, may_query=True)
    assert found.baud == 57600
    assert found.why == "an answer came at 57600 baud, the configured rate"


def test_garbage_is_distinguished_from_silence(pty):
    with device(pty, 0) as talking, pytest.raises(BaudNotFound) as caught:
        detect_baud(pty.path, listen_s=0.05)
    assert not caught.value.silent
    assert len(caught.value.tried) == 9
    assert "bytes arrive but no message" in str(caught.value)
    assert talking.heard == b""


def test_rate_that_the_adapter_lacks_is_skipped(pty, monkeypatch):
    real = SerialPort.set_baud

    def cannot(port, baud):
        if baud == 115200:
            raise PortUnusable("no 115200")
        real(port, baud)

    monkeypatch.setattr(SerialPort, "set_baud", cannot)
    with device(pty, 921600):
        found = detect_baud(pty.path, listen_s=0.2)
    assert [heard.baud for heard in found.tried] == [921600]


def test_latency_timer_is_read_if_present(tmp_path):
    folder = tmp_path / "class" / "tty" / "ttyUSB7" / "device"
    folder.mkdir(parents=True)
    (folder / "latency_timer").write_text("16\n")
    assert latency_timer_ms("/dev/ttyUSB7", tmp_path) == 16
    assert latency_timer_ms("/dev/ttyUSB8", tmp_path) is None
    (folder / "latency_timer").write_text("soon\n")
    assert latency_timer_ms("/dev/ttyUSB7", tmp_path) is None


def test_a_pty_has_no_latency_timer(pty):
    assert latency_timer_ms(pty.path) is None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes device nodes")
def test_a_pty_of_the_same_number_elsewhere_is_no_holder(tmp_path):
    """A container counts its ptys from 0 as well: what is open there is another device."""
    master, slave = os.openpty()
    try:
        path = os.ttyname(slave)
        os.mknod(tmp_path / "elsewhere", stat.S_IFCHR | 0o600, os.fstat(slave).st_rdev)
        for pid, node in (("7", path), ("8", str(tmp_path / "elsewhere"))):
            (tmp_path / "proc" / pid / "fd").mkdir(parents=True)
            (tmp_path / "proc" / pid / "fd" / "3").symlink_to(node)
            (tmp_path / "proc" / pid / "cmdline").write_bytes(b"minicom\0")
        assert [holder.pid for holder in holders(path, tmp_path / "proc")] == [7]
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    ("mode", "member", "advice"),
    [
        (0o660, False, "join its group: sudo usermod -aG dialout ada, then log in again"),
        (0o660, True, "you are in its group dialout since you logged in: log in again"),
        (0o600, False, "no group may open it: give it to one by a udev rule"),
    ],
)
def test_no_permission_names_the_group_to_join(monkeypatch, tmp_path, mode, member, advice):
    port = tmp_path / "ttyUSB0"
    port.write_bytes(b"")
    port.chmod(mode)
    group = grp.struct_group(("dialout", "x", 20, ["ada"] if member else []))
    status = os.stat_result((0o020000 | mode, 0, 0, 1, 0, 20, 0, 0, 0, 0), {"st_rdev": 0x403})
    monkeypatch.setattr(serial_port.grp, "getgrgid", lambda _: group)
    monkeypatch.setattr(serial_port.os, "getgroups", lambda: [1000])
    ada = SimpleNamespace(pw_name="ada")
    monkeypatch.setattr(serial_port.pwd, "getpwuid", lambda _: ada)
    monkeypatch.setattr(serial_port.Path, "stat", lambda _: status)
    monkeypatch.setattr(serial_port, "holders", lambda _: ())

    def refused(*_):
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(serial_port.os, "open", refused)
    with pytest.raises(PortForbidden) as caught:
        SerialPort(port, 115200)
    assert str(caught.value) == f"{port}: no permission; {advice}"
