"""Numbers for Prometheus, on 127.0.0.1 only, out of the newest status. Off by default.

`METRICS` is the whole list; docs/guide/operating.md is checked against it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ahrsd.sharing.arbiter import COUNTED
from ahrsd.telemetry.words import STATES

Status = Mapping[str, Any]
Samples = list[tuple[tuple[str, ...], float]]  # values of the labels, value


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One metric: name, kind, help, labels, and where its numbers come from."""

    name: str
    kind: Literal["counter", "gauge"]
    help: str
    labels: tuple[str, ...]
    read: Callable[[Status], Samples]


def _number(*path: str) -> Callable[[Status], Samples]:
    """The number at a path; absent where there is none yet."""

    def read(status: Status) -> Samples:
        value: Any = status
        for key in path:
            value = None if value is None else value.get(key)
        return [] if value is None else [((), float(value))]

    return read


def _axes(*path: str) -> Callable[[Status], Samples]:
    def read(status: Status) -> Samples:
        value: Any = status
        for key in path:
            value = None if value is None else value.get(key)
        return [] if value is None else [((a,), float(v)) for a, v in zip("xyz", value)]

    return read


def _gates(status: Status) -> Samples:
    return [((gate["gate"],), float(gate["ok"])) for gate in status["gates"]]


def _states(status: Status) -> Samples:
    now = status["write_back"]["state"]
    return [((state,), float(state == now)) for state in STATES]


def _locked(status: Status) -> Samples:
    return [((), float(status["write_back"]["locked"] is not None))]


def _shares(name: str) -> Callable[[Status], Samples]:
    """One figure of each share; absent where a share has none, as UDP has no readers."""

    def read(status: Status) -> Samples:
        every = [(share["port"], share[name]) for share in status["shares"]]
        return [((port,), float(value)) for port, value in every if value is not None]

    return read


def _commands(status: Status) -> Samples:
    """What became of the commands that clients of ptys sent."""
    return [
        ((share["port"], outcome), float(share[outcome]))
        for share in status["shares"]
        if not share["send"]
        for outcome in COUNTED
        if outcome != "commands"  # all of them
    ]


def _capture(status: Status) -> Samples:
    return [((), float(bool(status["capture"]["error"])))]


METRICS: Final = (
    MetricRow("ahrsd_link_up", "gauge", "1 if the port is open", (), _number("link", "open")),
    MetricRow("ahrsd_bytes", "counter", "Bytes from the device", (), _number("link", "bytes")),
    MetricRow("ahrsd_messages", "counter", "Valid messages", (), _number("stream", "messages")),
    MetricRow("ahrsd_rejected", "counter", "Messages refused", (), _number("stream", "rejected")),
    MetricRow(
        "ahrsd_skipped_bytes",
        "counter",
        "Bytes that were in no message",
        (),
        _number("stream", "skipped_bytes"),
    ),
    MetricRow("ahrsd_samples", "counter", "Samples taken", (), _number("stream", "samples")),
    MetricRow("ahrsd_sample_rate_hertz", "gauge", "Sample rate", (), _number("stream", "rate_hz")),
    MetricRow("ahrsd_gaps", "counter", "Gaps in the stream", (), _number("stream", "gaps")),
    MetricRow(
        "ahrsd_device_restarts",
        "counter",
        "Restarts of the device",
        (),
        _number("stream", "restarts"),
    ),
    MetricRow("ahrsd_device_errors", "counter", "VNERR reported", (), _number("stream", "faults")),
    MetricRow(
        "ahrsd_heading_sigma_degrees",
        "gauge",
        "Heading error (1 sigma), worst attitude",
        (),
        _number("estimate", "heading_sigma_deg"),
    ),
    MetricRow(
        "ahrsd_converged",
        "gauge",
        "1 if the estimate has converged",
        (),
        _number("estimate", "converged"),
    ),
    MetricRow(
        "ahrsd_hard_iron_gauss",
        "gauge",
        "Hard iron",
        ("axis",),
        _axes("estimate", "hard_iron_gauss"),
    ),
    MetricRow(
        "ahrsd_gyro_bias_radians_per_second",
        "gauge",
        "Gyro bias",
        ("axis",),
        _axes("estimate", "gyro_bias_rad_s"),
    ),
    MetricRow("ahrsd_gate_open", "gauge", "1 if the gate is open", ("gate",), _gates),
    MetricRow(
        "ahrsd_state", "gauge", "1 for the present state of the write-back", ("state",), _states
    ),
    MetricRow("ahrsd_locked", "gauge", "1 if a person locked the write-back", (), _locked),
    MetricRow(
        "ahrsd_flash_writes",
        "counter",
        "Flash writes of this device, by its journal",
        (),
        _number("write_back", "flashes"),
    ),
    MetricRow("ahrsd_capture_failing", "gauge", "1 if records are being lost", (), _capture),
    MetricRow(
        "ahrsd_viewer_dropped",
        "counter",
        "Batches that the viewer did not accept",
        (),
        _number("viewer", "dropped"),
    ),
    MetricRow(
        "ahrsd_share_open",
        "gauge",
        "1 if the shared port has a reader",
        ("share",),
        _shares("open"),
    ),
    MetricRow("ahrsd_share_readers", "gauge", "Readers over TCP", ("share",), _shares("readers")),
    MetricRow(
        "ahrsd_share_lost_bytes",
        "counter",
        "Bytes lost by readers that were too slow",
        ("share",),
        _shares("lost_bytes"),
    ),
    MetricRow(
        "ahrsd_share_turned_away",
        "counter",
        "Readers turned away",
        ("share",),
        _shares("turned_away"),
    ),
    MetricRow(
        "ahrsd_share_ignored_bytes",
        "counter",
        "Bytes sent by readers, which may not write",
        ("share",),
        _shares("ignored_bytes"),
    ),
    MetricRow(
        "ahrsd_share_commands",
        "counter",
        "Commands of clients, by outcome",
        ("share", "outcome"),
        _commands,
    ),
)


class StatusCollector(Collector):
    """Turns the newest status into metrics when it is scraped."""

    def __init__(self) -> None:
        self.status: Status | None = None

    def collect(self) -> Iterator[Metric]:
        """One family per row that has numbers; nothing before the first status."""
        status = self.status
        for row in METRICS if status is not None else ():
            family = (CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily)(
                row.name, row.help, labels=row.labels
            )
            for labels, value in row.read(status or {}):
                family.add_metric(labels, value)
            yield family


class MetricsServer:
    """Serves on 127.0.0.1:`port` until `close`. Raises OSError where the port is taken."""

    def __init__(self, port: int) -> None:
        self._collector = StatusCollector()
        registry = CollectorRegistry()
        registry.register(self._collector)
        self._server: WSGIServer
        self._thread: threading.Thread
        self._server, self._thread = start_http_server(port, "127.0.0.1", registry)

    @property
    def port(self) -> int:
        """Where it serves."""
        return int(self._server.server_port)

    def status(self, status: Status) -> None:
        """The newest status."""
        self._collector.status = status

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(1.0)
