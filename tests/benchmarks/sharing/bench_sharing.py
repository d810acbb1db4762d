"""What a shared port costs a driver: the time from the device's port to the driver's, and bytes.

    python tests/benchmarks/sharing/bench_sharing.py
        [--rate HZ] [--seconds S] [--way NAME] [--wire socket] [--times N]

A writer puts binary packets with the host's time into a pty, a reader stamps each when it is whole:
directly, through `ahrsd run` (mode passive) with a shared port or with a raw share over tcp, and
through socat where that is installed. `alone` is the daemon without a share and `unread` one with a
shared port that nobody opens: what their processor time differs by is what sharing costs. `crowd`:
over tcp with 15 readers more, one of which never reads; the losses are those of all that read.
Median and 99 % of the delay in ms, messages lost, and the daemon's share of a core.
Run it on a quiet machine: the figures are those of the scheduler otherwise. A busy one can be made
quiet for a while with `chrt -r 20 python ...bench_sharing.py --wire socket` (root): the
kernel hands the bytes of a pty over in threads of ordinary priority, those of a socket it does not.
Then the device is a server on this machine, and only what a network reader gets is measured.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from cabled_units import crc16
from free_port import free_port

HEAD = bytes([0xFA, 0x01]) + struct.pack("<H", 0x0001 | 0x0008 | 0x0020 | 0x0400)
PATIENCE_S = 30.0
CROWD = 14
SETTLE_S = 2.0


@dataclass
class Way:
    """Where to read, the process between, and what other readers lost by the end."""

    reader: int | None
    pid: int | None = None
    others_lost: int = 0


Opened = Callable[[str, Path], contextlib.AbstractContextManager[Way]]


def packet(number: int, moved: tuple[float, ...] = (0.0,) * 6) -> bytes:
    """Group 1 with TimeStartup (the host's), YawPitchRoll (yaw: a number), AngularRate, MagPres."""
    data = struct.pack("<Q", time.monotonic_ns())
    data += struct.pack("<3f3f3f2f", number, 0.1, 0.1, *moved, 25.0, 101.3)
    return HEAD + data + struct.pack(">H", crc16((HEAD + data)[1:]))


def motion(rate_hz: float, seconds: float) -> list[tuple[float, ...]]:
    """Rate of turn and field of a vehicle that turns all the time, so that there is an estimate."""
    draw, attitude, rows = np.random.default_rng(1), np.eye(3), []
    for t in np.arange(0.0, seconds, 1.0 / rate_hz).tolist():
        rate = np.array([0.5 * np.sin(0.7 * t), 0.6 * np.cos(0.45 * t), 0.7])
        x, y, z = rate / rate_hz
        step = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        attitude = attitude @ (np.eye(3) + step + step @ step / 2)
        field = attitude.T @ [0.2, 0.0, 0.42] + [0.05, -0.03, 0.04]
        noise = 1e-3 * draw.normal(size=6)
        rows.append(tuple(float(v) for v in np.concatenate([rate, field]) + noise))
    return rows


SIZE = len(packet(0))


def pair() -> tuple[int, int, str]:
    """Master and slave of a raw pty, and its name."""
    master, slave = os.openpty()
    tty.setraw(slave)
    return master, slave, os.ttyname(slave)


class Pty:
    """A device on a pty."""

    def __init__(self) -> None:
        self._master, self._slave, self.name = pair()

    def taken(self) -> None:
        """Another process is to have it."""
        os.close(self._slave)

    def write(self, data: bytes) -> None:
        os.write(self._master, data)

    def close(self) -> None:
        os.close(self._master)


class Server:
    """A device on a device server: whoever connects last has it."""

    def __init__(self) -> None:
        self._place = socket.create_server(("127.0.0.1", 0))
        self._place.settimeout(0.2)
        self.name = f"socket://127.0.0.1:{self._place.getsockname()[1]}"
        self._taker: socket.socket | None = None

    def taken(self) -> None:
        """Nothing is to be done."""

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            if self._taker is None:
                self._taker = self._place.accept()[0]
                self._taker.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                self._taker.sendall(data)
            except OSError:  # it was only looked at
                self._taker.close()
                self._taker = None

    def close(self) -> None:
        if self._taker is not None:
            self._taker.close()
        self._place.close()


def write(wire: Pty | Server, rate_hz: float, stop: threading.Event, count: list[int]) -> None:
    """Packets at their times until `stop`; after a break it is not caught up."""
    rows = motion(rate_hz, 60.0)
    due_s = time.monotonic()
    while not stop.is_set():
        due_s = max(due_s + 1.0 / rate_hz, time.monotonic() - 0.1)
        if (wait_s := due_s - time.monotonic()) > 0.0:
            time.sleep(wait_s)
        wire.write(packet(count[0], rows[count[0] % len(rows)]))
        count[0] += 1


def read(reader: int | None, seconds: float) -> tuple[np.ndarray, int]:
    """Delay of each packet in ms, and how many were missing between the first and the last."""
    if reader is None:
        time.sleep(seconds)
        return np.array([]), 0
    os.set_blocking(reader, False)
    got, delays, numbers, end_s = b"", [], [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        if not select.select([reader], [], [], 0.2)[0]:
            continue
        with contextlib.suppress(BlockingIOError):
            got += os.read(reader, 65536)
        now_ns = time.monotonic_ns()
        while (start := got.find(HEAD)) >= 0 and len(got) >= start + SIZE:
            sent_ns, number = struct.unpack_from("<Qf", got, start + 4)
            delays.append((now_ns - sent_ns) * 1e-6)
            numbers.append(int(number))
            got = got[start + SIZE :]
    return np.array(delays), numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0


@contextlib.contextmanager
def direct(device: str, _folder: Path) -> Iterator[Way]:
    """The device's own port."""
    if device.startswith("socket://"):
        yield Way(connected(int(device.rpartition(":")[2])).detach())
    else:
        yield Way(os.open(device, os.O_RDWR | os.O_NOCTTY))


@contextlib.contextmanager
def running(command: list[str]) -> Iterator[int]:
    """A program that shares the port; its process."""
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as process:
        try:
            yield process.pid
        finally:
            process.terminate()
            process.wait()


def ahrsd(device: str, folder: Path, share: str) -> list[str]:
    """The command of `ahrsd run` with this share."""
    config = folder / "ahrsd.toml"
    config.write_text(
        f'mode = "passive"\nstate_directory = "{folder}"\n[device]\nport = "{device}"\n'
        "baud = 115200\n" + (f"[[share]]\n{share}\n" if share else "")
    )
    return [sys.executable, "-m", "ahrsd", "run", "--config", str(config)]


@contextlib.contextmanager
def alone(device: str, folder: Path) -> Iterator[Way]:
    """`ahrsd run` without a share."""
    with running(ahrsd(device, folder, "")) as pid:
        await_opened(device, pid)
        yield Way(None, pid)


@contextlib.contextmanager
def unread(device: str, folder: Path) -> Iterator[Way]:
    """A shared port that nobody opens."""
    with running(ahrsd(device, folder, f'pty = "{folder / "shared"}"')) as pid:
        await_opened(device, pid)
        yield Way(None, pid)


@contextlib.contextmanager
def shared(device: str, folder: Path) -> Iterator[Way]:
    """A shared port of `ahrsd run`."""
    port = folder / "shared"
    with running(ahrsd(device, folder, f'pty = "{port}"')) as pid:
        yield Way(opened(port), pid)


@contextlib.contextmanager
def tcp(device: str, folder: Path) -> Iterator[Way]:
    """A raw share over tcp."""
    place = free_port()
    with running(ahrsd(device, folder, f'tcp = "127.0.0.1:{place}"')) as pid:
        yield Way(connected(place).detach(), pid)


@contextlib.contextmanager
def crowd(device: str, folder: Path) -> Iterator[Way]:
    """The same with 14 readers in another process, and one that never reads."""
    place, way = free_port(), Way(-1)
    with contextlib.ExitStack() as leaving:
        way.pid = leaving.enter_context(
            running(ahrsd(device, folder, f'tcp = "127.0.0.1:{place}"'))
        )
        idle = leaving.enter_context(connected(place))
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        drain = leaving.enter_context(
            subprocess.Popen(
                [sys.executable, __file__, "--drain", str(place)], stdout=subprocess.PIPE
            )
        )
        assert drain.stdout is not None
        assert drain.stdout.readline() == b"connected\n"
        way.reader = connected(place).detach()
        yield way
        os.kill(way.pid, signal.SIGTERM)  # the readers say what they have when it ends
        way.others_lost = int(drain.stdout.readline())


def drain(place: int) -> None:
    """Read until the other side ends, and print how many packets are missing, of all readers."""
    readers = dict.fromkeys((connected(place) for _ in range(CROWD)), b"")
    print("connected", flush=True)
    left, missing, last = set(readers), 0, dict.fromkeys(readers, -1)
    while left:
        for one in select.select(list(left), [], [])[0]:
            data = one.recv(1 << 16)
            if not data:
                left.discard(one)
            got = readers[one] + data
            while (start := got.find(HEAD)) >= 0 and len(got) >= start + SIZE:
                number = int(struct.unpack_from("<Qf", got, start + 4)[1])
                missing += number - last[one] - 1 if last[one] >= 0 else 0
                last[one], got = number, got[start + SIZE :]
            readers[one] = got
    print(missing, flush=True)


@contextlib.contextmanager
def socat(device: str, folder: Path) -> Iterator[Way]:
    """socat between the two."""
    if device.startswith("socket://"):
        place, host = free_port(), device.removeprefix("socket://")
        to = f"tcp-listen:{place},bind=127.0.0.1,nodelay"
        with running(["socat", to, f"tcp:{host}"]) as pid:
            yield Way(connected(place).detach(), pid)
        return
    port = folder / "socat"
    with running(["socat", f"{device},raw,echo=0", f"pty,raw,echo=0,link={port}"]) as pid:
        yield Way(opened(port), pid)


def connected(place: int) -> socket.socket:
    """A connection, as soon as somebody listens."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", place))
        except ConnectionRefusedError:
            if time.monotonic() > end_s:
                raise SystemExit(f"nobody listens at {place}") from None
            time.sleep(0.05)


def opened(port: Path) -> int:
    """The port, as soon as it is there."""
    end_s = time.monotonic() + PATIENCE_S
    while not port.exists():
        if time.monotonic() > end_s:
            raise SystemExit(f"{port} does not appear")
        time.sleep(0.05)
    return os.open(port, os.O_RDWR | os.O_NOCTTY)


def await_opened(device: str, pid: int) -> None:
    """Wait until the process has the device open."""
    end_s = time.monotonic() + PATIENCE_S
    while not any(_link(entry) == device for entry in Path(f"/proc/{pid}/fd").iterdir()):
        if time.monotonic() > end_s:
            raise SystemExit(f"nobody opens {device}")
        time.sleep(0.05)


def _link(entry: Path) -> str:
    try:
        return str(entry.readlink())
    except OSError:  # closed meanwhile
        return ""


def cpu_s(pid: int) -> float:
    """Processor time of a process until now."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(
    way: Opened, rate_hz: float, seconds: float, kind: type[Pty | Server] = Pty
) -> dict[str, float]:
    """One way at one rate."""
    wire = kind()
    stop, count = threading.Event(), [0]
    writer = threading.Thread(target=write, args=(wire, rate_hz, stop, count), daemon=True)
    with tempfile.TemporaryDirectory() as folder:
        if way is not direct:
            wire.taken()
        writer.start()
        with way(wire.name, Path(folder)) as there:
            read(there.reader, SETTLE_S)  # what waits since it was opened
            pid = there.pid
            used_s, begun_s = cpu_s(pid) if pid else 0.0, time.monotonic()
            delays, lost = read(there.reader, seconds)
            share = (cpu_s(pid) - used_s) / (time.monotonic() - begun_s) if pid else 0.0
            stop.set()
            writer.join()
            if there.reader is not None:
                os.close(there.reader)
    wire.close()
    core = {"core_percent": round(100.0 * share, 1)}
    if not len(delays):
        return core
    return {
        "packets": len(delays),
        "median_ms": round(float(np.median(delays)), 3),
        "p99_ms": round(float(np.percentile(delays, 99)), 3),
        "worst_ms": round(float(delays.max()), 1),
        "lost": lost + there.others_lost,
        **core,
    }


def main() -> None:
    """Measure each way at each rate."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rate", type=float, action="append", help="Hz; default 200 and 800")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument(
        "--way", action="append", help="direct, alone, unread, shared, tcp, crowd, socat; all"
    )
    parser.add_argument("--times", type=int, default=1, help="all of it, by turns")
    parser.add_argument("--wire", choices=["pty", "socket"], default="pty", help="of the device")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--drain", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.drain:
        drain(options.drain)
        return
    ways: dict[str, Opened] = {"direct": direct, "alone": alone, "unread": unread}
    ways |= {"shared": shared, "tcp": tcp, "crowd": crowd}
    if shutil.which("socat"):
        ways["socat"] = socat
    if options.wire == "socket":
        del ways["shared"], ways["unread"]  # a pty again
    found: dict[str, list[dict[str, float]]] = {}
    kind = Server if options.wire == "socket" else Pty
    for rate_hz in options.rate or (200.0, 800.0):
        for name, way in [*ways.items()] * options.times:
            if options.way and name not in options.way:
                continue
            row = measured(way, rate_hz, options.seconds, kind)
            found.setdefault(f"{name} {rate_hz:.0f} Hz", []).append(row)
            print(f"{name:8} {rate_hz:4.0f} Hz", row, flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
