"""`ahrsd foxglove`: the running daemon for Foxglove, in a process of its own."""

from __future__ import annotations

import importlib.util
import signal
import threading
import time
from contextlib import closing
from typing import TYPE_CHECKING

import click

from ahrsd.cli.running.daemon import DaemonPlace, in_url, ip_address, place_options
from ahrsd.errors import AhrsdError, DeviceError

if TYPE_CHECKING:
    from ahrsd.telemetry.unix_socket import DaemonConnection
    from ahrsd.viewer.foxglove import FoxgloveServer

_AGAIN_S = 1.0


@click.command()
@place_options
@click.option(
    "--address",
    default="127.0.0.1",
    show_default=True,
    help="Where to listen. Anybody who reaches another address can read.",
)
@click.option("--port", default=8765, show_default=True, type=click.IntRange(0, 65535))
def command(place: DaemonPlace, address: str, port: int) -> None:
    """Serve the running daemon to Foxglove: fields, rates, heading, estimate, log, on a WebSocket.

    It only shows. It is a process of its own: whatever happens to it, the daemon does not notice.
    Exit 75 where the port is taken.
    """
    if not importlib.util.find_spec("foxglove"):
        raise AhrsdError("foxglove-sdk is missing: pip install 'ahrsd[foxglove]'")
    from ahrsd.viewer.foxglove import FoxgloveServer

    found = ip_address(address)
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    with closing(FoxgloveServer(address, port)) as server:
        where = in_url(found, server.port)
        click.echo(f"ws://{where} (in Foxglove: Open connection, Foxglove WebSocket)")
        if not found.is_loopback:
            click.echo(f"anybody who reaches {where} can read it", err=True)
        _follow(place, server, stopped)


def _follow(place: DaemonPlace, server: FoxgloveServer, stopped: threading.Event) -> None:
    """Show what the daemon says until a signal comes; where it is gone, wait for it."""
    away = ""
    while not stopped.is_set():
        try:
            with place.connect() as daemon:
                away = ""
                server.back()
                click.echo(f"{daemon.path}: the daemon answers", err=True)
                _show(daemon, server, stopped)
        except (DeviceError, OSError, ValueError) as error:
            if str(error) != away:
                away = str(error)
                click.echo(f"{away}; waiting for it", err=True)
            server.away(away)
            stopped.wait(_AGAIN_S)


def _show(daemon: DaemonConnection, server: FoxgloveServer, stopped: threading.Event) -> None:
    from ahrsd.viewer.foxglove import Topics

    topics = Topics(time.time() - time.monotonic())
    for record in daemon.watch(("status", "events", "samples")):
        if stopped.is_set():
            return
        if "error" in record:
            raise ValueError(str(record["error"]))
        for message in topics.of(record, time.monotonic()):
            server.show(message)
