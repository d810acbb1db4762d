"""`ahrsd run` with a port and three network shares, as its readers see it.

Readers are plain sockets. One is killed, one sends bytes, the device is unplugged, the run is
restarted.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import reduce
from operator import xor
from pathlib import Path

import pytest
from free_port import free_port
from patience import PATIENCE_S

from ahrsd.inputs import Received
from ahrsd.recording.capture import CaptureReader
from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build


class Reader:
    """Reads in a thread until the end; `data`: everything, `ended`: the other side closed."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection, self.data, self.ended = connection, b"", False
        self._read, self._records = 0, []
        connection.settimeout(0.2)
        self._closing = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._closing:
            with contextlib.suppress(TimeoutError):
                try:
                    piece = self.connection.recv(1 << 16)
                except ConnectionResetError:
                    piece = b""
                if not piece:
                    self.ended = True
                    return
                self.data += piece

    def records(self, kind: str) -> list[dict]:
        """New lines since the last call: each line is returned once."""
        whole = self.data.rfind(b"\n") + 1
        self._records += map(json.loads, self.data[self._read : whole].splitlines())
        self._read = max(whole, self._read)
        return [record for record in self._records if record["record"] == kind]

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.connection.close()


class Vehicle:
    """A device, the configuration of a run with all kinds of shares, and the run."""

    def __init__(self, folder: Path, mode: str, **setup: object) -> None:
        self.folder, self.heard = folder, bytearray()
        self.raw, self.corrected = free_port(), free_port()
        self.nmea = free_port(socket.SOCK_DGRAM)
        emulator = build(Setup(output="binary", rate_hz=50, **setup))
        receive = emulator.receive

        def listen(data: bytes, now_s: float) -> object:
            self.heard.extend(data)
            return receive(data, now_s)

        emulator.receive = listen
        self.device = PtyEmulator(emulator, link=folder / "device")
        self.config = folder / "ahrsd.toml"
        self.config.write_text(
            f'mode = "{mode}"\nstate_directory = "{folder}"\n'
            f'[device]\nport = "{folder}/device"\nbaud = 115200\n'
            f'[[share]]\npty = "{folder}/vn100"\n'
            f'[[share]]\ntcp = "127.0.0.1:{self.raw}"\n'
            f'[[share]]\ntcp = "127.0.0.1:{self.corrected}"\nsend = "corrected"\n'
            'calibrated_by = "qualified"\n'
            f'[[share]]\nudp = "127.0.0.1:{self.nmea}"\nsend = "nmea"\n'
            'calibrated_by = "qualified"\n'
        )
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text(encoding="utf-8")

    def start(self) -> None:
        command = [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(self.config)]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

    def until(self, what) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not what():
            assert self.process.poll() is None, self.log
            assert time.monotonic() < end_s, self.log
            time.sleep(0.02)

    def reader(self, port: int) -> Reader:
        end_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return Reader(socket.create_connection(("127.0.0.1", port)))
            except ConnectionRefusedError:
                assert self.process.poll() is None, self.log
                assert time.monotonic() < end_s, self.log
                time.sleep(0.05)

    def status(self) -> dict:
        command = [sys.executable, "-m", "ahrsd", "status", "--config", str(self.config)]
        asked = subprocess.run([*command, "--json", "-"], capture_output=True, check=True)
        return json.loads(asked.stdout)


@pytest.fixture
def vehicle(tmp_path) -> Iterator:
    with contextlib.ExitStack() as leaving:

        def make(mode: str, **setup: object) -> Vehicle:
            made = Vehicle(tmp_path, mode, **setup)
            leaving.enter_context(made.device)
            leaving.callback(lambda: made.process and (made.process.kill(), made.process.wait()))
            made.start()
            return made

        yield make


def test_readers_get_every_byte_and_none_of_theirs_reaches_the_device(vehicle, tmp_path):
    run = vehicle("passive")
    first, doomed = run.reader(run.raw), run.reader(run.raw)
    corrected = run.reader(run.corrected)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plotter:
        plotter.bind(("127.0.0.1", run.nmea))
        heard = Reader(plotter)
        run.until(lambda: len(first.data) > 5_000)
        first.connection.sendall(b"$VNRRG,01*72\r\n$VNWNV*57\r\n")
        doomed.connection.shutdown(socket.SHUT_RDWR)  # killed
        enough = len(first.data) + 10_000
        run.until(lambda: len(first.data) > enough and len(corrected.records("sample")) > 100)
        shares = {share["port"].split()[0]: share for share in run.status()["shares"][:3]}
        run.until(lambda: heard.data.count(b"$HCHDM") > 20)
        got = first.data  # the last bytes before the end may be in no capture
        time.sleep(0.5)
        assert run.stop() == 0
        heard.close()
    assert bytes(run.heard) == b""
    warnings = [line for line in run.log.splitlines() if "WARNING" in line]
    assert [line for line in warnings if "shar" in line or "tcp" in line or "udp" in line] == [
        line for line in warnings if "what it sends is thrown away" in line
    ]
    assert run.log.count("what it sends is thrown away") == 1
    assert shares["tcp"]["readers"] == 1
    (capture,) = (tmp_path / "captures").glob("*.mcap")
    device = b"".join(it.data for it in CaptureReader(capture) if isinstance(it, Received))
    assert got in device  # in one piece
    assert doomed.data in device
    numbers = [r["seq"] for r in corrected.records("sample") + corrected.records("state")]
    numbers.sort()
    assert numbers[1:] == list(range(numbers[1], numbers[1] + len(numbers) - 1))
    assert len(corrected.records("gap")) == 0
    for line in heard.data.split(b"\r\n")[:-1]:
        body, _, check = line[1:].partition(b"*")
        assert check.decode() == f"{reduce(xor, body):02X}"
        assert body[:5] in (b"HCHDM", b"YXXDR")
        assert body[:5] != b"HCHDM" or body == b"HCHDM,,M"  # this device is not known yet
    assert first.ended
    assert corrected.ended
    for one in (first, doomed, corrected):
        one.close()


def test_readers_stay_connected_while_the_device_is_unplugged(vehicle):
    run = vehicle("observe", faults=("unplug@10",))
    raw, corrected = run.reader(run.raw), run.reader(run.corrected)
    run.until(lambda: any(not r["device_present"] for r in corrected.records("state")))
    gone = next(r for r in corrected.records("state") if not r["device_present"])
    assert gone["alarms"] == [f"no device on {run.folder}/device: waiting for it"]
    size, count = len(raw.data), len(corrected.records("sample"))
    run.until(lambda: len(raw.data) > size + 3_000)
    run.until(lambda: len(corrected.records("sample")) > count + 50)
    behind = corrected.records("sample")[count]
    assert behind["gap_before"] is True
    assert corrected.records("state")[-1]["device_present"] is True
    assert run.stop() == 0
    raw.close()
    corrected.close()


def test_restarted_run_with_readers_listens_again_at_once(vehicle):
    run = vehicle("observe")
    before = run.reader(run.raw)
    run.until(lambda: len(before.data) > 1000)
    assert run.stop() == 0
    run.start()
    again = run.reader(run.raw)
    run.until(lambda: len(again.data) > 1000)
    assert before.ended
    run.process.kill()
    run.process.wait()
    run.start()
    third = run.reader(run.raw)
    run.until(lambda: len(third.data) > 1000)
    for one in (before, again, third):
        one.close()


def test_address_in_use_is_a_one_line_error_without_remains(vehicle, tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        number = other.getsockname()[1]
        run = vehicle("observe")
        run.process.kill()
        run.process.wait()
        text = run.config.read_text().replace(f":{run.corrected}", f":{number}")
        run.config.write_text(text)
        run.start()
        assert run.process.wait(PATIENCE_S) == 2
    line = run.log.splitlines()[-1]
    assert f"share.tcp = 127.0.0.1:{number}: another program listens there" in line
    assert not (tmp_path / "vn100").exists()
