"""A quiet emulated device and a host that talks to it one command at a time.

Sums and lines are made and checked here and not by the project's codec, so that a mistake which
codec and emulator share does not pass.
"""

import re
from functools import reduce
from operator import xor

from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import EmulatedTruth, make_motion


def xor8(body: bytes) -> bytes:
    return b"%02X" % reduce(xor, body, 0)


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        crc &= 0xFFFF
    return crc


def command(body: str) -> bytes:
    return b"$%s*%s\r\n" % (body.encode(), xor8(body.encode()))


def bodies(wire: bytes) -> list[str]:
    """Bodies of a wire that carries sentences only; every byte must belong to a valid one."""
    found = []
    for line in wire.split(b"\r\n")[:-1]:
        match = re.fullmatch(rb"\$([ -~]+)\*([0-9A-F]{2}|[0-9A-F]{4})", line)
        assert match, line
        body, check = match.groups()
        assert check == (xor8(body) if len(check) == 2 else b"%04X" % crc16(body)), line
        found.append(body.decode())
    assert wire == b"" or wire.endswith(b"\r\n")
    return found


def device(motion="static", truth=None, **options) -> Emulator:
    return Emulator(truth or EmulatedTruth(), make_motion(motion, 1), **options)


def quiet(**options) -> Emulator:
    """A device that sends nothing by itself."""
    made = device(presets={6: (0,), **options.pop("presets", {})}, **options)
    assert made.advance(0.01) == b""
    return made


class Host:
    """Talks to a quiet device, one command at a time."""

    def __init__(self, made: Emulator, now_s: float = 0.01) -> None:
        self.device, self.now_s = made, now_s

    def send(self, line: bytes, wait_s: float = 0.1) -> bytes:
        self.device.receive(line, self.now_s)
        self.now_s += wait_s
        return self.device.advance(self.now_s)

    def ask(self, body: str, wait_s: float = 0.1) -> str:
        (answer,) = bodies(self.send(command(body), wait_s))
        return answer

    def wait(self, seconds: float) -> bytes:
        self.now_s += seconds
        return self.device.advance(self.now_s)
