"""What a shared port costs a driver: the time from the device's port to the driver's, and bytes.

    python tests/benchmarks/bench_sharing.py [--rate HZ] [--seconds S] [--json FILE]

A writer puts binary packets with the host's time into a pty, a reader stamps each when it is whole:
directly, through `ahrsd run` with a shared port (mode passive), and through socat where that is
installed. Median and 99 % of the delay in ms, messages lost, and the daemon's share of a core.
Run it on a quiet machine: the figures are those of the scheduler otherwise.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

from cabled_units import crc16

HEAD = bytes([0xFA, 0x01]) + struct.pack("<H", 0x0001 | 0x0008 | 0x0020 | 0x0400)
PATIENCE_S = 30.0
Opened = Callable[[str, Path], contextlib.AbstractContextManager[tuple[int, int | None]]]


def packet(number: int) -> bytes:
    """Group 1 with TimeStartup (the host's), YawPitchRoll (yaw: a number), AngularRate, MagPres."""
    data = struct.pack("<Q", time.monotonic_ns())
    data += struct.pack("<3f3f3f2f", number, 0.1, 0.1, *([0.01] * 3), 0.2, 0.0, 0.4, 25.0, 101.3)
    return HEAD + data + struct.pack(">H", crc16((HEAD + data)[1:]))


SIZE = len(packet(0))


def pair() -> tuple[int, int, str]:
    """Master and slave of a raw pty, and its name."""
    master, slave = os.openpty()
    tty.setraw(slave)
    return master, slave, os.ttyname(slave)


def write(master: int, rate_hz: float, stop: threading.Event, count: list[int]) -> None:
    """Packets at their times until `stop`."""
    begun_s = time.monotonic()
    while not stop.is_set():
        due_s = begun_s + count[0] / rate_hz
        if (wait_s := due_s - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        os.write(master, packet(count[0]))
        count[0] += 1


def read(reader: int, seconds: float) -> tuple[np.ndarray, int]:
    """Delay of each packet in ms, and how many were missing between the first and the last."""
    os.set_blocking(reader, False)
    with contextlib.suppress(BlockingIOError):
        while os.read(reader, 65536):
            pass
    got, delays, numbers, end_s = b"", [], [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        if not select.select([reader], [], [], 0.2)[0]:
            continue
        got += os.read(reader, 65536)
        now_ns = time.monotonic_ns()
        while (start := got.find(HEAD)) >= 0 and len(got) >= start + SIZE:
            sent_ns, number = struct.unpack_from("<Qf", got, start + 4)
            delays.append((now_ns - sent_ns) * 1e-6)
            numbers.append(int(number))
            got = got[start + SIZE :]
    return np.array(delays), numbers[-1] - numbers[0] + 1 - len(numbers)


@contextlib.contextmanager
def direct(_device: str, _folder: Path) -> Iterator[tuple[int, int | None]]:
    """The device's own port."""
    yield os.open(_device, os.O_RDWR | os.O_NOCTTY), None


@contextlib.contextmanager
def shared(device: str, folder: Path) -> Iterator[tuple[int, int | None]]:
    """`ahrsd run` on the device's port, and its shared one."""
    port, config = folder / "shared", folder / "ahrsd.toml"
    config.write_text(
        f'mode = "passive"\nstate_directory = "{folder}"\n[device]\nport = "{device}"\n'
        f'baud = 115200\n[[share]]\npty = "{port}"\n'
    )
    command = [sys.executable, "-m", "ahrsd", "run", "--config", str(config)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as process:
        try:
            yield opened(port), process.pid
        finally:
            process.terminate()
            process.wait()


@contextlib.contextmanager
def socat(device: str, folder: Path) -> Iterator[tuple[int, int | None]]:
    """socat between the two."""
    port = folder / "socat"
    command = ["socat", f"{device},raw,echo=0", f"pty,raw,echo=0,link={port}"]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as process:
        try:
            yield opened(port), process.pid
        finally:
            process.terminate()
            process.wait()


def opened(port: Path) -> int:
    """The port, as soon as it is there."""
    end_s = time.monotonic() + PATIENCE_S
    while not port.exists():
        if time.monotonic() > end_s:
            raise SystemExit(f"{port} does not appear")
        time.sleep(0.05)
    return os.open(port, os.O_RDWR | os.O_NOCTTY)


def cpu_s(pid: int) -> float:
    """Processor time of a process until now."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(way: Opened, rate_hz: float, seconds: float) -> dict[str, float]:
    """One way at one rate."""
    master, slave, device = pair()
    stop, count = threading.Event(), [0]
    writer = threading.Thread(target=write, args=(master, rate_hz, stop, count), daemon=True)
    with tempfile.TemporaryDirectory() as folder:
        if way is not direct:
            os.close(slave)
        writer.start()
        with way(device, Path(folder)) as (reader, pid):
            time.sleep(1.0)
            used_s, begun_s = cpu_s(pid) if pid else 0.0, time.monotonic()
            delays, lost = read(reader, seconds)
            share = (cpu_s(pid) - used_s) / (time.monotonic() - begun_s) if pid else 0.0
            stop.set()
            writer.join()
            os.close(reader)
    os.close(master)
    return {
        "packets": len(delays),
        "median_ms": round(float(np.median(delays)), 3),
        "p99_ms": round(float(np.percentile(delays, 99)), 3),
        "lost": lost,
        "core_percent": round(100.0 * share, 1),
    }


def main() -> None:
    """Measure each way at each rate."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rate", type=float, action="append", help="Hz; default 200 and 800")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    ways: dict[str, Opened] = {"direct": direct, "shared": shared}
    if shutil.which("socat"):
        ways["socat"] = socat
    found = {}
    for rate_hz in options.rate or (200.0, 800.0):
        for name, way in ways.items():
            found[f"{name} {rate_hz:.0f} Hz"] = row = measured(way, rate_hz, options.seconds)
            print(f"{name:8} {rate_hz:4.0f} Hz", row, flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
