"""`ahrsd run --wait`: a device that is not there yet is waited for, what is no port is refused."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from ahrsd.config.config import Config
from ahrsd.config.sections import DeviceSection
from ahrsd.daemon.service import run_daemon
from ahrsd.errors import EXIT_DONE
from drivers.serial_port import NoPort


@pytest.fixture
def stopped_soon():
    timer = threading.Timer(0.8, os.kill, (os.getpid(), signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    timer.start()
    yield
    timer.cancel()
    timer.join()
    signal.signal(signal.SIGTERM, before)


def ended(*_: object) -> None:
    pytest.fail("no run began")


@pytest.mark.parametrize("name", ["file", "folder", "socket://nowhere", "tcp://10.0.0.7:4001"])
@pytest.mark.usefixtures("stopped_soon")
def test_what_can_never_be_a_port_is_not_waited_for(tmp_path, name):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    port = Path(name) if "://" in name else tmp_path / name
    config = Config(device=DeviceSection(port=port), state_directory=tmp_path / "state")
    with pytest.raises(NoPort):
        run_daemon(config, ended, wait=True)


@pytest.mark.usefixtures("stopped_soon")
def test_an_absent_device_is_waited_for_until_a_signal(tmp_path):
    port = DeviceSection(port=tmp_path / "ttyUSB7")
    config = Config(device=port, state_directory=tmp_path / "state")
    assert run_daemon(config, ended, wait=True) == EXIT_DONE
