"""Replay: a recording through the same shell and core as a live run.

A capture is fed its own inputs, ticks and answers included, so the decisions are those of the run.
Byte streams and tables have nobody to talk to: they are taken as a passive run over what they hold.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from ahrsd.config import CONFIG_KEY, Config, recorded_config
from ahrsd.core import Core
from ahrsd.core_settings import CoreSettings
from ahrsd.errors import RecordingError
from ahrsd.inputs import Input, Received, Samples
from ahrsd.recording.bytestream import read_chunks
from ahrsd.recording.opening import Kind, Recording, open_recording
from ahrsd.settings import core_settings
from ahrsd.shell import Listener, Shell, Viewer
from ahrsd.stream import NoSamplesError
from ahrsd.stream_rate import rate_of
from ahrsd.writeback.permissions import Mode
from ahrsd.writeback.policy import WriteBackPolicy

_PASSIVE = WriteBackPolicy(mode=Mode.PASSIVE)


@dataclass(slots=True)
class Replayed:
    """What a replay leaves behind."""

    core: Core
    recording: Recording
    warnings: list[str] = field(default_factory=list)


def replay(
    path: Path,
    config: Config,
    *,
    rate_hz: float | None = None,
    speed: float = 0.0,
    viewer: Viewer | None = None,
    listeners: list[Listener] | None = None,
    progress: Callable[[int], None] | None = None,
    held_out: bool = True,
    settings: CoreSettings | None = None,
) -> Replayed:
    """Feed a recording to a core; speed 0 is as fast as it goes, 1 real time.

    settings: of the core, else those of `config`. Raises RecordingError where nothing in the
    recording can be calibrated.
    """
    recording = open_recording(path, rate_hz)
    warnings = list(recording.notes)
    core = Core(settings or _settings(recording, config, rate_hz, held_out))
    shell = Shell(core, viewer=viewer, listeners=listeners or [])
    for item in _paced(recording.inputs(), core, speed):
        shell.feed(item)
        if progress is not None and isinstance(item, Received):
            progress(len(item.data))
    _refuse_empty(core, path)
    warnings += [note for note in recording.notes if note not in warnings]
    return Replayed(core, recording, warnings)


def _settings(
    recording: Recording, config: Config, rate_hz: float | None, held_out: bool
) -> CoreSettings:
    """A capture of the daemon says itself how it was made; the others are passive."""
    if text := recording.header.get(CONFIG_KEY):
        return core_settings(recorded_config(text), stream_rate_hz=rate_hz)
    found = None
    if rate_hz is None and recording.kind is Kind.BYTES:
        found = rate_of(read_chunks(recording.path))
    rate = rate_hz if found is None else found[0]
    settings = core_settings(config, stream_rate_hz=rate, policy=_PASSIVE, held_out=held_out)
    return settings if found is None else replace(settings, stream_rate_source=found[1])


def _paced(items: Iterator[Input], core: Core, speed: float) -> Iterator[Input]:
    """Hold inputs back so that device time passes `speed` times as fast as real time."""
    start = time.monotonic()
    for item in items:
        if speed > 0 and isinstance(item, Received | Samples):
            ahead_s = (core.at_s - core.first_s) / speed - (time.monotonic() - start)
            if ahead_s > 0:
                time.sleep(ahead_s)
        yield item


def _refuse_empty(core: Core, path: Path) -> None:
    counters = core.conversation.session.deframer.counters
    try:
        core.stream.check()
    except NoSamplesError as error:
        raise RecordingError(path, "nothing to calibrate from", str(error)) from error
    if core.stream.facts.samples:
        return
    if counters.fed_bytes == 0:
        raise RecordingError(path, "is empty", "record again with the device on")
    if counters.valid == 0:
        raise RecordingError(
            path,
            f"no VN-100 message in {counters.fed_bytes} bytes",
            "wrong baud rate while recording, or not a VN-100 stream",
        )
    raise RecordingError(
        path,
        "no complete sample",
        "record longer, with a message that carries the magnetometer and the gyroscope",
    )
