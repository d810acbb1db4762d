"""Small PX4 logs: definitions, parameters, subscriptions and data."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

_CODES = {"uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "float": "f", "uint8_t": "B",
          "double": "d"}  # fmt: skip
FORMATS = {
    "vehicle_magnetometer": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;"
    "float[3] magnetometer_ga",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2",
    "sensor_selection": "uint64_t timestamp;uint32_t accel_device_id;uint32_t gyro_device_id",
    "battery_status": "uint64_t timestamp;float voltage_v;float current_a",
    "sensor_gps": "uint64_t timestamp;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float vel_m_s;uint8_t fix_type;uint64_t time_utc_usec",
    "vehicle_attitude": "uint64_t timestamp;float[4] q",
}
OLD = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
    "int32_t magnetometer_timestamp_relative;float[3] magnetometer_ga",
}


def _message(kind: bytes, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), kind[0]) + body


def _layout(text: str) -> str:
    out = "<"
    for one in text.split(";"):
        kind = one.split(" ")[0]
        name, _, count = kind.partition("[")
        out += f"{count.rstrip(']') or 1}{_CODES[name]}"
    return out


def us(time_s: float) -> int:
    return round(time_s * 1e6) + 1_000_000


def save(
    path: Path,
    data: list[tuple[str, int, float, tuple]],
    parameters: dict[str, float] | None = None,
    formats: dict[str, str] = FORMATS,
) -> Path:
    """data: (topic, instance, time in s, values behind the time stamp)."""
    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1)
    out += _message(b"B", bytes(40))
    for name, text in formats.items():
        out += _message(b"F", f"{name}:{text};".encode())
    for name, value in (parameters or {}).items():
        whole = isinstance(value, int)
        key = f"{'int32_t' if whole else 'float'} {name}".encode()
        number = struct.pack("<i" if whole else "<f", value)
        out += _message(b"P", bytes([len(key)]) + key + number)
    topics = list(dict.fromkeys((name, number) for name, number, _, _ in data))
    for k, (name, number) in enumerate(topics):
        out += _message(b"A", struct.pack("<BH", number, k) + name.encode())
    layouts = {name: _layout(text) for name, text in formats.items()}
    messages = [
        _message(
            b"D",
            struct.pack("<H", topics.index((name, number)))
            + struct.pack(layouts[name], us(time_s), *values),
        )
        for name, number, time_s, values in sorted(data, key=lambda one: one[2])
    ]
    path.write_bytes(out + b"".join(messages))
    return path


def mags(time_s: np.ndarray, field: np.ndarray, device: int = 7, number: int = 0) -> list:
    return [
        ("vehicle_magnetometer", number, t, (us(t), device, *row))
        for t, row in zip(time_s, field, strict=True)
    ]


def combined(time_s: np.ndarray, rate: np.ndarray, force: np.ndarray) -> list:
    return [
        ("sensor_combined", 0, t, (*g, 0, *a)) for t, g, a in zip(time_s, rate, force, strict=True)
    ]
