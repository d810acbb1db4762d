"""Binary packets: the tables of groups and fields, and both directions from them. Sans I/O.

    FA | group byte | field word, u16 LE, per group | payload | CRC-16, high byte first

Fields are packed in ascending bit order, groups in ascending order. The rows of a VN-100 have
columns; the others only have a length, so that `generic` reading stays in step on other models
(vn100-protocol 1.2, 1.3; UM001 "User Configurable Binary Output Messages"). Fields whose length
depends on their content (SatInfo, RawMeas of the GNSS groups) are refused.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from operator import mul

from drivers.vn100 import fields
from drivers.vn100.checksum import crc16
from drivers.vn100.fields import Columns, Layout

SYNC = 0xFA
MAX_PACKET_BYTES = 600
_EXTENDED = 0x8000  # a further field word of the same group follows; never on a VN-100


@dataclass(frozen=True, slots=True)
class Field:
    """One bit of a field word. `code`: struct code of each column, or of the bytes to skip."""

    name: str
    code: str
    columns: Columns = ()

    @property
    def format(self) -> str:
        """The field for `struct`."""
        return f"{len(self.columns)}{self.code}" if self.columns else self.code


def _skipped(sizes: str) -> dict[int, Field]:
    """Fields known by length only: bytes for bits 0, 1, ...; 0 where the length is unknown."""
    return {
        bit: Field(f"field {bit}", f"{size}x")
        for bit, size in enumerate(sizes.split())
        if size != "0"
    }


COMMON = {
    0: Field("TimeStartup", "Q", fields.TIME_STARTUP),
    1: Field("TimeGps", "8x"),
    2: Field("TimeSyncIn", "Q", fields.TIME_SYNC_IN),
    3: Field("Ypr", "f", fields.YPR),
    4: Field("Quaternion", "f", fields.QUATERNION),
    5: Field("AngularRate", "f", fields.GYRO),
    6: Field("PosLla", "24x"),
    7: Field("VelNed", "12x"),
    8: Field("Accel", "f", fields.ACCEL),
    9: Field("Imu", "f", fields.UNCOMP_ACCEL + fields.UNCOMP_GYRO),
    10: Field("MagPres", "f", fields.MAG + fields.TEMPERATURE + fields.PRESSURE),
    11: Field("Deltas", "f", fields.DELTA_TIME + fields.DELTA_THETA + fields.DELTA_VELOCITY),
    12: Field("VpeStatus", "H", fields.VPE_STATUS),
    13: Field("SyncInCnt", "I", fields.SYNC_IN_COUNT),
    14: Field("TimeGpsPps", "8x"),
}
TIME = {
    0: Field("TimeStartup", "Q", fields.TIME_STARTUP),
    1: Field("TimeGps", "8x"),
    2: Field("GpsTow", "8x"),
    3: Field("GpsWeek", "2x"),
    4: Field("TimeSyncIn", "Q", fields.TIME_SYNC_IN),
    5: Field("TimeGpsPps", "8x"),
    6: Field("TimeUtc", "8x"),
    7: Field("SyncInCnt", "I", fields.SYNC_IN_COUNT),
    8: Field("SyncOutCnt", "I", fields.SYNC_OUT_COUNT),
    9: Field("TimeStatus", "1x"),
}
IMU = {
    0: Field("ImuStatus", "H", fields.IMU_STATUS),
    1: Field("UncompMag", "f", fields.UNCOMP_MAG),
    2: Field("UncompAccel", "f", fields.UNCOMP_ACCEL),
    3: Field("UncompGyro", "f", fields.UNCOMP_GYRO),
    4: Field("Temp", "f", fields.TEMPERATURE),
    5: Field("Pres", "f", fields.PRESSURE),
    6: Field("DeltaTheta", "f", fields.DELTA_TIME + fields.DELTA_THETA),
    7: Field("DeltaVel", "f", fields.DELTA_VELOCITY),
    8: Field("Mag", "f", fields.MAG),
    9: Field("Accel", "f", fields.ACCEL),
    10: Field("AngularRate", "f", fields.GYRO),
    11: Field("SensSat", "H", fields.SENS_SAT),
    12: Field("Raw", "f", fields.IMU_RAW),
}
ATTITUDE = {
    0: Field("VpeStatus", "H", fields.VPE_STATUS),
    1: Field("Ypr", "f", fields.YPR),
    2: Field("Quaternion", "f", fields.QUATERNION),
    3: Field("DCM", "f", fields.DCM),
    4: Field("MagNed", "f", fields.MAG_NED),
    5: Field("AccelNed", "f", fields.ACCEL_NED),
    6: Field("LinearAccelBody", "f", fields.LINEAR_ACCEL_BODY),
    7: Field("LinearAccelNed", "f", fields.LINEAR_ACCEL_NED),
    8: Field("YprU", "f", fields.YPR_SIGMA),
    9: Field("reserved", "12x"),
    10: Field("reserved", "28x"),
    11: Field("reserved", "24x"),
    12: Field("Heave", "f", fields.HEAVE),
    13: Field("AttU", "4x"),
}
# bits 16 and up are those of the second field word (bit 15 only says that there is one)
GNSS = _skipped("8 8 2 1 1 24 24 12 12 12 4 4 2 28") | {
    17: Field("Status", "2x"),
    18: Field("AltMSL", "8x"),
}
INS = _skipped("2 24 24 12 12 12 12 12 12 4 4 68 64")

GROUPS: dict[int, dict[int, Field]] = {
    0: COMMON,
    1: TIME,
    2: IMU,
    3: GNSS,
    4: ATTITUDE,
    5: INS,
    6: GNSS,
}
# What a VN-100 can send: by these a false FA is told from a header.
FIELD_MASKS = {
    number: mask
    for number, group in GROUPS.items()
    if (mask := sum(1 << bit for bit, row in group.items() if row.columns))
}
GROUP_MASK = sum(1 << number for number in FIELD_MASKS)


@dataclass(frozen=True, slots=True, eq=False)
class BinaryLayout(Layout):
    """Layout of a packet.

    header:  first bytes, FA included;  size: of the packet, header and CRC included
    codes, offsets: struct code of each column, and where it begins in the packet
    """

    header: bytes
    size: int
    payload: struct.Struct
    codes: str
    offsets: tuple[int, ...]

    def unpack(self, packet: bytes) -> tuple[int | float, ...]:
        """The numbers as the wire has them: whole nanoseconds, degrees, f32 values."""
        return self.payload.unpack_from(packet, len(self.header))


def read_header(buffer: bytes, start: int) -> bytes:
    """The header of a packet that begins at `start`, empty while bytes of it are missing."""
    if len(buffer) < start + 2:
        return b""
    end = start + 2
    for _ in range(buffer[start + 1].bit_count()):
        end += 2
        if end <= len(buffer) and buffer[end - 1] & 0x80:
            end += 2
    return buffer[start:end] if end <= len(buffer) else b""


@lru_cache(maxsize=1024)  # noise brings ever new headers
def packet_size(header: bytes, generic: bool = False) -> int:
    """Bytes of the packet that `header` announces, CRC included; 0 where it is none.

    Without `generic` only what a VN-100 can send is a header.
    """
    groups = header[1]
    if not groups or groups & 0x80:
        return 0
    if not generic and (groups & ~GROUP_MASK or len(header) != 2 + 2 * groups.bit_count()):
        return 0
    size = len(header) + 2
    for number, word in _words(header):
        if not word or (not generic and word & ~FIELD_MASKS[number]):
            return 0
        rows = GROUPS[number]
        if any(bit not in rows for bit in _bits(word)):
            return 0
        size += sum(struct.calcsize("<" + rows[bit].format) for bit in _bits(word))
    return size if size <= MAX_PACKET_BYTES else 0


@cache  # one object per layout, for ever; only headers whose packet passed its CRC come here
def layout_of(header: bytes) -> BinaryLayout:
    """The layout that a header announces. ValueError where it is none."""
    size = packet_size(header, generic=True)
    if header[0] != SYNC or not size:
        raise ValueError(f"{header.hex(' ')} is not the header of a packet of known layout")
    rows = [GROUPS[number][bit] for number, word in _words(header) for bit in _bits(word)]
    words = [f"{word:04X}" for (word,) in struct.iter_unpack("<H", header[2:])]
    offsets: list[int] = []
    end = len(header)
    for row in rows:
        offsets += [end + place * struct.calcsize(row.code) for place in range(len(row.columns))]
        end += struct.calcsize("<" + row.format)
    return BinaryLayout(
        name=" ".join(["FA", f"{header[1]:02X}", *words]),
        columns=tuple(column for row in rows for column in row.columns),
        header=header,
        size=size,
        payload=struct.Struct("<" + "".join(row.format for row in rows)),
        codes="".join(row.code * len(row.columns) for row in rows),
        offsets=tuple(offsets),
    )


def binary_layout(groups: int, words: Sequence[int]) -> BinaryLayout:
    """The layout by group byte and field words, as registers 75 to 77 have them."""
    if not 0 < groups < 0x80 or len(words) != groups.bit_count():
        raise ValueError(
            f"group byte {groups:#04x} needs one field word per group, got {len(words)}"
        )
    return layout_of(struct.pack(f"<BB{len(words)}H", SYNC, groups, *words))


def encode_packet(layout: BinaryLayout, values: Sequence[float]) -> bytes:
    """A packet as on the wire, from SI values in the order of the layout's columns.

    ValueError for a wrong number of values, or one that its field cannot hold.
    """
    if len(values) != len(layout.columns):
        raise ValueError(f"{layout.name} has {len(layout.columns)} values, not {len(values)}")
    wire = list(map(mul, values, layout.per_si))
    try:
        for place, code in enumerate(layout.codes):
            if code != "f":
                wire[place] = round(wire[place])
        checked = layout.header[1:] + layout.payload.pack(*wire)
    except (struct.error, OverflowError, ValueError) as error:
        raise ValueError(f"{layout.name} cannot carry these values: {error}") from error
    return bytes([SYNC]) + checked + struct.pack(">H", crc16(checked))


def _words(header: bytes) -> Iterator[tuple[int, int]]:
    """Group number and fields of each group; a second field word adds bits 16 and up."""
    words = (word for (word,) in struct.iter_unpack("<H", header[2:]))
    for number in _bits(header[1]):
        word = next(words)
        if word & _EXTENDED:
            word = word & ~_EXTENDED | next(words) << 16
        yield number, word


def _bits(word: int) -> list[int]:
    return [bit for bit in range(word.bit_length()) if word >> bit & 1]
