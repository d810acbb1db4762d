"""`ahrsd capture PORT -o FILE`: record what a device sends, and what it was set to."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import click

from ahrsd.cli import Number
from ahrsd.cli.device.access import PORT, describe, driver_errors, open_port, read_all
from ahrsd.cli.files import refuse_unwritable, write_json
from ahrsd.daemon import host_clock
from ahrsd.errors import EXIT_BUSY, EXIT_DONE, EXIT_NO, DeviceError
from ahrsd.inputs import Input, LinkLost, LinkOpened, Received, RegistersKnown, Stop, WallClock
from ahrsd.printable import counted
from ahrsd.recording.capture import CaptureStatus, CaptureWriter, Sent
from drivers import serial_port
from drivers.serial_port import SerialPort, latency_timer_ms
from drivers.vn100.deframer import Deframer, Sentence
from drivers.vn100.device import Device

_WAIT_S = 0.2  # how soon a signal or the end of --seconds is noticed
_PROGRESS_S, _LINE_S = 0.5, 5.0  # on a terminal, and where each is a line of its own
_MOST_KINDS = 64


@dataclass(slots=True)
class _Session:
    """What happened between the port's opening and its end."""

    start_s: float
    received: int = 0
    deframer: Deframer = field(default_factory=Deframer)
    kinds: Counter[str] = field(default_factory=Counter)
    reason: str = ""
    unplugged: bool = False

    @property
    def messages(self) -> int:
        """Whole messages so far."""
        return self.deframer.counters.valid

    def hear(self, data: bytes) -> None:
        """Bytes that arrived: counted, and the messages in them."""
        self.received += len(data)
        for frame in self.deframer.feed(data):
            kind = frame.body[:5] if isinstance(frame, Sentence) else frame.layout.name
            if kind in self.kinds or len(self.kinds) < _MOST_KINDS:
                self.kinds[kind] += 1

    def progress_text(self, now_s: float) -> str:
        """What was heard until now, for a person."""
        took_s = now_s - self.start_s
        if not self.messages:
            heard = "no message of a VN-100" if self.received else "silence"
        else:
            most = ", ".join(kind for kind, _ in self.kinds.most_common(2))
            heard = f"{counted(self.messages, 'message', ',')} ({most})"
        return f"{took_s:7.1f} s {self.received:12,} bytes, {heard}"


@click.command()
@click.argument("port", type=PORT)
@click.option("-o", "--output", "path", required=True, type=click.Path(path_type=Path),
              help="File to write, *.mcap; it must not exist.")  # fmt: skip
@click.option("--passive", is_flag=True, help="Send no byte; the registers stay unknown.")
@click.option("--seconds", type=Number(0.0, min_open=True), help="Stop after this long.")
@click.option("--baud", type=int, help="The port's rate; without it, each rate is tried.")
@click.option("--json", "json_path", help="Summary as JSON into this file, - for stdout.")
def command(
    *,
    path: Path,
    port: Path,
    passive: bool,
    seconds: float | None,
    baud: int | None,
    json_path: str | None,
) -> None:
    """Record what the device on PORT sends, until Ctrl-C.

    Nothing on the device is changed. Without --passive its identity and registers are read first
    and go into the file, so that a replay knows which calibration was already applied to the data.
    """
    if path.suffix != ".mcap":
        raise click.BadParameter(f"{path}: a capture's name ends in .mcap", param_hint="-o")
    if path.exists():
        raise click.BadParameter(f"{path} exists already; name another file", param_hint="-o")
    if not path.parent.is_dir():
        raise click.BadParameter(f"{path.parent} is no folder", param_hint="-o")
    refuse_unwritable(json_path)
    with driver_errors(), open_port(port, baud, may_query=not passive) as serial:
        before = _opened(port, serial)
        header = {} if passive else _read_device(serial, before)
        with CaptureWriter(path, header) as writer:
            for item in before:
                _write(writer, item)
            session = _record(serial, writer, seconds)
            status = writer.close()
    _report(path, session, status, json_path)


def _opened(port: Path, serial: SerialPort) -> list[Input | Sent]:
    host_ns = time.monotonic_ns()
    return [
        WallClock(host_ns, time.time(), host_clock.boot_id(), host_clock.boot_s()),
        LinkOpened(host_ns, str(port), serial.baud, latency_timer_ms(port)),
    ]


def _read_device(serial: SerialPort, items: list[Input | Sent]) -> dict[str, str]:
    """Read identity and registers; the bytes of both directions go behind `items`."""

    def tap(direction: str, host_ns: int, data: bytes) -> None:
        items.append(Received(host_ns, data) if direction == "rx" else Sent(host_ns, data))

    identity, registers = read_all(Device(serial, tap=tap))
    items.append(RegistersKnown(time.monotonic_ns(), registers, "read before the capture"))
    return describe(identity)


def _write(writer: CaptureWriter, item: Input | Sent) -> None:
    if isinstance(item, Sent):
        writer.write_sent(item.host_ns, item.data)
        return
    writer.write(item)
    if isinstance(item, RegistersKnown):
        writer.write_registers(item.host_ns, {str(k): v for k, v in item.values.items()})


def _record(serial: SerialPort, writer: CaptureWriter, seconds: float | None) -> _Session:
    """Move bytes into the file until a signal, the time or the end of the link."""
    session = _Session(time.monotonic())
    end_s = None if seconds is None else session.start_s + seconds
    progress_s = session.start_s
    with _signals(session):
        while not session.reason:
            try:
                data = serial.read() if serial.wait_readable(_WAIT_S) else b""
            except serial_port.PortLost as error:
                session.reason, session.unplugged = str(error), True
                break
            if data:
                session.hear(data)
                writer.write(Received(time.monotonic_ns(), data))
            now_s = time.monotonic()
            if end_s is not None and now_s >= end_s:
                session.reason = f"--seconds {seconds:g}"
            if now_s >= progress_s:
                progress_s = now_s + (_PROGRESS_S if sys.stderr.isatty() else _LINE_S)
                _progress(session, writer.status, now_s)
    host_ns = time.monotonic_ns()
    if session.unplugged:
        writer.write(LinkLost(host_ns, session.reason))
    writer.write(Stop(host_ns, session.reason))
    return session


@contextmanager
def _signals(session: _Session) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the recording in order."""

    def stop(number: int, _: object) -> None:
        session.reason = signal.Signals(number).name

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _progress(session: _Session, status: CaptureStatus, now_s: float) -> None:
    trouble = f"  {status.error}" if status.error else ""
    if sys.stderr.isatty():
        click.echo(f"\r{session.progress_text(now_s)}{trouble}\033[K", err=True, nl=False)
    elif now_s > session.start_s:
        click.echo(f"{session.progress_text(now_s)}{trouble}", err=True)


def _report(path: Path, session: _Session, status: CaptureStatus, json_path: str | None) -> None:
    """Say what is in the file; the exit code says whether it is all."""
    took_s = time.monotonic() - session.start_s
    if sys.stderr.isatty():
        click.echo("", err=True)
    summary = {
        "schema": "ahrsd.capture_summary/1",
        "recording": str(path),
        "duration_s": round(took_s, 3),
        "bytes": session.received,
        "messages": session.messages,
        "lost_bytes": status.lost_bytes,
        "stopped_by": session.reason,
    }
    if json_path == "-":
        click.echo(json.dumps(summary))
    else:
        click.echo(
            f"{path}: {session.received} bytes, "
            f"{counted(session.messages, 'message')} in {took_s:.1f} s, "
            f"ended by {session.reason}"
        )
        if json_path:
            write_json(json_path, summary)
    if status.lost_bytes:
        click.echo(f"ahrsd: {status.lost_bytes} bytes were lost: {status.error}", err=True)
        raise SystemExit(EXIT_NO)
    if session.unplugged:
        raise DeviceError(f"{session.reason}; what came before is in {path}", EXIT_BUSY)
    if not session.received:
        raise DeviceError("nothing was received; is the device on, is --baud right?", EXIT_BUSY)
    if not session.messages:
        raise DeviceError(
            f"no message of a VN-100 in {session.received} bytes; is --baud right?", EXIT_BUSY
        )
    raise SystemExit(EXIT_DONE)
