"""`ahrsd watch`: the running daemon, live on a terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from ahrsd.cli.running_daemon import DaemonPlace, place_options
from ahrsd.counting import counted
from ahrsd.gates import guards_a_write
from ahrsd.printable import line
from ahrsd.telemetry.explain import explain_json, holding
from ahrsd.telemetry.lines import status_lines

_EVENTS = 6  # lines of what happened
_BESIDE = 28  # lines of everything but the gates


@click.command()
@place_options
@click.option("--raw", is_flag=True, help="The records as JSON lines, as they come.")
@click.option("--samples", is_flag=True, help="With --raw: the samples too.")
def command(place: DaemonPlace, raw: bool, samples: bool) -> None:
    """Rates, errors, what motion is missing, estimates, gates: until Ctrl-C.

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
    console, happened = Console(), deque[str](maxlen=_EVENTS)
    status: Mapping[str, Any] | None = None
    said: list[str] = []
    if not console.is_terminal:
        for record in records:
            if record.get("record") == "status" and (lines := status_lines(record)) != said:
                said = lines
                click.echo(pasted("\n".join(lines)) + "\n")
        return
    with Live(console=console, refresh_per_second=4, screen=True) as live:
        for record in records:
            if record.get("record") == "status":
                status = record
            elif happening := event_line(record):
                happened.append(happening)
            if status is not None:
                live.update(screen(status, happened, console.height - _BESIDE, pasted))


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


def screen(
    status: Mapping[str, Any],
    happened: deque[str],
    most: int = 99,
    pasted: Callable[[str], str] = str,
) -> RenderableType:
    """Status on top, what happened last, and `most` of the gates, nearest to the cause first."""
    explained = explain_json(status)
    head = Panel(Text("\n".join(map(line, status_lines(status)))), title="ahrsd")
    todo = Panel(Text(pasted(str(explained["next"])), style="bold"), title="what to do next")
    log = Panel(Text("\n".join(happened) or "nothing yet"), title="what happened")
    return Group(head, todo, log, _gates(status, max(most, 3)))


def _gates(status: Mapping[str, Any], most: int) -> RenderableType:
    table = Table("gate", "value", "limit", "for", expand=True, title="gates that hold a write")
    holds = holding(status)[0]
    for gate in holds[:most]:
        table.add_row(gate["gate"], _value(gate, "value"), _value(gate, "limit"), _for(gate))
    counted = [gate for gate in status["gates"] if guards_a_write(gate["gate"])]
    green = sum(gate["ok"] for gate in counted)
    more = f"and {len(holds) - most} more; " if len(holds) > most else ""
    table.caption = f"{more}{green} of {len(counted)} gates are green"
    return table


def _value(gate: Mapping[str, Any], key: str) -> str:
    value = gate[key]
    return "not measured" if value is None else f"{value:.3g} {gate['unit']}".strip()


def _for(gate: Mapping[str, Any]) -> str:
    return "" if gate["for_s"] is None else f"{gate['for_s']:.0f} s"
