"""What the newest captures of a folder hold for a warm start: samples whose device is known.

A sample counts only between two readings of the device (model, serial number, firmware, and the
registers that un-mapping depends on) that agree: what came after the last one may be of a unit that
nobody asked. A write, a restart of the device, a link that was lost or an estimator that failed
ends what was collected. Nothing is decided here about the device of the new run (`warm_start`).

Only the newest minutes of a file are read: blocks in front of them are skipped unread, all but the
first ones, which have the host's clocks.
"""

from __future__ import annotations

import re
import stat
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ahrsd.core.warm_start import MOST_ROWS, too_old
from ahrsd.errors import RecordingError
from ahrsd.estimator.epoch_data import StepAverager, samples_per_step
from ahrsd.inputs import (
    EarlierRun,
    EarlierSamples,
    Examined,
    LinkLost,
    LinkOpened,
    Received,
    WallClock,
)
from ahrsd.recording import capture
from ahrsd.recording.blocks import SEQUENCES, Damage, Entry, read_entries, read_head
from ahrsd.samples import Array, SampleBlock
from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs
from ahrsd.writeback.journal_history import Stamp
from drivers.vn100.decode import Measurement, Undecodable, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import Reply
from drivers.vn100.registers import COMPENSATING, Unit, Values, parse, same

RUNS = 4  # captures that are looked at
FIRST_S = 2.0  # of a capture that is read for its clocks, however long ago it began
AT_ONCE_S = 180.0  # a run that began warm and ended sooner after that may have died of it
PIECE_ROWS = 300  # of an input: the work of a second or less
_NAME = "ahrsd-*.mcap"
_PART = re.compile(r"\.part\d+$")
_IDENTITY = (1, 3, 4)
_CONFIRMS = frozenset({*_IDENTITY, 23, 84})
_INPUTS = tuple(
    f'{{"type":"{kind.__name__}"'.encode()
    for kind in (WallClock, LinkOpened, LinkLost, Examined, EarlierRun)
)
_RESETS = ("VNRST", "VNRFS")
_COLUMNS = ("time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")


class NotUsableError(Exception):
    """Why nothing of a capture, nor of older ones, is used."""


@dataclass(slots=True)
class Run:
    """What one capture gave; `blocks` are those between two agreeing readings of the device."""

    source: str
    unit: Unit
    registers: dict[int, Values]
    compensated: tuple[bool, ...]
    clock: WallClock
    blocks: list[SampleBlock] = field(default_factory=list)
    failed: bool = False  # its estimator did, before these samples: older ones may be why

    def stamp(self) -> Stamp:
        """The host's clocks at the newest sample."""
        since_s = float(self.blocks[-1].host_s[-1]) - self.clock.host_ns * 1e-9
        boot_s = None if self.clock.boot_s is None else self.clock.boot_s + since_s
        return Stamp(self.clock.wall_s + since_s, self.clock.boot_id, boot_s)

    def of_same(self, other: Run) -> bool:
        """Whether the samples of both may be put together."""
        return (
            self.unit == other.unit
            and self.compensated == other.compensated
            and self.registers.keys() == other.registers.keys()
            and all(same(n, v, other.registers[n]) for n, v in self.registers.items())
        )


class Reading:
    """One capture's entries in order; see the module."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.clock: WallClock | None = None
        self.began_warm_ns: int | None = None
        self.last_ns = 0
        self.why = "no reading of the device follows its samples"
        self.failed = False
        self._deframer = Deframer()
        self._epochs = RegisterEpochs()
        self._stream = Stream(self._epochs, keep_gaps=1)
        self._values: dict[int, Values] = {}
        self._known = False
        self._heard: set[int] = set()
        self._open: list[SampleBlock] = []
        self._kept: list[SampleBlock] = []
        self._restarts = 0

    def take(self, entry: Entry) -> None:
        """The next entry."""
        self.last_ns = entry.host_ns
        if entry.topic == "rx":
            self._received(Received(entry.host_ns, entry.data))
        elif entry.topic == "tx":
            self._sent(entry.data.decode("ascii", "replace"))
        elif entry.topic == "input" and entry.data.startswith(_INPUTS):
            self._input(capture.input_from_json(entry.data))

    def skipped(self) -> None:
        """Part of the file was not read."""
        self._deframer = Deframer()
        self._away()

    def run(self) -> Run | None:
        """What is to be had of it."""
        if not self._kept or self.clock is None:
            return None
        model, serial, firmware = (self._values[n][0] for n in _IDENTITY)
        return Run(
            self.name,
            Unit(str(model), int(serial), str(firmware)),
            {n: self._values[n] for n in COMPENSATING if n in self._values},
            (self._stream.compensated_mag, self._stream.compensated_gyro),
            self.clock,
            self._kept,
            self.failed,
        )

    def _input(self, item: object) -> None:
        if isinstance(item, WallClock):
            self.clock = item
        elif isinstance(item, LinkOpened | LinkLost):
            self._away()
        elif isinstance(item, Examined) and item.failure:
            self.failed = True
            self._drop(f"its estimator failed: {item.failure}")
        elif isinstance(item, EarlierRun) and not item.why:
            self.began_warm_ns = item.host_ns

    def _received(self, item: Received) -> None:
        host_s = item.host_ns * 1e-9
        frames = self._deframer.feed(item.data)
        skipped = deque(self._deframer.take_skipped())
        for frame in frames:
            found = decode(frame)
            if isinstance(found, Reply):
                self._reply(found, host_s)
            elif isinstance(found, Undecodable):
                self._stream.undecodable()
            elif isinstance(found, Measurement):
                while skipped and skipped[0].offset < found.offset:
                    self._stream.damaged(skipped.popleft())
                if self._known:
                    self._collect(self._stream.take(found, host_s))
        for piece in skipped:
            self._stream.damaged(piece)

    def _collect(self, blocks: list[SampleBlock]) -> None:
        if self._stream.take_replaced():
            self._kept, self._open = [], []
        self._open += blocks
        if self._stream.restarts > self._restarts:
            self._restarts = self._stream.restarts
            self._drop("the device restarted")

    def _reply(self, reply: Reply, host_s: float) -> None:
        number = reply.register
        if number is None or reply.word not in ("VNRRG", "VNWRG"):
            return
        try:
            values = parse(number, reply.tokens)
        except ValueError:
            return
        watched = number in COMPENSATING or number in _IDENTITY
        if watched and number in self._values and not same(number, self._values[number], values):
            what = (
                "another device answered" if number in _IDENTITY else f"register {number} changed"
            )
            self._drop(what)
        self._values[number] = values
        self._heard.add(number)
        if number == 84 and self._heard >= _CONFIRMS:
            self._heard.clear()
            self._confirm(host_s)

    def _confirm(self, host_s: float) -> None:
        if self._known:
            self._collect(self._stream.flush())
            if self._known:  # a restart may have shown
                self._kept += self._open
                self._open = []
                return
        self._known = True
        self._stream.forget()
        self._stream.registers = dict(self._values)
        self._epochs.begin(host_s, Compensation.from_registers(self._values))

    def _sent(self, text: str) -> None:
        for line in text.split("$")[1:]:
            word, _, rest = line.partition(",")
            number = rest.partition(",")[0]
            if word[:5] in _RESETS:
                self._drop("the device was reset")
            elif word == "VNWRG" and number.isdecimal() and int(number) in COMPENSATING:
                self._drop(f"register {int(number)} was written")
                self._values.pop(int(number), None)
            elif word == "VNWRG" and self._known:  # the output
                self._collect(self._stream.flush())
                self._stream.forget()

    def _away(self) -> None:
        """The link was away: what was not confirmed never will be."""
        self._stream.forget()
        self._open, self._known = [], False
        self._heard.clear()

    def _drop(self, why: str) -> None:
        self._away()
        self._kept, self.why = [], f"{why}, and no reading of the device follows later samples"


def earlier_inputs(
    folder: Path,
    own: Path | None,
    now: Stamp,
    limit_s: float,
    step_rate_hz: float,
    go_on: Callable[[], bool] = lambda: True,
) -> list[EarlierSamples | EarlierRun]:
    """What the core is told of earlier runs; the last one says whose they are, or why none come.

    own: the capture of this run; go_on: false where it takes too long. Their `host_ns` is 0.
    """
    try:
        runs = _runs(folder, own, now, limit_s, go_on)
    except (NotUsableError, RecordingError) as error:
        return [EarlierRun(0, why=str(error))]
    except (OSError, ValueError) as error:
        return [EarlierRun(0, why=f"the captures in {folder} cannot be read: {error}")]
    newest_s = now.boot_s or 0.0
    blocks: list[SampleBlock] = []
    for run in reversed(runs):
        from_s = newest_s - limit_s - (run.clock.boot_s or 0.0) + run.clock.host_ns * 1e-9
        young = [b for b in run.blocks if float(b.host_s[0]) >= from_s]
        blocks += _averaged(young, step_rate_hz)
    while blocks and sum(map(len, blocks)) > MOST_ROWS:
        del blocks[0]
    run, stamp = runs[0], runs[0].stamp()
    told: list[EarlierSamples | EarlierRun] = [EarlierSamples(0, b) for b in blocks]
    told.append(
        EarlierRun(
            0,
            "" if blocks else "no sample is young enough",
            ", ".join(r.source for r in runs),
            run.unit.model,
            run.unit.serial,
            run.unit.firmware,
            run.registers,
            run.compensated,
            stamp.boot_id,
            stamp.boot_s,
            stamp.wall_s or 0.0,
        )
    )
    return told


def _runs(
    folder: Path, own: Path | None, now: Stamp, limit_s: float, go_on: Callable[[], bool]
) -> list[Run]:
    """The newest run first; older ones as long as they are of the same device."""
    found: list[Run] = []
    why = "there is no earlier capture"
    for path in _newest(folder, own)[:RUNS]:
        try:
            run, reason = _read(path, now, limit_s, go_on)
        except (NotUsableError, RecordingError):
            if found:
                break
            raise
        if run is not None and found and not run.of_same(found[0]):
            break
        if run is not None:
            found.append(run)
            if run.failed:
                break
        elif not found:
            why = f"{path.name}: {reason}"
    if not found:
        raise NotUsableError(why)
    return found


def _newest(folder: Path, own: Path | None) -> list[Path]:
    """First parts of captures, the newest first; only regular files."""
    found = []
    for path in folder.glob(_NAME):
        status = path.lstat()
        if path != own and stat.S_ISREG(status.st_mode) and not _PART.search(path.stem):
            newest = max(p.lstat().st_mtime_ns for p in _parts(path))
            found.append((newest, path))
    return [path for _, path in sorted(found, reverse=True)]


def _parts(path: Path) -> Iterator[Path]:
    part = 1
    while (one := capture.part_path(path, part)).exists():
        if not stat.S_ISREG(one.lstat().st_mode):
            return
        yield one
        part += 1


def _read(
    path: Path, now: Stamp, limit_s: float, go_on: Callable[[], bool]
) -> tuple[Run | None, str]:
    """What a capture gives, or why nothing. Raises NotUsableError where older ones do not either"""
    read_head(path)
    reading = Reading(path.name)
    ended, expected = True, None
    for entry in _entries(path, reading, now, limit_s):
        if not go_on():
            raise NotUsableError(f"{path.name}: to read it took too long")
        if entry is None:
            reading.skipped()
            expected = None
        elif isinstance(entry, Damage):
            if not entry.unclosed:
                raise NotUsableError(f"{path.name}: damaged: {entry.what}")
            ended = False
        elif expected not in (None, entry.sequence):
            raise NotUsableError(f"{path.name}: damaged: records are missing")
        else:
            expected = (entry.sequence + 1) % SEQUENCES
            reading.take(entry)
    warm_ns = reading.began_warm_ns
    if not ended and warm_ns is not None and reading.last_ns - warm_ns < AT_ONCE_S * 1e9:
        raise NotUsableError(f"{path.name}: that run began warm and was cut off at once")
    run = reading.run()
    if run is None:
        if reading.failed:
            raise NotUsableError(f"{path.name}: {reading.why}")
        return None, reading.why
    if reason := too_old(run.stamp(), now, limit_s):
        raise NotUsableError(f"{path.name}: {reason}")
    return run, ""


def _entries(
    path: Path, reading: Reading, now: Stamp, limit_s: float
) -> Iterator[Entry | Damage | None]:
    """The first seconds and the newest minutes of a capture; None for what lies between."""
    first_ns: int | None = None

    def wanted(start_ns: int, end_ns: int) -> bool:
        nonlocal first_ns
        first_ns = start_ns if first_ns is None else first_ns
        clock = reading.clock
        if clock is None or start_ns < first_ns + FIRST_S * 1e9:
            return True
        if clock.boot_s is None or clock.boot_id != now.boot_id:
            then = Stamp(clock.wall_s, clock.boot_id, clock.boot_s)
            raise NotUsableError(f"{path.name}: {too_old(then, now, limit_s)}")
        from_s = (now.boot_s or 0.0) - limit_s - clock.boot_s
        return end_ns >= clock.host_ns + from_s * 1e9

    for part in _parts(path):
        yield from read_entries(part, wanted)


def _averaged(blocks: list[SampleBlock], step_rate_hz: float) -> list[SampleBlock]:
    """The same as the estimator's steps, in pieces; each of its gaps stays one."""
    spans: list[list[SampleBlock]] = []
    for block in blocks:
        if block.gap_before or not spans:
            spans.append([])
        spans[-1].append(block)
    return [piece for span in spans for piece in _steps(span, step_rate_hz)]


def _steps(span: list[SampleBlock], step_rate_hz: float) -> list[SampleBlock]:
    def joined(name: str) -> Array:
        return np.concatenate([getattr(block, name) for block in span])

    time_s, dt_s = joined("time_s"), joined("dt_s")
    known = dt_s[1:][np.isfinite(dt_s[1:])]
    if not len(known):
        return []
    vectors = [joined(n) for n in ("raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")]
    averager = StepAverager(samples_per_step(1.0 / float(np.median(known)), step_rate_hz))
    steps = averager.add(np.column_stack([time_s, dt_s, *vectors]))
    if len(steps) < 2:
        return []
    gyro = steps.angle_b_rad / steps.dt_s[:, None]
    gyro[0] = gyro[1]  # the angle into the first step is not known
    temperature = {}
    if all("temperature_c" in block.covariates for block in span):
        values = np.concatenate([block.covariates["temperature_c"] for block in span])
        temperature["temperature_c"] = np.round(np.interp(steps.time_s, time_s, values), 3)
    whole = SampleBlock(
        np.round(steps.time_s, 7),
        np.round(steps.dt_s, 9),
        np.round(np.interp(steps.time_s, time_s, joined("host_s")), 6),
        np.round(steps.field_b_gauss, 8),
        np.round(gyro, 9),
        np.round(steps.accel_b_m_s2, 6),
        temperature,
    )
    return [_rows(whole, k) for k in range(0, len(steps), PIECE_ROWS)]


def _rows(whole: SampleBlock, first: int) -> SampleBlock:
    rows = slice(first, first + PIECE_ROWS)
    return replace(
        whole,
        **{name: getattr(whole, name)[rows] for name in _COLUMNS},
        covariates={name: values[rows] for name, values in whole.covariates.items()},
        gap_before=first == 0,
    )
