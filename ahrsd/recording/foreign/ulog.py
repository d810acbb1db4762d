"""Sensors of a PX4 log, by the package pyulog.

vehicle_magnetometer is corrected: R S (raw + power - offset), with offset and S of CAL_MAG of the
device. Offset and S are undone where R is the identity; power compensation is told. The gyro of
sensor_combined has CAL_GYRO's offset taken off, which is put back the same way. Before PX4 1.9 the
field stands in sensor_combined. Gauss, rad/s, m/s^2; x forward, y to the right, z down.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.errors import RecordingError
from ahrsd.printable import counted, printable
from ahrsd.recording.foreign.sensors import (
    Choice,
    Sensors,
    SensorSeries,
    positions,
    recorded_utc,
)
from ahrsd.samples import Array

_TOPICS = (
    "vehicle_magnetometer", "sensor_combined", "sensor_selection", "sensor_mag", "sensor_gyro",
    "sensor_baro", "battery_status", "vehicle_gps_position", "sensor_gps", "vehicle_attitude",
    "vehicle_air_data",
)  # fmt: skip
_NO_TIME = 0x7FFFFFFF  # of a field of sensor_combined that is not new
_SLOTS = 8
_FEWEST = 2
_Set = Any  # one topic of the library: name, multi_id, data by field
_Log = Any
_Parameters = Mapping[str, float]


def _loaded(path: Path, topics: tuple[str, ...] | None) -> _Log:
    from pyulog import ULog
    from pyulog.exceptions import ULogException

    said = io.StringIO()
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(said):
            return ULog(file, topics and list(topics), disable_str_exceptions=True)
    except (
        ULogException, struct.error, LookupError, ValueError, TypeError, AttributeError, OSError,
        ArithmeticError, RuntimeError,
    ) as error:  # fmt: skip
        words = printable(" ".join(str(error).split()) or type(error).__name__, 160)
        raise RecordingError(
            path, f"is a damaged PX4 log ({words})", "copy it from the card again"
        ) from error


def listed(path: Path) -> list[str]:
    """One line per topic: name, instance, messages, fields."""
    log = _loaded(path, None)
    return [
        f"{printable(one.name)}[{one.multi_id}]  {counted(len(one.data['timestamp']), 'message')}  "
        + ", ".join(printable(name) for name in sorted(one.data) if name != "timestamp")
        for one in sorted(log.data_list, key=lambda one: (one.name, one.multi_id))
    ]


def read(path: Path, choice: Choice) -> Sensors:
    """The sensors.  Raises RecordingError naming what the log has not."""
    log = _loaded(path, _TOPICS)
    sets: dict[str, list[_Set]] = {}
    for one in sorted(log.data_list, key=lambda one: (one.name, one.multi_id)):
        if "timestamp" in one.data:
            sets.setdefault(one.name, []).append(one)
    if "sensor_combined" not in sets:
        there = ", ".join(sorted(sets)) or "no sensor at all"
        raise RecordingError(
            path, f"holds no gyro (sensor_combined), but {there}", "log with SDLOG_PROFILE default"
        )
    out = Sensors()
    if log.file_corruption:
        out.notes.append("parts of the log are damaged: left out")
    if lost := sum(one.duration for one in log.dropouts):
        out.notes.append(
            f"the logger lost data: {counted(len(log.dropouts), 'gap')}, {lost / 1e3:.1f} s"
        )
    parameters = {str(k): float(v) for k, v in log.initial_parameters.items()}
    combined = sets["sensor_combined"][0].data
    time_s = combined["timestamp"] * 1e-6
    words = [_field(path, sets, parameters, choice, out), _inertial(path, sets, parameters, out)]
    if changed := {name for _, name, _ in log.changed_parameters if name.startswith("CAL_")}:
        out.notes.append(f"{', '.join(sorted(changed)[:3])} changed during the log")
    out.facts |= {
        "undone": "; ".join(words),
        "frame": "axes of the vehicle: x forward, y to the right, z down",
        "clock": "the autopilot's, s since its start",
        "firmware": printable(str(log.get_version_info_str() or "not in the log")),
    }
    if len(time_s) >= _FEWEST:
        _covariates(sets, out)
    return out


def _three(path: Path, one: _Set, stem: str) -> Array:
    names = [f"{stem}[{axis}]" for axis in range(3)]
    if absent := [name for name in names if name not in one.data]:
        raise RecordingError(
            path, f"{one.name} has no field {absent[0]}", "`ahrsd convert FILE --list` names them"
        )
    with np.errstate(invalid="ignore"):  # signalling nan of damaged bytes
        return np.column_stack([one.data[name] for name in names]).astype(np.float64)


def _field(
    path: Path, sets: dict[str, list[_Set]], parameters: _Parameters, choice: Choice, out: Sensors
) -> str:
    """The magnetometer into `out`; words on what was undone."""
    combined = sets["sensor_combined"][0]
    found = {int(one.multi_id): one for one in sets.get("vehicle_magnetometer", ())}
    number = choice.compass if choice.compass is not None else min(found, default=0)
    old = {"magnetometer_ga[0]", "magnetometer_timestamp_relative"} <= set(combined.data)
    if not found and old and not number:
        relative = combined.data["magnetometer_timestamp_relative"].astype(np.int64)
        new = relative != _NO_TIME
        at = (combined.data["timestamp"] + relative)[new] * 1e-6
        out.mag = SensorSeries(at, _three(path, combined, "magnetometer_ga")[new])
        out.names["mag"] = "sensor_combined"
        return "nothing of the field (PX4 before 1.9 does not say which device it is)"
    if not found:
        raise RecordingError(
            path, "holds no magnetometer (vehicle_magnetometer)", "log with SDLOG_PROFILE default"
        )
    if number not in found:
        there = ", ".join(map(str, sorted(found)))
        raise RecordingError(path, f"holds no compass {number}", f"it has --compass {there}")
    if len(found) > 1 and choice.compass is None:
        out.notes.append(
            f"it holds {len(found)} compasses: number {number} is used (`ahrsd convert --compass` "
            "takes another)"
        )
    one = found[number]
    stamp = "timestamp_sample" if "timestamp_sample" in one.data else "timestamp"
    device = int(one.data["device_id"][0]) if len(one.data.get("device_id", ())) else 0
    logged = _three(path, one, "magnetometer_ga")
    raw, words = _without_calibration(logged, device, parameters, out)
    out.mag, out.names["mag"] = (
        SensorSeries(one.data[stamp] * 1e-6, raw),
        f"vehicle_magnetometer[{number}]",
    )
    out.facts["device"] = str(device)
    return words


def _slot(kind: str, device: int, parameters: _Parameters) -> int | None:
    """The number of the calibration of a device."""
    return next(
        (n for n in range(_SLOTS) if device and parameters.get(f"CAL_{kind}{n}_ID", 0) == device),
        None,
    )


def _turned(kind: str, slot: int, parameters: _Parameters) -> bool:
    """Whether the sensor's axes are not those of the vehicle."""
    own = parameters.get(f"CAL_{kind}{slot}_ROT", -1.0)
    return own > 0.0 or (own < 0.0 and parameters.get("SENS_BOARD_ROT", 0.0) != 0.0)


def _xyz(stem: str, end: str, parameters: _Parameters, default: float) -> Array:
    return np.array([parameters.get(f"{stem}_{axis}{end}", default) for axis in "XYZ"])


def _without_calibration(
    logged: Array, device: int, parameters: _Parameters, out: Sensors
) -> tuple[Array, str]:
    slot = _slot("MAG", device, parameters)
    if slot is None:
        out.notes.append("no calibration of this compass is in the log: its field was taken as raw")
        return logged, "nothing of the field (no calibration of the device in the log)"
    stem = f"CAL_MAG{slot}"
    if _turned("MAG", slot, parameters):
        out.notes.append(f"the compass is turned ({stem}_ROT): its calibration stays in the field")
        return logged, f"nothing of the field ({stem}_ROT turns the compass)"
    if np.any(_xyz(stem, "COMP", parameters, 0.0)) and parameters.get("CAL_MAG_COMP_TYP", 0.0):
        out.notes.append(f"the motors' part of the field ({stem}_XCOMP ...) is not undone")
    offset = _xyz(stem, "OFF", parameters, 0.0)
    scale = _xyz(stem, "SCALE", parameters, 1.0)
    x, y, z = _xyz(stem, "ODIAG", parameters, 0.0)
    S = np.diag(scale) + np.array([[0.0, x, y], [x, 0.0, z], [y, z, 0.0]])
    if np.linalg.cond(S) > 100.0:
        out.notes.append(f"{stem}_XSCALE ... is no calibration: the field was taken as raw")
        return logged, f"nothing of the field ({stem} is no calibration)"
    words = f"offset {np.round(offset, 4).tolist()} gauss, S {np.round(S, 4).tolist()} of {stem}"
    return logged @ np.linalg.inv(S).T + offset, words


def _inertial(
    path: Path, sets: dict[str, list[_Set]], parameters: _Parameters, out: Sensors
) -> str:
    combined = sets["sensor_combined"][0]
    rate, at = _three(path, combined, "gyro_rad"), combined.data["timestamp"] * 1e-6
    words = "not the gyro's offset (the log does not say which gyro it is)"
    selected = sets.get("sensor_selection")
    device = int(selected[0].data["gyro_device_id"][0]) if selected else 0
    slot = _slot("GYRO", device, parameters)
    if slot is not None and not _turned("GYRO", slot, parameters):
        offset = _xyz(f"CAL_GYRO{slot}", "OFF", parameters, 0.0)
        rate = rate + offset
        words = f"gyro offset {np.round(1e3 * offset, 2).tolist()} mrad/s of CAL_GYRO{slot}"
    out.gyro, out.names["gyro"] = SensorSeries(at, rate), "sensor_combined"
    if "accelerometer_m_s2[0]" in combined.data:
        relative = combined.data.get("accelerometer_timestamp_relative", np.zeros(len(at)))
        new = relative != _NO_TIME
        out.accel = SensorSeries(
            (at + 1e-6 * relative)[new], _three(path, combined, "accelerometer_m_s2")[new]
        )
        out.names["accel"] = "sensor_combined"
    return words


def _covariates(sets: dict[str, list[_Set]], out: Sensors) -> None:
    def add(topic: str, name: str, column: str, factor: float = 1.0) -> None:
        for one in sets.get(topic, ())[:1]:
            values = one.data.get(name)
            if values is None or column in out.more:
                continue
            numbers = factor * np.asarray(values, dtype=np.float64)
            if topic == "battery_status":
                numbers = np.where(numbers < 0.0, np.nan, numbers)  # -1: not measured
            out.more[column] = SensorSeries(one.data["timestamp"] * 1e-6, numbers[:, None])

    add("battery_status", "current_a", "motor_current_a")
    add("battery_status", "voltage_v", "battery_v")
    for topic in ("sensor_gyro", "sensor_mag"):
        add(topic, "temperature", "temperature_c")
    add("vehicle_air_data", "baro_pressure_pa", "pressure_kpa", 1e-3)
    for topic in ("vehicle_gps_position", "sensor_gps"):
        for one in sets.get(topic, ())[:1]:
            _fixes(one, out)
    for one in sets.get("vehicle_attitude", ())[:1]:
        if all(f"q[{k}]" in one.data for k in range(4)):
            _attitude(one, out)


def _fixes(one: _Set, out: Sensors) -> None:
    data = one.data
    if "position_north_m" in out.more or "fix_type" not in data:
        return
    fixed = data["fix_type"] >= 3
    at = data["timestamp"][fixed] * 1e-6
    if "time_utc_usec" in data and out.mag is not None:
        unix_s = data["time_utc_usec"][fixed] * 1e-6
        out.facts |= recorded_utc(at, unix_s, float(out.mag.time_s[0]))
    if "latitude_deg" in data:  # since 1.14; before that integers of 1e-7 deg and mm
        names, factors = ("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0, 1.0)
    else:
        names, factors = ("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)
    if not set(names) <= set(data):
        return
    place = [f * data[n][fixed].astype(np.float64) for n, f in zip(names, factors, strict=True)]
    out.more |= positions(at, *place)
    if "vel_m_s" in data:
        speed = data["vel_m_s"][fixed].astype(np.float64)
        out.more["gps_speed_m_s"] = SensorSeries(at, speed[:, None])


def _attitude(one: _Set, out: Sensors) -> None:
    """The autopilot's own: from the vehicle's axes to north, east, down."""
    at = one.data["timestamp"] * 1e-6
    w, x, y, z = (one.data[f"q[{k}]"].astype(np.float64) for k in range(4))
    angles = {
        "vn_yaw_deg": np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        "vn_pitch_deg": np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
        "vn_roll_deg": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    }
    out.more |= {name: SensorSeries(at, np.degrees(v)[:, None]) for name, v in angles.items()}
    out.angles |= set(angles)
