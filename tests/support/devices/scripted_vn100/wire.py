"""Sentences and packets of a VN-100: sums, framing, what a host sends."""

from __future__ import annotations

import struct
from binascii import crc_hqx

SYNC = 0xFA
LONGEST_LINE = 256

# Field of a binary group: bit -> (quantity, struct format). Only what this device can send.
COMMON = {
    0: ("time_ns", "Q"), 3: ("ypr_deg", "3f"), 5: ("gyro", "3f"), 8: ("accel", "3f"),
    9: ("imu", "6f"), 10: ("mag_pres", "5f"),
}  # fmt: skip
TIME = {0: ("time_ns", "Q"), 7: ("sync_in", "I")}
IMU = {
    0: ("imu_status", "H"), 1: ("uncomp_mag", "3f"), 2: ("uncomp_accel", "3f"),
    3: ("uncomp_gyro", "3f"), 4: ("temp", "f"), 5: ("pres", "f"), 8: ("mag", "3f"),
    9: ("accel", "3f"), 10: ("gyro", "3f"), 11: ("sens_sat", "H"),
}  # fmt: skip
ATTITUDE = {1: ("ypr_deg", "3f")}
GROUPS = {0: COMMON, 1: TIME, 2: IMU, 4: ATTITUDE}


class BadLine(ValueError):
    """A command that the device refuses; `code` is what VNERR says."""

    def __init__(self, code: int) -> None:
        super().__init__(f"VNERR {code:02X}")
        self.code = code


def xor8(body: bytes) -> int:
    """The 8-bit checksum of what is between $ and *."""
    total = 0
    for byte in body:
        total ^= byte
    return total


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM."""
    return crc_hqx(data, 0)


def sentence(body: str, *, crc: bool = False) -> bytes:
    """$body*CS and the end of the line."""
    raw = body.encode("ascii")
    check = f"{crc16(raw):04X}" if crc else f"{xor8(raw):02X}"
    return b"$" + raw + b"*" + check.encode() + b"\r\n"


def parse_command(line: bytes) -> list[str]:
    """Tokens of a command line without its end. Raises BadLine."""
    if len(line) > LONGEST_LINE:
        raise BadLine(0x02)
    start = line.rfind(b"$")
    if start < 0 or b"*" not in line[start:]:
        raise BadLine(0x03)
    body, _, check = line[start + 1 :].partition(b"*")
    if check != b"XX":
        wanted = {2: f"{xor8(body):02X}", 4: f"{crc16(body):04X}"}.get(len(check))
        if wanted is None or check.decode("ascii", "replace").upper() != wanted:
            raise BadLine(0x03)
    return body.decode("ascii", "replace").split(",")


def layout_of(groups: int, words: list[int]) -> tuple[list[str], str]:
    """Quantities of a packet in order, and its struct format. Raises BadLine (07)."""
    names, form, rest = [], "<", list(words)
    if not groups or groups & ~0x17:
        raise BadLine(0x07)
    for group in range(8):
        if not groups >> group & 1:
            continue
        if not rest:
            raise BadLine(0x05)
        word, table = rest.pop(0), GROUPS[group]
        for bit in range(16):
            if word >> bit & 1:
                if bit not in table:
                    raise BadLine(0x07)
                name, code = table[bit]
                names.append(name)
                form += code
    if rest:
        raise BadLine(0x06)
    return names, form


def packet(groups: int, words: list[int], form: str, values: list[float]) -> bytes:
    """A binary packet as on the wire."""
    head = bytes([groups]) + b"".join(struct.pack("<H", word) for word in words)
    content = head + struct.pack(form, *values)
    return bytes([SYNC]) + content + struct.pack(">H", crc16(content))
