"""Foxglove: the records of the daemon's socket as messages on topics, and the WebSocket server.

Who connects reads, and is offered nothing to write to.

| topic | holds | how often |
|---|---|---|
| /magnetometer/raw, .../corrected | x, y, z, norm [gauss]; by register 23 in force | each sample |
| /angular_rate | x, y, z [rad/s] | each sample |
| /field/raw, /field/corrected | a cloud of points [gauss]: a sphere where all is well | 1 s |
| /attitude | heading now and by the newest estimate, roll, pitch [deg] | 1 s |
| /estimate | hard iron [gauss], gyro bias [rad/s], heading's sigma [deg] | each estimate |
| /write_back | state, what holds a write back | each change, 1 s |
| /log | the daemon's log | each line |

Vectors are in the body frame, that of the device's own outputs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from foxglove import Channel, Context, start_server
from foxglove.channels import LogChannel, PointCloudChannel
from foxglove.messages import (
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    Quaternion,
    Timestamp,
    Vector3,
)
from foxglove.websocket import StatusLevel

from ahrsd.errors import EXIT_BUSY, DeviceError
from ahrsd.printable import counted
from ahrsd.samples import Array

# -- Topics ----------------------------------------------------------------------------------------


FRAME: Final = "body"
RAW, CORRECTED, RATE = "/magnetometer/raw", "/magnetometer/corrected", "/angular_rate"
CLOUDS: Final = {RAW: "/field/raw", CORRECTED: "/field/corrected"}
ATTITUDE, ESTIMATE, WRITE_BACK, LOG = "/attitude", "/estimate", "/write_back", "/log"
_POINTS = 4000  # of a cloud; the oldest goes first
_APART = 0.02  # of the field, from the last point that was kept
_CLOUD_S = 1.0

_NUMBER: dict[str, object] = {"type": ["number", "null"]}
_TEXT: dict[str, object] = {"type": "string"}


def _object(**properties: object) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
#: topic: JSON schema of its messages
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    RAW: {**_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, norm=_NUMBER), "title": "gauss"},
    CORRECTED: {**_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, norm=_NUMBER), "title": "gauss"},
    RATE: {**_VECTOR, "title": "rad/s"},
    ATTITUDE: _object(
        heading_deg=_NUMBER, heading_would_be_deg=_NUMBER, roll_deg=_NUMBER, pitch_deg=_NUMBER
    ),
    ESTIMATE: _object(
        hard_iron_gauss=_VECTOR,
        sigma_hard_iron_gauss=_VECTOR,
        gyro_bias_rad_s=_VECTOR,
        sigma_gyro_bias_rad_s=_VECTOR,
        heading_sigma_deg=_NUMBER,
        converged={"type": "boolean"},
    ),
    WRITE_BACK: _object(
        state=_TEXT,
        reason=_TEXT,
        holds={"type": "array", "items": _TEXT},
        gates_shut=_NUMBER,
    ),
}


@dataclass(frozen=True, slots=True)
class TopicMessage:
    """A message: of a cloud (n, 3) points, of the log (level, text), else a JSON object."""

    topic: str
    unix_ns: int
    content: dict[str, Any] | Array | tuple[str, str]


@dataclass(slots=True)
class _Cloud:
    points: deque[Array] = field(default_factory=lambda: deque(maxlen=_POINTS))

    def take(self, vector: Array) -> None:
        """Keep it where it differs from the last one; a vehicle at rest fills no cloud."""
        if not np.isfinite(vector).all():
            return
        size = float(np.linalg.norm(vector))
        if not self.points or np.linalg.norm(vector - self.points[-1]) > _APART * size:
            self.points.append(vector)


class Topics:
    """The messages of one connection to the daemon."""

    def __init__(self, wall_offset_s: float) -> None:
        """`wall_offset_s`: what the host's wall clock is ahead of its monotonic one."""
        self._offset_ns = round(wall_offset_s * 1e9)
        self._clouds = {topic: _Cloud() for topic in CLOUDS}
        self._cloud_s = float("-inf")

    def of(self, record: Mapping[str, Any], now_s: float) -> list[TopicMessage]:
        """What a record says; nothing of kinds that are not shown.

        now_s: the host's monotonic clock, for records that carry no time of their own
        """
        at_ns = self._unix_ns(_number(record.get("host_s"), now_s))
        match record.get("record"):
            case "samples":
                return list(self._samples(record))
            case "status":
                return list(_status(record, self._unix_ns(now_s)))
            case "estimate":
                return [TopicMessage(ESTIMATE, at_ns, _estimate(record))]
            case "state":
                told = {"state": record["new"], "reason": record["reason"]}
                return [TopicMessage(WRITE_BACK, at_ns, told)]
            case "note":
                return [TopicMessage(LOG, at_ns, (str(record["level"]), str(record["text"])))]
            case "gap":
                text = (
                    f"lost {counted(int(record['lost']), 'record')}: this program read too slowly"
                )
                return [TopicMessage(LOG, at_ns, ("warning", text))]
        return []

    def _samples(self, record: Mapping[str, Any]) -> Iterator[TopicMessage]:
        columns = {
            RAW: record["raw_b_gauss"],
            CORRECTED: record["corrected_b_gauss"],
            RATE: record["gyro_b_rad_s"],
        }
        host_s = record["host_s"]
        for topic, vectors in columns.items():
            for at_s, vector in zip(host_s, vectors, strict=True):
                content = _vector(vector)
                if topic in self._clouds:
                    known = np.array([np.nan if one is None else one for one in vector])
                    self._clouds[topic].take(known)
                    norm = float(np.linalg.norm(known))
                    content["norm"] = norm if np.isfinite(norm) else None
                yield TopicMessage(topic, self._unix_ns(at_s), content)
        if host_s and host_s[-1] - self._cloud_s >= _CLOUD_S:
            self._cloud_s = host_s[-1]
            for topic, cloud in self._clouds.items():
                if cloud.points:
                    points = np.array(cloud.points)
                    yield TopicMessage(CLOUDS[topic], self._unix_ns(self._cloud_s), points)

    def _unix_ns(self, host_s: float) -> int:
        return round(host_s * 1e9) + self._offset_ns


def _status(record: Mapping[str, Any], at_ns: int) -> Iterator[TopicMessage]:
    readings, write_back = record.get("readings"), record.get("write_back")
    if readings:
        names = SCHEMAS[ATTITUDE]["properties"]
        yield TopicMessage(ATTITUDE, at_ns, {name: readings.get(name) for name in names})
    if write_back:
        shut = sum(not gate["ok"] for gate in record.get("gates", ()))
        told = {"state": write_back["state"], "holds": write_back["holds"], "gates_shut": shut}
        yield TopicMessage(WRITE_BACK, at_ns, told)


def _estimate(record: Mapping[str, Any]) -> dict[str, Any]:
    sigma = record["standard_deviation"]  # soft iron (6,), hard iron (3,), gyro bias (3,)
    return {
        "hard_iron_gauss": _vector(record["hard_iron_gauss"]),
        "sigma_hard_iron_gauss": _vector(sigma[6:9]),
        "gyro_bias_rad_s": _vector(record["gyro_bias_rad_s"]),
        "sigma_gyro_bias_rad_s": _vector(sigma[9:12]),
        "heading_sigma_deg": record["heading_sigma_deg"],
        "converged": record["converged"],
    }


def _vector(values: Iterable[float | None]) -> dict[str, float | None]:
    return dict(zip("xyz", values, strict=True))


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


# -- The server ------------------------------------------------------------------------------------


_LEVELS = {
    "debug": LogLevel.Debug,
    "info": LogLevel.Info,
    "warning": LogLevel.Warning,
    "error": LogLevel.Error,
}
_AWAY = "daemon"  # the id of the server's status while no daemon answers
_HERE = Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(w=1.0))


class FoxgloveServer:
    """Messages of `Topics` for whoever connects, until `close`."""

    def __init__(self, address: str, port: int) -> None:
        """Port 0: any that is free.  DeviceError where it is taken."""
        self._context = context = Context()  # its channels close with it
        self._channels = {
            topic: Channel(topic, schema=schema, context=context)
            for topic, schema in SCHEMAS.items()
        }
        self._clouds = {t: PointCloudChannel(t, context=context) for t in CLOUDS.values()}
        self._log = LogChannel(LOG, context=context)
        try:
            self._server = start_server(
                name="ahrsd", host=address, port=port, capabilities=[], context=context
            )
        except RuntimeError as error:
            reason = str(error).rpartition(": ")[2].partition(" (os error")[0]
            text = f"{address} port {port}: {reason}; --port and --address choose others"
            raise DeviceError(text, EXIT_BUSY) from None
        self.port: int = self._server.port

    def show(self, message: TopicMessage) -> None:
        """To everybody who asked for its topic."""
        content, at_ns = message.content, message.unix_ns
        if isinstance(content, dict):
            self._channels[message.topic].log(content, log_time=at_ns)
        elif isinstance(content, tuple):
            level, text = content
            found = _LEVELS.get(level, LogLevel.Unknown)
            line = Log(timestamp=_timestamp(at_ns), level=found, message=text, name="ahrsd")
            self._log.log(line, log_time=at_ns)
        else:
            self._clouds[message.topic].log(_cloud(content, at_ns), log_time=at_ns)

    def away(self, why: str) -> None:
        """No daemon answers, for this reason."""
        self._server.publish_status(why, StatusLevel.Warning, _AWAY)

    def back(self) -> None:
        """A daemon answers."""
        self._server.remove_status([_AWAY])

    def close(self) -> None:
        """Everybody is let go."""
        self._server.stop()


def _timestamp(unix_ns: int) -> Timestamp:
    return Timestamp(sec=unix_ns // 10**9, nsec=unix_ns % 10**9)


def _cloud(points: Array, unix_ns: int) -> PointCloud:
    data = np.ascontiguousarray(points, dtype="<f4")
    fields = [
        PackedElementField(name=name, offset=4 * k, type=PackedElementFieldNumericType.Float32)
        for k, name in enumerate("xyz")
    ]
    return PointCloud(
        timestamp=_timestamp(unix_ns),
        frame_id=FRAME,
        pose=_HERE,
        point_stride=12,
        fields=fields,
        data=data.tobytes(),
    )
