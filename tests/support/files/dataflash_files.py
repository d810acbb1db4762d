"""Small ArduPilot logs, of the format's own description of itself."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

SIZES = {"Q": "Q", "I": "I", "B": "B", "H": "H", "h": "h", "f": "f", "c": "h", "C": "H", "L": "i",
         "e": "i", "n": "4s", "N": "16s", "Z": "64s"}  # fmt: skip
TYPES = {
    "PARM": (1, "QNf", "TimeUS,Name,Value"),
    "MSG": (2, "QZ", "TimeUS,Message"),
    "MAG": (3, "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "IMU": (4, "QBfffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T"),
    "BAT": (5, "QBff", "TimeUS,Inst,Volt,Curr"),
    "GPS": (6, "QBBIHLLef", "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,Spd"),
    "ATT": (7, "QccC", "TimeUS,Roll,Pitch,Yaw"),
    "MOD": (8, "QB", "TimeUS,Mode"),
}


def formats(types: dict[str, tuple[int, str, str]] = TYPES) -> bytes:
    out = b""
    for name, (number, codes, fields) in {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
                                          **types}.items():  # fmt: skip
        length = 3 + struct.calcsize("<" + "".join(SIZES[code] for code in codes))
        body = struct.pack(
            "<BB4s16s64s", number, length, name.encode(), codes.encode(), fields.encode()
        )
        out += b"\xa3\x95\x80" + body
    return out


def message(name: str, *values: Any, types: dict[str, tuple[int, str, str]] = TYPES) -> bytes:
    number, codes, _ = types[name]
    layout = "<" + "".join(SIZES[code] for code in codes)
    return b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)


def us(time_s: float) -> int:
    return round(time_s * 1e6) + 5_000_000


def parameters(values: dict[str, float]) -> bytes:
    return b"".join(message("PARM", 1, name.encode(), value) for name, value in values.items())


def mags(time_s: np.ndarray, field_mg: np.ndarray, offsets, motor, number: int = 0) -> list:
    """(time, bytes) of the messages; offsets, motor: (3,) or (N, 3) mG."""
    shape = np.shape(field_mg)
    rows = np.hstack([field_mg, np.broadcast_to(offsets, shape), np.broadcast_to(motor, shape)])
    return [
        (t, message("MAG", us(t), number, *np.round(row).astype(int).tolist(), 1, 0))
        for t, row in zip(time_s, rows, strict=True)
    ]


def imus(time_s: np.ndarray, rate: np.ndarray, force: np.ndarray, number: int = 0) -> list:
    return [
        (t, message("IMU", us(t), number, *g, *a, 31.5))
        for t, g, a in zip(time_s, rate, force, strict=True)
    ]


def save(path: Path, *parts: bytes | list) -> Path:
    """Bytes in front as they are, timed messages in order of time."""
    head = b"".join(part for part in parts if isinstance(part, bytes))
    timed = sorted((one for part in parts if isinstance(part, list) for one in part),
                   key=lambda one: one[0])  # fmt: skip
    path.write_bytes(formats() + head + b"".join(data for _, data in timed))
    return path
