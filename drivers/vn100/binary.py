"""Binary packets: the tables of groups and fields, and both directions from them. Sans I/O.

    FA | group byte | field word, u16 LE, per group | payload | CRC-16, high byte first

Fields are packed in ascending bit order, groups in ascending order. The rows of what a VN-100
measures have columns; the others only have a length, so that reading stays in step: drivers ask a
VN-100 for the fields of other models (it sends zeros), and other models send them (vn100-protocol
1.2, 1.3; UM001 "User Configurable Binary Output Messages").

Bit 7 of a group byte announces a second one with groups 8 to 14, of which GNSS3 (13) has the fields
of the other GNSS groups; bit 15 of a field word announces a second word with fields 16 to 30. The
length of SatInfo and RawMeas depends on a count inside of them. A header with a field of unknown
length is none.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from operator import mul

from drivers.vn100 import fields
from drivers.vn100.checksum import crc16
from drivers.vn100.fields import Columns, Layout

SYNC = 0xFA
MAX_PACKET_BYTES = 2300  # header and CRC around the longest payload of vendor code and some more
GROUP_EXTENDED = 0x80  # a second group byte follows
WORD_EXTENDED = 0x8000  # a further field word of the same group follows


@dataclass(frozen=True, slots=True)
class Field:
    """One bit of a field word.

    code:      struct code of each column, or of the bytes to skip
    each, at:  bytes of an entry that repeats, and where the count of entries is; each 0: none does
    """

    name: str
    code: str
    columns: Columns = ()
    each: int = 0
    at: int = 0

    @property
    def format(self) -> str:
        """The field for `struct`, without the entries that repeat."""
        return f"{len(self.columns)}{self.code}" if self.columns else self.code

    @property
    def size(self) -> int:
        """Bytes, without the entries that repeat."""
        return struct.calcsize("<" + self.format)


def _skipped(fields_and_sizes: str) -> dict[int, Field]:
    """Fields known by length only: names and bytes for bits 0, 1, ..."""
    words = fields_and_sizes.split()
    return {
        bit: Field(name, f"{size}x")
        for bit, (name, size) in enumerate(zip(words[::2], words[1::2], strict=True))
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
GNSS = _skipped(
    "Utc 8 Tow 8 Week 2 NumSats 1 Fix 1 PosLla 24 PosEcef 24 VelNed 12 VelEcef 12 PosU 12 VelU 4 "
    "TimeU 4 TimeInfo 2 Dop 28"
) | {
    14: Field("SatInfo", "2x", each=8),
    16: Field("RawMeas", "12x", each=28, at=10),
    17: Field("Status", "2x"),
    18: Field("AltMSL", "8x"),
}
INS = _skipped(
    "InsStatus 2 PosLla 24 PosEcef 24 VelBody 12 VelNed 12 VelEcef 12 MagEcef 12 AccelEcef 12 "
    "LinAccelEcef 12 PosU 4 VelU 4 reserved 68 reserved 64"
)

# by the place of the group's bit: those of a second group byte begin at 7
GROUPS: dict[int, dict[int, Field]] = {
    0: COMMON,
    1: TIME,
    2: IMU,
    3: GNSS,
    4: ATTITUDE,
    5: INS,
    6: GNSS,
    12: GNSS,
}
# What a VN-100 measures: the fields with columns.
FIELD_MASKS = {
    number: mask
    for number, group in GROUPS.items()
    if (mask := sum(1 << bit for bit, row in group.items() if row.columns))
}


@dataclass(frozen=True, slots=True, eq=False)
class BinaryLayout(Layout):
    """Layout of a packet.

    header:  first bytes, FA included
    size:    of the packet, header and CRC included; the least where entries repeat
    codes:   struct code of each column
    left_out: names of the fields that a VN-100 does not measure
    """

    header: bytes
    size: int
    payload: struct.Struct
    codes: str
    left_out: tuple[str, ...] = ()
    rows: tuple[Field, ...] = field(default=(), repr=False)
    repeats: bool = False

    def unpack(self, packet: bytes) -> tuple[int | float, ...]:
        """The numbers as the wire has them: whole nanoseconds, degrees, f32 values."""
        if not self.repeats:
            return self.payload.unpack_from(packet, len(self.header))
        values: list[int | float] = []
        position = len(self.header)
        for row in self.rows:
            values += struct.unpack_from("<" + row.format, packet, position)
            position += row.size
            if row.each:
                position += row.each * packet[position - row.size + row.at]
        return tuple(values)

    def size_in(self, buffer: bytes, start: int) -> int:
        """As `size_in` of the module."""
        return size_in(self.header, buffer, start) if self.repeats else self.size


def read_header(buffer: bytes, start: int) -> bytes:
    """The header of a packet that begins at `start`, empty while bytes of it are missing."""
    if len(buffer) < start + 2:
        return b""
    groups, end = buffer[start + 1], start + 2
    count = (groups & ~GROUP_EXTENDED).bit_count()
    if groups & GROUP_EXTENDED:
        if len(buffer) < end + 1:
            return b""
        count += (buffer[end] & ~GROUP_EXTENDED).bit_count()
        end += 1
    for _ in range(count):
        end += 2
        if end <= len(buffer) and buffer[end - 1] & 0x80:
            end += 2
    return buffer[start:end] if end <= len(buffer) else b""


def packet_size(header: bytes) -> int:
    """Least bytes of a packet that `header` announces, CRC included; 0 where it is none."""
    size = _announced(header)[1]
    return size if size <= MAX_PACKET_BYTES else 0


@lru_cache(maxsize=1024)  # noise brings ever new headers
def is_of_vn100(header: bytes) -> bool:
    """Whether a VN-100 measures all that the header announces."""
    rows = _announced(header)[0]
    return bool(rows) and all(row.columns for row in rows)


def size_in(header: bytes, buffer: bytes, start: int) -> int:
    """Bytes of the packet with this header that begins at `start`; 0 where there can be none.

    Where a count of entries is not in the buffer yet, the least number of bytes that it may have.
    """
    rows, size, repeats = _announced(header)
    position = start + len(header)
    for row in rows if repeats else ():
        if row.each:
            if position + row.at >= len(buffer):
                size = max(size, position + row.at + 1 - start)
                break
            more = row.each * buffer[position + row.at]
            size, position = size + more, position + more
        position += row.size
    return size if size <= MAX_PACKET_BYTES else 0


@cache  # one object per layout, for ever; only headers whose packet passed its CRC come here
def layout_of(header: bytes) -> BinaryLayout:
    """The layout that a header announces. ValueError where it is none."""
    size = packet_size(header)
    if header[0] != SYNC or not size:
        raise ValueError(f"{header.hex(' ')} is not the header of a packet of known layout")
    rows, _, repeats = _announced(header)
    groups, words = _split(header)
    return BinaryLayout(
        name=" ".join(["FA", *(f"{byte:02X}" for byte in groups), *(f"{w:04X}" for w in words)]),
        columns=tuple(column for row in rows for column in row.columns),
        header=header,
        size=size,
        payload=struct.Struct("<" + "".join(row.format for row in rows)),
        codes="".join(row.code * len(row.columns) for row in rows),
        left_out=tuple(row.name for row in rows if not row.columns),
        rows=rows,
        repeats=repeats,
    )


def binary_layout(groups: int, words: Sequence[int]) -> BinaryLayout:
    """The layout by group byte and field words, as registers 75 to 77 have them."""
    own = sum(1 for place, word in enumerate(words) if not place or not words[place - 1] >> 15)
    if not 0 < groups < 0x80 or own != groups.bit_count():
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


def _split(header: bytes) -> tuple[bytes, list[int]]:
    """Group bytes and field words."""
    stop = 3 if header[1] & GROUP_EXTENDED else 2
    return header[1:stop], [word for (word,) in struct.iter_unpack("<H", header[stop:])]


def _rows(header: bytes) -> tuple[Field, ...]:
    """The fields that a header announces, in order; none where it is no header."""
    groups, words = _split(header)
    numbers = _bits(groups[0] & ~GROUP_EXTENDED)
    if len(groups) > 1:
        if groups[1] & GROUP_EXTENDED:
            return ()
        numbers += [7 + bit for bit in _bits(groups[1])]
    if any(number not in GROUPS for number in numbers):
        return ()
    left = iter(words)
    found: list[Field] = []
    for number in numbers:
        word = next(left)
        if word & WORD_EXTENDED:
            word = word & ~WORD_EXTENDED | next(left) << 16
        bits = _bits(word)
        if not bits or any(bit not in GROUPS[number] for bit in bits):
            return ()
        found += [GROUPS[number][bit] for bit in bits]
    return tuple(found)


@lru_cache(maxsize=1024)  # noise brings ever new headers
def _announced(header: bytes) -> tuple[tuple[Field, ...], int, bool]:
    """Fields, least size of the packet, and whether entries repeat; size 0: no header."""
    rows = _rows(header)
    size = len(header) + 2 + sum(row.size for row in rows) if rows else 0
    return rows, size, any(row.each for row in rows)


def _bits(word: int) -> list[int]:
    return [bit for bit in range(word.bit_length()) if word >> bit & 1]
