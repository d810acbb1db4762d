"""A WebSocket server for Foxglove; who connects reads, and is offered nothing to write to."""

from __future__ import annotations

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
from ahrsd.samples import Array
from ahrsd.viewer.foxglove_topics import CLOUDS, FRAME, LOG, SCHEMAS, TopicMessage

_LEVELS = {
    "debug": LogLevel.Debug,
    "info": LogLevel.Info,
    "warning": LogLevel.Warning,
    "error": LogLevel.Error,
}
_AWAY = "daemon"  # the id of the server's status while no daemon answers
_HERE = Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(w=1.0))


class FoxgloveServer:
    """Topics of `foxglove_topics` for whoever connects, until `close`."""

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
