"""Streams as real drivers leave them, by the command line: files and scripted devices of the field.

The inputs are not part of the project; the same kinds are made by our own generators in
`vn100/test_any_packet.py`, `vn100/test_echo.py` and `test_output_rates.py`.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from operator import xor
from pathlib import Path

import pytest
from patience import PATIENCE_S

CASES = Path(__file__).parents[3] / "shared" / "field-cases"
HARD_IRON_MG, GYRO_BIAS_MRAD_S = (120.0, -80.0, 60.0), (3.5, -4.2, 2.1)
LISTENED_S = 8.0
COMMAND = [sys.executable, "-m", "ahrsd"]

pytestmark = [
    pytest.mark.timeout(400),
    pytest.mark.field_cases,
]


def ahrsd(*arguments: object, timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


# -- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "samples", "said"),
    [
        ("f01_ros2_default.vnbin.gz", 1200, "FA 29 7FFF 0210 000C: skipped"),
        ("f04_ardupilot_50hz.mcap", 2754, "50 Hz (register 75: 800 Hz / 16)"),
        pytest.param("f25_crcrlf.txt", 400, "VNYMR carries no time: 20 Hz", marks=pytest.mark.slow),
    ],
)
def test_a_recording_is_calibrated(name: str, samples: int, said: str, tmp_path: Path) -> None:
    done = ahrsd("calibrate", CASES / name, "--json", tmp_path / "out.json")
    assert done.returncode == 0, done.stderr
    assert f"{samples} samples" in done.stdout
    assert said in done.stdout
    result = json.loads((tmp_path / "out.json").read_text())
    lines = re.findall(r"^  (?:hard iron|gyro bias) .*", done.stdout, re.MULTILINE)
    hard_mg, bias_mrad_s = (
        [float(number) for number in re.findall(r"([+-][0-9.]+) \+-", line)] for line in lines
    )
    assert hard_mg == pytest.approx(HARD_IRON_MG, abs=1.0)
    assert bias_mrad_s == pytest.approx(GYRO_BIAS_MRAD_S, abs=0.3)
    assert result["schema"].startswith("ahrsd.calibration")


# -- scripted devices -----------------------------------------------------------------------------


class Scripted:
    """A device of the field on a pty, and what it heard."""

    def __init__(self, case: str, folder: Path) -> None:
        self._log = (folder / "device.log").open("w+", encoding="utf-8")
        tool = CASES / "tools" / "fake_vn100.py"
        self._process = subprocess.Popen(
            [sys.executable, str(tool), case], stdout=subprocess.PIPE, stderr=self._log, text=True
        )
        assert self._process.stdout is not None
        self.port = self._process.stdout.readline().strip()

    @property
    def heard(self) -> list[str]:
        self._log.flush()
        text = Path(self._log.name).read_text(encoding="utf-8")
        return [line.removeprefix("<< ").partition("*")[0] for line in text.splitlines()]

    @property
    def writes(self) -> list[str]:
        return [line for line in self.heard if not line.startswith("VNRRG")]

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()  # type: ignore[union-attr]
        self._log.close()


@contextlib.contextmanager
def device(case: str, folder: Path) -> Iterator[Scripted]:
    scripted = Scripted(case, folder)
    try:
        yield scripted
    finally:
        scripted.close()


def run(scripted: Scripted, folder: Path, until: str, kilobytes: int, config: str = "") -> str:
    """All that `ahrsd run` says until its log has `until` and its capture so much more; exit 0."""
    path = folder / "ahrsd.toml"
    path.write_text(f'state_directory = "{folder}"\n[device]\nbaud = 115200\n{config}')
    log = folder / "log"
    with log.open("wb") as file:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "ahrsd",
                "-v",
                "run",
                "--config",
                str(path),
                "--port",
                scripted.port,
            ],
            stdout=file,
            stderr=file,
        )

    def wait_for(condition: Callable[[], object]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end_s, log.read_text()
            time.sleep(0.1)

    def recorded() -> int:
        return sum(file.stat().st_size for file in (folder / "captures").glob("*.mcap"))

    try:
        wait_for(lambda: re.search(until, log.read_text()))
        start = recorded()
        wait_for(lambda: recorded() > start + 1000 * kilobytes)
        time.sleep(LISTENED_S)  # longer than a rate is watched before it is believed
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0, log.read_text()
    finally:
        process.kill()
        process.wait()
    return log.read_text()


def rate_of(said: str) -> str:
    match = re.search(r"(\d+) samples in [0-9.]+ s \((.*)\)", said)
    assert match is not None, said
    assert int(match[1]) > 60, said
    return match[2]


def test_packets_of_the_ros_2_driver_are_heard_live(tmp_path: Path) -> None:
    with device("f02_ros2_left_it", tmp_path) as scripted:
        said = run(scripted, tmp_path, "OBSERVING", 30)
        assert scripted.writes == []
    assert rate_of(said) == "20 Hz, device time"
    assert " 0 rejected" in said
    assert "link lost" not in said


def test_settings_of_the_ros_2_driver_are_restored(tmp_path: Path) -> None:
    with device("f03_ros2_left_it_follows_75", tmp_path) as scripted:
        config = "configure_stream = true\n"
        said = run(scripted, tmp_path, "output set up for the session", 20, config)
        writes = scripted.writes
    assert "outputs put back as they were" in said
    assert [w for w in writes if w.startswith("VNWRG,75")][-1] == (
        "VNWRG,75,3,40,29,7FFF,0210,000C"
    )
    assert writes[-1] == "VNASY,1"


def test_the_autopilots_packets_have_the_rate_of_their_register(tmp_path: Path) -> None:
    with device("f04_ardupilot", tmp_path) as scripted:
        said = run(scripted, tmp_path, "OBSERVING", 40)
    assert rate_of(said) == "50 Hz, register 75: 800 Hz / 16"


def test_echoing_adapter_is_not_a_device(tmp_path: Path) -> None:
    with device("f06_echo", tmp_path) as scripted:
        read = ahrsd("registers", "read", scripted.port, "--baud", 115200)
        said = run(scripted, tmp_path, "OBSERVING", 20)
    assert read.returncode == 0
    assert read.stdout.startswith("VN-100T-CR, serial 100056785, firmware 2.1.0.0\n")
    (line,) = [line for line in read.stderr.splitlines() if "echo" in line]
    assert line.startswith("ahrsd: the line sends back what is sent")
    assert "VN-100T-CR serial 100056785 firmware 2.1.0.0" in said
    assert said.count("the line sends back what is sent") == 1
    assert rate_of(said).startswith("40 Hz")


def test_a_device_without_a_register_is_observed_and_never_written(tmp_path: Path) -> None:
    with device("f07_no_register_75", tmp_path) as scripted:
        read = ahrsd("registers", "read", scripted.port, "--baud", 115200)
        one = ahrsd("registers", "read", scripted.port, "--baud", 115200, 23, 75)
        config = "configure_stream = true\n"
        said = run(scripted, tmp_path, "OBSERVING", 25, config)
        assert scripted.writes == []
    assert read.returncode == 0
    assert "Magnetometer Calibration\n     c [1 0 0; 0 1 0; 0 0 1]  b [0 0 0] gauss" in read.stdout
    missing = "firmware 1.1.1.0 has no register"
    assert f"{missing} 43, 44, 47, 75, 76, 77, 82, 84, 85" in read.stderr
    assert one.returncode == 1
    assert f"{missing} 75" in one.stderr
    assert "23  Magnetometer Calibration" in one.stdout
    (line,) = [line for line in said.splitlines() if "observed only" in line]
    assert "firmware 1.1.1.0 has no registers 44, 47, 75, 76, 77, 84, 85" in line
    assert rate_of(said).startswith("40 Hz")


def test_another_model_is_named_observed_and_never_written(tmp_path: Path) -> None:
    identity = ["1", "0", "0", "0", "1", "0", "0", "0", "1", ".1", "0", "0"]
    with device("f09_vn110", tmp_path) as scripted:
        port = (scripted.port, 23, *identity, "--yes", "--save", "--baud", 115200)
        written = ahrsd("registers", "write", *port, "--state-directory", tmp_path)
        said = run(scripted, tmp_path, "OBSERVING", 20, "configure_stream = true\n")
        assert scripted.writes == []
    assert written.returncode == 2
    assert "the model is VN-110-A, and only a VN-100 is written" in written.stderr
    (line,) = [line for line in said.splitlines() if "observed only" in line]
    assert "the model is VN-110-A" in line
    assert rate_of(said).startswith("40 Hz")


@contextlib.contextmanager
def emulated(firmware: int) -> Iterator[Callable[[str], str]]:
    """Asks `ahrsd emulate` as a terminal program does: a command in, the first reply out."""
    command = [*COMMAND, "emulate", "--firmware", str(firmware)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        fd = os.open(process.stdout.readline().strip(), os.O_RDWR | os.O_NOCTTY)
        tty.setraw(fd)

        def ask(body: str) -> str:
            os.write(fd, f"${body}*{functools.reduce(xor, body.encode()):02X}\r\n".encode())
            heard, end_s = b"", time.monotonic() + PATIENCE_S
            reply = re.compile(rb"\$(VN(?:ERR|" + body[2:5].encode() + rb")[^*\r]*)\*[0-9A-F]+\r")
            while not (found := reply.search(heard)):
                assert time.monotonic() < end_s, heard[-200:]
                heard += os.read(fd, 4096)
            return found[1].decode()

        try:
            yield ask
        finally:
            os.close(fd)
            process.terminate()


def test_the_emulator_answers_as_devices_did_in_public_reports() -> None:
    """f38; in more ways in `vn100/emulator/test_emulator.py`."""
    ros2 = "VNWRG,75,3,40,29,7FFF,0210,000C"
    with emulated(2) as ask:
        assert ask("VNRRG,04").startswith("VNRRG,04,2.")
        assert ask(ros2) == ros2
        assert ask("VNBOM,1") == "VNBOM,1"
        assert ask("VNSFB") == "VNERR,04"
    with emulated(3) as ask:
        assert ask(ros2) == ros2
        assert ask("VNSIH,+090.000") == "VNSIH,+090.000"
        assert ask("VNSFB") == "VNSFB"
        assert ask("VNRRG,206") == "VNRRG,206,0,0,0,0"
        assert ask("VNRRG,116") == "VNRRG,116,0,0,0,0,0,0,0"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open every port")
def test_port_without_permission_is_refused_with_the_group(tmp_path: Path) -> None:
    with device("plain", tmp_path) as scripted:
        Path(scripted.port).chmod(0o000)
        read = ahrsd("registers", "read", scripted.port)
    assert read.returncode == 75
    assert "no permission" in read.stderr
