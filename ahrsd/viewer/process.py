"""The process that holds rerun: reads events from its input until it ends, writes files and serves.

Two streams are kept apart, because a stream whose file writer has died can neither be flushed nor
dropped: the file, in parts, and the live viewer. What goes wrong is reported as one JSON string a
line on standard output and tried again later; a file writer that died while writing (full disk)
ends this process, and the daemon starts a new one.

The recording API of rerun sends no usage data and writes no settings; only its viewer does
(`rerun analytics disable`). Everything binds to 127.0.0.1.
"""

from __future__ import annotations

import json
import os
import pickle
import select
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import rerun as rr

from ahrsd.viewer.blueprint import blueprint
from ahrsd.viewer.recorder import Recorder, new_stream, write_batch
from ahrsd.viewer.sink import HEADER, REMEMBERED, Item, ProcessSettings

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
