"""The blocking device on a pty: results, gate, tap, timeouts, Ctrl-C, a port that goes away."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty

import pytest
from patience import PATIENCE_S

from drivers.serial_port import PortLost, SerialPort
from drivers.vn100.commands import (
    NoReply,
    NotPermitted,
    Pause,
    Word,
    Write,
    identify,
    quiet,
    read,
    write_verified,
)
from drivers.vn100.decode import Measurement
from drivers.vn100.device import Device, TookTooLong
from drivers.vn100.session import DeviceFault

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
YMR = (
    b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,"
    b"-00.000018,+00.001122,-00.000551*69\r\n"
)
SCRIPT = {
    b"$VNRRG,04*77": b"$VNRRG,04,3.1.0.0*77\r\n",
    b"$VNRRG,01*72": b"$VNRRG,01,VN-200T-CR*31\r\n",
    b"$VNRRG,23*72": b"$VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0*73\r\n",
    b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76": b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76\r\n",
    b"$VNASY,0*4F": b"$VNASY,0*4F\r\n",
    b"$VNASY,1*4E": b"$VNASY,1*4E\r\n",
}


class Scripted(threading.Thread):
    """Answers from SCRIPT, a measurement before and behind each answer."""

    def __init__(self):
        super().__init__(daemon=True)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.heard = []
        self.script = dict(SCRIPT)
        self.hang_up_on = b"\0"

    def run(self):
        pending = b""
        with contextlib.suppress(OSError):
            while True:
                *lines, pending = (pending + os.read(self.master, 4096)).split(b"\r\n")
                for line in lines:
                    self.heard.append(line)
                    if line == self.hang_up_on:
                        self.close()
                    os.write(self.master, YMR + self.script.get(line, b"") + YMR)

    def close(self):
        """Once for each end: a number that is closed belongs to whoever opens something next."""
        slave, self.slave = self.slave, -1
        if slave >= 0:
            os.close(slave)
        if threading.current_thread() is not self:
            self.join(5.0)  # no other end: its read ends, and eats nothing of the next test
        master, self.master = self.master, -1
        if master >= 0:
            os.close(master)


@pytest.fixture
def scripted():
    thread = Scripted()
    thread.start()
    yield thread
    thread.close()


def everything(command):
    return True


def test_a_read_returns_its_values_and_the_tap_sees_every_byte(scripted):
    tapped, events = [], []
    tap = lambda direction, host_ns, data: tapped.append((direction, host_ns, data))  # noqa: E731
    with Device(SerialPort(scripted.path, 115200), tap=tap, on_event=events.append) as device:
        assert device.run(read(23)) == IDENTITY
        assert device.run(read(4)) == ("3.1.0.0",)
    sent = b"".join(data for direction, _, data in tapped if direction == "tx")
    assert sent == b"$VNRRG,23*72\r\n$VNRRG,04*77\r\n"
    received = b"".join(data for direction, _, data in tapped if direction == "rx")
    assert SCRIPT[b"$VNRRG,23*72"] in received
    times = [host_ns for _, host_ns, _ in tapped]
    assert times == sorted(times)
    assert events
    assert all(isinstance(event, Measurement) for event in events)


def test_only_reads_are_permitted_by_default(scripted):
    with Device(SerialPort(scripted.path, 115200)) as device:
        for procedure in (write_verified(23, IDENTITY), quiet(read(23))):
            with pytest.raises(NotPermitted):
                device.run(procedure)
    time.sleep(0.05)
    assert scripted.heard == []


def test_a_verified_write_leaves_the_output_on(scripted):
    with Device(SerialPort(scripted.path, 115200), everything) as device:
        assert device.run(quiet(write_verified(23, IDENTITY))) == IDENTITY
    assert scripted.heard[0] == b"$VNASY,0*4F"
    assert scripted.heard[-1] == b"$VNASY,1*4E"


def test_a_silent_device_is_no_reply(scripted):
    scripted.script.clear()
    with (
        Device(SerialPort(scripted.path, 921600)) as device,
        pytest.raises(NoReply, match="no reply to read of register 1"),
    ):
        device.run(identify())


def hang(seconds):
    yield Pause(seconds)


def test_timeout_cancels_the_procedure_and_resumes_the_output(scripted):
    with Device(SerialPort(scripted.path, 115200), everything) as device:
        begin_s = time.monotonic()
        with pytest.raises(TookTooLong, match=r"0\.2 s"):
            device.run(quiet(hang(60.0)), timeout_s=0.2)
        assert time.monotonic() - begin_s < 55.0  # and not the minute of the procedure
        assert scripted.heard == [b"$VNASY,0*4F", b"$VNASY,1*4E"]
        assert device.run(read(4)) == ("3.1.0.0",)


def test_ctrl_c_resumes_the_output_before_it_goes_on(scripted):
    def press(event):
        if isinstance(event, Measurement) and b"$VNRRG,23*72" in scripted.heard and not pressed:
            pressed.append(True)
            raise KeyboardInterrupt

    pressed = []
    scripted.script[b"$VNRRG,23*72"] = b""
    with Device(SerialPort(scripted.path, 115200), everything, on_event=press) as device:
        with pytest.raises(KeyboardInterrupt):
            device.run(quiet(read(23)))
        until_s = time.monotonic() + PATIENCE_S  # the other end reads in a thread of its own
        while scripted.heard[-1] != b"$VNASY,1*4E" and time.monotonic() < until_s:
            time.sleep(0.01)
        assert scripted.heard[-1] == b"$VNASY,1*4E"


def test_interrupted_clean_up_resumes_the_output(scripted):
    def impatient(event):
        if isinstance(event, Measurement) and len(scripted.heard) >= 2 and len(pressed) < 2:
            pressed.append(True)
            raise KeyboardInterrupt

    pressed = []
    scripted.script[b"$VNRRG,23*72"] = b""
    with (
        pytest.raises(KeyboardInterrupt),
        Device(SerialPort(scripted.path, 115200), everything, on_event=impatient) as device,
    ):
        device.run(quiet(read(23)))
    time.sleep(0.05)
    assert len(pressed) == 2
    assert scripted.heard[-1] == b"$VNASY,1*4E"


def test_a_port_that_goes_away_ends_the_run_at_once(scripted):
    scripted.hang_up_on = b"$VNRRG,23*72"
    with (
        pytest.raises(PortLost, match="is gone"),
        Device(SerialPort(scripted.path, 115200), everything) as device,
    ):
        device.run(quiet(read(23)))
    assert scripted.heard == [b"$VNASY,0*4F", b"$VNRRG,23*72"]


def test_faults_reach_the_caller(scripted):
    events = []
    scripted.script[b"$VNRRG,23*72"] = b"$VNERR,0A*00\r\n" + SCRIPT[b"$VNRRG,23*72"]
    with Device(SerialPort(scripted.path, 115200), on_event=events.append) as device:
        device.run(read(23))
    assert DeviceFault(0x0A) in events


def test_commands_have_readable_names():
    assert str(Word("VNASY", (0,))) == "VNASY,0"
    assert str(Write(23, IDENTITY)) == "write of register 23"
