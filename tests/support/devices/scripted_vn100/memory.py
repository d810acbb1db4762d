"""Registers of a VN-100 in RAM and flash: which there are, what they take, how they are printed."""

from __future__ import annotations

import struct

from scripted_vn100.wire import BadLine, layout_of

# Kinds: f float32, u whole number, s text, b binary output, m world model. "r": only read.
_IDENTITY = "1,0,0,0,1,0,0,0,1"
TABLE: dict[int, tuple[str, str, str]] = {
    0: ("s", "w", ""),
    1: ("s", "r", "VN-100T-CR"),
    2: ("u", "r", "7"),
    3: ("s", "r", "0000000000"),
    4: ("s", "r", "3.1.0.0"),
    5: ("u", "w", "115200"),
    6: ("u", "w", "14"),
    7: ("u", "w", "40"),
    21: ("6f", "w", "0.234,0,0.4212,0,0,-9.79375"),
    23: ("12f", "w", _IDENTITY + ",0,0,0"),
    25: ("12f", "w", _IDENTITY + ",0,0,0"),
    26: ("9f", "w", _IDENTITY),
    30: ("7u", "w", "0,0,0,0,1,0,1"),
    32: ("9u", "w", "3,0,0,0,3,0,0,500000,0"),
    33: ("3u", "r", "0,0,0"),
    35: ("4u", "w", "1,1,1,1"),
    36: ("9f", "w", "4,4,4,5,5,5,5.5,5.5,5.5"),
    38: ("9f", "w", "6,6,6,3,3,3,5,5,5"),
    43: ("3f", "w", "0,0,0"),
    44: ("3u", "w", "0,1,5"),
    47: ("12f", "r", _IDENTITY + ",0,0,0"),
    75: ("b", "w", "0,1,00"),
    76: ("b", "w", "0,1,00"),
    77: ("b", "w", "0,1,00"),
    82: ("5u", "w", "0,0,0,0,0"),
    83: ("m", "w", "0,0,0,0,1000,0.000,+00.00000000,+000.00000000,+00000.000"),
    84: ("12f", "w", _IDENTITY + ",0,0,0"),
    85: ("10u", "w", "0,4,4,4,0,0,3,3,3,0"),
}
_RATES = (0, 1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
_BAUDS = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
_OUTPUTS = (0, 1, 2, 8, 10, 11, 12, 13, 14, 16, 17, 19, 30)
PER_PORT = (5, 6, 7)


def float32(value: float) -> float:
    """As the device stores it."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def printed(value: float) -> str:
    """A configuration float as the device prints it: %G of the stored float."""
    return f"{float32(value):G}"


def stored(number: int, tokens: list[str]) -> str:
    """What a register holds after these tokens were written, as it is printed. Raises BadLine."""
    kind, access, _ = TABLE[number]
    if access == "r":
        raise BadLine(0x09)
    if kind == "s":
        return ",".join(tokens)[:20]
    if kind == "b":
        return _binary(tokens)
    if kind == "m":
        return ",".join(tokens)
    count = int(kind[:-1] or 1)
    if len(tokens) != count:
        raise BadLine(0x05 if len(tokens) < count else 0x06)
    try:
        numbers = [float(t) for t in tokens] if kind.endswith("f") else [int(t) for t in tokens]
    except ValueError:
        raise BadLine(0x07) from None
    _in_range(number, numbers)
    if kind.endswith("f"):
        return ",".join(printed(value) for value in numbers)
    return ",".join(str(value) for value in numbers)


def _in_range(number: int, values: list[float]) -> None:
    allowed = {5: _BAUDS, 6: _OUTPUTS, 7: _RATES}.get(number)
    if allowed is not None and values[0] not in allowed:
        raise BadLine(0x07)
    if any(value != value or abs(value) > 1e30 for value in values):
        raise BadLine(0x07)


def _binary(tokens: list[str]) -> str:
    if len(tokens) < 3:
        raise BadLine(0x05)
    try:
        mode, divisor = int(tokens[0]), int(tokens[1])
        groups, words = int(tokens[2], 16), [int(t, 16) for t in tokens[3:]]
    except ValueError:
        raise BadLine(0x07) from None
    if mode not in (0, 1, 2, 3) or divisor < 0:
        raise BadLine(0x07)
    if groups:
        layout_of(groups, words)
    elif words:
        raise BadLine(0x06)
    return ",".join([str(mode), str(divisor), f"{groups:02X}", *(f"{w:04X}" for w in words)])


class Memory:
    """RAM and flash of one unit; values are the printed text behind the register's number."""

    def __init__(self, serial: int, presets: dict[int, str] | None = None) -> None:
        self.flash = {number: default for number, (_, _, default) in TABLE.items()}
        self.flash[3] = f"{serial:010d}"
        for number, text in (presets or {}).items():
            self.flash[number] = text
        self.ram = dict(self.flash)

    def restart(self) -> None:
        """RAM is what the flash holds."""
        self.ram = dict(self.flash)

    def factory(self) -> None:
        """VNRFS."""
        own = {number: self.flash[number] for number in (1, 2, 3, 4)}
        self.flash = {**{n: default for n, (_, _, default) in TABLE.items()}, **own}
        self.ram = dict(self.flash)

    def floats(self, number: int, where: str = "ram") -> list[float]:
        """Numbers of a register."""
        return [float(token) for token in getattr(self, where)[number].split(",")]
