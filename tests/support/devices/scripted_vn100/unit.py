"""One scripted unit: what it answers, what it sends by itself, how it lies, what was done to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from scripted_vn100.memory import PER_PORT, TABLE, Memory, stored
from scripted_vn100.physics import Iron, Vehicle
from scripted_vn100.wire import BadLine, layout_of, packet, parse_command, sentence

REPLY_S = 0.002
SAVE_S = 0.5
STAMP_S = 0.0005  # of a message behind its sample
BASE_HZ = 800.0
CALIBRATION = (23, 84)


@dataclass(frozen=True)
class Change:
    """Something that changed a unit. `what`: "write", "save", "restart", "factory".

    who:     "host" (the cable that the daemon is on), "other" (the second port), "unit" (itself)
    before:  the register's text before it; `after`: what it holds then; `asked`: what was sent
    pair:    registers 23 and 84 afterwards in RAM; for VNRFS in flash
    """

    at_s: float
    serial: int
    what: str
    who: str
    register: int = 0
    before: str = ""
    after: str = ""
    asked: str = ""
    pair: tuple[str, str] = ("", "")


@dataclass
class Lies:
    """How a unit does other than it says.

    not_held:    registers whose write is acknowledged and not carried out
    reads_told:  and whose reading repeats what was told
    not_saved:   VNWNV is acknowledged, the flash stays
    half_saved:  VNWNV saves register 23 and not 84
    refuse:      register -> VNERR code of a write
    """

    not_held: set[int] = field(default_factory=set)
    reads_told: bool = False
    not_saved: bool = False
    half_saved: bool = False
    refuse: dict[int, int] = field(default_factory=dict)


class Unit:
    """A device on port 1. `log` has every change; nothing in it is ever removed.

    boot_s:  when it was switched on, on the world's clock; its own time counts from there
    presets: registers as its user saved them
    """

    def __init__(
        self,
        serial: int,
        iron: Iron,
        vehicle: Vehicle,
        *,
        boot_s: float = 0.0,
        presets: dict[int, str] | None = None,
    ) -> None:
        self.serial, self.iron, self.vehicle, self.boot_s = serial, iron, vehicle, boot_s
        self.memory = Memory(serial, presets)
        self.lies = Lies()
        self.log: list[Change] = []
        self.asynchronous = True
        self.busy_until_s = 0.0
        self.silent_until_s = 0.0
        self._told: dict[int, str] = {}
        self._next_s = boot_s

    # -- what it is told ---------------------------------------------------------------------------

    def answer(self, line: bytes, at_s: float, who: str = "host") -> tuple[float, bytes]:
        """Carry out a command line (without its end); the reply and when it is there."""
        crc = self.memory.ram[30].split(",")[4] == "3"
        try:
            word, *tokens = parse_command(line)
            body, took_s = self._obey(word, tokens, at_s, who)
        except BadLine as error:
            body, took_s = f"VNERR,{error.code:02X}", 0.0
        return at_s + took_s + REPLY_S, sentence(body, crc=crc)

    def _obey(self, word: str, tokens: list[str], at_s: float, who: str) -> tuple[str, float]:
        if word == "VNRRG":
            number, port = self._register(tokens)
            return ",".join([f"VNRRG,{number:02d}", self.shown(number), *port]), 0.0
        if word == "VNWRG":
            number, _ = self._register(tokens[:1])
            return f"VNWRG,{number:02d}," + self._write(number, tokens[1:], at_s, who), 0.0
        if word == "VNASY" and tokens in (["0"], ["1"]):
            self.asynchronous = tokens == ["1"]
            self._next_s = max(self._next_s, at_s)
            return f"VNASY,{tokens[0]}", 0.0
        if word == "VNWNV" and not tokens:
            self.save(at_s, who)
            self.busy_until_s = at_s + SAVE_S
            return "VNWNV", SAVE_S
        if word == "VNRST" and not tokens:
            self.restart(at_s, who)
            return "VNRST", 0.0
        if word == "VNRFS" and not tokens:
            self.memory.factory()
            self._change(at_s, "factory", who, pair=self._pair("flash"))
            self.restart(at_s, who)
            return "VNRFS", 0.0
        raise BadLine(0x04)

    def _register(self, tokens: list[str]) -> tuple[int, list[str]]:
        try:
            number = int(tokens[0])
        except (IndexError, ValueError):
            raise BadLine(0x05 if not tokens else 0x08) from None
        if number not in TABLE:
            raise BadLine(0x08)
        return number, tokens[1:2] if number in PER_PORT else []

    def shown(self, number: int) -> str:
        """What it says that a register holds."""
        if self.lies.reads_told and number in self._told:
            return self._told[number]
        return self.memory.ram[number]

    def _write(self, number: int, tokens: list[str], at_s: float, who: str) -> str:
        if number in self.lies.refuse:
            raise BadLine(self.lies.refuse[number])
        port: list[str] = []
        if number in PER_PORT and len(tokens) == 2:
            tokens, port = tokens[:1], tokens[1:]
        text, before = stored(number, tokens), self.memory.ram[number]
        if port == ["2"]:  # the other port's own setting, which nobody here reads
            return ",".join([text, *port])
        if number not in self.lies.not_held or who != "host":  # it lies to one side only
            self.memory.ram[number] = text
            self._told.pop(number, None)
        else:
            self._told[number] = text
        held = self.memory.ram[number]
        self._change(
            at_s, "write", who, register=number, before=before, after=held, asked=text,
            pair=self._pair("ram"),
        )  # fmt: skip
        return ",".join([text, *port])

    def save(self, at_s: float, who: str) -> None:
        """All of RAM to flash."""
        keep = {84: self.memory.flash[84]} if self.lies.half_saved else {}
        if not self.lies.not_saved:
            self.memory.flash = {**self.memory.ram, **keep}
        self._change(at_s, "save", who, pair=self._pair("ram"))

    def restart(self, at_s: float, who: str = "unit", *, off_s: float = 0.0) -> None:
        """The power was gone for `off_s`, or a reset: RAM is flash, its time begins anew."""
        self.memory.restart()
        self._told.clear()
        self.asynchronous, self.boot_s = True, at_s + off_s
        self._next_s = self.silent_until_s = at_s + off_s
        self._change(at_s, "restart", who, pair=self._pair("ram"))

    def _pair(self, where: str) -> tuple[str, str]:
        memory = getattr(self.memory, where)
        return memory[23], memory[84]

    def _change(self, at_s: float, what: str, who: str, **facts: Any) -> None:
        self.log.append(Change(at_s, self.serial, what, who, **facts))

    # -- what it sends by itself -------------------------------------------------------------------

    @property
    def period_s(self) -> float:
        """Between two samples that are sent; inf where nothing is."""
        ram = self.memory.ram
        return _period_s(ram[6], ram[7], ram[75], ram[76], ram[77])

    def attach(self, at_s: float) -> None:
        """It was put on a cable; what it would have said before is gone."""
        self._next_s = max(self._next_s, at_s)

    def next_s(self) -> float:
        """When its next message is due."""
        if not self.asynchronous or self.period_s == float("inf"):
            return float("inf")
        return max(self._next_s, self.silent_until_s)

    def stream(self, until_s: float) -> list[tuple[float, bytes]]:
        """Messages of the samples up to a time, each with when it is out."""
        found: list[tuple[float, bytes]] = []
        period_s = self.period_s
        while (due_s := self.next_s()) <= until_s:
            step = int(np.ceil(due_s / period_s - 1e-6))
            sample_s = step * period_s
            if sample_s > until_s:
                break
            self._next_s = sample_s + 0.5 * period_s
            if self.busy_until_s > sample_s:
                continue
            found.append((sample_s + STAMP_S, self._messages(sample_s, period_s)))
        return found

    def _messages(self, sample_s: float, period_s: float) -> bytes:
        facts = self._facts(sample_s, period_s)
        out = bytearray()
        for _, groups, words in _binaries(*(self.memory.ram[n] for n in (75, 76, 77))):
            names, form = layout_of(groups, words)
            values: list[Any] = []
            for name in names:
                value = facts[name]
                values += value if isinstance(value, list) else [value]
            out += packet(groups, words, form, values)
        kind = self.memory.ram[6]
        if kind in _TEXT:
            crc = self.memory.ram[30].split(",")[4] == "3"
            out += sentence(_TEXT[kind](facts), crc=crc)
        return bytes(out)

    def _facts(self, sample_s: float, period_s: float) -> dict[str, Any]:
        """What every message draws from: registers 23, 25 and 84 act on it, nothing else does."""
        raw, rate, force = self.vehicle.reading(self.iron, sample_s, period_s)
        mag, gyro = self._applied(23, raw), self._applied(84, rate)
        accel = force.tolist()
        return {
            "time_ns": max(round((sample_s - self.boot_s) * 1e9), 0), "sync_in": 0,
            "imu_status": 0, "sens_sat": 0, "temp": 25.0, "pres": 101.3,
            "uncomp_mag": mag, "uncomp_accel": accel, "uncomp_gyro": gyro,
            "mag": mag, "accel": accel, "gyro": gyro, "ypr_deg": [0.0, 0.0, 0.0],
            "imu": accel + gyro, "mag_pres": [*mag, 25.0, 101.3],
        }  # fmt: skip

    def _applied(self, number: int, values: np.ndarray) -> list[float]:
        """C (x - B) of the register in RAM."""
        matrix, offset = _matrix_and_offset(self.memory.ram[number])
        result: list[float] = (matrix @ (values - offset)).tolist()
        return result

    def uptime_s(self, at_s: float) -> float:
        """Its own time since it was switched on."""
        return at_s - self.boot_s


@cache
def _binaries(*registers: str) -> list[tuple[int, int, list[int]]]:
    """Divisor, groups and words of each packet that these registers ask for."""
    found = []
    for register in registers:
        mode, divisor, groups, *words = register.split(",")
        if mode in ("1", "3") and int(divisor) and int(groups, 16):
            found.append((int(divisor), int(groups, 16), [int(w, 16) for w in words]))
    return found


@cache
def _period_s(text: str, rate: str, *binary: str) -> float:
    divisors = [divisor for divisor, _, _ in _binaries(*binary)]
    if text != "0" and int(rate):
        divisors.append(round(BASE_HZ / int(rate)))
    return min(divisors) / BASE_HZ if divisors else float("inf")


@cache
def _matrix_and_offset(register: str) -> tuple[np.ndarray, np.ndarray]:
    numbers = np.array([float(token) for token in register.split(",")])
    return numbers[:9].reshape(3, 3), numbers[9:]


def _ymr(facts: dict[str, Any]) -> str:
    y, m, a, g = (facts[name] for name in ("ypr_deg", "mag", "accel", "gyro"))
    return "VNYMR," + ",".join(
        [f"{v:+08.3f}" for v in y]
        + [f"{v:+08.4f}" for v in m]
        + [f"{v:+07.3f}" for v in a]
        + [f"{v:+010.6f}" for v in g]
    )


def _imu(facts: dict[str, Any]) -> str:
    m, a, g = (facts[name] for name in ("uncomp_mag", "uncomp_accel", "uncomp_gyro"))
    return "VNIMU," + ",".join(
        [f"{v:+08.4f}" for v in m]
        + [f"{v:+07.3f}" for v in a]
        + [f"{v:+010.6f}" for v in g]
        + [f"{facts['temp']:+05.1f}", f"{facts['pres']:+08.3f}"]
    )


_TEXT = {"14": _ymr, "19": _imu}
