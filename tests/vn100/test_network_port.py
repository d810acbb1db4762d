"""A VN-100 behind a device server: raw TCP and RFC 2217, through pyserial."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest
from device_server import DeviceServer

from drivers.serial_port import (
    PortAbsent,
    PortLost,
    PortUnusable,
    SerialPort,
    detect_baud,
    spelled,
)
from drivers.vn100.commands import identify
from drivers.vn100.device import Device
from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build

pytestmark = pytest.mark.filterwarnings(
    "ignore:setDaemon:DeprecationWarning", "ignore:setName:DeprecationWarning"
)


@pytest.fixture
def emulator(tmp_path):
    made = build(Setup("rov", seed=1, output="imu", rate_hz=40))
    with PtyEmulator(made, link=tmp_path / "vn100"):
        made.link = str(tmp_path / "vn100")
        yield made


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.parametrize("telnet", [False, True], ids=["socket", "rfc2217"])
def test_device_is_received_and_queried_over_the_network(emulator, telnet):
    with DeviceServer(emulator.link, telnet=telnet) as server:
        found = detect_baud(server.url, may_query=True)
        assert found.baud == 115200
        with SerialPort(server.url, found.baud) as port, Device(port) as device:
            assert device.run(identify()).serial == emulator.serial
        if telnet:
            assert server.baud == 115200
        else:
            assert found.why == "heard through a device server"


@pytest.mark.parametrize("telnet", [False, True], ids=["socket", "rfc2217"])
def test_closed_connection_is_a_lost_link_and_can_be_reopened(emulator, telnet):
    with DeviceServer(emulator.link, telnet=telnet) as server:
        with SerialPort(server.url, 115200) as port:
            until(port.read)
            server.drop()
            with pytest.raises(PortLost, match=server.url):
                until(lambda: port.wait_readable(0.1) and not port.read() and False)
        with SerialPort(server.url, 115200) as again:
            until(again.read)


def test_missing_server_is_an_absent_port():
    with socket.create_server(("127.0.0.1", 0)) as gone:
        url = f"socket://127.0.0.1:{gone.getsockname()[1]}"
    with pytest.raises(PortAbsent, match=r"is the device server on, is it on this network\?"):
        SerialPort(url, 115200)


@pytest.mark.parametrize("wrong", ["socket://nowhere", "socket://:4001", "rfc2217://a:b"])
def test_incomplete_url_is_refused_with_the_expected_form(wrong):
    with pytest.raises(PortUnusable, match=r"expected (socket|rfc2217)://HOST:PORT"):
        SerialPort(wrong, 115200)


@pytest.mark.parametrize("wrong", ["tcp://10.0.0.7:4001", Path("http://a"), "10.0.0.7:4001"])
def test_what_only_looks_like_a_device_server_is_told_how_one_is_written(wrong):
    with pytest.raises(PortUnusable, match="is socket://HOST:PORT or rfc2217://HOST:PORT"):
        SerialPort(wrong, 115200)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (Path("socket://10.0.0.7:4001"), "socket://10.0.0.7:4001"),
        ("rfc2217://moxa:4001", "rfc2217://moxa:4001"),
        (Path("/dev/ttyUSB0"), "/dev/ttyUSB0"),
        ("socket:", "socket:"),
    ],
)
def test_url_slashes_are_restored(given, text):
    assert spelled(given) == text
