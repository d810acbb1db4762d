"""Bad input to `ahrsd run`: one clear line, the correct exit code, and an unchanged device."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from patience import PATIENCE_S

from ahrsd.inputs import Received
from ahrsd.recording.capture import CaptureReader

LIMIT_S = 60.0  # allows for a busy machine; a real hang lasts for ever
HOLD = (
    "import serial, sys, time\n"
    "port = serial.Serial(sys.argv[1])\n"
    "print(1, flush=True)\n"
    "time.sleep(60)\n"
)


def one_line(text):
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


@pytest.fixture
def refused(run, tmp_path, capsys):
    """`refused(*arguments)`: exit code and the one line of a run that does not start."""

    def call(*arguments, config=""):
        file = tmp_path / "ahrsd.toml"
        state = tmp_path / "state"
        file.write_text(f'state_directory = "{state}"\n{config}')
        code = run("run", "--config", file, *arguments)
        assert not state.exists(), "something was left behind"
        said = capsys.readouterr()
        assert said.out == ""
        return code, one_line(said.err)

    return call


def test_missing_port_is_refused(refused, tmp_path):
    port = tmp_path / "nowhere"
    code, line = refused("--port", port)
    assert code == 75
    assert line.startswith(f"ahrsd: {port} does not exist")


def test_path_that_is_not_a_port_is_refused(refused, tmp_path):
    port = tmp_path / "file"
    port.write_text("")
    code, line = refused("--port", port)
    assert code == 2
    assert str(port) in line


def test_port_in_use_is_refused_with_its_holder(refused, emulated):
    with emulated() as (emulator, path):
        with subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE) as other:
            try:
                other.stdout.read(1)
                code, line = refused("--port", path)
            finally:
                other.kill()
        assert code == 75
        assert f"{path} is in use by process {other.pid}" in line
        assert emulator.counters["commands"] == 0


def test_wrong_configured_rate_is_refused(refused, emulated):
    with emulated(output="imu") as (emulator, path):
        before = dict(emulator.memory.ram)
        code, line = refused("--port", path, config="[device]\nbaud = 9600\n")
        assert code == 75
        assert "9600: " in line
        assert "bytes arrive but no message: not a VN-100, or a rate that was not tried" in line
        assert emulator.memory.ram == before


@pytest.mark.parametrize("baud", ["115200", '"auto"'])
def test_garbage_on_the_line_is_refused(refused, emulated, baud):
    with emulated(faults=("garbage",)) as (_, path):
        code, line = refused("--port", path, config=f"[device]\nbaud = {baud}\n")
        assert code == 75
        assert "bytes arrive but no message" in line


def test_silent_device_is_refused(refused, emulated):
    with emulated(faults=("off",)) as (_, path):
        code, line = refused("--port", path, config="[device]\nbaud = 115200\n")
        assert code == 75
        assert "the device does not answer: check power, cable" in line


def test_typo_in_the_configuration_is_refused_with_a_suggestion(refused):
    code, line = refused("--port", "/dev/null", config="[device]\nbuad = 9600\n")
    assert code == 2
    assert line.endswith("device.buad = 9600: unknown key; did you mean baud?")


def test_folder_that_cannot_be_made_is_refused(run, emulated, tmp_path, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("")
    config = tmp_path / "ahrsd.toml"
    config.write_text(f'state_directory = "{blocked}"\n[device]\nbaud = 115200\n')
    with emulated() as (emulator, path):
        assert run("run", "--config", config, "--port", path) == 2
        line = one_line(capsys.readouterr().err)
        assert line.startswith(f"ahrsd: {blocked}/captures: the folder of the captures cannot be")
        assert emulator.counters["refused"] == 0


def test_stream_without_a_field_keeps_running_and_advises_a_setting(live, caplog):
    caplog.set_level(logging.INFO, "ahrsd")
    daemon = live({"faults": ("reset@9",)})
    daemon.emulator.memory.preset(6, (17,))  # VNYIA: attitude, acceleration, rates; no field
    daemon.emulator.restart(0.0)
    with daemon:
        for port in (1, 2):
            daemon.emulator.memory.flash[6, port] = (19,)  # in force after the reset
        daemon.until(lambda: "VNYIA carries no magnetometer" in caplog.text, 20.0)
        assert "device.configure_stream = true" in caplog.text
        daemon.until(lambda: "all is well again" in caplog.text)
        daemon.flowing()
    assert caplog.text.count("VNYIA carries") == 1


def test_device_that_refuses_every_write_keeps_its_output(live):
    stream = {"configure_stream": True, "rate_hz": 50.0}
    with live({"output": "imu", "faults": ("refused_write",)}, device=stream) as daemon:
        daemon.until(lambda: daemon.noted("output cannot be set up, its own output stays"))
        daemon.flowing()
        assert daemon.core.registers[23][0] == 1.0
        assert daemon.stop() < LIMIT_S
        assert daemon.emulator.memory.ram == daemon.before


def test_output_that_exceeds_the_baud_rate_is_not_configured(live):
    stream = {"configure_stream": True, "rate_hz": 800.0}
    with live({"output": "imu"}, device=stream) as daemon:
        daemon.until(lambda: daemon.noted("ask for at most 180 Hz or use a faster port"))
        daemon.flowing()
        assert b"VNWRG" not in daemon.heard


def test_full_disk_loses_no_sample(live, small_disk, caplog):
    """No sample may be lost. One line is logged at once, and one when space is available again."""
    caplog.set_level(logging.INFO, "ahrsd")
    filler = small_disk / "filler"
    free = os.statvfs(small_disk)
    filler.write_bytes(bytes(free.f_bavail * free.f_frsize - 12288))
    setup = {"output": "binary", "rate_hz": 100}
    with live(setup, capture={"directory": str(small_disk)}) as daemon:
        daemon.until(lambda: "capture: No space left on device" in caplog.text, 30.0)
        before = daemon.samples
        time.sleep(2.0)
        assert daemon.samples - before > 150
        filler.unlink()
        daemon.until(lambda: "all is well again" in caplog.text, 30.0)
        daemon.stop()
        facts = daemon.core.stream.facts
        assert facts.samples == facts.expected
        assert daemon.core.stream.gaps == []
    assert caplog.text.count("capture: No space left") == 1
    reader = CaptureReader(daemon.capture)
    assert sum(isinstance(item, Received) for item in reader) > 10
    assert reader.notes == []  # unstored data waited in memory


def test_nothing_is_written_when_the_journal_is_not_writable(live, tmp_path):
    """The folder of the journal is a file, because root ignores permissions."""
    blocked = tmp_path / "blocked"
    with live({"output": "imu"}, mode="stage", state_directory=str(blocked)) as daemon:
        blocked.write_text("")
        importer("test_daemon").Operator(daemon, "TRIAL", lambda: None)
        daemon.until(
            lambda: (
                daemon.noted("PREPARED could not be journalled")
                or daemon.noted("nothing can be written")
            )
        )
        daemon.flowing()
        daemon.stop()
        assert b"VNWRG" not in daemon.heard
        assert daemon.emulator.memory.ram == daemon.before


def test_nothing_is_written_when_the_disk_of_the_journal_is_full(live, small_disk, tmp_path):
    captures = {"directory": str(tmp_path / "captures")}
    (tmp_path / "captures").mkdir()
    setup = {"mode": "stage", "state_directory": str(small_disk), "capture": captures}
    with live({"output": "imu"}, **setup) as daemon:
        daemon.until(lambda: "OBSERVING" in daemon.states)
        free = os.statvfs(small_disk)
        (small_disk / "filler").write_bytes(bytes(free.f_bavail * free.f_frsize))
        operator = importer("test_daemon").Operator(daemon, "TRIAL", lambda: None)
        daemon.until(lambda: daemon.noted("No space left on device"))
        daemon.flowing()
        daemon.stop()
        assert operator.proposed
        assert not operator.acted
        assert b"VNWRG" not in daemon.heard
        assert daemon.emulator.memory.ram == daemon.before


def importer(name):
    import importlib.util

    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_signal_ends_the_command_in_time_with_the_device_restored(emulated, tmp_path, number):
    config = tmp_path / "ahrsd.toml"
    config.write_text(
        f'state_directory = "{tmp_path}"\n[device]\nbaud = 115200\nconfigure_stream = true\n'
    )
    with emulated(output="ascii") as (emulator, path):
        before = dict(emulator.memory.ram)
        command = [sys.executable, "-m", "ahrsd", "run", "--config", str(config), "--port", path]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as daemon:
            end = time.monotonic() + PATIENCE_S
            while emulator.memory.get(75)[0] == 0 or emulator.memory.get(6, 1) != (0,):
                assert time.monotonic() < end
                time.sleep(0.01)
            time.sleep(1.0)
            assert emulator.memory.ram != before
            asked = time.monotonic()
            daemon.send_signal(number)
            out, err = daemon.communicate()
            assert time.monotonic() - asked < LIMIT_S
        assert daemon.returncode == 0
        assert err == b""
        assert b" samples in " in out
        assert emulator.memory.ram == before


def test_signal_during_the_search_for_the_rate_ends_the_command(emulated, tmp_path):
    with emulated(faults=("off",)) as (_, path):
        command = [sys.executable, "-m", "ahrsd", "-v", "run", "--port", path]
        environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
        with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment) as daemon:
            wait_until_open(daemon.pid, path)
            asked = time.monotonic()
            daemon.send_signal(signal.SIGTERM)
            err = daemon.communicate()[1]
        assert time.monotonic() - asked < LIMIT_S
        assert daemon.returncode == 0
        assert b"stopped (SIGTERM) before a device was found" in err
        assert list(tmp_path.iterdir()) == []


def wait_until_open(pid, path):
    end = time.monotonic() + PATIENCE_S
    target = Path(path).resolve()
    while time.monotonic() < end:
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            try:
                if descriptor.readlink() == target:
                    return
            except OSError:
                continue
        time.sleep(0.01)
    raise AssertionError("the port was not opened")
