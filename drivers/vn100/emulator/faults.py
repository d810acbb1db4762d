"""What can go wrong with the emulated VN-100, by name, and when.

A schedule is text: `name[=parameter][@start[+duration]]`, times in seconds since the start.

    byte_drop                 all the time, with the default parameter
    byte_drop=0.01@30+5       one byte in a hundred, from 30 s for 5 s
    reset@60                  once, at 60 s

A `lasting` fault without a duration never ends, and without a start begins at 0. Faults that strike
once happen at their start (default `ONCE_DEFAULT_S`); for those that go away again (unplug) the
duration is the time until they do. Every fault draws from its own generator: the same seed and the
same schedule give the same bytes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from drivers.vn100.emulator.physics import Dipole, Disturbance, IronStep

ONCE_DEFAULT_S = 10.0


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A row of the table. `duration_s` is the default length; 0 for what strikes once."""

    description: str
    parameter: float
    unit: str
    duration_s: float = math.inf

    @property
    def is_probability(self) -> bool:
        """Whether the parameter is one, of each byte or message."""
        return self.unit.startswith("per ")


def _once(
    description: str, parameter: float = 0.0, unit: str = "", lasts_s: float = 0.0
) -> FaultKind:
    return FaultKind(description, parameter, unit, lasts_s)


FAULTS: dict[str, FaultKind] = {
    # the wire
    "byte_drop": FaultKind("bytes from the device get lost", 1e-3, "per byte"),
    "bit_flip": FaultKind("single bits from the device flip", 1e-3, "per byte"),
    "noise_insert": FaultKind("1 to 40 random bytes get into a message", 0.05, "per message"),
    "false_header": FaultKind("0xFA and headers of long packets before it", 0.05, "per message"),
    "garbage": FaultKind("messages turn into random bytes", 1.0, "per message"),
    "duplicate": FaultKind("messages arrive twice", 0.05, "per message"),
    "intermittent": FaultKind("whole messages get lost", 0.3, "per message"),
    "burst_latency": FaultKind("the USB adapter delivers in bunches", 16.0, "ms"),
    "baud_mismatch": FaultKind("both ends run at different rates", 0.0, ""),
    "mute": FaultKind("the device hears but sends nothing", 0.0, ""),
    "off": FaultKind("the device neither hears nor sends", 0.0, ""),
    # replies
    "late_reply": FaultKind("replies come late", 0.7, "s"),
    "lost_reply": FaultKind("commands act but their replies get lost", 1.0, "per reply"),
    "wrong_reply": FaultKind("replies name another register", 1.0, "per reply"),
    "altered_reply": FaultKind("a digit of the reply changes, checksum valid", 1.0, "per reply"),
    "refused_write": FaultKind("VNWRG is answered with this VNERR code", 7.0, "code"),
    "refused_command": FaultKind("every command is answered with this VNERR code", 4.0, "code"),
    "silent_refusal": FaultKind(
        "VNWRG of this register (0: of all) is echoed, not stored", 0.0, "register"
    ),
    "collision": FaultKind(
        "VNWRG over 100 characters while streaming loses a byte (VNERR 03)", 0.57, "per command"
    ),
    # the sensor
    "stuck": FaultKind("the sensors repeat their last values", 0.0, ""),
    "dipole": _once("a magnet is carried past", 5.0, "A m2", 4.0),
    "iron_step": _once("the vehicle picks up iron", 0.1, "gauss"),
    "clock_step": _once("TimeStartup jumps ahead", 1.0, "s"),
    "clock_wrap": _once("TimeStartup begins again at 0, without a restart"),
    # power and people
    "reset": _once("the device restarts: RAM lost, TimeStartup from 0"),
    "unplug": _once("the port disappears; 1: the device loses power too", 1.0, "", 2.0),
    "replug_other_serial": _once("unplugged; another device comes back", 0.0, "", 2.0),
    "power_cut": _once("power fails", 0.0, "", 2.0),
    "power_cut_wrg": _once("power fails after the n-th VNWRG from then on", 1.0, "n", 2.0),
    "power_cut_wnv": _once("power fails in the next VNWNV, nothing saved", 0.0, "", 2.0),
    "torn_flash": _once("power fails in the next VNWNV, half saved", 0.0, "", 2.0),
    "third_party_write": _once(
        "another program on this line writes the register", 23.0, "register"
    ),
    "third_party_change": _once("a register changes without notice", 23.0, "register"),
}

_SCHEDULE = re.compile(r"(\w+)(?:=([^@+]+))?(?:@([^+]+)(?:\+(.+))?)?")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a schedule."""

    name: str
    parameter: float
    start_s: float
    duration_s: float

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.start_s + self.duration_s


def _number(text: str, what: str, schedule: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"fault {schedule!r}: {what} must be a number >= 0, not {text!r}")
    return value


def parse_fault(schedule: str) -> Fault:
    """A fault from `name[=parameter][@start[+duration]]`.

    Raises ValueError naming what is wrong and what is allowed.
    """
    match = _SCHEDULE.fullmatch(schedule.strip())
    if match is None:
        raise ValueError(f"fault {schedule!r}: expected name[=parameter][@start[+duration]]")
    name, parameter, start, duration = match.groups()
    kind = FAULTS.get(name)
    if kind is None:
        raise ValueError(f"no fault {name!r}; there are {', '.join(FAULTS)}")
    begins_s = 0.0 if kind.duration_s == math.inf else ONCE_DEFAULT_S
    size = kind.parameter if parameter is None else _number(parameter, "parameter", schedule)
    if kind.is_probability and size > 1.0:
        raise ValueError(f"fault {schedule!r}: parameter is a probability, at most 1")
    return Fault(
        name,
        size,
        begins_s if start is None else _number(start, "start", schedule),
        kind.duration_s if duration is None else _number(duration, "duration", schedule),
    )


class FaultPlan:
    """The faults of one emulator: what is active when, and what it does to bytes."""

    def __init__(self, schedules: Iterable[str] = (), seed: int = 0) -> None:
        self.faults = tuple(parse_fault(schedule) for schedule in schedules)
        self._draw = [np.random.default_rng([seed, 4, index]) for index in range(len(self.faults))]
        once = [fault for fault in self.faults if FAULTS[fault.name].duration_s != math.inf]
        self.events = tuple(sorted(once, key=lambda fault: fault.start_s))

    def active(self, name: str, now_s: float) -> Fault | None:
        """The first fault of that name that is in force now."""
        for fault in self.faults:
            if fault.name == name and fault.start_s <= now_s < fault.end_s:
                return fault
        return None

    def strikes(self, name: str, now_s: float) -> bool:
        """Whether a fault whose parameter is a probability happens this time."""
        fault = self.active(name, now_s)
        if fault is None:
            return False
        return bool(self._draw[self.faults.index(fault)].random() < fault.parameter)

    def disturbances(self) -> tuple[Disturbance, ...]:
        """The faults that act on the field."""
        found: list[Disturbance] = []
        for fault in self.faults:
            if fault.name == "dipole":
                found.append(Dipole(fault.start_s, fault.duration_s, fault.parameter))
            elif fault.name == "iron_step":
                found.append(IronStep(fault.start_s, fault.parameter))
        return tuple(found)

    def release_s(self, sent_s: float) -> float:
        """When bytes that left the device at `sent_s` reach the host."""
        fault = self.active("burst_latency", sent_s)
        if fault is None or fault.parameter == 0:
            return sent_s
        grid_s = fault.parameter / 1000
        return math.ceil(sent_s / grid_s) * grid_s

    def distort(self, message: bytes, now_s: float) -> bytes:
        """What becomes of a whole message on its way to the host."""
        if self.active("off", now_s) or self.active("mute", now_s):
            return b""
        for index, fault in enumerate(self.faults):
            if fault.name in _DISTORTIONS and fault.start_s <= now_s < fault.end_s:
                message = _DISTORTIONS[fault.name](message, fault.parameter, self._draw[index])
        return message

    def distort_command(self, data: bytes, now_s: float) -> bytes:
        """What becomes of the host's bytes on their way to the device."""
        if self.active("off", now_s):
            return b""
        fault = self.active("baud_mismatch", now_s)
        return data if fault is None else garble(data, self._draw[self.faults.index(fault)])


_Draw = np.random.Generator


def garble(data: bytes, draw: _Draw) -> bytes:
    """Bytes as an UART at the wrong rate sees them: other bits, and not as many."""
    kept = draw.random(len(data)) < 0.8
    mask = draw.integers(1, 256, len(data), dtype=np.uint8)
    return (np.frombuffer(data, dtype=np.uint8) ^ mask)[kept].tobytes()


def _byte_drop(message: bytes, rate: float, draw: _Draw) -> bytes:
    kept = draw.random(len(message)) >= rate
    return np.frombuffer(message, dtype=np.uint8)[kept].tobytes()


def _bit_flip(message: bytes, rate: float, draw: _Draw) -> bytes:
    flipped = draw.random(len(message)) < rate
    bit = np.left_shift(1, draw.integers(0, 8, len(message))).astype(np.uint8)
    return (np.frombuffer(message, dtype=np.uint8) ^ np.where(flipped, bit, 0)).tobytes()


def _noise_insert(message: bytes, rate: float, draw: _Draw) -> bytes:
    if draw.random() >= rate:
        return message
    at = int(draw.integers(0, len(message) + 1))
    return message[:at] + draw.bytes(int(draw.integers(1, 41))) + message[at:]


# A packet of 602 bytes by the general tables (seen in a recording, vector bin_false_header_85), and
# one of 472 bytes that passes the VN-100's own masks: group 17, all of its fields.
FALSE_HEADERS = (
    bytes.fromhex("FA60B9006179"),
    bytes.fromhex("FA173D3F9101FF1FFF11"),
    b"\xfa" * 6,
)


def _false_header(message: bytes, rate: float, draw: _Draw) -> bytes:
    if draw.random() >= rate:
        return message
    return FALSE_HEADERS[int(draw.integers(len(FALSE_HEADERS)))] + message


def _garbage(message: bytes, rate: float, draw: _Draw) -> bytes:
    return draw.bytes(len(message)) if draw.random() < rate else message


def _duplicate(message: bytes, rate: float, draw: _Draw) -> bytes:
    return message * 2 if draw.random() < rate else message


def _intermittent(message: bytes, rate: float, draw: _Draw) -> bytes:
    return b"" if draw.random() < rate else message


_DISTORTIONS: dict[str, Callable[[bytes, float, _Draw], bytes]] = {
    "byte_drop": _byte_drop,
    "bit_flip": _bit_flip,
    "noise_insert": _noise_insert,
    "false_header": _false_header,
    "garbage": _garbage,
    "duplicate": _duplicate,
    "intermittent": _intermittent,
    "baud_mismatch": lambda message, _, draw: garble(message, draw),
}
