"""`ahrsd watch`: the running daemon, live on a terminal."""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import click
from rich.console import Console
from rich.live import Live

from ahrsd.cli.keys import keys
from ahrsd.cli.running_daemon import DaemonPlace, place_options
from ahrsd.cli.watch_screen import Scroll, screen
from ahrsd.counting import counted
from ahrsd.printable import line
from ahrsd.telemetry.driving import Pace
from ahrsd.telemetry.lines import status_lines

_EVENTS = 6  # lines of what happened


@click.command()
@place_options
@click.option("--raw", is_flag=True, help="The records as JSON lines, as they come.")
@click.option("--samples", is_flag=True, help="With --raw: the samples too.")
def command(place: DaemonPlace, raw: bool, samples: bool) -> None:
    """What to drive next and how long it takes, heading, readings, gates, rates: until q or Ctrl-C.

    Where stdout is not a terminal, one status is printed every time it changes by a line.
    """
    streams = ("status", "events", "samples") if samples else ("status", "events")
    with place.connect() as daemon:
        records = daemon.watch(streams)
        try:
            if raw:
                _raw(records)
            else:
                _show(records, place.pasted)
        except KeyboardInterrupt:
            return


def _raw(records: Iterator[Mapping[str, Any]]) -> None:
    import json

    for record in records:
        click.echo(json.dumps(record, separators=(",", ":")))


def _show(records: Iterator[Mapping[str, Any]], pasted: Callable[[str], str]) -> None:
    console = Console()
    said: list[str] = []
    if not console.is_terminal:
        for record in records:
            if record.get("record") == "status" and (lines := status_lines(record)) != said:
                said = lines
                click.echo(pasted("\n".join(lines)) + "\n")
        return
    _live(console, records, pasted)


def _live(
    console: Console, records: Iterator[Mapping[str, Any]], pasted: Callable[[str], str]
) -> None:
    """Draw until the daemon or the person ends it."""
    happened, pace, scroll = deque[str](maxlen=_EVENTS), Pace(), Scroll()
    status: Mapping[str, Any] | None = None
    lock = threading.Lock()
    with Live(console=console, refresh_per_second=4, screen=True) as live:

        def draw() -> None:
            if status is not None:
                whole = screen(status, happened, pace, pasted)
                live.update(scroll.seen(console, whole, console.height))

        def pressed(key: str) -> None:
            with lock:
                scroll.key(key)
                draw()
            if scroll.ended:  # like Ctrl-C, also while no record comes
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

        with keys(pressed):
            for record in records:
                with lock:
                    if record.get("record") == "status":
                        status = record
                        pace.take(status)
                    elif happening := event_line(record):
                        happened.append(happening)
                    draw()


def event_line(record: Mapping[str, Any]) -> str:
    """One line for what happened; empty for what the status shows anyway."""
    match record.get("record"):
        case "note":
            return line(f"{record['level']}: {record['text']}")
        case "state":
            return line(f"{record['old']} -> {record['new']}: {record['reason']}")
        case "register":
            return f"register {record['register']} {record['outcome']}"
        case "gap":
            return f"(this terminal was too slow: {counted(record['lost'], 'record')} lost)"
    return ""
