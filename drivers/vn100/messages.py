"""What a VN-100 streams: quantities, ASCII sentences, binary packets. Sans I/O.

Here messages are written, with their checksum or CRC. Both are checked in `deframer`; values come
out of a whole message in `decode`.

**Quantities**: one row per number, for ASCII and binary messages alike. A column's name says
quantity, frame where it is not the sensor's, axis and unit, and is the same in every message that
carries the quantity. On the wire angles are degrees and times nanoseconds; decoded values are SI,
``SI = wire / per_si``, and the field stays in gauss. The text format is the one that current
firmware prints (vn100-protocol 2; UM001 "Async Data Output").

**ASCII sentences**: the table of all that a VN-100 streams, and text to wire.

    $ VNxxx [, field]* * CS CR LF          (vn100-protocol 1.1, 2; UM001 "Async Data Output")

Reading is by commas and never by column, so the widths that older firmware printed decode too.

**Binary packets**: the tables of groups and fields, and both directions from them.

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

import math
import struct
from binascii import crc_hqx
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from operator import mul
from typing import Literal

# -- Checksum and CRC ------------------------------------------------------------------------------


_FOLDED_BYTES = 128  # covers every line that a device streams


def xor8(body: bytes) -> int:
    """XOR of all bytes: the body as one long integer, folded in half until a byte is left."""
    if len(body) > _FOLDED_BYTES:
        return xor8(body[:_FOLDED_BYTES]) ^ xor8(body[_FOLDED_BYTES:])
    bits = int.from_bytes(body, "little")
    bits ^= bits >> 512
    bits ^= bits >> 256
    bits ^= bits >> 128
    bits ^= bits >> 64
    bits ^= bits >> 32
    bits ^= bits >> 16
    bits ^= bits >> 8
    return bits & 0xFF


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM; ``crc16(b"123456789") == 0x31C3``."""
    return crc_hqx(data, 0)


# -- Quantities ------------------------------------------------------------------------------------


Compensation = Literal["", "uncompensated", "compensated"]
Frame = Literal["", "b", "n"]

_DEG = 180 / math.pi  # degrees in one radian
_NS = 1e9


@dataclass(frozen=True, slots=True)
class Column:
    """One number of a message.

    unit:         of the decoded value
    frame:        "b" sensor axes (after register 26), "n" north-east-down, "" no vector
    compensation: "uncompensated" is before, "compensated" behind the on-board real-time HSI and
                  filter biases; registers 23, 25 and 84 are in both. "" where it makes no sense
    per_si:       wire units in one unit of the decoded value
    printed:      C format in ASCII messages; empty where no ASCII message has it
    """

    name: str
    unit: str = ""
    frame: Frame = ""
    compensation: Compensation = ""
    per_si: float = 1.0
    printed: str = ""


Columns = tuple[Column, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The columns of one kind of message; there is one object per layout, compared by identity.

    name: "VNYMR", or header bytes and field words of a packet: "FA 06 0001 083F"
    """

    name: str
    columns: Columns
    per_si: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "per_si", tuple(column.per_si for column in self.columns))

    def index(self, name: str) -> int | None:
        """Where the column is; the first where a packet repeats it, None where it lacks it."""
        return next((i for i, column in enumerate(self.columns) if column.name == name), None)


def _vector(
    stem: str, unit: str, frame: Frame, compensation: Compensation = "", printed: str = ""
) -> Columns:
    """Three columns; NED vectors say so in their names."""
    axes = "xyz" if frame == "b" else ("n_n", "n_e", "n_d")
    suffix = f"_{unit.replace('^', '').replace('/', '_')}" if unit else ""
    return tuple(
        Column(f"{stem}_{axis}{suffix}", unit, frame, compensation, printed=printed)
        for axis in axes
    )


def _angles(names: str, printed: str, frame: Frame = "") -> Columns:
    return tuple(Column(name, "rad", frame, "", _DEG, printed) for name in names.split())


_MAG, _ACCEL, _GYRO, _ANGLE = "%+08.4f", "%+07.3f", "%+010.6f", "%+08.3f"
_EXPONENT = "%+.6E"  # of $VNCMV

TIME_STARTUP = (Column("time_startup_s", "s", per_si=_NS),)
TIME_SYNC_IN = (Column("time_sync_in_s", "s", per_si=_NS),)
SYNC_IN_COUNT = (Column("sync_in_count"),)
SYNC_OUT_COUNT = (Column("sync_out_count"),)
SERIAL_COUNT = Column("serial_count")  # appended to ASCII messages by register 30
SERIAL_STATUS = Column("serial_status")

YPR = _angles("yaw_rad pitch_rad roll_rad", _ANGLE)
YPR_SIGMA = _angles("yaw_sigma_rad pitch_sigma_rad roll_sigma_rad", "")
QUATERNION = tuple(Column(f"quat_{axis}", printed="%+09.6f") for axis in "xyzw")
# R_nb row by row, v_n = R_nb v_b (the manual's matrix, NED to body, column by column). A recording
# of a real device says so: there it agrees with the angles to f32 precision.
DCM = tuple(Column(f"dcm_{row}{column}") for row in range(3) for column in range(3))

MAG = _vector("mag", "gauss", "b", "compensated", _MAG)
ACCEL = _vector("accel", "m/s^2", "b", "compensated", _ACCEL)
GYRO = _vector("gyro", "rad/s", "b", "compensated", _GYRO)
UNCOMP_MAG = _vector("uncomp_mag", "gauss", "b", "uncompensated", _MAG)
UNCOMP_ACCEL = _vector("uncomp_accel", "m/s^2", "b", "uncompensated", _ACCEL)
UNCOMP_GYRO = _vector("uncomp_gyro", "rad/s", "b", "uncompensated", _GYRO)
UNCOMP_MAG_E = _vector("uncomp_mag", "gauss", "b", "uncompensated", _EXPONENT)
UNCOMP_ACCEL_E = _vector("uncomp_accel", "m/s^2", "b", "uncompensated", _EXPONENT)
UNCOMP_GYRO_E = _vector("uncomp_gyro", "rad/s", "b", "uncompensated", _EXPONENT)
MAG_NED = _vector("mag", "gauss", "n", "compensated")
ACCEL_NED = _vector("accel", "m/s^2", "n", "compensated")
LINEAR_ACCEL_BODY = _vector("linear_accel_b", "m/s^2", "b", "compensated", _ACCEL)
LINEAR_ACCEL_NED = _vector("linear_accel", "m/s^2", "n", "compensated", _ACCEL)

TEMPERATURE = (Column("temperature_c", "degC", printed="%+05.1f"),)
TEMPERATURE_E = (Column("temperature_c", "degC", printed=_EXPONENT),)
PRESSURE = (Column("pressure_kpa", "kPa", printed="%+08.3f"),)
DELTA_TIME = (Column("delta_time_s", "s", printed="%+09.6f"),)
DELTA_THETA = _angles("delta_theta_x_rad delta_theta_y_rad delta_theta_z_rad", "%+08.3f", "b")
DELTA_VELOCITY = _vector("delta_velocity", "m/s", "b", "", "%+08.3f")
HEAVE = (  # no source prints its format
    Column("heave_m", "m", printed="%+08.3f"),
    Column("heave_rate_m_s", "m/s", printed="%+08.3f"),
    Column("delayed_heave_m", "m", printed="%+08.3f"),
)

IMU_STATUS = (Column("imu_status"),)
SENS_SAT = (Column("sens_sat"),)
VPE_STATUS = (Column("vpe_status"),)
IMU_RAW = tuple(Column(f"imu_raw_{i}") for i in range(10))  # internal to firmware 2


# -- ASCII sentences -------------------------------------------------------------------------------


Check = Literal["xor", "crc"]


@dataclass(frozen=True, slots=True)
class Message:
    """A row of the table of asynchronous messages.

    output_type: ADOR, the value of register 6 that selects it
    register:    the register that holds the same values, 0 where none does
    """

    name: str
    output_type: int
    register: int
    columns: Columns


_ROWS = (
    Message("VNYPR", 1, 8, YPR),
    Message("VNQTN", 2, 9, QUATERNION),
    Message("VNQMR", 8, 15, QUATERNION + MAG + ACCEL + GYRO),
    Message("VNMAG", 10, 17, MAG),
    Message("VNACC", 11, 18, ACCEL),
    Message("VNGYR", 12, 19, GYRO),
    Message("VNMAR", 13, 20, MAG + ACCEL + GYRO),
    Message("VNYMR", 14, 27, YPR + MAG + ACCEL + GYRO),
    Message("VNYBA", 16, 239, YPR + LINEAR_ACCEL_BODY + GYRO),
    Message("VNYIA", 17, 240, YPR + LINEAR_ACCEL_NED + GYRO),
    Message(
        "VNIMU",
        19,
        54,
        UNCOMP_MAG + UNCOMP_ACCEL + UNCOMP_GYRO + TEMPERATURE + PRESSURE,
    ),
    Message("VNDTV", 30, 80, DELTA_TIME + DELTA_THETA + DELTA_VELOCITY),
    Message("VNHVE", 34, 115, HEAVE),
    # of firmware 1; the vendor's old library names its values uncompensated
    Message(
        "VNCMV",
        253,
        0,
        UNCOMP_MAG_E + UNCOMP_ACCEL_E + UNCOMP_GYRO_E + TEMPERATURE_E,
    ),
)
MESSAGES: dict[str, Message] = {row.name: row for row in _ROWS}

REGISTER_WORDS = frozenset({"VNRRG", "VNWRG"})
COMMAND_WORDS = frozenset(
    {
        *("VNWNV", "VNRFS", "VNRST", "VNASY", "VNKMD", "VNKAD"),
        *("VNSGB", "VNTAR", "VNBOM", "VNSFB", "VNSIH"),
    }
)


_LAYOUTS = {
    (row.name, count, status): Layout(
        row.name,
        row.columns + (SERIAL_COUNT,) * count + (SERIAL_STATUS,) * status,
    )
    for row in _ROWS
    for count in (False, True)
    for status in (False, True)
}


def sentence_layout(name: str, count: bool = False, status: bool = False) -> Layout:
    """The layout of a message, with the columns that register 30 may append. KeyError if unknown.

    Count comes before status in the columns, whichever the device prints first.
    """
    return _LAYOUTS[name, count, status]


def encode(body: str, crc: bool = False) -> bytes:
    """Frame what goes between ``$`` and ``*``; `crc` for the 4-digit check instead of the XOR.

    ValueError for text that cannot be inside a sentence.
    """
    raw = body.encode("ascii", "replace")
    if not body.isascii() or not body.isprintable() or "$" in body or "*" in body:
        raise ValueError(f"{body!r} cannot be a sentence: printable ASCII without $ and * only")
    check = b"%04X" % crc16(raw) if crc else b"%02X" % xor8(raw)
    return b"$%b*%b\r\n" % (raw, check)


def encode_sentence(
    name: str,
    values: Sequence[float],
    count: int | None = None,
    status: int | None = None,
    check: Check = "xor",
) -> bytes:
    """An asynchronous message as the device prints it, from SI values in the order of its columns.

    count, status: what register 30 appends. KeyError for an unknown name, ValueError for a wrong
    number of values or one that is not finite.
    """
    columns = MESSAGES[name].columns
    if len(values) != len(columns):
        raise ValueError(f"{name} has {len(columns)} values, not {len(values)}")
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{name} cannot carry a value that is not finite")
    tokens = [name]
    tokens += [c.printed % (value * c.per_si) for c, value in zip(columns, values, strict=True)]
    if count is not None:
        tokens.append(f"T{count:010d}")
    if status is not None:
        tokens.append(f"S{status:04X}")
    return encode(",".join(tokens), crc=check == "crc")


@dataclass(frozen=True, slots=True)
class Reply:
    """The device's answer to a command: its word, the register if it has one, and the rest."""

    word: str
    register: int | None
    tokens: tuple[str, ...]


# -- Binary packets --------------------------------------------------------------------------------


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
    0: Field("TimeStartup", "Q", TIME_STARTUP),
    1: Field("TimeGps", "8x"),
    2: Field("TimeSyncIn", "Q", TIME_SYNC_IN),
    3: Field("Ypr", "f", YPR),
    4: Field("Quaternion", "f", QUATERNION),
    5: Field("AngularRate", "f", GYRO),
    6: Field("PosLla", "24x"),
    7: Field("VelNed", "12x"),
    8: Field("Accel", "f", ACCEL),
    9: Field("Imu", "f", UNCOMP_ACCEL + UNCOMP_GYRO),
    10: Field("MagPres", "f", MAG + TEMPERATURE + PRESSURE),
    11: Field("Deltas", "f", DELTA_TIME + DELTA_THETA + DELTA_VELOCITY),
    12: Field("VpeStatus", "H", VPE_STATUS),
    13: Field("SyncInCnt", "I", SYNC_IN_COUNT),
    14: Field("TimeGpsPps", "8x"),
}
TIME = {
    0: Field("TimeStartup", "Q", TIME_STARTUP),
    1: Field("TimeGps", "8x"),
    2: Field("GpsTow", "8x"),
    3: Field("GpsWeek", "2x"),
    4: Field("TimeSyncIn", "Q", TIME_SYNC_IN),
    5: Field("TimeGpsPps", "8x"),
    6: Field("TimeUtc", "8x"),
    7: Field("SyncInCnt", "I", SYNC_IN_COUNT),
    8: Field("SyncOutCnt", "I", SYNC_OUT_COUNT),
    9: Field("TimeStatus", "1x"),
}
IMU = {
    0: Field("ImuStatus", "H", IMU_STATUS),
    1: Field("UncompMag", "f", UNCOMP_MAG),
    2: Field("UncompAccel", "f", UNCOMP_ACCEL),
    3: Field("UncompGyro", "f", UNCOMP_GYRO),
    4: Field("Temp", "f", TEMPERATURE),
    5: Field("Pres", "f", PRESSURE),
    6: Field("DeltaTheta", "f", DELTA_TIME + DELTA_THETA),
    7: Field("DeltaVel", "f", DELTA_VELOCITY),
    8: Field("Mag", "f", MAG),
    9: Field("Accel", "f", ACCEL),
    10: Field("AngularRate", "f", GYRO),
    11: Field("SensSat", "H", SENS_SAT),
    12: Field("Raw", "f", IMU_RAW),
}
ATTITUDE = {
    0: Field("VpeStatus", "H", VPE_STATUS),
    1: Field("Ypr", "f", YPR),
    2: Field("Quaternion", "f", QUATERNION),
    3: Field("DCM", "f", DCM),
    4: Field("MagNed", "f", MAG_NED),
    5: Field("AccelNed", "f", ACCEL_NED),
    6: Field("LinearAccelBody", "f", LINEAR_ACCEL_BODY),
    7: Field("LinearAccelNed", "f", LINEAR_ACCEL_NED),
    8: Field("YprU", "f", YPR_SIGMA),
    9: Field("reserved", "12x"),
    10: Field("reserved", "28x"),
    11: Field("reserved", "24x"),
    12: Field("Heave", "f", HEAVE),
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
