"""Everything that the daemon tells the world, behind one object: socket, metrics, systemd.

None of it is needed for the work: where one cannot be had, that is logged and the daemon goes on.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable
from pathlib import Path

from ahrsd import events
from ahrsd.calibration import Affine
from ahrsd.core.core import Core
from ahrsd.samples import SampleBlock
from ahrsd.stream.decompensation import user_compensation
from ahrsd.telemetry.feeds import Feed, Outlet
from ahrsd.telemetry.metrics import MetricsServer
from ahrsd.telemetry.protocol import Newest, samples_record
from ahrsd.telemetry.sd_notify import Notifier
from ahrsd.telemetry.status import LinkFacts, StatusMaker
from ahrsd.telemetry.unix_socket import SocketServer, default_socket_path
from ahrsd.telemetry.words import service_line

_PACE_S = 0.004  # samples are told so often at most; a look at those that wait takes 0.3 ms

log = logging.getLogger("ahrsd")


class Public:
    """See the module. Used by the daemon's thread alone."""

    def __init__(self, now_s: float, notifier: Notifier | None = None) -> None:
        self.notifier = notifier or Notifier()
        self.socket: SocketServer | None = None
        self.metrics: MetricsServer | None = None
        self._maker = StatusMaker(now_s)
        self._feeds: list[Feed] = []  # of network shares
        self._newest, self._next_s = Newest(), now_s
        self._parts: list[tuple[SampleBlock, Affine]] = []  # to be told, with register 23

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

    def feed(self, outlets: Iterable[Outlet]) -> None:
        """Send what these shares are for."""
        self._feeds = [Feed(outlet) for outlet in outlets]

    def event(self, event: events.Event) -> None:
        """Something happened in the core."""
        if isinstance(event, events.SamplesSeen):
            self._maker.saw(event)
            part = self._newest.full(event.block)
            if part is not None and self._awaited:
                self._parts.append((part, event.present))
        elif self.socket is not None:
            self.socket.publish(event)

    def turn(self, core: Core, now_s: float, *, well: bool = True) -> None:
        """The daemon's loop turned once; the watchdog is fed while all is `well`."""
        if well:
            self.notifier.feed()
        parts, self._parts = self._parts, []
        if self._awaited and now_s >= self._next_s:
            self._next_s = now_s + self._pace_s
            present, _ = user_compensation(core.registers)
            parts += [(part, present) for part in self._newest.waiting(core.stream.peek())]
        feeds = [feed for feed in self._feeds if feed.outlet.wanted] if parts else []
        for part, present in parts:
            if self.socket is not None and self.socket.wants("samples"):
                self.socket.samples(samples_record(part, present))
            for feed in feeds:
                feed.samples(part, core)

    @property
    def _awaited(self) -> bool:
        """Whether anybody wants samples."""
        return self._pace_s < math.inf

    @property
    def _pace_s(self) -> float:
        """How often the samples that wait are told, by who wants them."""
        if self.socket is not None and self.socket.wants("samples"):
            return _PACE_S
        return min((feed.pace_s for feed in self._feeds if feed.outlet.wanted), default=math.inf)

    def look(self, core: Core, link: LinkFacts, now_s: float) -> None:
        """About once a second: the newest status for everybody who asks."""
        status = self._maker.make(core, link, now_s)
        self.notifier.ready(service_line(status))
        if self.socket is not None:
            self.socket.status(status)
        if self.metrics is not None:
            self.metrics.status(status)
        wall_offset_s = time.time() - time.monotonic()
        for feed in self._feeds:
            feed.look(core, status, wall_offset_s)

    def stopping(self) -> None:
        """The daemon ends; what it puts back takes a moment."""
        self.notifier.stopping()

    def close(self) -> None:
        """Tell no more."""
        for server in (self.socket, self.metrics):
            if server is not None:
                server.close()
