"""Sensors on a cable that can be moved from one to the other, written by hand for the write-back.

Shares no table and no codec with the project or its emulator: registers are a dict of texts, sums
are made here. A unit keeps what it was sent (`log`), what was written (`writes`) and saved
(`saves`); whoever holds the cable hears the host. `before` is called with each line just before the
unit acts on it, so that a test can pull the cable at every command.
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, reduce
from operator import xor

import numpy as np

ONE = "1,0,0,0,1,0,0,0,1,0,0,0"
FIELD_N, WEIGHT_N = np.array([0.24, 0.0, 0.42]), np.array([0.0, 0.0, -9.81])
I_3 = np.eye(3)
FACTORY = {
    1: "VN-100T-CR", 2: "7", 4: "3.1.0.0", 5: "115200", 6: "19", 7: "20",
    21: "0.234,0,0.4212,0,0,-9.79375", 23: ONE, 25: ONE, 26: "1,0,0,0,1,0,0,0,1",
    30: "0,0,0,0,1,0,1", 44: "0,1,5", 47: ONE, 75: "0,1,00", 76: "0,1,00", 77: "0,1,00", 84: ONE,
    85: "0,4,4,4,0,0,3,3,3,0",
}  # fmt: skip


def sentence(body: str) -> bytes:
    """With its sum, an exclusive or of eight bits."""
    return b"$%s*%02X\r\n" % (body.encode(), reduce(xor, body.encode(), 0))


def crc16(data: bytes) -> int:
    """CCITT, as at the end of a packet."""
    return crc_hqx(data, 0)


def printed(values: str) -> str:
    """Numbers as the device prints them, of single precision and with six digits."""
    return ",".join(f"{np.float32(float(v)):.6g}" for v in values.split(","))


@cache
def matrix_and_offset(values: str) -> tuple[np.ndarray, np.ndarray]:
    """Of register 23 or 84."""
    numbers = np.array([float(v) for v in values.split(",")])
    return numbers[:9].reshape(3, 3), numbers[9:]


@dataclass
class Unit:
    """One sensor. `binary`: packets with device time, else VNIMU text without any."""

    serial: int
    hard_iron: np.ndarray
    gyro_bias: np.ndarray
    binary: bool = False
    model: str = "VN-100T-CR"
    uptime_s: float = 1000.0
    flash: dict[int, str] = field(default_factory=dict)
    writes: list[tuple[int, str]] = field(default_factory=list)
    saves: list[dict[int, str]] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    before: Callable[[str], None] = lambda _: None
    paused: bool = False

    def __post_init__(self) -> None:
        self.flash = {**FACTORY, 1: self.model, 3: str(self.serial), **self.flash}
        self.ram = dict(self.flash)

    def restart(self) -> None:
        """What was not saved is gone."""
        self.ram, self.paused, self.uptime_s = dict(self.flash), False, 0.2

    def held(self, where: str = "ram") -> tuple[str, str]:
        """Registers 23 and 84."""
        memory = getattr(self, where)
        return printed(memory[23]), printed(memory[84])

    def answer(self, line: bytes) -> bytes:
        """To one line of the host."""
        text, _, given = line.decode("ascii").strip().removeprefix("$").partition("*")
        if given.upper() not in ("XX", f"{reduce(xor, text.encode(), 0):02X}"):
            return sentence("VNERR,03")
        self.log.append(text)
        word, *rest = text.split(",")
        if word in ("VNRRG", "VNWRG"):
            return self._register(word, int(rest[0]), rest[1:])
        if word == "VNASY":
            self.paused = rest == ["0"]
        elif word == "VNRST":
            self.restart()
        elif word == "VNWNV":
            self.flash = dict(self.ram)
            self.saves.append(dict(self.ram))
        else:
            return sentence("VNERR,04")
        return sentence(text)

    def _register(self, word: str, number: int, values: list[str]) -> bytes:
        if number not in self.ram:
            return sentence("VNERR,08")
        if word == "VNWRG":
            self.ram[number] = text = ",".join(values)
            self.writes.append((number, printed(text) if number in (23, 84) else text))
        text = self.ram[number]
        return sentence(f"{word},{number:02d},{printed(text) if number in (23, 84) else text}")

    def measure(self, R_nb: np.ndarray, rate: np.ndarray, iron: np.ndarray, noise) -> bytes:
        """One message, through the registers in RAM."""
        of_field, of_spin, of_force = noise.normal(size=(3, 3))
        if self.paused:
            return b""
        mag, mag_offset = matrix_and_offset(self.ram[23])
        gyro, gyro_offset = matrix_and_offset(self.ram[84])
        raw = R_nb.T @ FIELD_N + self.hard_iron + iron + 1e-3 * of_field
        raw = (mag @ (raw - mag_offset)).tolist()
        spin = (gyro @ (rate + self.gyro_bias + 1e-3 * of_spin - gyro_offset)).tolist()
        force = (R_nb.T @ WEIGHT_N + 1e-2 * of_force).tolist()
        if not self.binary:
            body = ("%+.6f," * 9) % (*raw, *force, *spin)
            return sentence(f"VNIMU,{body}+25.0,+101.300")
        head = bytes([0xFA, 0x06]) + struct.pack("<HH", 0x0001, 0x003F)
        data = struct.pack("<Q", int(self.uptime_s * 1e9))
        data += struct.pack("<H3f3f3fff", 0, *raw, *force, *spin, 25.0, 101.3)
        return head + data + struct.pack(">H", crc16((head + data)[1:]))


class Cable:
    """Who holds it hears the host; a swap leaves the line silent for a while."""

    def __init__(self, *units: Unit, rate_hz: float = 20.0, seed: int = 1) -> None:
        self.units = {unit.serial: unit for unit in units}
        self.unit: Unit = units[0]
        self.moving, self.iron = True, np.zeros(3)
        self.step_s = 1.0 / rate_hz
        self._noise = np.random.default_rng(seed)
        self._R = np.eye(3)
        self._t_s = 0.0
        self._silent_s = 0.0
        self._half = b""
        self._out = b""

    def swap(self, serial: int, silent_s: float = 2.0) -> None:
        """The cable goes to another unit, which starts; the first one loses its power."""
        self.unit.restart()
        self.unit = self.units[serial]
        self._silent_s = silent_s
        self._half = self._out = b""

    def fall_silent(self, seconds: float) -> None:
        """Nothing goes either way for a while; the unit stays."""
        self._silent_s = seconds

    def receive(self, data: bytes) -> None:
        """From the host."""
        lines = (self._half + data).split(b"\n")
        self._half = lines.pop()
        for line in lines:
            if self._silent_s > 0.0:
                continue
            self.unit.before(line.decode("ascii").strip()[1:].split("*")[0])
            if self._silent_s <= 0.0:
                self._out += self.unit.answer(line)

    def advance(self) -> bytes:
        """One step of time; what went to the host."""
        self._t_s += self.step_s
        t = self._t_s
        rate = np.array([0.5 * math.sin(0.7 * t), 0.6 * math.cos(0.45 * t), 0.7]) * self.moving
        self._R = self._R @ turn(rate * self.step_s)
        self.unit.uptime_s += self.step_s
        if self._silent_s > 0.0:
            self._silent_s -= self.step_s
            return b""
        out, self._out = self._out, b""
        return out + self.unit.measure(self._R, rate, self.iron, self._noise)


def turn(angle: np.ndarray) -> np.ndarray:
    """Rodrigues."""
    x, y, z = angle.tolist()
    size = math.hypot(x, y, z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if size < 1e-9:
        return I_3 + K
    return I_3 + math.sin(size) / size * K + (1.0 - math.cos(size)) / size**2 * (K @ K)
