"""Replay: a recording through the same shell and core as a live run.

For a capture of the daemon, the core gets the recorded inputs, including ticks and journal answers,
so it takes the decisions of that run. Any other recording has no device to communicate with and is
processed as a passive run. Registers that `ahrsd capture` read first are applied from the first
byte on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from ahrsd.config.config import CONFIG_KEY, Config, core_settings, recorded_config, terms_text
from ahrsd.core.core import Core
from ahrsd.core.settings import BESIDE_KEY, CoreSettings
from ahrsd.daemon.core_runner import Listener, Shell, Viewer
from ahrsd.errors import RecordingError
from ahrsd.inputs import Input, Received, RegistersKnown, Samples, TermsKnown
from ahrsd.recording.column_names import NO_MAP, ColumnMap
from ahrsd.recording.limits import GARBAGE_BYTES, on_one_thread, refuse_beyond
from ahrsd.recording.opening import Recording, RecordingKind, open_recording
from ahrsd.stream.assembler import NoSamplesError
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from drivers.vn100.deframer import Cause
from drivers.vn100.errors import NO_CHECKSUM

_CUT = "cut it in parts"
_PASSIVE = WriteBackPolicy(mode=Mode.PASSIVE)


@dataclass(slots=True)
class Replayed:
    """Result of a replay."""

    core: Core
    recording: Recording
    warnings: list[str] = field(default_factory=list)

    @property
    def of_daemon(self) -> bool:
        """Whether it is a capture of the daemon, which has its own configuration."""
        return CONFIG_KEY in self.recording.header


@on_one_thread
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
    columns: ColumnMap = NO_MAP,
    most_samples: float = math.inf,
    opened: Recording | None = None,
) -> Replayed:
    """Feed a recording to a core; speed 0 is as fast as possible, 1 real time.

    settings: of the core; None: those of `config`, but a capture of the daemon has its own
    configuration and `held_out`. columns: names and units of a table. most_samples: limit for
    callers that keep all samples. opened: the recording at `path`, if it is open already. Raises
    RecordingError if nothing in the recording can be calibrated.
    """
    if rate_hz is not None and not math.isfinite(rate_hz):
        raise RecordingError(path, f"a rate of {rate_hz} Hz is impossible", "give --rate in Hz")
    recording = opened or open_recording(path, rate_hz, columns=columns)
    core = Core(settings or _settings(recording, config, rate_hz, held_out))
    shell = Shell(core, viewer=viewer, listeners=listeners or [])
    done = Replayed(core, recording, list(recording.notes))
    items = recording.inputs() if done.of_daemon else _registers_first(recording)
    share = recording.bytes_of_file()
    if (text := terms_text(config)) and not done.of_daemon:
        shell.feed(TermsKnown(0, text))
    for item in _paced(items, core, speed):
        shell.feed(item)
        if progress is not None:
            progress(share(item))
        refuse_beyond(path, core.stream.facts.samples, most_samples, "samples", _CUT)
        counters = core.device_session.session.deframer.counters
        if counters.valid == 0 and counters.fed_bytes > GARBAGE_BYTES:
            break
    _refuse_empty(core, path)
    done.warnings += [note for note in recording.notes if note not in done.warnings]
    if recording.kind is RecordingKind.BYTES and _ends_mid_message(core):
        done.warnings.append("the recording ends in the middle of a message")
    return done


def _settings(
    recording: Recording, config: Config, rate_hz: float | None, held_out: bool
) -> CoreSettings:
    """Settings from a capture of the daemon; other recordings are passive."""
    if text := recording.header.get(CONFIG_KEY):
        own = recorded_config(text)
        if config not in (Config(), own):
            recording.notes.append("the configuration in the capture was used, not the given one")
        return replace(core_settings(own), beside=BESIDE_KEY in recording.header)
    if recording.kind is not RecordingKind.BYTES:
        return core_settings(config, policy=_PASSIVE, held_out=held_out)
    known = None if rate_hz is not None else recording.told_rate()
    rate = rate_hz if known is None else known[0]
    settings = core_settings(config, stream_rate_hz=rate, policy=_PASSIVE, held_out=held_out)
    return settings if known is None else replace(settings, stream_rate_source=known[1])


def _registers_first(recording: Recording) -> Iterator[Input]:
    """The inputs, with registers that were read at the beginning moved to the front."""
    if recording.kind is not RecordingKind.CAPTURE:
        yield from recording.inputs()
        return
    found = next((i for i in recording.inputs() if isinstance(i, RegistersKnown)), None)
    if found is not None:
        yield replace(found, host_ns=0)
    for item in recording.inputs():
        if item != found:
            yield item


def _paced(items: Iterator[Input], core: Core, speed: float) -> Iterator[Input]:
    """Delay inputs so that device time passes `speed` times as fast as real time."""
    start = time.monotonic()
    for item in items:
        if speed > 0 and isinstance(item, Received | Samples):
            ahead_s = (core.at_s - core.first_s) / speed - (time.monotonic() - start)
            if ahead_s > 0:
                time.sleep(ahead_s)
        yield item


def _ends_mid_message(core: Core) -> bool:
    """Whether the bytes end inside a message; a byte stream has no silence to end one."""
    deframer = core.device_session.session.deframer
    return deframer.pending > 0 or Cause.CUT in deframer.counters.damage


def _refuse_empty(core: Core, path: Path) -> None:
    counters = core.device_session.session.deframer.counters
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
            NO_CHECKSUM
            if counters.unchecked
            else "wrong baud rate while recording, or not a VN-100 stream",
        )
    raise RecordingError(
        path,
        "no complete sample",
        "record longer, with a message that carries the magnetometer and the gyroscope",
    )
