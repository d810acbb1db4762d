"""Everything that the daemon tells the world, behind one object: socket, metrics, systemd.

None of it is needed for the work: where one cannot be had, that is logged and the daemon goes on.
"""

from __future__ import annotations

import logging
from pathlib import Path

from ahrsd import events
from ahrsd.core.core import Core
from ahrsd.stream.decompensation import user_compensation
from ahrsd.telemetry.client import default_socket_path
from ahrsd.telemetry.lines import service_line
from ahrsd.telemetry.metrics import MetricsServer
from ahrsd.telemetry.records import Newest
from ahrsd.telemetry.sd_notify import Notifier
from ahrsd.telemetry.server import SocketServer
from ahrsd.telemetry.status import LinkFacts, StatusMaker

_PACE_S = 0.004  # samples are told so often at most

log = logging.getLogger("ahrsd")


class Public:
    """See the module. Used by the daemon's thread alone."""

    def __init__(self, now_s: float, notifier: Notifier | None = None) -> None:
        self.notifier = notifier or Notifier()
        self.socket: SocketServer | None = None
        self.metrics: MetricsServer | None = None
        self._maker = StatusMaker(now_s)
        self._newest, self._next_s = Newest(), now_s

    def open_socket(self, path: Path | None, state: Path) -> None:
        """Serve the socket, at its default place where no path is given."""
        place = path or default_socket_path(state)
        try:
            self.socket = SocketServer(place)
        except OSError as error:
            log.warning("%s: %s; status, watch and explain find no daemon", place, error)

    def open_metrics(self, port: int) -> None:
        """Serve the metrics."""
        try:
            self.metrics = MetricsServer(port)
        except OSError as error:
            log.warning("metrics: 127.0.0.1:%d: %s; set metrics.port", port, error.strerror)

    def event(self, event: events.Event) -> None:
        """Something happened in the core."""
        if isinstance(event, events.SamplesSeen):
            self._maker.saw(event)
        if self.socket is None:
            return
        if not isinstance(event, events.SamplesSeen):
            self.socket.publish(event)
        elif (record := self._newest.full(event.block, event.present)) and self._watched:
            self.socket.samples(record)

    def turn(self, core: Core, now_s: float, *, well: bool = True) -> None:
        """The daemon's loop turned once; the watchdog is fed while all is `well`."""
        if well:
            self.notifier.feed()
        if self.socket is not None and self._watched and now_s >= self._next_s:
            self._next_s = now_s + _PACE_S
            present, _ = user_compensation(core.registers)
            for record in self._newest.waiting(core.stream.peek(), present):
                self.socket.samples(record)

    @property
    def _watched(self) -> bool:
        return self.socket is not None and self.socket.wants("samples")

    def look(self, core: Core, link: LinkFacts, now_s: float) -> None:
        """About once a second: the newest status for everybody who asks."""
        status = self._maker.make(core, link, now_s)
        self.notifier.ready(service_line(status))
        if self.socket is not None:
            self.socket.status(status)
        if self.metrics is not None:
            self.metrics.status(status)

    def stopping(self) -> None:
        """The daemon ends; what it puts back takes a moment."""
        self.notifier.stopping()

    def close(self) -> None:
        """Tell no more."""
        for server in (self.socket, self.metrics):
            if server is not None:
                server.close()
