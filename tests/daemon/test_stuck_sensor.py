"""A stuck, absurd or saturated sensor with `ahrsd run`: reported in plain words, without an
abort.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time

import numpy as np
import pytest
from patience import PATIENCE_S

from ahrsd.config.config import Config
from ahrsd.errors import DeviceError
from ahrsd.offline.replay import replay
from ahrsd.recording.capture import CaptureReader
from ahrsd.telemetry.unix_socket import DaemonConnection, default_socket_path


def constant(field):
    return np.broadcast_to([0.21, -0.05, 0.43], field.shape)


def saturated_axis(field):
    return np.column_stack([field[:, 0], field[:, 1], np.full(len(field), 2.5)])


class OneInFifty:
    """An impossible reading now and then."""

    def __init__(self, value):
        self.value, self.count = value, 0

    def __call__(self, field):
        rows = (self.count + np.arange(len(field))) % 1000 < 20  # ticks of the world: one in fifty
        self.count += len(field)
        field = field.copy()
        field[rows] = self.value
        return field


@contextlib.contextmanager
def daemon(emulated, folder, change_field=None, **setup):
    """A running `ahrsd run` with a device whose sensors are modified; yields `ask`."""
    with emulated(**{"output": "binary", "scenario": "rov", "rate_hz": 50, **setup}) as made:
        device, port = made
        world = device._world
        read = world._read_field
        if change_field is not None:
            world._read_field = lambda *a: np.array(change_field(read(*a)))
        config, log = folder / "a.toml", folder / "log"
        config.write_text(
            f'state_directory = "{folder}"\n[device]\nbaud = 115200\nport = "{port}"\n'
        )
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)],
                stdout=file, stderr=file,
            )  # fmt: skip

        def ask(what):
            assert process.poll() is None, log.read_text()
            path = default_socket_path(folder)
            if not path.exists():
                return None
            with (
                contextlib.suppress(DeviceError),
                DaemonConnection(path) as running,
            ):  # busy, or just started
                return running.ask(what)
            return None

        try:
            yield ask
            process.terminate()
            assert process.wait(PATIENCE_S) == 0, log.read_text()
        finally:
            process.kill()
            process.wait()


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.5)
    return found


@pytest.mark.filterwarnings(
    "ignore:invalid value encountered"
)  # raised by the emulator for an infinity
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (constant, "the magnetometer gives the same value on all axes"),
        pytest.param(saturated_axis, "saturated", marks=pytest.mark.slow),
        pytest.param(OneInFifty(1e30), "% of the newest", marks=pytest.mark.slow),
        pytest.param(OneInFifty(float("nan")), "% of the newest", marks=pytest.mark.slow),
        pytest.param(OneInFifty(float("inf")), "% of the newest", marks=pytest.mark.slow),
    ],
    ids=["constant", "saturated", "1e30", "nan", "inf"],
)
def test_sensor_fault_is_reported_and_the_daemon_continues(emulated, tmp_path, change, words):
    with daemon(emulated, tmp_path, change) as ask:

        def said():
            status = ask("status")
            return status if status and any(words in t for t in status["sensors"]) else None

        status = until(said)
        explained = until(lambda: ask("explain"))
        assert any(words in text for text in explained["sensors"])
        assert words in explained["next"]
        count = status["stream"]["messages"]
        until(lambda: (now := ask("status")) and now["stream"]["messages"] > count)
    (capture,) = (tmp_path / "captures").glob("*.mcap")
    assert list(CaptureReader(capture))
    if change is saturated_axis:
        return  # no sample remains, which a replay refuses in one line
    again = replay(capture, Config())
    assert any(words in text for text in again.core.source.sensors.findings.values())
