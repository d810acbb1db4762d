"""Sensors of an ArduPilot log. Its field is corrected, which is undone from the log's parameters:

    logged = D s (raw + offsets) + motor       since the motors are measured on the corrected field
    logged = D s (raw + offsets + motor)       before that (Copter 3.5)

D holds COMPASS_DIA and COMPASS_ODI, s is COMPASS_SCALE; offsets and motor stand in each row, as
offsets may be learned in flight. The gyro's offsets (INS_GYROFFS) are put back, too. Field in mG,
rates in rad/s, force in m/s^2, in the axes of the vehicle: x forward, y to the right, z down.

The file (DataFlash) is a row of messages `A3 95 TYPE body`. Type 128 (FMT) names the types, their
lengths, the codes of their fields and the fields. Where a header does not stand where it should,
the next one is searched and the bytes in between are counted as damage.
"""

from __future__ import annotations

import mmap
import re
from array import array
from collections.abc import Container
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ahrsd.errors import RecordingError
from ahrsd.printable import counted, printable
from ahrsd.recording.foreign.sensors import (
    STILL,
    Choice,
    Sensors,
    SensorSeries,
    positions,
    recorded_utc,
)
from ahrsd.recording.limits import TABLE_CELLS, refuse_beyond
from ahrsd.samples import Array

# -- The file (DataFlash) --------------------------------------------------------------------------


_HEADER = b"\xa3\x95"
_FMT, _FMT_BYTES = 128, 89
_CODES: dict[str, str] = {
    "a": "(32,)<i2", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2", "e": "<i4",
    "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8", "g": "<f2",
}  # fmt: skip
_SCALES = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


@dataclass(slots=True)
class _Type:
    """A kind of message: what it holds, how many there are, and where they begin if wanted."""

    name: str
    length: int
    fields: tuple[str, ...]
    codes: str
    layout: np.dtype[np.void] | None
    places: array[int] | None = None
    count: int = 0


@dataclass(slots=True)
class Log:
    """rows by message name; counts of all messages, wanted or not; bytes that are no message."""

    rows: dict[str, NDArray[np.void]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    codes: dict[str, dict[str, str]] = field(default_factory=dict)
    damaged_bytes: int = 0

    def has(self, message: str, *fields: str) -> bool:
        """Whether the log has rows of this message with these fields."""
        return message in self.rows and set(fields) <= set(self.codes[message])

    def column(self, message: str, name: str) -> Array:
        """(N,) in the field's unit; KeyError where there is none."""
        scale = _SCALES.get(self.codes[message][name], 1.0)
        with np.errstate(invalid="ignore"):  # signalling nan of damaged bytes
            return np.asarray(self.rows[message][name], dtype=np.float64) * scale

    def texts(self, message: str, name: str) -> list[str]:
        """The strings of a field."""
        if not self.has(message, name):
            return []
        raw = self.rows[message][name].tolist()
        return [bytes(one).split(b"\0")[0].decode("ascii", "replace") for one in raw]


def read_log(path: Path, wanted: Container[str]) -> Log:
    """The messages of these names.  Raises RecordingError."""
    log = Log()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        types = _indexed(path, data, wanted, log)
    for kind in types.values():
        if not kind.count:
            continue
        log.counts[kind.name] = log.counts.get(kind.name, 0) + kind.count
        if kind.places and kind.layout is not None:
            log.rows[kind.name] = _log_rows(path, kind.places, kind.length, kind.layout)
            log.codes[kind.name] = dict(zip(kind.fields, kind.codes, strict=False))
    return log


def _log_rows(
    path: Path, places: array[int], length: int, layout: np.dtype[np.void]
) -> NDArray[np.void]:
    """The bodies of the messages that begin at these places."""
    bodies = np.frombuffer(places, np.int64)[:, None] + np.arange(3, length)
    rows: NDArray[np.void] = np.memmap(path, np.uint8, "r")[bodies].view(layout)[:, 0]
    return rows


def _indexed(path: Path, data: mmap.mmap, wanted: Container[str], log: Log) -> dict[bytes, _Type]:
    """The kinds of messages by their first three bytes, with their places."""
    formats = _HEADER + bytes([_FMT])
    types = {formats: _Type("FMT", _FMT_BYTES, (), "", None)}
    end, at = len(data), 0
    while at + 3 <= end:
        start = data[at : at + 3]
        kind = types.get(start)
        if kind is not None and at + kind.length <= end:
            kind.count += 1
            if kind.places is not None:
                kind.places.append(at)
            elif start == formats:
                _learn(data[at + 3 : at + _FMT_BYTES], types, wanted)
            at += kind.length
            continue
        following = data.find(_HEADER, at + 1)
        following = end if following < 0 else following
        log.damaged_bytes += following - at
        at = following
    log.damaged_bytes += end - at
    numbers = sum(len(kind.places) * len(kind.fields) for kind in types.values() if kind.places)
    refuse_beyond(path, numbers, TABLE_CELLS, "numbers", "cut it in parts")
    return types


def _learn(body: bytes, types: dict[bytes, _Type], wanted: Container[str]) -> None:
    """A format message; one whose codes do not give its length is skipped over as it is."""
    number, length = body[0], body[1]
    start = _HEADER + bytes([number])
    name, codes, names = (
        body[a:b].split(b"\0")[0].decode("ascii", "replace") for a, b in ((2, 6), (6, 22), (22, 86))
    )
    if number == _FMT or length < 3 or (start in types and types[start].count):
        return
    fields = tuple(part for part in names.split(",") if part)
    layout = None
    if len(fields) == len(codes) == len(set(fields)) and set(codes) <= set(_CODES):
        layout = np.dtype([(one, _CODES[code]) for one, code in zip(fields, codes, strict=True)])
    if layout is not None and layout.itemsize != length - 3:
        layout = None
    places = array("q") if name in wanted and layout is not None else None
    types[start] = _Type(name, length, fields, codes, layout, places)


def refuse_empty(path: Path, log: Log) -> None:
    """Raise RecordingError where nothing but formats is in the log."""
    if not set(log.counts) - {"FMT", "FMTU", "UNIT", "MULT", "PARM"}:
        raise RecordingError(
            path, "is an ArduPilot log without a measurement", "arm, or set LOG_DISARMED, and log"
        )


# -- Its sensors -----------------------------------------------------------------------------------


_MAGS = ("MAG", "MAG2", "MAG3")
_WANTED = frozenset(
    {*_MAGS, "IMU", "IMU2", "PARM", "MSG", "VER", "BAT", "CURR", "GPS", "ATT", "BARO", "RCOU"}
)
_INSTANCES = ("I", "Inst", "Instance")
_TIMES = (("TimeUS", 1e-6), ("TimeMS", 1e-3))
_VERSION = re.compile(r"V(\d+)\.(\d+)")
_LEARNED_MG = 2.0  # offsets that move by more were learned in flight
#: week and ms of the week since 1980; the second pair in old logs
_SATELLITES = (("GWk", "GMS"), ("Week", "TimeMS"))
_GPS_EPOCH_S, _WEEK_S = 315964800.0, 604800.0
_LEAP_S = 18.0  # since 2017; up to 3 less before
_SOME = "record MAG and IMU (LOG_BITMASK)"


@dataclass(frozen=True, slots=True)
class _Undone:
    """The field in mG as the sensor read it, and words on what was taken off."""

    raw_mg: Array
    words: str
    notes: list[str]


def listed(path: Path) -> list[str]:
    """One line per message: name, how many, fields."""
    log = read_log(path, _WANTED)
    return [
        f"{printable(name)}  {counted(count, 'message')}"
        + (f"  {', '.join(log.codes[name])}" * (name in log.codes))
        for name, count in sorted(log.counts.items())
    ]


def read(path: Path, choice: Choice) -> Sensors:
    """The sensors.  Raises RecordingError naming what the log has not."""
    log = read_log(path, _WANTED)
    refuse_empty(path, log)
    out = Sensors(units={"mag": "mG", "gyro": "rad/s", "accel": "m/s^2"})
    if log.damaged_bytes:
        out.notes.append(f"{log.damaged_bytes} bytes of the log are no message: left out")
    parameters = _parameters(log)
    message, rows, number = _compass(path, log, choice, out)
    at = _times(path, log, message)[rows]
    undone = _without_corrections(path, log, parameters, message, rows, number)
    out.mag, out.names["mag"] = SensorSeries(at, undone.raw_mg), f"{message}[{number}]"
    out.notes += undone.notes
    words = [undone.words, _inertial(path, log, parameters, out)]
    out.facts |= {
        "undone": "; ".join(word for word in words if word),
        "frame": "axes of the vehicle: x forward, y to the right, z down",
        "clock": "the autopilot's, s since its start",
        "firmware": _firmware(log) or "not in the log",
        "device": f"{parameters.get('COMPASS_DEV_ID' + _suffix(number), 0.0):.0f}",
    }
    _covariates(path, log, out)
    return out


def _parameters(log: Log) -> dict[str, float]:
    """The last value of each."""
    if not log.has("PARM", "Name", "Value"):
        return {}
    names, values = log.texts("PARM", "Name"), log.column("PARM", "Value")
    return dict(zip(names, values.tolist(), strict=True))


def _firmware(log: Log) -> str:
    texts = [*log.texts("VER", "FWS"), *log.texts("MSG", "Message")]
    return next((printable(text) for text in texts if _VERSION.search(text)), "")


def _suffix(number: int) -> str:
    """What stands for a sensor in the names of its parameters: INS_GYROFFS_X, INS_GYR2OFFS_X."""
    return "" if number == 0 else str(number + 1)


def _times(path: Path, log: Log, message: str) -> Array:
    for name, factor in (("SampleUS", 1e-6), *_TIMES):
        if log.has(message, name):
            return log.column(message, name) * factor
    raise RecordingError(path, f"{message} has no time", "give a log with TimeUS or TimeMS")


def _rows(log: Log, message: str, number: int) -> NDArray[np.bool]:
    """The rows of one instance of a sensor."""
    column = next((one for one in _INSTANCES if log.has(message, one)), None)
    if column is None:
        return np.ones(len(log.rows[message]), dtype=bool)
    return np.asarray(log.rows[message][column] == number)


def _compass(
    path: Path, log: Log, choice: Choice, out: Sensors
) -> tuple[str, NDArray[np.bool], int]:
    """(message, its rows, number) of the chosen magnetometer, or of the first."""
    field = ("MagX", "MagY", "MagZ")
    found: dict[int, tuple[str, NDArray[np.bool]]] = {}
    column = next((one for one in _INSTANCES if log.has("MAG", one)), None)
    if column is not None and log.has("MAG", *field):
        for number in np.unique(log.rows["MAG"][column]).tolist():
            found[int(number)] = ("MAG", _rows(log, "MAG", int(number)))
    else:
        for number, name in enumerate(_MAGS):
            if log.has(name, *field):
                found[number] = (name, np.ones(len(log.rows[name]), dtype=bool))
    if not found:
        raise RecordingError(path, "holds no magnetometer (MAG)", _SOME)
    live = [one for one, (name, rows) in sorted(found.items()) if _reads(log, name, field, rows)]
    number = min(live or found) if choice.compass is None else choice.compass
    if number not in found:
        there = ", ".join(map(str, sorted(found)))
        raise RecordingError(path, f"holds no compass {number}", f"it has --compass {there}")
    if len(found) > 1 and choice.compass is None:
        out.notes.append(
            f"it holds {len(found)} compasses: number {number} is used (`ahrsd convert --compass` "
            "takes another)"
        )
        if dead := sorted(set(found) - set(live)):
            out.notes.append(f"dead, one reading throughout: compass {', '.join(map(str, dead))}")
    return (*found[number], number)


def _reads(log: Log, message: str, fields: tuple[str, ...], rows: NDArray[np.bool]) -> bool:
    """Whether a sensor's readings differ at all."""
    return bool(np.any(np.ptp(_vector(log, message, fields, rows), axis=0) > 0.0))


def _gyro_number(log: Log, out: Sensors) -> int:
    """The first gyro, but where another one turns with the vehicle and it does not."""
    column = next((one for one in _INSTANCES if log.has("IMU", one)), None)
    numbers = [0] if column is None else np.unique(log.rows["IMU"][column]).tolist()
    fields = ("GyrX", "GyrY", "GyrZ")
    rates = {k: _vector(log, "IMU", fields, _rows(log, "IMU", k)) for k in map(int, numbers)}
    turning = {k: float(np.sqrt(np.mean(np.var(one, axis=0)))) for k, one in rates.items()}
    first = min(turning)
    most = max(turning, key=lambda k: turning[k])
    if not turning[first] < STILL * turning[most]:
        return first
    out.notes.append(
        f"the gyro of IMU {first} hardly turns ({turning[first]:.2g} rad/s), that of IMU {most} "
        f"does ({turning[most]:.2g} rad/s): its rates were taken"
    )
    return most


def _vector(log: Log, message: str, fields: tuple[str, ...], rows: NDArray[np.bool]) -> Array:
    return np.column_stack([log.column(message, name)[rows] for name in fields])


def _without_corrections(
    path: Path,
    log: Log,
    parameters: dict[str, float],
    message: str,
    rows: NDArray[np.bool],
    number: int,
) -> _Undone:
    logged = _vector(log, message, ("MagX", "MagY", "MagZ"), rows)
    if not log.has(message, "OfsX", "OfsY", "OfsZ"):
        return _Undone(logged, "nothing of the field: the log has no offsets", [])
    offsets = _vector(log, message, ("OfsX", "OfsY", "OfsZ"), rows)
    names = next(
        (
            found
            for found in (("MOX", "MOY", "MOZ"), ("MOfsX", "MOfsY", "MOfsZ"))
            if log.has(message, *found)
        ),
        None,
    )
    motor = np.zeros_like(logged) if names is None else _vector(log, message, names, rows)
    end = _suffix(number)
    dia = [parameters.get(f"COMPASS_DIA{end}_{axis}", 1.0) for axis in "XYZ"]
    dia = dia if all(dia) else [1.0, 1.0, 1.0]
    odi = [parameters.get(f"COMPASS_ODI{end}_{axis}", 0.0) for axis in "XYZ"]
    D = np.array([[dia[0], odi[0], odi[1]], [odi[0], dia[1], odi[2]], [odi[1], odi[2], dia[2]]])
    if np.linalg.cond(D) > 100.0:
        raise RecordingError(
            path, f"COMPASS_DIA{end} and ODI{end} are no calibration: {np.round(D, 3).tolist()}",
            "the field cannot be undone; log with a calibrated compass",
        )  # fmt: skip
    scale = parameters.get(f"COMPASS_SCALE{end}", 0.0)
    scale = scale if 0.5 < scale < 2.0 else 1.0
    after, order = _motor_after(log, parameters)
    notes = []
    shaped = not np.allclose(D, np.eye(3)) or scale != 1.0
    if shaped and np.any(motor):
        notes.append(f"the motors' part of the field is taken off {order}")
    inverse = np.linalg.inv(scale * D)
    raw = (logged - motor) @ inverse.T if after else logged @ inverse.T - motor
    if (learned := float(np.ptp(offsets, axis=0).max())) > _LEARNED_MG:
        notes.append(f"the offsets moved by {learned:.0f} mG in flight: undone row by row")
    words = (
        f"offsets {np.round(np.median(offsets, axis=0)).astype(int).tolist()} mG (median), "
        f"D {np.round(D, 4).tolist()}, scale {scale:g}, motors up to {np.abs(motor).max():.0f} mG"
    )
    return _Undone(raw - offsets, words, notes)


def _motor_after(log: Log, parameters: dict[str, float]) -> tuple[bool, str]:
    """Whether the motors' part is added after D, and how that is known."""
    if "COMPASS_PMOT_EN" in parameters or "COMPASS_SCALE" in parameters:
        return True, "before D, as this firmware's parameters say"
    version = _VERSION.search(_firmware(log))
    if version is None:
        return False, "after D; the log does not name its firmware, so that the order is a guess"
    since = (3, 6) if "Copter" in _firmware(log) else (4, 0)
    if (int(version[1]), int(version[2])) >= since:
        return True, f"before D, as in {version[0]}"
    return False, f"after D, as in {version[0]}"


def _inertial(path: Path, log: Log, parameters: dict[str, float], out: Sensors) -> str:
    if not log.has("IMU", "GyrX", "GyrY", "GyrZ"):
        raise RecordingError(path, "holds no gyro (IMU)", _SOME)
    number = _gyro_number(log, out)
    rows = _rows(log, "IMU", number)
    at = _times(path, log, "IMU")[rows]
    rate = _vector(log, "IMU", ("GyrX", "GyrY", "GyrZ"), rows)
    offset = np.array(
        [parameters.get(f"INS_GYR{_suffix(number)}OFFS_{axis}", 0.0) for axis in "XYZ"]
    )
    words = ""
    if np.any(offset):
        if parameters.get("AHRS_ORIENTATION", 0.0) == 0.0:
            rate = rate + offset
            words = f"gyro offsets {np.round(1e3 * offset, 2).tolist()} mrad/s"
        else:
            words = "not the gyro's offsets (AHRS_ORIENTATION turns them)"
    out.gyro, out.names["gyro"] = SensorSeries(at, rate), f"IMU[{number}]"
    if log.has("IMU", "AccX", "AccY", "AccZ"):
        out.accel = SensorSeries(at, _vector(log, "IMU", ("AccX", "AccY", "AccZ"), rows))
        out.names["accel"] = f"IMU[{number}]"
    for name in ("T", "Temp"):
        if log.has("IMU", name, "TimeUS"):
            out.more["temperature_c"] = SensorSeries(at, log.column("IMU", name)[rows][:, None])
            break
    return words


def _covariates(path: Path, log: Log, out: Sensors) -> None:
    def add(message: str, name: str, column: str, factor: float = 1.0) -> None:
        if log.has(message, name) and column not in out.more:
            rows = _rows(log, message, 0)
            values = factor * log.column(message, name)[rows]
            out.more[column] = SensorSeries(_times(path, log, message)[rows], values[:, None])

    for message in ("BAT", "CURR"):
        old = log.has(message, "Volt") and float(np.median(log.column(message, "Volt"))) > 100.0
        add(message, "Curr", "motor_current_a", 0.01 if old else 1.0)
        add(message, "Volt", "battery_v", 0.01 if old else 1.0)
    add("BARO", "Press", "pressure_kpa", 1e-3)
    for name, column in (("Yaw", "vn_yaw_deg"), ("Pitch", "vn_pitch_deg"), ("Roll", "vn_roll_deg")):
        add("ATT", name, column)
    out.angles |= {"vn_yaw_deg", "vn_pitch_deg", "vn_roll_deg"}
    if log.has("GPS", "Lat", "Lng", "Alt"):
        rows = _rows(log, "GPS", 0)
        if log.has("GPS", "Status"):
            rows &= log.column("GPS", "Status") >= 3.0
        if log.has("GPS", "TimeUS"):
            at = log.column("GPS", "TimeUS")[rows] * 1e-6
        elif log.has("GPS", "T"):  # TimeMS of old logs is the satellites' week
            at = log.column("GPS", "T")[rows] * 1e-3
        else:
            return
        if out.mag is not None:
            out.facts |= _began(log, rows, at, float(out.mag.time_s[0]))
        lat, lon, height = (log.column("GPS", name)[rows] for name in ("Lat", "Lng", "Alt"))
        out.more |= positions(at, lat, lon, height)
        if log.has("GPS", "Spd"):
            out.more["gps_speed_m_s"] = SensorSeries(at, log.column("GPS", "Spd")[rows][:, None])


def _began(log: Log, rows: NDArray[np.bool], at: Array, first_s: float) -> dict[str, str]:
    """When the log's first reading was, by the satellites' time of the fixes."""
    for week, milliseconds in _SATELLITES:
        if log.has("GPS", week, milliseconds):
            weeks = log.column("GPS", week)[rows]
            seconds = 1e-3 * log.column("GPS", milliseconds)[rows] - _LEAP_S
            unix_s = np.where(weeks > 0, _GPS_EPOCH_S + _WEEK_S * weeks + seconds, np.nan)
            return recorded_utc(at, unix_s, first_s)
    return {}
