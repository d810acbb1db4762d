"""Recordings of ROS as the library rosbags writes them, of a tumbling sensor of known truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd import so3

HARD = np.array([0.12, -0.08, 0.06])
BIAS = np.array([3.5e-3, -4.2e-3, 2.1e-3])
BEGAN_NS = 1_747_130_000_000_000_000
SUFFIXES = {"bag": ".bag", "mcap": ".mcap", "db3": ".db3"}
_TYPES = {"float32": "f4", "uint8": "u1", "byte": "u1"}
Message = tuple[str, str, int, dict[str, Any]]  # topic, type, ns, fields


def motion(time_s: np.ndarray) -> np.ndarray:
    """(N, 3) rad/s."""
    return np.column_stack(
        [0.5 * np.sin(0.9 * time_s), 0.4 * np.sin(0.61 * time_s + 1), 0.4 + 0.2 * np.sin(time_s)]
    )


def sensor(
    count: int = 600, rate_hz: float = 20.0, seed: int = 1, turn: float = 1.0
) -> dict[str, np.ndarray]:
    """time_s, mag in gauss, gyro in rad/s, accel in m/s^2."""
    draw = np.random.default_rng(seed)
    time_s = np.arange(count) / rate_hz
    rate = turn * motion(turn * time_s)
    R = so3.products(so3.exp(rate / rate_hz))
    return {
        "time_s": time_s,
        "mag": np.einsum("nji,j->ni", R, [0.25, 0.0, 0.43])
        + HARD
        + 1e-3 * draw.normal(size=(count, 3)),
        "gyro": rate + BIAS + 7e-4 * draw.normal(size=(count, 3)),
        "accel": np.einsum("nji,j->ni", R, [0.0, 0.0, -9.80665]),
    }


def ns_of(time_s: float) -> int:
    return BEGAN_NS + round(time_s * 1e9)


def imu(data: dict[str, np.ndarray], topic: str = "/imu/data", **fields: Any) -> list[Message]:
    return [
        (topic, "sensor_msgs/msg/Imu", ns_of(t), {"angular_velocity": g, "linear_acceleration": a}
         | fields)
        for t, g, a in zip(data["time_s"], data["gyro"], data["accel"], strict=True)
    ]  # fmt: skip


def magnetic(
    data: dict[str, np.ndarray], topic: str = "/imu/mag", factor: float = 1e-4, **fields: Any
) -> list[Message]:
    return [
        (topic, "sensor_msgs/msg/MagneticField", ns_of(t), {"magnetic_field": factor * m} | fields)
        for t, m in zip(data["time_s"], data["mag"], strict=True)
    ]


def save(
    folder: Path,
    container: str,
    messages: Iterable[Message],
    name: str = "recording",
    definitions: dict[str, str] | None = None,
) -> Path:
    """A recording; each header has the time of its message unless `stamp_ns` says another."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if container == "bag" else Stores.ROS2_HUMBLE)
    for kind, text in (definitions or {}).items():
        store.register(get_types_from_msg(text, kind))
    if container == "bag":
        path = folder / f"{name}.bag"
        writer: Any = Writer1(path)
        pack = store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(folder / name, version=9, storage_plugin=plugin)
        pack = store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, ns, fields in sorted(messages, key=lambda one: one[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            stamp_ns = fields.pop("stamp_ns", ns) if isinstance(fields, dict) else ns
            writer.write(connections[topic], ns, pack(_filled(store, kind, stamp_ns, fields), kind))
    if container == "bag":
        return path
    return next(one for one in sorted((folder / name).iterdir()) if one.suffix == f".{container}")


def _filled(store: Any, kind: str, ns: int, fields: dict[str, Any]) -> Any:
    """A message with these fields; vectors may be arrays, what is not given is zero."""
    values = {}
    for name, (nodetype, argument) in store.fielddefs[kind][1]:
        if name in fields and not isinstance(fields[name], np.ndarray | dict):
            values[name] = fields[name]
        elif int(nodetype) == 1:
            zeros = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
            values[name] = zeros.get(argument[0], 0)
        elif int(nodetype) == 2:
            values[name] = _part(store, argument, ns, fields.get(name))
        elif int(nodetype) == 3:
            values[name] = np.zeros(argument[1])
        elif name in fields:
            values[name] = fields[name]
        else:
            plain = int(argument[0][0]) == 1 and argument[0][1][0] != "string"
            values[name] = (
                np.array([], np.dtype(_TYPES.get(argument[0][1][0], "f8"))) if plain else []
            )
    return store.types[kind](**values)


def _part(store: Any, kind: str, ns: int, value: Any) -> Any:
    if kind == "builtin_interfaces/msg/Time":
        return store.types[kind](ns // 10**9, ns % 10**9)
    if isinstance(value, np.ndarray):
        names = [field.name for field in dataclasses.fields(store.types[kind])][: len(value)]
        value = dict(zip(names, map(float, value), strict=True))
    return _filled(store, kind, ns, value or {})
