"""`ahrsd run` as a program beside an emulated device: what it sends, a second one, being frozen.

Bytes are counted on the pty, where the device hears them.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ahrsd.config.loading import Config
from ahrsd.events import SamplesSeen
from ahrsd.offline.replay import replay

READ = rb"\$VNRRG,\d+(,\d)?\*[0-9A-F]{2}"
PATIENCE_S = 60.0


class Running:
    """The program, its log, and what the device heard."""

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
    def start(*options: str, **setup: object):
        with emulated(**setup) as (device, port):
            heard, receive = bytearray(), device.receive

            def listen(data: bytes, now_s: float) -> object:
                heard.extend(data)
                return receive(data, now_s)

            device.receive = listen
            with (tmp_path / "log").open("wb") as log:
                process = subprocess.Popen(
                    [*command(tmp_path), "--port", port, *options], stdout=log, stderr=log
                )
            try:
                yield Running(process, tmp_path / "log", heard), port
            finally:
                process.kill()
                process.wait()

    return start


def command(folder: Path) -> list[str]:
    config = folder / "ahrsd.toml"
    config.write_text(f'state_directory = "{folder}"\n[device]\nbaud = 115200\n')
    return [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)]


def captured(folder: Path) -> Path:
    (capture,) = (folder / "captures").glob("*.mcap")
    return capture


def grown(path: Path, by: int):
    """A condition: the file has grown by so many bytes."""
    start = path.stat().st_size
    return lambda: path.stat().st_size > start + by


def test_passive_sends_not_one_byte(program, tmp_path):
    with program("--mode", "passive", output="imu") as (running, _):
        running.until(lambda: list((tmp_path / "captures").glob("*.mcap")))
        running.until(grown(captured(tmp_path), 10_000))
        assert running.stop() == 0
        assert bytes(running.heard) == b""
    assert re.search(r"messages: \d{2,} valid", running.said)


def test_observe_sends_register_reads_and_nothing_else(program, tmp_path):
    with program(output="imu") as (running, _):
        running.until(lambda: "OBSERVING" in running.said)
        running.until(grown(captured(tmp_path), 10_000))
        assert running.stop() == 0
        lines = bytes(running.heard).split(b"\r\n")
    assert lines.pop() == b""
    assert len(lines) > 20
    assert [line for line in lines if not re.fullmatch(READ, line)] == []


def test_a_second_one_is_told_who_holds_the_port_and_the_device_hears_nothing(program, tmp_path):
    with program(output="imu") as (running, port):
        running.until(lambda: "OBSERVING" in running.said)
        heard = len(running.heard)
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
        assert len(running.heard) == heard
        assert [path.name for path in second.iterdir()] == ["ahrsd.toml"]
        assert running.stop() == 0


@pytest.mark.timeout(120)
def test_frozen_for_seconds_it_goes_on_and_bridges_nothing(program, tmp_path):
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
    for length_s in gaps:  # samples that came before their registers are missing too
        assert np.min(np.abs(missing_s - length_s)) < 1e-6
    assert max(missing_s, default=0.0) == pytest.approx(max(gaps, default=0.0), abs=1e-6)
