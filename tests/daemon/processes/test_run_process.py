"""`ahrsd run` as a program with an emulated device: bytes sent, a second instance, and
suspension.

Bytes are counted on the pty, as the device receives them.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import termios
import time
import tty
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from contract import REPLAY, faults
from drivers_at_start import ROS2_DAWONN, SDK
from patience import PATIENCE_S

from ahrsd.config.config import Config
from ahrsd.events import SamplesSeen
from ahrsd.offline.replay import replay
from drivers.vn100.messages import encode

#: VectorNav's own SDK for Python (0.99, MIT licence), built from its sources: a program that
#: uses it and prints one word per line; it is in no package registry
WITH_THE_SDK = """
import sys, time
from vectornav import Registers, Sensor
sensor = Sensor()
sensor.autoConnect(sys.argv[1])
model, held = Registers.System.Model(), Registers.IMU.MagCal()
sensor.readRegister(model)
print(model.model)
output = Registers.System.BinaryOutput1()
output.asyncMode.serial1, output.rateDivisor, output.common.imu = 1, 40, 1
output.asyncMode.serial2 = 0
sensor.writeRegister(output)
sensor.readRegister(held)
sensor.writeRegister(held)
held.magBiasX = 0.25
try:
    sensor.writeRegister(held)
except Exception as error:
    print(error)
count, end_s = 0, time.time() + 3.0
while time.time() < end_s:
    count += sensor.getNextMeasurement() is not None
print(count)
"""
ANSWER = re.compile(rb"\$(VN(?:RRG|WRG|ERR|ASY|WNV|RST)[^*\r]*)\*..\r\n")
READ = rb"\$VNRRG,\d+(,\d)?\*[0-9A-F]{2}"


class Running:
    """The program, its log, and the bytes that the device received."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path, heard: bytearray) -> None:
        self.process, self.log, self.heard = process, log, heard

    @property
    def said(self) -> str:
        return self.log.read_text(encoding="utf-8")

    def until(self, condition) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.process.poll() is None, self.said
            assert time.monotonic() < end, self.said
            time.sleep(0.05)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)


@pytest.fixture
def program(emulated, tmp_path):
    """`with program("--mode", "passive", output="imu") as (running, port)`."""

    @contextlib.contextmanager
    def start(*options: str, config: str = "", **setup: object):
        with emulated(**setup) as (device, port):
            heard, receive = bytearray(), device.receive

            def listen(data: bytes, now_s: float) -> object:
                heard.extend(data)
                return receive(data, now_s)

            device.receive = listen
            with (tmp_path / "log").open("wb") as log:
                process = subprocess.Popen(
                    [*command(tmp_path, config), "--port", port, *options], stdout=log, stderr=log
                )
            try:
                yield Running(process, tmp_path / "log", heard), port
            finally:
                process.kill()
                process.wait()

    return start


def command(folder: Path, more: str = "") -> list[str]:
    config = folder / "ahrsd.toml"
    config.write_text(f'state_directory = "{folder}"\n[device]\nbaud = 115200\n{more}')
    return [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)]


def captured(folder: Path) -> Path:
    (capture,) = (folder / "captures").glob("*.mcap")
    return capture


def grown(path: Path, by: int):
    """A condition: the file has its head, and this many more bytes than when that was first
    seen.

    The head of a capture is larger than what a device sends in seconds.
    """
    seen: list[int] = []

    def condition() -> bool:
        size = path.stat().st_size
        if not seen and size:
            seen.append(size)
        return bool(seen) and size > seen[0] + by

    return condition


def test_passive_sends_no_byte_and_ends_with_a_summary(program, tmp_path):
    target = tmp_path / "run.json"
    with program("--mode", "passive", "--json", str(target), output="imu") as (running, _):
        running.until(lambda: list((tmp_path / "captures").glob("*.mcap")))
        running.until(grown(captured(tmp_path), 10_000))
        assert running.stop() == 0
        assert bytes(running.heard) == b""
    assert re.search(r"messages: \d{2,} valid", running.said)
    closing = json.loads(target.read_text())
    assert faults(closing, {**REPLAY, "calibration": {"schema": "ahrsd.calibration/1"}}) == []
    again = replay(captured(tmp_path), Config()).core.decisions
    assert (closing["decision_sha256"], closing["decisions"]) == (again.sha256, again.entries)


def test_observe_sends_only_register_reads(program, tmp_path):
    with program(output="imu") as (running, _):
        running.until(lambda: "OBSERVING" in running.said)
        running.until(grown(captured(tmp_path), 10_000))
        assert running.stop() == 0
        lines = bytes(running.heard).split(b"\r\n")
    assert lines.pop() == b""
    assert len(lines) > 20
    assert [line for line in lines if not re.fullmatch(READ, line)] == []


def test_second_instance_is_refused_with_the_holder_and_sends_nothing(program, tmp_path):
    with program("--mode", "passive", output="imu") as (running, port):
        running.until(lambda: list((tmp_path / "captures").glob("*.mcap")))
        running.until(grown(captured(tmp_path), 1_000))
        second = tmp_path / "second"
        second.mkdir()
        refused = subprocess.run(
            [*command(second), "--port", port],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert refused.returncode == 75
        (line,) = refused.stderr.strip().splitlines()
        assert f"in use by process {running.process.pid}" in line
        assert bytes(running.heard) == b""
        assert [path.name for path in second.iterdir()] == ["ahrsd.toml"]
        assert running.stop() == 0


@pytest.mark.timeout(120)
def test_suspended_program_continues_and_bridges_no_gap(program, tmp_path):
    rate_hz, frozen_s = 100, 4.0
    with program(output="binary", rate_hz=rate_hz) as (running, _):
        running.until(lambda: "OBSERVING" in running.said)
        running.until(grown(captured(tmp_path), 20_000))
        os.kill(running.process.pid, signal.SIGSTOP)
        time.sleep(frozen_s)
        os.kill(running.process.pid, signal.SIGCONT)
        running.until(grown(captured(tmp_path), 40_000))
        assert running.stop() == 0
    seen: list[SamplesSeen] = []
    done = replay(
        captured(tmp_path),
        Config(),
        listeners=[lambda event: seen.append(event) if isinstance(event, SamplesSeen) else None],
    )
    steps_s = np.concatenate([event.block.dt_s for event in seen])
    times_s = np.concatenate([event.block.time_s for event in seen])
    assert times_s[-1] - times_s[0] > frozen_s
    assert float(np.nanmax(steps_s)) < 1.5 / rate_hz
    missing_s = np.diff(times_s)[np.diff(times_s) > 1.5 / rate_hz]
    gaps = [gap.length_s for gap in done.core.stream.gaps]
    for length_s in gaps:  # samples from before the registers were read are missing too
        assert np.min(np.abs(missing_s - length_s)) < 1e-6
    assert max(missing_s, default=0.0) == pytest.approx(max(gaps, default=0.0), abs=1e-6)


# -- programs on shared ports ----------------------------------------------------------------------


def driver_start(path: Path, lines: tuple[str, ...], *, crc: bool = False) -> list[str]:
    """Answers to a driver that repeats each request after 50 ms, as real drivers do."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(port)
    answers = []
    for line in lines:
        termios.tcflush(port, termios.TCIFLUSH)
        end_s, again_s, heard, found = time.monotonic() + PATIENCE_S, 0.0, b"", []
        while not found:
            now_s = time.monotonic()
            assert now_s < end_s, line
            if now_s >= again_s:
                os.write(port, encode(line, crc=crc))
                again_s = now_s + 0.05
            if select.select([port], [], [], 0.005)[0]:
                heard += os.read(port, 65536)
            found = [a for a in ANSWER.findall(heard) if a.startswith(line[:8].encode())]
        time.sleep(0.1)  # repeated requests are answered by then
        answers.append(found[0].decode())
    os.close(port)
    return answers


def test_drivers_on_shared_ports_of_a_working_daemon(program, tmp_path):
    owner, logger = tmp_path / "vn100", tmp_path / "logger"
    shares = f'[[share]]\npty = "{owner}"\nowner = true\n[[share]]\npty = "{logger}"\n'
    with program(output="binary", config=shares) as (running, _):
        running.until(lambda: owner.exists() and logger.exists())
        with ThreadPoolExecutor() as pool:
            first = pool.submit(driver_start, owner, ROS2_DAWONN)
            second = pool.submit(driver_start, logger, ("VNRRG,01", "VNRRG,23", "VNRRG,03") * 5)
            answers, others = first.result(), second.result()
        sdk = driver_start(owner, SDK, crc=True)
        assert running.stop() == 0
    assert answers[:7] == [
        "VNRRG,01,VN-100S-CR", "VNRRG,01,VN-100S-CR", "VNRRG,01,VN-100S-CR",
        "VNRRG,04,3.1.0.0", "VNRRG,02,8", "VNRRG,03,0100130608", "VNRRG,00,",
    ]  # fmt: skip
    assert answers[7:9] == ["VNWRG,06,0", "VNWRG,07,20"]
    assert answers[11] == "VNWRG,75,3,40,01,7FFF"
    one = "VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0"
    assert others == ["VNRRG,01,VN-100S-CR", one, "VNRRG,03,0100130608"] * 5
    assert sdk == ["VNRRG,01,VN-100S-CR", "VNWRG,06,0,1", "VNWRG,75,1,20,01,0721"]
    assert not owner.exists()
    assert b"VNWRG,23" not in running.heard
    assert b"VNWNV" not in running.heard
    again = replay(captured(tmp_path), Config()).core.clients
    counts = [again.counts(str(path)) for path in (owner, logger)]
    assert counts[0]["commands"] >= len(ROS2_DAWONN) + len(SDK)
    assert counts[1]["commands"] >= 15
    assert [one["refused"] for one in counts] == [0, 0]


def test_vendor_library_works_on_a_shared_port(program, tmp_path):
    pytest.importorskip("vectornav", reason="VectorNav's SDK for Python is not installed")
    owner = tmp_path / "vn100"
    with program(output="binary", config=f'[[share]]\npty = "{owner}"\nowner = true\n') as (one, _):
        one.until(lambda: owner.exists() and "OBSERVING" in one.said)
        done = subprocess.run(
            [sys.executable, "-c", WITH_THE_SDK, str(owner)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        one.until(lambda: "what calibrates is ahrsd's" in one.said)
    assert done.returncode == 0, done.stderr
    model, refused, count = done.stdout.split()
    assert (model, refused) == ("VN-100S-CR", "UnauthorizedAccess")
    assert 20 <= int(count) <= 80  # 20 Hz for three seconds, on a machine that may be busy
    assert b"VNWRG,23" not in one.heard
