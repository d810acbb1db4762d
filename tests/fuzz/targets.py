"""What is fuzzed: each target takes any bytes and may end in its own typed errors, in nothing else.

What survives parsing is pushed on: messages and captures into the whole core, a configuration into
the settings that are made of it, journal records into the history that decides what is written.
"""

from __future__ import annotations

import math
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

from ahrsd.config.config import Config, check_config, core_settings, print_config
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import Shell
from ahrsd.daemon.journal import Journal, wrg_lines
from ahrsd.daemon.vehicle_files import columns_of
from ahrsd.errors import CaptureError, ConfigError, JournalError, RecordingError
from ahrsd.inputs import Received, Stop
from ahrsd.recording.capture import CaptureReader, Sent
from ahrsd.report.summary import summary_json
from ahrsd.telemetry.protocol import BadRequest, parse_request
from ahrsd.writeback.journal_history import JournalHistory
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer

Target = Callable[[bytes], None]
_SCRATCH = tempfile.TemporaryDirectory(prefix="ahrsd-fuzz-")  # gone with the process
_FOLDER = Path(_SCRATCH.name)


def deframer(data: bytes) -> None:
    """Every byte ends up in exactly one message or is skipped, however the stream is cut."""
    whole, pieces = Deframer(), Deframer()
    frames = whole.feed(data)
    size = 1 + (len(data) and data[0] % 7)
    cut = [frame for k in range(0, len(data), size) for frame in pieces.feed(data[k : k + size])]
    assert [(f.offset, type(f)) for f in frames] == [(f.offset, type(f)) for f in cut]
    assert whole.counters == pieces.counters
    skipped = sum(len(piece.data) for piece in whole.take_skipped())
    assert skipped <= len(data)


def messages(data: bytes) -> None:
    """What the deframer lets through is decoded, or refused in words; numbers are numbers."""
    for frame in Deframer().feed(data):
        found = decode(frame)
        if isinstance(found, Measurement):
            assert len(found.values) == len(found.layout.columns)
            assert all(isinstance(value, float) for value in found.values)


def pipeline(data: bytes) -> None:
    """Bytes through the whole core, as a passive run; the summary is plain JSON in the end."""
    core = Core(core_settings(Config(mode="passive"), stream_rate_hz=40.0))
    shell = Shell(core)
    for number, start in enumerate(range(0, len(data), 97)):
        piece = data[start : start + 97]
        assert shell.feed(Received(number * 10_000_000, piece)) == b""  # passive: not one byte
    shell.feed(Stop(len(data) * 10_000_000, "end"))
    body = summary_json(core, "fuzz")
    assert body["bytes"] == len(data)
    assert math.isfinite(float(str(body["duration_s"])))


def config(data: bytes) -> None:
    """A configuration is accepted or refused key by key; what is accepted can be printed."""
    try:
        body = tomllib.loads(data.decode("utf-8", "replace"))
        accepted = check_config(body, "fuzz")
    except (tomllib.TOMLDecodeError, RecursionError):
        return
    except ConfigError as error:
        assert error.lines
        return
    again = check_config(tomllib.loads(print_config(accepted)), "printed")
    assert again == accepted
    accepted.write_back_policy()


def capture(data: bytes) -> None:
    """A damaged capture gives what is whole; that goes through the core."""
    path = _FOLDER / "capture.mcap"
    path.write_bytes(data)
    core = Core(core_settings(Config(mode="passive"), stream_rate_hz=40.0))
    shell = Shell(core)
    try:
        for item in CaptureReader(path):
            if not isinstance(item, Sent):
                shell.feed(item)
    except (CaptureError, RecordingError):
        return


def journal(data: bytes) -> None:
    """A journal is trusted whole or not at all; what is trusted decides without an exception."""
    path = _FOLDER / "journal-1.jsonl"
    path.write_bytes(data)
    try:
        opened = Journal.open(path)
    except JournalError:
        return
    records = opened.records()
    JournalHistory.of(records)
    for record in records:
        try:
            wrg_lines(record)
        except JournalError:
            continue


def socket_line(data: bytes) -> None:
    """A line is a request or refused in words."""
    for line in data.split(b"\n"):
        try:
            assert parse_request(line).ask
        except BadRequest as error:
            assert str(error)


def columns(data: bytes) -> None:
    """What the vehicle writes is numbers or refused in words."""
    try:
        found = columns_of(data)
    except ValueError as error:
        assert str(error)
        return
    assert all(math.isfinite(value) for value in found.values())


TARGETS: dict[str, Target] = {
    "deframer": deframer,
    "messages": messages,
    "pipeline": pipeline,
    "config": config,
    "capture": capture,
    "journal": journal,
    "socket_line": socket_line,
    "columns": columns,
}
