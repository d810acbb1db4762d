"""The emulated device on a pseudo-terminal, as hosts open it."""

import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
import serial
from patience import PATIENCE_S

from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import EmulatedTruth, make_motion
from drivers.vn100.emulator.pty import OVERRUN_BYTES, EmulatorProcess, Line, PtyEmulator
from drivers.vn100.emulator.scenarios import Setup

STREAM = {5: (921600,), 6: (0,), 75: (1, 4, 1, 0x0001)}  # TimeStartup at 200 Hz, 14 bytes
READ_07, REPLY_07 = b"$VNRRG,07*74\r\n", b"$VNRRG,07,40*5C\r\n"


def emulator(*faults, presets=None) -> Emulator:
    presets = {6: (0,)} if presets is None else presets
    return Emulator(EmulatedTruth(), make_motion("static", 0), faults=faults, presets=presets)


def opened(path: str, baud: int = 115200) -> serial.Serial:
    return serial.Serial(path, baud, timeout=2.0)


def stamps(wire: bytes) -> list[int]:
    """TimeStartup of packets that follow each other without a gap between bytes."""
    start = wire.index(b"\xfa\x01\x01\x00")
    whole = range(start, len(wire) - 13, 14)
    assert all(wire[at : at + 4] == b"\xfa\x01\x01\x00" for at in whole)
    return [struct.unpack_from("<Q", wire, at + 4)[0] for at in whole]


def until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


def test_commands_are_answered_and_output_streams():
    with PtyEmulator(emulator()) as served, opened(served.path) as host:
        host.write(READ_07)
        assert host.read_until(b"\n") == REPLY_07
        host.write(b"$VNWRG,75,1,8,01,0001*XX\r\n")
        assert host.read_until(b"\n").startswith(b"$VNWRG,75,1,8,01,0001*")
        began = time.monotonic()
        times = stamps(host.read(14 * 50))
        assert time.monotonic() - began > 0.4
        assert all(abs(b - a - 10e6) < 30e3 for a, b in pairwise(times))


def test_new_host_gets_no_echo_and_no_old_bytes():
    with PtyEmulator(emulator(presets=STREAM)) as served:
        time.sleep(0.3)
        with opened(served.path, 921600) as host:
            first = stamps(host.read(14 * 20))
            assert first[0] / 1e9 > 0.25
        assert served.emulator.counters["commands"] == 0


def test_wrong_rate_garbles_both_directions_until_it_is_right():
    with PtyEmulator(emulator()) as served, opened(served.path, 9600) as host:
        host.timeout = 0.3
        host.write(READ_07)
        assert REPLY_07 not in host.read(64)
        host.baudrate = 115200
        host.write(b"\n" + READ_07)
        assert host.read_until(REPLY_07).endswith(REPLY_07)
        host.write(b"$VNWRG,05,128000*XX\r\n")
        assert host.read_until(b"\n").startswith(b"$VNWRG,05,128000*")
        until(lambda: served.emulator.baud == 128000)
        host.write(READ_07)
        assert REPLY_07 not in host.read(64)
        host.baudrate = 128000
        host.write(b"\n" + READ_07)
        assert host.read_until(REPLY_07).endswith(REPLY_07)


def test_baud_rate_can_be_ignored():
    with PtyEmulator(emulator(), check_baud=False) as served, opened(served.path, 9600) as host:
        host.write(READ_07)
        assert host.read_until(b"\n") == REPLY_07


def test_a_host_that_configures_nothing_gets_a_raw_line():
    with PtyEmulator(emulator(presets={7: (50,)})) as served:
        descriptor = os.open(served.path, os.O_RDWR | os.O_NOCTTY)
        try:
            line = b""
            while line.count(b"\n") < 3:
                line += os.read(descriptor, 500)
        finally:
            os.close(descriptor)
        assert line.startswith(b"$VNYMR,") and b"\r\n$VNYMR," in line
        assert served.emulator.counters["commands"] == 0


def test_the_link_follows_unplug_and_replug(tmp_path):
    link = tmp_path / "vn100"
    served = PtyEmulator(emulator("unplug@0.5+0.3"), link=link)
    with served:
        assert served.path == str(link)
        first = link.readlink()
        host = opened(str(link))
        until(lambda: not link.is_symlink())
        with pytest.raises((serial.SerialException, OSError)):
            for _ in range(100):
                host.read(1)
                host.write(b"\n")
        host.close()
        until(link.is_symlink)
        with opened(str(link)) as again:
            time.sleep(0.7)
            again.write(READ_07)
            assert again.read_until(b"\n") == REPLY_07
    assert not link.is_symlink()
    assert first.name.isdecimal()


def test_a_file_in_the_place_of_the_link_is_not_touched(tmp_path):
    (tmp_path / "vn100").write_text("mine")
    with pytest.raises(FileExistsError, match="choose another --link"):
        PtyEmulator(emulator(), link=tmp_path / "vn100")
    assert (tmp_path / "vn100").read_text() == "mine"


def test_lossless_keeps_step_with_a_slow_reader():
    with PtyEmulator(emulator(presets=STREAM), speed=50.0, lossless=True) as served:
        with opened(served.path, 921600) as host:
            wire = b""
            while len(wire) < 14 * 4000:
                wire += host.read(200)
                if len(wire) % 2800 == 0:
                    time.sleep(0.01)
            times = stamps(wire)
            assert max(b - a for a, b in pairwise(times)) < 5.1e6
            time.sleep(0.3)  # not reading: time stands still
            ahead_s = served.device_s - times[-1] / 1e9
            assert ahead_s < 2.0
        assert served.overrun_bytes == 0


def test_lossless_port_can_be_opened_again_after_exclusive_use():
    with PtyEmulator(emulator(), lossless=True) as served:
        for _ in range(2):
            with serial.Serial(served.path, 115200, timeout=2.0, exclusive=True) as host:
                host.write(READ_07)
                assert host.read_until(b"\n") == REPLY_07


def test_a_port_that_stays_locked_is_replaced(tmp_path, monkeypatch):
    """Exclusive use outlives a killed host on a pty; only root could open it again."""
    monkeypatch.setattr(Line, "free", lambda self: False)
    said = []
    link = tmp_path / "vn100"
    with PtyEmulator(emulator(), link=link, report=said.append):
        with opened(str(link)) as host:
            first = link.readlink()
            host.write(READ_07)
            assert host.read_until(b"\n") == REPLY_07
        until(lambda: said)
        with opened(str(link)) as host:
            host.write(READ_07)
            assert host.read_until(b"\n") == REPLY_07
    assert said[0].endswith(f"port {link}") and first.is_absolute()


def test_a_host_that_never_reads_loses_bytes_and_they_are_counted():
    with PtyEmulator(emulator(presets=STREAM), speed=100.0) as served:
        with opened(served.path, 921600):
            until(lambda: served.overrun_bytes > 10_000, 20.0)
        assert len(served._backlog) <= OVERRUN_BYTES


def test_many_emulators_leave_no_thread_and_no_descriptor(tmp_path):
    def used():
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    before = used()
    for _ in range(30):
        served = PtyEmulator(emulator(), link=tmp_path / "link")
        served.start()
        with opened(served.path):
            pass
        served.stop()
        served.stop()
    assert used() == before


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_speed_must_be_positive(speed):
    with pytest.raises(ValueError, match="speed must be positive"):
        PtyEmulator(emulator(), speed=speed)


def test_emulator_process_starts_serves_and_ends():
    with EmulatorProcess(Setup("calibrated", output="imu"), speed=20.0, lossless=True) as device:
        with opened(device.path) as host:
            lines = [host.read_until(b"\n") for _ in range(400)]
        assert {line[:6] for line in lines} == {b"$VNIMU"}
        assert device.device_s() > 9.0  # its own time
        held = os.open(device.path, os.O_RDONLY | os.O_NOCTTY)
    # The name may be another port's already: the open port itself says that its device went away.
    poll = select.poll()
    poll.register(held)
    [(_, events)] = poll.poll(0)
    assert events & select.POLLHUP
    os.close(held)
    device.stop()  # a second time is no error
    with pytest.raises(ValueError, match="speed must be positive"):
        EmulatorProcess(Setup(), speed=0.0)
    with pytest.raises(ValueError, match="no scenario"):
        EmulatorProcess(Setup("moon"))


def command_line(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "ahrsd", "emulate", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_command_prints_the_path_serves_and_ends_cleanly(tmp_path, stop):
    link = tmp_path / "device"
    process = command_line("--link", str(link), "--firmware", "2", "--fault", "clock_step@0")
    try:
        assert process.stdout.readline() == f"{link}\n"
        with opened(str(link)) as host:
            host.write(b"$VNASY,0*4F\r\n")
            assert host.read_until(b"$VNASY,0*4F\r\n")
            host.write(b"$VNRRG,04*77\r\n")
            assert host.read_until(b"\n").startswith(b"$VNRRG,04,2.1.0.0*")
        process.send_signal(stop)
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "fault clock_step" in said
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scenario", "moon"], "no scenario 'moon'; there are rov, "),
        (["--fault", "gremlins"], "no fault 'gremlins'; there are byte_drop, "),
        (["--speed", "0"], "speed must be positive"),
        (["--output", "binary", "--rate", "200"], "does not fit 115200 Bd"),
        (["--link", "/nowhere/at/all"], "/nowhere/at"),
    ],
)
def test_bad_usage_is_one_line_and_exit_2(arguments, complaint):
    process = command_line(*arguments)
    out, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert out == ""
    assert complaint in said and said.count("\n") == 1


def test_list_shows_scenarios_and_faults():
    process = command_line("--list")
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "\n  rov " in out and "\n  torn_flash " in out


def test_importing_the_command_is_light():
    code = "import sys, ahrsd.cli.device.emulate; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path.cwd()).returncode == 0
