"""The process that holds rerun: reads events from its input until it ends, writes files and serves.

Two streams are kept apart, because a stream whose file writer has died can neither be flushed nor
dropped: the file, in parts, and the live viewer. What goes wrong is reported as one JSON string a
line on standard output and tried again later; a file writer that died while writing (full disk)
ends this process, and the daemon starts a new one.

The recording API of rerun sends no usage data and writes no settings; only its viewer does
(`rerun analytics disable`). Everything binds to 127.0.0.1.

A `Recorder` says which event becomes which entity, at which rate. One recorder writes to one
recording stream. It keeps just enough of the past to write a gate's lane only when it changes and
to keep points, ellipsoids and the gate table at a readable rate.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import select
import shutil
import signal
import sys
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from ahrsd.calibration import Affine, Estimate
from ahrsd.events import (
    Estimated,
    Event,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.gates import guards_a_write
from ahrsd.report.contents import RunTime
from ahrsd.samples import Array
from ahrsd.viewer import blueprint as names
from ahrsd.viewer.blueprint import blueprint
from ahrsd.viewer.sink import BATCH_ROWS, HEADER, REMEMBERED, Item, ProcessSettings

# -- Which event becomes which entity --------------------------------------------------------------


Indices = NDArray[np.signedinteger]

APPLICATION = "ahrsd"
POINTS_PER_S = 50.0
SLOW_S = 1.0  # the gate table and the ellipsoids change at most this often
FLUSH_TICK_S = 1.0
FILE_FLUSH_S = 10.0

_LEVELS = {
    "debug": rr.TextLogLevel.DEBUG,
    "info": rr.TextLogLevel.INFO,
    "warning": rr.TextLogLevel.WARN,
    "error": rr.TextLogLevel.ERROR,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Samples of consecutive events as columns; norms and `corrected` are nan where unknown."""

    time_s: Array
    host_s: Array
    gyro: Array
    raw: Array
    present: Array
    corrected: Array

    @staticmethod
    def of(seen: Sequence[SamplesSeen], newest: Affine | None) -> _Rows:
        blocks = [event.block for event in seen]
        corrections = [event.proposed or newest for event in seen]
        return _Rows(
            np.concatenate([b.time_s for b in blocks]),
            np.concatenate([b.host_s for b in blocks]),
            np.concatenate([b.gyro_b_rad_s for b in blocks]),
            np.concatenate([b.raw_b_gauss for b in blocks]),
            np.concatenate([e.present.apply(e.block.raw_b_gauss) for e in seen]),
            np.concatenate(
                [
                    np.full((len(block), 3), np.nan)
                    if correction is None
                    else correction.apply(block.raw_b_gauss)
                    for block, correction in zip(blocks, corrections, strict=True)
                ]
            ),
        )


class Recorder:
    """Writes events into one stream; `stream` must already have its sinks."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._last_point = -1  # number of the 1/POINTS_PER_S interval that already has a point
        self._first_s: tuple[float, float] | None = None  # device and host time of sample 0
        self._gates: dict[str, bool] = {}
        self._newest: Affine | None = None  # shown until there is a proposal
        self._state_known = False
        self._time = RunTime()
        self._table_at_s = self._shape_at_s = -math.inf
        names.log_styles(stream)

    def samples(self, seen: Sequence[SamplesSeen], first_sample: int) -> None:
        """Write consecutive sample events as columns; `first_sample` numbers their first row."""
        rows = _Rows.of(seen, self._newest)
        if not len(rows.time_s):
            return
        rows = replace(rows, time_s=self._time.samples(rows.time_s))
        if self._first_s is None:
            self._first_s = float(rows.time_s[0]), float(rows.host_s[0])
        every = np.arange(len(rows.time_s))
        norms = np.stack(
            [np.linalg.norm(rows.present, axis=1), np.linalg.norm(rows.corrected, axis=1)], axis=1
        )
        self._scalars(names.GYRO, rows, first_sample, rows.gyro)
        self._scalars(names.FIELD_NORM, rows, first_sample, norms)
        shown = every[self._thinned(rows.time_s)]
        self._points(names.RAW_POINTS, rows, first_sample, shown, rows.raw)
        known = shown[np.isfinite(rows.corrected[shown]).all(axis=1)]
        self._points(names.CORRECTED_POINTS, rows, first_sample, known, rows.corrected)

    def event(self, event: Event, first_sample: int) -> None:
        """Write one event other than samples; what is meant for the shell is not shown."""
        match event:
            case Estimated():
                self._at(event.at_s, event.host_s, first_sample)
                self._estimate(event.estimate, event.at_s)
            case Judged():
                self._at(event.at_s, event.host_s, first_sample)
                self._judged(event)
            case StateChanged():
                self._state_changed(event, first_sample)
            case RegisterWritten():
                self._at(event.at_s, event.host_s, first_sample)
                self._text("registers", register_text(event), "info")
            case Noted():
                self._at(event.at_s, event.host_s, first_sample)
                self._text("notes", event.text, event.level)

    def _at(self, at_s: float, host_s: float, sample: int) -> None:
        self._stream.reset_time()  # a clock that is not known yet must not keep an old value
        device_s = self._time.at(at_s)
        for timeline, value in ((names.DEVICE_TIME, device_s), (names.HOST_TIME, host_s)):
            if math.isfinite(value):
                self._stream.set_time(timeline, duration=value)
        self._stream.set_time(names.SAMPLE, sequence=sample)

    def _times(self, rows: _Rows, first_sample: int, which: Indices) -> list[rr.TimeColumn]:
        columns = [rr.TimeColumn(names.SAMPLE, sequence=first_sample + which)]
        for timeline, values in ((names.DEVICE_TIME, rows.time_s), (names.HOST_TIME, rows.host_s)):
            if np.isfinite(values[which]).all():
                columns.append(rr.TimeColumn(timeline, duration=values[which]))
        return columns

    def _scalars(self, path: str, rows: _Rows, first_sample: int, values: Array) -> None:
        count, width = values.shape
        self._stream.send_columns(
            path,
            self._times(rows, first_sample, np.arange(count)),
            rr.Scalars.columns(scalars=values.ravel()).partition([width] * count),
        )

    def _thinned(self, time_s: Array) -> Array:
        """Rows that show a point: the first of each 1/POINTS_PER_S interval of device time."""
        interval = np.floor(np.nan_to_num(time_s) * POINTS_PER_S).astype(np.int64)
        before = np.concatenate([[self._last_point], interval[:-1]])
        self._last_point = int(interval[-1])
        return np.asarray(interval != before)

    def _points(
        self, path: str, rows: _Rows, first_sample: int, which: Indices, values: Array
    ) -> None:
        if not len(which):
            return
        self._stream.send_columns(
            path,
            self._times(rows, first_sample, which),
            rr.Points3D.columns(
                positions=values[which],
                colors=[names.POINT_COLOURS[path]] * len(which),
                radii=[-2.0] * len(which),  # negative: pixels, readable at any zoom
            ),
        )

    def _estimate(self, estimate: Estimate, at_s: float) -> None:
        self._newest = estimate.correction
        sigma = estimate.sigma
        upper = np.triu_indices(3)
        soft = (estimate.soft_iron - np.eye(3))[upper]
        self._band(names.SOFT_IRON, soft, sigma[:6])
        self._band(names.HARD_IRON, estimate.hard_iron_gauss, sigma[6:9])
        self._band(names.GYRO_BIAS, estimate.gyro_bias_rad_s * 1e3, sigma[9:12] * 1e3)
        self._stream.log(names.HEADING_SIGMA, rr.Scalars(estimate.heading_sigma_deg))
        if not abs(at_s - self._shape_at_s) < SLOW_S:
            self._shape_at_s = at_s
            self._shapes(estimate)

    def _band(self, path: str, value: Array, sigma: Array) -> None:
        lines = np.stack([value, value - sigma, value + sigma], axis=1)
        self._stream.log(path, rr.Scalars(lines.ravel()))

    def _shapes(self, estimate: Estimate) -> None:
        """The raw field lies on centre b with axes field * eig(A); the corrected on a sphere."""
        stretch, axes = np.linalg.eigh(estimate.soft_iron)
        axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a reflection
        self._stream.log(
            names.RAW_ELLIPSOID,
            rr.Ellipsoids3D(
                half_sizes=[estimate.field_gauss * stretch],
                centers=[estimate.hard_iron_gauss],
                quaternions=[quaternion_xyzw(axes)],
                colors=[(*names.RAW, 90)],
                line_radii=-0.5,
                fill_mode="densewireframe",
            ),
        )
        self._stream.log(
            names.CORRECTED_SPHERE,
            rr.Ellipsoids3D(
                half_sizes=[[estimate.field_gauss] * 3],
                colors=[(*names.CORRECTED, 90)],
                line_radii=-0.5,
                fill_mode="densewireframe",
            ),
        )

    def _judged(self, judged: Judged) -> None:
        changed = False
        counted = [check for check in judged.gates if guards_a_write(check.gate)]
        for gate, checks in by_gate(counted).items():
            ok = all(check.ok for check in checks)
            if self._gates.get(gate) is ok:
                continue
            changed = True
            path = names.gate_path(gate)
            if gate not in self._gates:
                style = names.states_style({"ok": names.OK, "not met": names.NOT_OK})
                self._stream.log(path, style, static=True)
            self._gates[gate] = ok
            self._stream.log(path, rr.StateChange(state="ok" if ok else "not met"))
        if changed or not abs(judged.at_s - self._table_at_s) < SLOW_S:
            self._table_at_s = judged.at_s
            self._stream.log(
                names.GATE_TABLE,
                rr.TextDocument(gate_table(judged.gates), media_type=rr.MediaType.MARKDOWN),
            )

    def _state_changed(self, event: StateChanged, first_sample: int) -> None:
        if not self._state_known and self._first_s is not None and self._first_s[0] < event.at_s:
            self._at(*self._first_s, 0)  # the lane begins where the samples do
            self._stream.log(names.STATE_LANE, rr.StateChange(state=event.old))
        self._state_known = True
        self._at(event.at_s, event.host_s, first_sample)
        self._stream.log(names.STATE_LANE, rr.StateChange(state=event.new))
        self._text("states", f"{event.old} -> {event.new}: {event.reason}", "info")

    def _text(self, kind: str, text: str, level: str) -> None:
        shown = _LEVELS.get(level, rr.TextLogLevel.INFO)
        self._stream.log(f"{names.LOG}/{kind}", rr.TextLog(text, level=shown))


def by_gate(checks: Iterable[GateResult]) -> dict[str, list[GateResult]]:
    """The gates of each family: `field.spread` and `field.strongest` both belong to `field`."""
    gates: dict[str, list[GateResult]] = {}
    for check in checks:
        gates.setdefault(check.gate.partition(".")[0], []).append(check)
    return gates


def gate_table(checks: Sequence[GateResult]) -> str:
    """Markdown of a verdict: what to do first, then every gate with its value and its limit."""
    checks = [check for check in checks if guards_a_write(check.gate)]
    families = by_gate(check for check in checks if not check.ok)
    shut = sum(map(len, families.values()))
    held = f"**Held back by {shut} of {len(checks)} gates**"
    lines = [held if shut else f"**All {len(checks)} gates ok**", ""]
    for name, bad in families.items():
        more = f" *(and {len(bad) - 1} more)*" if len(bad) > 1 else ""
        lines.append(f"- **{name}**: {bad[0].advice}{more}")
    lines += ["", "| | gate | value | limit |", "|---|---|---|---|"]
    for check in sorted(checks, key=lambda check: check.ok):
        lines.append(
            f"| {'ok' if check.ok else '**NO**'} | {_cell(check.gate)} "
            f"| {check.value:.3g} {check.unit} | {check.limit:.3g} {check.unit} |"
        )
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "/").replace("\n", " ")


def register_text(event: RegisterWritten) -> str:
    """One line: which register, how it ended, and its numbers before and after."""

    def numbers(values: tuple[float, ...]) -> str:
        return ", ".join(f"{value:.6g}" for value in values)

    return (
        f"register {event.register}: {event.outcome}; "
        f"before [{numbers(event.old)}] now [{numbers(event.new)}]"
    )


def quaternion_xyzw(R_ab: Array) -> Array:
    """Quaternion (x, y, z, w) of a rotation matrix (3, 3): the eigenvector of its 4x4 form.

    Itzhack Bar-Itzhack's symmetric matrix K has eigenvalue 1 at the quaternion; no branches.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R_ab
    K = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.asarray(np.linalg.eigh(K / 3.0)[1][:, -1])


def new_stream(recording_id: str) -> rr.RecordingStream:
    """Make a stream with this package's name and without rerun's own log timelines."""
    stream = rr.RecordingStream(
        APPLICATION,
        recording_id=recording_id,
        batcher_config=rr.ChunkBatcherConfig(flush_tick=FLUSH_TICK_S),
    )
    stream.set_log_tick_enabled(False)
    stream.set_log_time_enabled(False)
    return stream


def write_batch(recorders: Sequence[Recorder], batch: Sequence[tuple[int, Event]]) -> None:
    """Write (first sample's number, event) pairs; neighbouring samples become one block of rows."""
    start = 0
    while start < len(batch):
        end = start
        while end < len(batch) and isinstance(batch[end][1], SamplesSeen):
            end += 1
        seen = [event for _, event in batch[start:end] if isinstance(event, SamplesSeen)]
        for recorder in recorders:
            if seen:
                recorder.samples(seen, batch[start][0])
            else:
                recorder.event(batch[start][1], batch[start][0])
        start = max(end, start + 1)


def record(events: Iterable[Event], path: Path) -> None:
    """Write events to a .rrd file in this process; raises OSError where that cannot be done.

    For tests and tools. On a disk that fills up meanwhile, rerun may never let this process end:
    programs use `RerunSink`.
    """
    stream = new_stream(uuid.uuid4().hex)
    try:
        stream.set_sinks(rr.FileSink(path), default_blueprint=names.blueprint())
    except RuntimeError as error:
        raise OSError(f"{path}: {error}") from error
    recorder = Recorder(stream)
    batch: list[tuple[int, Event]] = []
    samples = rows = 0
    for event in events:
        batch.append((samples, event))
        count = len(event.block) if isinstance(event, SamplesSeen) else 0
        samples, rows = samples + count, rows + count
        if rows >= BATCH_ROWS:
            write_batch([recorder], batch)
            batch, rows = [], 0
    write_batch([recorder], batch)
    try:
        stream.flush(timeout_sec=FILE_FLUSH_S)
    except RuntimeError as error:
        raise OSError(f"{path}: {error}") from error
    stream.disconnect()


# -- The process -----------------------------------------------------------------------------------


READ_BYTES = 1 << 18
TICK_S = 1.0
FLUSH_S = 3.0
FINISH_FLUSH_S = 30.0  # the parent kills earlier, where it does not wait for so long
RETRY_S = 30.0
EXIT_FILE_LOST = 3


class Output:
    """One stream to one sink, opened again some time after a failure."""

    def __init__(self, kind: str, recording_id: str) -> None:
        self.kind = kind
        self.recorder: Recorder | None = None
        self.opened_s = 0.0
        self.retry_s = 0.0
        self._recording_id = recording_id
        self._stream: rr.RecordingStream | None = None

    def open(self, sink: rr.FileSink | rr.GrpcServerSink, now_s: float) -> bool:
        """Open the stream; false where the sink cannot be had (no folder, port in use)."""
        stream = new_stream(self._recording_id)
        try:
            stream.set_sinks(sink, default_blueprint=blueprint())
            stream.flush(timeout_sec=FLUSH_S)  # a server finds out that its port is taken only now
        except RuntimeError as error:
            self.pause(str(error), now_s)
            return False
        self._stream, self.recorder, self.opened_s = stream, Recorder(stream), now_s
        return True

    def pause(self, reason: str, now_s: float) -> None:
        """Report why there is no output, and try again in a while."""
        report(f"{self.kind}: {reason}")
        self.retry_s = now_s + RETRY_S

    def flush(self, timeout_s: float) -> bool:
        """Write out what was logged; false where the writer no longer works."""
        if self._stream is None:
            return True
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError as error:
            report(f"{self.kind}: {error}")
            return False
        return True

    def close(self) -> None:
        """End the stream; only after a flush that succeeded, otherwise this could hang."""
        if self._stream is not None:
            self._stream.disconnect()
        self._stream = self.recorder = None


class RerunOutputs:
    """The file, part after part, and the live server."""

    def __init__(self, settings: ProcessSettings) -> None:
        self._settings = settings
        self._path = None if settings.path is None else Path(settings.path)
        self._fresh = settings.fresh
        self._part = self._path
        self._file = Output("file", settings.recording_id)
        self._server = Output("server", settings.recording_id)
        self._latest: dict[type, Item] = {}

    def write(self, batch: list[Item]) -> None:
        """Write a batch to whatever is open."""
        open_now = [out.recorder for out in (self._file, self._server) if out.recorder is not None]
        write_batch(open_now, batch)
        for item in batch:
            if isinstance(item[1], REMEMBERED):
                self._latest[type(item[1])] = item

    def tick(self, now_s: float) -> None:
        """Open what should be open, flush, and change the file part when its time has come."""
        if self._file.recorder is not None:
            if not self._file.flush(FLUSH_S):
                os._exit(EXIT_FILE_LOST)
            if self._part_is_full(now_s):
                self._file.close()
                self._file.retry_s = now_s
            elif self._disk_is_full():
                self._file.close()
                self._file.pause(self._disk_text(), now_s)
        if self._path is not None and self._file.recorder is None and now_s >= self._file.retry_s:
            self._open_part(self._path, now_s)
        if self._settings.serve and self._server.recorder is None and now_s >= self._server.retry_s:
            memory = f"{self._settings.limits.server_bytes}B"
            sink = rr.GrpcServerSink("127.0.0.1", self._settings.port, server_memory_limit=memory)
            self._tell(self._server, self._server.open(sink, now_s))

    def finish(self) -> None:
        """Write out everything, and the footer of the file, which its end brings.

        The live stream is not closed: that waits for viewers without limit.
        """
        if self._file.flush(FINISH_FLUSH_S):
            self._file.close()

    def _open_part(self, path: Path, now_s: float) -> None:
        self._part = path if self._fresh else free_part(path)
        if self._disk_is_full():
            self._file.pause(self._disk_text(), now_s)
            return
        keep_quota(path, self._settings.limits.quota_bytes)
        opened = self._file.open(rr.FileSink(self._part), now_s)
        self._fresh = self._fresh and not opened
        self._tell(self._file, opened)

    def _tell(self, output: Output, opened: bool) -> None:
        """Begin a part or a session with the last known state, estimate and verdict."""
        if opened and output.recorder is not None:
            known = sorted(self._latest.values(), key=lambda item: item[0])
            write_batch([output.recorder], known)

    def _part_is_full(self, now_s: float) -> bool:
        if now_s - self._file.opened_s >= self._settings.limits.part_s:
            return True
        return self._part is not None and size(self._part) >= self._settings.limits.part_bytes

    def _disk_is_full(self) -> bool:
        return (
            self._part is not None and free_bytes(self._part) < self._settings.limits.reserve_bytes
        )

    def _disk_text(self) -> str:
        reserve_mb = self._settings.limits.reserve_bytes / 1e6
        return f"{self._part}: less than {reserve_mb:.0f} MB free on the disk; recording pauses"


def part_name(path: Path, number: int) -> Path:
    """Name of a further part: run.rrd, run.split2.rrd, run.split3.rrd, ..."""
    return path.with_name(f"{path.stem}.split{number}{path.suffix}")


def parts(path: Path) -> list[Path]:
    """All files of this name and its splits, oldest first."""
    found = [p for p in (path, *path.parent.glob(f"{path.stem}.split*{path.suffix}")) if p.exists()]
    return sorted(found, key=lambda p: p.stat().st_mtime_ns)


def free_part(path: Path) -> Path:
    """Give the first name after the highest one taken: a file that exists is never replaced."""
    if not parts(path):
        return path
    number = 2
    for taken in parts(path):
        digits = taken.stem.rpartition(".split")[2]
        if taken != path and digits.isdecimal():
            number = max(number, int(digits) + 1)
    return part_name(path, number)


def keep_quota(path: Path, quota_bytes: int) -> None:
    """Delete the oldest parts until the rest is within the quota; reports what it cannot delete."""
    files = parts(path)
    total = sum(size(file) for file in files)
    for file in files:
        if total <= quota_bytes:
            return
        total -= size(file)
        try:
            file.unlink()
        except OSError as error:
            report(f"file: {file} is over the quota and cannot be deleted: {error.strerror}")


def size(path: Path) -> int:
    """Bytes in a file; 0 where it is gone."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def free_bytes(path: Path) -> int:
    """Bytes free on the disk that holds a file; unlimited where that is not known."""
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return sys.maxsize  # a missing folder is found, and named, on opening the file


def report(fault: str) -> None:
    """Tell the daemon; a reader that has gone or does not read is no reason to stop."""
    line = json.dumps(fault) + "\n"
    try:
        os.write(_status, line.encode())
    except OSError:
        return


def batches(outputs: RerunOutputs) -> Iterator[list[Item]]:
    """Batches from standard input until it ends; `outputs` gets its turn about once a second."""
    buffer = bytearray()
    next_tick_s = 0.0
    while True:
        if time.monotonic() >= next_tick_s:
            outputs.tick(time.monotonic())
            next_tick_s = time.monotonic() + TICK_S
        if not select.select([0], [], [], TICK_S)[0]:
            continue
        chunk = os.read(0, READ_BYTES)
        if not chunk:
            return
        buffer += chunk
        while len(buffer) >= HEADER.size:
            end = HEADER.size + HEADER.unpack_from(buffer)[0]
            if len(buffer) < end:
                break
            yield pickle.loads(bytes(buffer[HEADER.size : end]))  # written by our own parent
            del buffer[:end]


_status = 1


def main() -> None:
    """Serve until the input ends. Signals meant for the daemon's group are not for us."""
    global _status  # noqa: PLW0603
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _status = os.dup(1)
    os.set_blocking(_status, False)
    os.dup2(2, 1)  # whatever a library prints must not look like a report
    os.nice(5)
    outputs = RerunOutputs(ProcessSettings.from_json(sys.argv[1]))
    for batch in batches(outputs):
        outputs.write(batch)
    outputs.finish()
    sys.stderr.flush()
    os._exit(0)  # closing a stream waits for viewers without limit


if __name__ == "__main__":
    main()
