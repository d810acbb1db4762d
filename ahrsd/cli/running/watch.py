"""`ahrsd watch`: the running daemon, live on a terminal.

What to do and how it goes come first, for a terminal of 24 lines; keys scroll, without echo, in a
thread beside what is drawn.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import signal
import sys
import termios
import threading
import tty
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from ahrsd.cli.running.daemon import DaemonPlace, place_options
from ahrsd.errors import DeviceError
from ahrsd.gates import guards_a_write
from ahrsd.printable import counted, line
from ahrsd.telemetry.driving import LEVEL, TILTED, Pace, about, drive_next, shown_of
from ahrsd.telemetry.words import explain_json, heading_line, holding, reading_lines, status_lines

# -- Keys of a terminal ----------------------------------------------------------------------------


_NAMES = {
    "\x1b[A": "up",
    "\x1b[B": "down",
    "\x1b[5~": "page up",
    "\x1b[6~": "page down",
    "\x1b[H": "home",
}
_KEY = re.compile(r"\x1b\[[0-9;]*[A-Za-z~]|.", re.DOTALL)
_BEGUN = re.compile(r"\x1b(\[[0-9;]*)?\Z")
_PIECE = 16
_LOOK_S = 0.2


@contextlib.contextmanager
def keys(pressed: Callable[[str], None]) -> Iterator[None]:
    """Call `pressed` with each key until the block ends; the terminal is as before then.

    Nothing is read where stdin is no terminal. Ctrl-C stays what it is.
    """
    if not sys.stdin.isatty():
        yield
        return
    terminal, ended = sys.stdin.fileno(), threading.Event()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    thread = threading.Thread(target=_read, args=(terminal, pressed, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(2 * _LOOK_S)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _read(terminal: int, pressed: Callable[[str], None], ended: threading.Event) -> None:
    begun = ""  # of a key whose end has not come yet
    while not ended.is_set():
        if not select.select([terminal], [], [], _LOOK_S)[0]:
            continue
        text = os.read(terminal, _PIECE).decode(errors="replace")
        if not text:
            return
        text = begun + text
        begun = match[0] if (match := _BEGUN.search(text)) else ""
        for key in _KEY.findall(text.removesuffix(begun)):
            pressed(_NAMES.get(key, key))


# -- The screen ------------------------------------------------------------------------------------


Status = Mapping[str, Any]


def screen(
    status: Status,
    happened: Iterable[str],
    pace: Pace,
    pasted: Callable[[str], str] = str,
) -> RenderableType:
    """Everything, what matters most on top."""
    todo = Text(pasted(str(explain_json(status)["next"])), style="bold")
    now = Text(
        "\n".join([heading_line(status), *reading_lines(status), *shown_lines(status, pace)])
    )
    log = Text("\n".join(happened) or "nothing yet")
    return Group(
        Panel(todo, title="what to do next", subtitle=countdown(status, pace) or None),
        now,
        gates_table(status, pace),
        Panel(log, title="what happened"),
        Panel(Text("\n".join(map(line, status_lines(status)))), title="ahrsd"),
    )


def countdown(status: Status, pace: Pace) -> str:
    """When the last of the gates that hold a write opens; empty where nobody can say."""
    found = pace.slowest(gate["gate"] for gate in holding(status)[0])
    return "" if found is None else f"{about(found[1])} ({found[0]} is last)"


def shown_lines(status: Status, pace: Pace) -> list[str]:
    """What was shown of the circle and of the tilts, what to drive, and how long it takes."""
    shown, lines = shown_of(status), []
    for name, share in (
        () if shown is None else ((LEVEL, shown.level_share), (TILTED, shown.tilted_share))
    ):
        left = f", {about(pace.left_s(name))}" if share < 1.0 else ""
        lines.append(f"{name}: {100 * share:.0f} % shown{left}")
    words = drive_next(status)
    return [*lines, f"drive: {words}"] if words else lines


def gates_table(status: Status, pace: Pace) -> RenderableType:
    """How many gates are green, and those that hold a write."""
    table = Table("gate", "value", "limit", "for", "opens in", expand=True, box=None)
    unmeasured: dict[str, list[str]] = {}
    for gate in holding(status)[0]:
        if gate["value"] is None:
            unmeasured.setdefault(gate["advice"], []).append(gate["gate"])
            continue
        left_s = pace.left_s(gate["gate"])
        left = "" if left_s is None else about(left_s).removesuffix(" at the present rate")
        table.add_row(gate["gate"], _value(gate, "value"), _value(gate, "limit"), _for(gate), left)
    for names in unmeasured.values():
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        table.add_row(f"{names[0]}{more}", "not measured")
    counted_gates = [gate for gate in status["gates"] if guards_a_write(gate["gate"])]
    green = sum(gate["ok"] for gate in counted_gates)
    total = f"{green} of {counted(len(counted_gates), 'gate')} are green"
    return Group(Text(total, style="bold"), *([table] if table.row_count else []))


def _value(gate: Mapping[str, Any], key: str) -> str:
    value = gate[key]
    return "not measured" if value is None else f"{value:.3g} {gate['unit']}".strip()


def _for(gate: Mapping[str, Any]) -> str:
    return "" if gate["for_s"] is None else f"{gate['for_s']:.0f} s"


class Scroll:
    """Which lines of the screen are seen. Keys: arrows, j and k, page up and down, home, q."""

    def __init__(self) -> None:
        self.top = 0
        self.ended = False
        self._page = 1

    def key(self, key: str) -> None:
        """A key was pressed, by its name or its character."""
        if key == "q":
            self.ended = True
        step = {"down": 1, "j": 1, "up": -1, "k": -1, "page down": self._page, " ": self._page}
        step["page up"] = -self._page
        self.top = 0 if key == "home" else max(self.top + step.get(key, 0), 0)

    def seen(self, console: Console, whole: RenderableType, height: int) -> RenderableType:
        """The lines that fit into `height`; the last line says where one is, if not all do."""
        lines = console.render_lines(whole, pad=False)
        if len(lines) <= height:
            self.top = 0
            return whole
        rows = max(height - 1, 1)
        self._page = rows
        self.top = min(self.top, len(lines) - rows)
        text = f"lines {self.top + 1}-{self.top + rows} of {len(lines)}: arrows scroll, q ends"
        shown: list[Segment] = []
        for one in lines[self.top : self.top + rows]:
            shown += [*one, Segment.line()]
        return Segments([*shown, Segment(text)])


# -- The command -----------------------------------------------------------------------------------


_EVENTS = 6  # lines of what happened
T = TypeVar("T")


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
    """Draw until the daemon or the person ends it.

    Records and keys come through one queue, in their order. What has come since the last picture is
    taken at once and drawn once: a terminal that is slower than the daemon lags by no key.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever started it may ignore it
    happened, pace, scroll = deque[str](maxlen=_EVENTS), Pace(), Scroll()
    status: Mapping[str, Any] | None = None
    come: queue.SimpleQueue[str | Mapping[str, Any] | _End] = queue.SimpleQueue()
    threading.Thread(target=_hand_on, args=(records, come.put), daemon=True).start()
    with Live(console=console, refresh_per_second=4, screen=True) as live, keys(come.put):
        while True:
            for one in _all_of(come):
                if isinstance(one, _End):
                    if one.why is not None:
                        raise one.why
                    return
                if isinstance(one, str):
                    scroll.key(one)
                elif one.get("record") == "status":
                    status = one
                    pace.take(status)
                elif happening := event_line(one):
                    happened.append(happening)
            if scroll.ended:
                return
            if status is not None:
                whole = screen(status, happened, pace, pasted)
                live.update(scroll.seen(console, whole, console.height))


class _End(NamedTuple):
    """No more records come; why: an error that is told to the person, None where there is none."""

    why: Exception | None


def _hand_on(
    records: Iterator[Mapping[str, Any]], put: Callable[[Mapping[str, Any] | _End], None]
) -> None:
    """Put all records, and an end behind them however they end: whoever waits is not left so."""
    why: Exception | None = None
    try:
        for record in records:
            put(record)
    except (DeviceError, ValueError) as error:  # raised again where it is drawn
        why = error
    finally:
        put(_End(why))


def _all_of(come: queue.SimpleQueue[T]) -> Iterator[T]:
    """Wait for one, then all that is there already."""
    yield come.get()
    for _ in range(come.qsize()):
        yield come.get()


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
