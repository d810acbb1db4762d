"""ROS 1 bags and ROS 2 recordings (MCAP, SQLite) without ROS, by the package rosbags.

Messages are searched for what they hold, not for their type alone: many drivers publish one of
their own with an Imu, a MagneticField or the device's raw line inside. A MagneticField is in tesla
and an Imu in rad/s and m/s^2 by definition; vectornav_msgs are in gauss. Axes stay as the driver
published them. Recordings in SQLite do not bring the definitions of their messages along: those of
vectornav_msgs are here, others are read from `.msg` files beside the recording, and of messages
without any the lines of a VN-100 in them are used all the same.
"""

from __future__ import annotations

import re
import sqlite3
import struct
import sys
import tempfile
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Enum
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.printable import counted, printable
from ahrsd.recording.foreign.sensors import (
    STILL,
    Choice,
    RawBytes,
    Sensors,
    SensorSeries,
    positions,
)
from ahrsd.recording.limits import TABLE_BYTES, TABLE_CELLS, refuse_beyond
from ahrsd.samples import Array
from drivers.vn100.deframer import Deframer

_INS_STATUS = """\
uint8 mode
bool gps_fix
bool time_error
bool imu_error
bool mag_pres_error
bool gps_error
bool gps_heading_ins
bool gps_compass
"""
_COMMON_GROUP = """\
std_msgs/Header header
uint16 group_fields
uint64 timestartup
uint64 timegps
uint64 timesyncin
geometry_msgs/Vector3 yawpitchroll
geometry_msgs/Quaternion quaternion
geometry_msgs/Vector3 angularrate
geometry_msgs/Point position
geometry_msgs/Vector3 velocity
geometry_msgs/Vector3 accel
geometry_msgs/Vector3 imu_accel
geometry_msgs/Vector3 imu_rate
geometry_msgs/Vector3 magpres_mag
float32 magpres_temp
float32 magpres_pres
float32 deltatheta_dtime
geometry_msgs/Vector3 deltatheta_dtheta
geometry_msgs/Vector3 deltatheta_dvel
vectornav_msgs/InsStatus insstatus
uint32 syncincnt
uint16 timegpspps
"""
_IMU_GROUP = """\
std_msgs/Header header
uint16 group_fields
uint16 imustatus
geometry_msgs/Vector3 uncompmag
geometry_msgs/Vector3 uncompaccel
geometry_msgs/Vector3 uncompgyro
float32 temp
float32 pres
float32 deltatheta_time
geometry_msgs/Vector3 deltatheta_dtheta
geometry_msgs/Vector3 deltavel
geometry_msgs/Vector3 mag
geometry_msgs/Vector3 accel
geometry_msgs/Vector3 angularrate
uint16 sensat
"""
#: message name -> its definition
DEFINITIONS = {
    "InsStatus": _INS_STATUS,
    "CommonGroup": _COMMON_GROUP,
    "ImuGroup": _IMU_GROUP,
}


_DEPTH = 3  # of messages within messages
_DEFINITION_BYTES = 1 << 16  # of a .msg file
_LINE = re.compile(rb"\$VN[A-Z]{3},[ -~]{1,400}?\*[0-9A-Fa-f]{2,4}(?![0-9A-Fa-f])")
_LOOKED_AT = 20  # messages of a type by which it is told whether they hold the device's bytes
_UNIQUE = 0.9  # share of the stamps that differ, or they are no times
_REINDEX = {
    ".bag": "recover it with `rosbag reindex`, or record again",
    ".mcap": "recover it with `mcap recover`, or record again",
    ".db3": "recover it with `ros2 bag reindex`, or record again",
}


class _Clock(Enum):
    """Whose times a recording's rows have."""

    DEVICE = "the device's (TimeStartup)"
    HEADERS = "the headers' stamps"
    RECORDER = "the recorder's"


@dataclass(slots=True)
class _Series:
    """One quantity of one topic. rank: of several kinds of one sensor the lowest is the best.

    stamp_s, log_s, device_s: of the header, of the recorder, of the device; nan where there is none
    """

    kind: str
    topic: str
    name: str
    unit: str
    rank: int
    width: int
    stamp_s: array[float] = field(default_factory=lambda: array("d"))
    log_s: array[float] = field(default_factory=lambda: array("d"))
    device_s: array[float] = field(default_factory=lambda: array("d"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def stream(self, shift_s: float, clock: _Clock) -> SensorSeries:
        """On the recording's clock; shift_s: from the host's clock to it."""
        time_s = np.array(self.device_s)
        if clock is _Clock.RECORDER:
            time_s = np.array(self.log_s)
        elif not (clock is _Clock.DEVICE and np.isfinite(time_s).all()):
            time_s = self._host_s() + shift_s
        return SensorSeries(time_s, np.array(self.values).reshape(-1, self.width))

    def _host_s(self) -> Array:
        stamps = np.array(self.stamp_s)
        return stamps if self.has_stamps else np.array(self.log_s)

    @property
    def has_stamps(self) -> bool:
        """Whether the headers' stamps are times at all."""
        stamps = np.array(self.stamp_s)
        return len(np.unique(stamps[np.isfinite(stamps)])) > _UNIQUE * len(stamps)

    def overlaps(self, other: _Series) -> bool:
        """Whether the headers' stamps of both are of one time, as the recorder's are."""
        a, b = np.array(self.stamp_s), np.array(other.stamp_s)
        return bool(max(np.nanmin(a), np.nanmin(b)) < min(np.nanmax(a), np.nanmax(b)))

    @property
    def turning_rad_s(self) -> float:
        """Rms of a gyro's rates about their mean."""
        rates = np.array(self.values).reshape(-1, self.width)
        rates = rates[np.isfinite(rates).all(axis=1)]
        return float(np.sqrt(np.mean(np.var(rates, axis=0)))) if len(rates) else 0.0

    @property
    def has_device(self) -> bool:
        """Whether each message has the device's time."""
        return len(self.device_s) > 0 and bool(np.isfinite(np.array(self.device_s)).all())

    def shift_s(self) -> float:
        """From the host's clock to the device's."""
        return float(np.median(np.array(self.device_s) - self._host_s()))


_Message = Any  # of types that the library makes at run time; its reader and store, too
_Taking = Callable[[_Message], tuple[float, ...] | None]
#: (kind, rank, unit, what to take of a message; None where it has none)
_Take = tuple[str, int, str, _Taking]


def _xyz(vector: _Message) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _bit(number: int, take: _Taking) -> _Taking:
    return lambda part: take(part) if int(part.group_fields) >> number & 1 else None


def _orientation(part: _Message) -> tuple[float, ...] | None:
    q = part.orientation
    values = (float(q.w), float(q.x), float(q.y), float(q.z))
    known = (
        float(part.orientation_covariance[0]) != -1.0 and abs(sum(v * v for v in values) - 1) < 0.1
    )
    return values if known and values != (1.0, 0.0, 0.0, 0.0) else None


_TAKES: dict[str, tuple[_Take, ...]] = {
    "Imu": (
        ("gyro", 2, "rad/s", lambda part: _xyz(part.angular_velocity)),
        ("accel", 2, "m/s^2", lambda part: _xyz(part.linear_acceleration)),
        ("attitude", 0, "", _orientation),
    ),
    "MagneticField": (("mag", 2, "T", lambda part: _xyz(part.magnetic_field)),),
    "CommonGroup": (
        ("gyro", 0, "rad/s", _bit(9, lambda part: _xyz(part.imu_rate))),
        ("accel", 0, "m/s^2", _bit(9, lambda part: _xyz(part.imu_accel))),
        ("gyro", 1, "rad/s", _bit(5, lambda part: _xyz(part.angularrate))),
        ("accel", 1, "m/s^2", _bit(8, lambda part: _xyz(part.accel))),
        ("mag", 1, "gauss", _bit(10, lambda part: _xyz(part.magpres_mag))),
        ("temperature_c", 0, "", _bit(10, lambda part: (float(part.magpres_temp),))),
        ("pressure_kpa", 0, "", _bit(10, lambda part: (float(part.magpres_pres),))),
        ("vn_attitude", 0, "", _bit(3, lambda part: _xyz(part.yawpitchroll))),
    ),
    "ImuGroup": (
        ("mag", 0, "gauss", _bit(1, lambda part: _xyz(part.uncompmag))),
        ("accel", 0, "m/s^2", _bit(2, lambda part: _xyz(part.uncompaccel))),
        ("gyro", 0, "rad/s", _bit(3, lambda part: _xyz(part.uncompgyro))),
        ("temperature_c", 1, "", _bit(4, lambda part: (float(part.temp),))),
        ("mag", 1, "gauss", _bit(8, lambda part: _xyz(part.mag))),
        ("gyro", 1, "rad/s", _bit(10, lambda part: _xyz(part.angularrate))),
    ),
    "BatteryState": (
        ("motor_current_a", 0, "", lambda part: (abs(float(part.current)),)),
        ("battery_v", 0, "", lambda part: (float(part.voltage),)),
    ),
    "Temperature": (("temperature_c", 2, "", lambda part: (float(part.temperature),)),),
    "FluidPressure": (
        ("pressure_kpa", 2, "", lambda part: (1e-3 * float(part.fluid_pressure),)),
    ),
    "NavSatFix": (
        ("fix", 0, "", lambda part: (
            float(part.latitude), float(part.longitude), float(part.altitude)
        )),
    ),
}  # fmt: skip
_WIDTHS = {"mag": 3, "gyro": 3, "accel": 3, "fix": 3, "vn_attitude": 3, "attitude": 4}
_DEVICE_TIME = "CommonGroup"
_NAN = float("nan")


@dataclass(slots=True)
class _Raw:
    """A topic that may hold what a device sent: it does where a message of a VN-100 is in it."""

    deframer: Deframer = field(default_factory=Deframer)
    received: list[Received] = field(default_factory=list)
    given_up: bool = False
    size: int = 0

    @property
    def of_device(self) -> bool:
        return self.deframer.counters.valid > 0

    def take(self, at_ns: int, data: bytes) -> None:
        """One more message; after some without a valid one the topic is something else."""
        if self.given_up:
            return
        self.received.append(Received(at_ns, data))
        self.size += len(data)
        if not self.of_device:
            self.deframer.feed(data)
            if len(self.received) >= _LOOKED_AT and not self.of_device:
                self.given_up = True
                self.received.clear()


@dataclass(slots=True)
class _Found:
    """What the messages held."""

    series: dict[tuple[str, int, str], _Series] = field(default_factory=dict)
    raw: dict[str, _Raw] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    base_ns: int = 0


def damages() -> tuple[type[BaseException], ...]:
    """What rosbags raises on files that are damaged, beside its own errors."""
    import apsw
    from rosbags.highlevel.anyreader import AnyReaderError, ReaderErrors
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return (
        AnyReaderError, *ReaderErrors, SerdeError, TypesysError, apsw.Error, zstd.ZstdError,
        sqlite3.Error, struct.error, LookupError, ValueError, TypeError, AttributeError,
        AssertionError, ArithmeticError, RuntimeError, EOFError, OSError,
    )  # fmt: skip


@contextmanager
def _opened(path: Path, suffix: str) -> Iterator[_Message]:
    """A reader; the library tells formats by the name, so another name gets a link to it."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, f"vectornav_msgs/msg/{name}"))
    with tempfile.TemporaryDirectory(prefix="ahrsd-") as folder:
        named = path
        if not path.is_dir() and path.suffix != suffix:
            named = Path(folder) / f"recording{suffix}"
            named.symlink_to(path.resolve())
        with AnyReader([named], default_typestore=store) as reader:
            _define(reader, path)
            yield reader


def _define(reader: _Message, path: Path) -> None:
    """Definitions that the recording lacks, from `.msg` files beside it.

    A message of the type PACKAGE/msg/NAME is in NAME.msg: in the folder of the recording (of one
    that is a folder, also within it), or in `msg` there.
    """
    from rosbags.typesys import TypesysError, get_types_from_msg

    homes = [path, path.parent] if path.is_dir() else [path.parent]
    folders = [folder for home in homes for folder in (home, home / "msg")]
    # each with the file whose message it is a part of; a message that nobody defined is no fault
    wanted: list[tuple[str, Path | None]] = [(one.msgtype, None) for one in reader.connections]
    asked: set[str] = set()
    while wanted:
        kind, part_of = wanted.pop()
        if kind in asked or kind in reader.typestore.fielddefs:
            continue
        name = f"{kind.rsplit('/', 1)[-1]}.msg"
        file = next((one / name for one in folders if (one / name).is_file()), None)
        if file is None or file.stat().st_size > _DEFINITION_BYTES:
            if part_of is not None:
                raise RecordingError(
                    part_of, f"has a part {printable(kind)}, whose definition is not there",
                    f"put {printable(name)} beside it",
                )  # fmt: skip
            continue
        asked.add(kind)
        try:
            types = get_types_from_msg(file.read_text("utf-8", "replace"), kind)
            reader.typestore.register(types)
        except (SyntaxError, TypesysError, OSError) as error:
            words = printable(" ".join(str(error).split()), 100)
            raise RecordingError(
                file, f"does not define a message ({words})", "repair it, or take it away"
            ) from error
        wanted += [(part, file) for _, fields in types.values() for part in _parts(fields)]


def _parts(fields: _Message) -> Iterator[str]:
    """Types of the messages within a message."""
    for _, (nodetype, argument) in fields:
        inner = argument if int(nodetype) == 2 else argument[0]
        if int(nodetype) == 2:
            yield argument
        elif isinstance(inner, tuple) and int(inner[0]) == 2:
            yield inner[1]


def _refused(path: Path, suffix: str, error: BaseException) -> RecordingError:
    words = printable(" ".join(str(error).split()) or type(error).__name__, 160)
    what = "is damaged, cut off or was never closed"
    if suffix == ".db3":
        what += ", or is a database of another program"
    return RecordingError(path, f"{what} ({words})", _REINDEX.get(suffix, "record again"))


def listed(path: Path, suffix: str) -> list[str]:
    """One line per topic: name, type, messages."""
    try:
        with _opened(path, suffix) as reader:
            rows = [(c.topic, c.msgtype, c.msgcount) for c in reader.connections]
            seconds = max((reader.end_time - reader.start_time) / 1e9, 0.0) if rows else 0.0
    except damages() as error:
        raise _refused(path, suffix, error) from error
    return [
        f"{printable(topic)}  {printable(kind)}  {counted(count, 'message')}"
        + (f", {count / seconds:.3g} Hz" if seconds > 0 else "")
        for topic, kind, count in sorted(rows)
    ]


def read(path: Path, suffix: str, choice: Choice) -> Sensors | RawBytes:
    """The sensors, or what the device sent where that is there.  Raises RecordingError."""
    found = _Found()
    try:
        with _opened(path, suffix) as reader:
            topics = sorted({c.topic for c in reader.connections})
            if absent := [topic for topic in choice.topics if topic not in topics]:
                raise RecordingError(
                    path, f"has no topic {printable(absent[0])}", f"it has {_some(topics)}"
                )
            _gather(path, reader, found)
    except damages() as error:
        raise _refused(path, suffix, error) from error
    raw = [
        topic
        for topic, one in found.raw.items()
        if one.of_device and (not choice.topics or topic in choice.topics)
    ]
    if raw:
        return _raw(path, found, raw)
    return _sensors(path, found, choice, topics)


def _some(names: list[str]) -> str:
    shown = ", ".join(printable(name) for name in names[:12])
    return f"{shown}, ... ({len(names)} in all)" if len(names) > 12 else shown or "none"


def _gather(path: Path, reader: _Message, found: _Found) -> None:
    plans: dict[tuple[int, str], tuple[list[_Place], list[str] | None]] = {}
    kept = []
    for connection in reader.connections:
        kind = connection.msgtype
        definition = reader.typestore.fielddefs.get(kind)
        if definition is None:
            found.unread[connection.topic] = kind
            plans[connection.id, connection.topic] = [], None
            kept.append(connection)
            continue
        plans[connection.id, connection.topic] = (
            [
                _Place(connection.topic, attributes, base)
                for attributes, base in _places(reader.typestore, kind, "")
            ],
            [name for name, node in definition[1] if _holds_bytes(node)],
        )
        if any(plans[connection.id, connection.topic]):
            kept.append(connection)
    taken = 0
    if not kept:
        return
    for connection, at_ns, data in reader.messages(connections=kept):
        places, fields = plans[connection.id, connection.topic]
        if not places and (one := found.raw.get(connection.topic)) is not None and one.given_up:
            continue
        found.base_ns = found.base_ns or at_ns
        if fields is None:
            raw = found.raw.setdefault(connection.topic, _Raw())
            raw.take(at_ns, b"".join(line + b"\r\n" for line in _LINE.findall(data)))
            continue
        message = reader.deserialize(data, connection.msgtype)
        for place in places:
            taken += place.take(message, at_ns, found)
        for name in fields:
            raw = found.raw.setdefault(connection.topic, _Raw())
            raw.take(at_ns, _bytes_of(getattr(message, name)))
            refuse_beyond(path, raw.size, TABLE_BYTES, "bytes of a device", "cut it in parts")
        refuse_beyond(path, taken, TABLE_CELLS, "numbers and more", "cut it in parts")


def _places(store: _Message, kind: str, prefix: str, depth: int = 0) -> Iterator[tuple[str, str]]:
    """(path of attributes, name of its type) of every part that holds a sensor."""
    base = kind.rsplit("/", 1)[-1]
    if base in _TAKES:
        yield prefix, base
        return
    if depth >= _DEPTH:
        return
    for name, (nodetype, argument) in store.fielddefs.get(kind, ((), ()))[1]:
        if int(nodetype) == 2 and isinstance(argument, str):
            yield from _places(store, argument, f"{prefix}.{name}" if prefix else name, depth + 1)


def _holds_bytes(node: _Message) -> bool:
    """A string, or a row of bytes of any length."""
    nodetype, argument = node
    if int(nodetype) == 1:
        return bool(argument[0] == "string")
    if int(nodetype) != 4:
        return False
    inner = argument[0]
    return int(inner[0]) == 1 and inner[1][0] in ("uint8", "byte", "octet", "char", "int8")


def _ns(part: _Message) -> int:
    header = getattr(part, "header", None)
    if header is None:
        return 0
    stamp = header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class _Place:
    """A part of a topic's messages that holds a sensor, and the series that it feeds."""

    def __init__(self, topic: str, attributes: str, base: str) -> None:
        self._topic, self._name = topic, f"{topic}.{attributes}" if attributes else topic
        self._part = attrgetter(attributes) if attributes else None
        self._device = base == _DEVICE_TIME
        self._takes: list[tuple[_Take, _Series | None]] = [(take, None) for take in _TAKES[base]]

    def take(self, message: _Message, at_ns: int, found: _Found) -> int:
        """One more message; how many numbers were kept."""
        part = message if self._part is None else self._part(message)
        stamp_ns = _ns(part) or (_ns(message) if part is not message else 0)
        stamp_s = (stamp_ns - found.base_ns) * 1e-9 if stamp_ns else _NAN
        log_s = (at_ns - found.base_ns) * 1e-9
        device_s = _NAN
        if self._device and int(part.group_fields) & 1:
            device_s = int(part.timestartup) * 1e-9
        count = 0
        for number, (take, series) in enumerate(self._takes):
            values = take[3](part)
            if values is None:
                continue
            if series is None:
                series = self._series(take, found)
                self._takes[number] = take, series
            series.stamp_s.append(stamp_s)
            series.log_s.append(log_s)
            series.device_s.append(device_s)
            series.values.extend(values)
            count += 3 + len(values)
        return count

    def _series(self, take: _Take, found: _Found) -> _Series:
        """Several connections may publish one topic."""
        kind, rank, unit, _ = take
        return found.series.setdefault(
            (kind, rank, self._name),
            _Series(kind, self._topic, self._name, unit, rank, _WIDTHS.get(kind, 1)),
        )


def _bytes_of(value: _Message) -> bytes:
    """What a message holds of a stream; a sentence without its end gets one."""
    if isinstance(value, str):
        data = value.encode("latin-1", "replace")
        return data if data.endswith((b"\n", b"\r")) or not data else data + b"\r\n"
    return np.asarray(value).astype(np.uint8, casting="unsafe").tobytes()


def _raw(path: Path, found: _Found, topics: list[str]) -> RawBytes:
    if len(topics) > 1:
        raise RecordingError(
            path, f"holds the bytes of {len(topics)} devices: {_some(sorted(topics))}",
            _pick(path, sorted(topics)),
        )  # fmt: skip
    received = found.raw[topics[0]].received
    note = (
        f"what the device sent is in {counted(len(received), 'message')} of "
        f"{printable(topics[0])}: used with the recorder's times"
    )
    facts = {"source": topics[0], "clock": "the recorder's, of each message"}
    return RawBytes(received, [note], facts)


def _pick(path: Path, names: list[str]) -> str:
    return (
        f"choose one: ahrsd convert {printable(path.name)} -o OUT.parquet --topic "
        f"{printable(names[0])}"
    )


def _sensors(path: Path, found: _Found, choice: Choice, topics: list[str]) -> Sensors:
    out = Sensors()
    for topic, kind in found.unread.items():
        out.notes.append(
            f"topic {printable(topic)} is of type {printable(kind)}, whose definition is not "
            f"in the recording: left out; put {printable(kind.rsplit('/', 1)[-1])}.msg beside it"
        )
    mag = _chosen(path, found, "mag", choice, None)
    gyro = _chosen(path, found, "gyro", choice, mag)
    if mag is None or gyro is None:
        missing = " and no ".join(
            word for word, one in (("magnetometer", mag), ("gyro", gyro)) if one is None
        )
        extra = f"; {out.notes[0]}" if out.notes else ""
        raise RecordingError(
            path, f"holds no {missing}, it has the topics {_some(topics)}{extra}",
            "record sensor_msgs/Imu and sensor_msgs/MagneticField",
        )  # fmt: skip
    clock = _clock_of(mag, gyro, out.notes)
    shift_s = mag.shift_s() if clock is _Clock.DEVICE else 0.0
    out.mag, out.gyro = mag.stream(shift_s, clock), gyro.stream(shift_s, clock)
    out.units |= {"mag": mag.unit, "gyro": gyro.unit}
    out.names |= {"mag": mag.name, "gyro": gyro.name}
    accel = found.series.get(("accel", gyro.rank, gyro.name))
    if accel is not None:
        out.accel, out.names["accel"] = accel.stream(shift_s, clock), accel.name
    _covariates(found, out, gyro, shift_s, clock)
    began = datetime.fromtimestamp(found.base_ns / 1e9, UTC).isoformat()
    out.facts["recorded_utc"] = began
    since = "" if clock is _Clock.DEVICE else f", s since {began}"
    out.facts |= {
        "clock": f"{clock.value}{since}",
        "frame": "the axes of the messages, as the driver published them",
    }
    if mag.rank == 2 or gyro.rank == 2:
        out.facts["undone"] = "nothing (what the driver or the device corrected stays in it)"
    else:
        out.facts["undone"] = "nothing; the device's uncompensated values were taken where present"
    return out


def _clock_of(mag: _Series, gyro: _Series, notes: list[str]) -> _Clock:
    """The device's clock, else that of the headers, if the two sensors share one."""
    if mag.has_device and gyro.has_device:
        return _Clock.DEVICE
    if not (mag.has_stamps and gyro.has_stamps):
        notes.append("the headers have no times: those of the recorder are used")
    elif not mag.overlaps(gyro):
        notes.append(
            "the headers of field and gyro are of different clocks: the recorder's times are used"
        )
    else:
        return _Clock.HEADERS
    return _Clock.RECORDER


def _chosen(
    path: Path, found: _Found, kind: str, choice: Choice, near: _Series | None
) -> _Series | None:
    """The best kind of the sensor; of several that of the magnetometer's message or namespace."""
    candidates = [one for (key, _, _), one in found.series.items() if key == kind]
    named = [one for one in candidates if {one.topic, one.name} & set(choice.topics)]
    candidates = named or candidates
    best = min((one.rank for one in candidates), default=0)
    candidates = [one for one in candidates if one.rank == best]
    if near is not None:
        for same in (
            [one for one in candidates if one.topic == near.topic],
            [one for one in candidates if _space(one.topic) == _space(near.topic)],
        ):
            candidates = same or candidates
    if len(candidates) > 1 and kind == "gyro":
        raw = [one for one in candidates if one.topic.endswith("raw")]
        candidates = raw if len(raw) == 1 else candidates
    if len(candidates) > 1:
        candidates = sorted(candidates, key=lambda one: one.name)
        names = [one.name for one in candidates]
        what = {"mag": "magnetometers", "gyro": "gyros"}[kind]
        most = max(one.turning_rad_s for one in candidates)
        still = [one.name for one in candidates if one.turning_rad_s < STILL * most]
        hint = ""
        if kind == "gyro" and still:
            hint = f"; {_some(still)} hardly turns beside the other"
            names = [*(name for name in names if name not in still), *still]
        raise RecordingError(
            path, f"holds {len(names)} {what}: {_some(sorted(names))}{hint}", _pick(path, names)
        )
    return candidates[0] if candidates else None


def _space(topic: str) -> str:
    return topic.rsplit("/", 1)[0]


def _covariates(found: _Found, out: Sensors, gyro: _Series, shift_s: float, clock: _Clock) -> None:
    for kind in ("temperature_c", "pressure_kpa", "motor_current_a", "battery_v"):
        of = [one for (key, _, _), one in found.series.items() if key == kind]
        if of:
            best = min(of, key=lambda one: (one.rank, -len(one.log_s), one.name))
            out.more[kind] = best.stream(shift_s, clock)
            if len(of) > 1:
                out.notes.append(f"{kind} is that of {printable(best.name)}, of {len(of)} topics")
    for key, one in found.series.items():
        if key[0] == "fix":
            fixes = one.stream(shift_s, clock)
            out.more |= positions(fixes.time_s, *fixes.values.T)
            break
    for (kind, _, name), one in found.series.items():
        stream = one.stream(shift_s, clock)
        if kind == "vn_attitude":
            names = ("vn_yaw_deg", "vn_pitch_deg", "vn_roll_deg")
            out.more |= {
                n: SensorSeries(stream.time_s, v[:, None])
                for n, v in zip(names, stream.values.T, strict=True)
            }
            out.angles |= set(names)
        elif kind == "attitude" and name == gyro.name:
            out.more |= {
                f"attitude_q{n}": SensorSeries(stream.time_s, v[:, None])
                for n, v in zip("wxyz", stream.values.T, strict=True)
            }
