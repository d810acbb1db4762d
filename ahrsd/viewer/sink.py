"""The daemon's end of the viewer: events go in, and nothing ever comes back to slow it down.

rerun runs in a process of its own (`ahrsd.viewer.process`), started afresh and never forked:
inside the daemon it could stop it: a wedged viewer makes its disconnect hang, a full disk ends its
file writer for good, and dropping a stream whose writer is dead blocks for ever.

    push() -> pending -> queue (bounded, drops the oldest) -> feeder thread -> pipe -> process

* `push` appends to a list under a lock that nobody holds while doing I/O.
* The feeder pickles and writes without blocking; a process that does not read costs events, not
  time. Events that were not written are counted in `counters.dropped`.
* A process that dies, or reads nothing for `stall_s`, is started again after a pause that doubles;
  it continues in a new file part and is first told the last state, estimate and verdict.
* The process writes its troubles (unwritable file, full disk, port in use) as JSON lines; they end
  up in `counters.faults` and `counters.last_fault`.

This module must not import rerun: that is the point of it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import os
import pickle
import select
import struct
import subprocess
import sys
import threading
import time
import uuid
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from ahrsd.events import (
    Estimated,
    Event,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)

Item = tuple[int, Event]  # number of samples seen before the event, and the event

BATCH_ROWS = 100  # rows of samples in one batch
BATCH_EVENTS = 500
BATCH_AGE_S = 1.0
HEADER = struct.Struct(">I")  # length of the pickle that follows
PIPE_BYTES = 1 << 20
BACKOFF_S = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
STEADY_S = 60.0  # a process that lived this long is forgiven its predecessors
POLL_S = 0.2
WAIT_S = 5.0
FINISH_S = 1.5  # of close()'s time, kept for the process to finish its file
SHOWN = (SamplesSeen, Estimated, Judged, StateChanged, RegisterWritten, Noted)
REMEMBERED = (StateChanged, Estimated, Judged)  # told again to a new process and a new file part


@dataclass(frozen=True, slots=True)
class RerunLimits:
    """How much the process may take of the disk and of the memory.

    part_s, part_bytes: a file part is closed at this age or size, and the next begins
    quota_bytes:        the oldest parts of this name are deleted above this sum
    reserve_bytes:      nothing is written while the disk has less than this free: captures and
                        the journal matter more
    server_bytes:       what the live view keeps for viewers that connect late
    """

    part_s: float = 3600.0
    part_bytes: int = 256 << 20
    quota_bytes: int = 4 << 30
    reserve_bytes: int = 256 << 20
    server_bytes: int = 64 << 20


@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """What the process is told at its start.

    path:         first file part; None for no file
    serve, port:  live viewer on 127.0.0.1:port
    recording_id: common to all parts, so that a viewer shows parts opened together as one
    fresh:        replace `path`; otherwise the next free split name is used
    """

    path: str | None
    serve: bool
    port: int
    recording_id: str
    limits: RerunLimits
    fresh: bool = True

    def to_json(self) -> str:
        """As one command-line argument."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> ProcessSettings:
        """From `to_json`'s text."""
        values = json.loads(text)
        return ProcessSettings(**{**values, "limits": RerunLimits(**values["limits"])})


@dataclass(frozen=True, slots=True)
class SinkCounters:
    """What was lost on the way to the viewer since the sink was made."""

    dropped: int = 0
    respawns: int = 0
    faults: int = 0
    last_fault: str = ""


_DEFAULT_LIMITS = RerunLimits()


class RerunSink:
    """Feeds rerun in another process; `push` never blocks (see `wait`) and never raises.

    path: .rrd file to write (replaced if it exists), or None; serve: live viewer at
    127.0.0.1:port; queue_batches: how many batches may wait before the oldest is dropped;
    stall_s: a process that reads nothing for this long is replaced; limits: of disk and memory;
    wait: for replays, which are faster than rerun: `push` waits for room in the queue instead of
    dropping, until it has once waited WAIT_S in vain.
    """

    def __init__(
        self,
        path: Path | None,
        serve: bool = False,
        port: int = 9876,
        queue_batches: int = 256,
        *,
        stall_s: float = 30.0,
        limits: RerunLimits = _DEFAULT_LIMITS,
        wait: bool = False,
    ) -> None:
        file = None if path is None else str(path.absolute())
        self._settings = ProcessSettings(file, serve, port, uuid.uuid4().hex, limits)
        self._queue_batches = queue_batches
        self._stall_s = stall_s
        self._wait = wait
        lock = threading.Lock()  # guards everything down to `_deadline_s`
        self._wake = threading.Condition(lock)  # for the feeder: there is something to do
        self._room = threading.Condition(lock)  # for `push`: a batch has left the queue
        self._pending: list[Item] = []
        self._pending_rows = 0
        self._pending_since_s = 0.0
        self._queue: deque[list[Item]] = deque()
        self._samples = 0
        self._latest: dict[type, Item] = {}
        self._counters = SinkCounters()
        self._deadline_s: float | None = None
        self._process: subprocess.Popen[bytes] | None = None  # the feeder's own from here on
        self._started_s = self._retry_s = self._progress_s = 0.0
        self._failures = 0
        self._status = b""
        self._thread = threading.Thread(target=self._feed, name="rerun-feeder", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> SinkCounters:
        """Losses so far; a consistent copy."""
        return self._counters

    @property
    def pid(self) -> int | None:
        """Process number of the process now running, if one is."""
        process = self._process
        return None if process is None else process.pid

    def push(self, event: Event, host_s: float) -> None:
        """Hand one event over; `host_s` is now on the host's monotonic clock."""
        if not isinstance(event, SHOWN) or self._deadline_s is not None:
            return
        with self._wake:
            if self._wait and len(self._queue) >= self._queue_batches:
                self._wait = self._room.wait_for(
                    lambda: len(self._queue) < self._queue_batches, WAIT_S
                )
            item = (self._samples, event)
            if not self._pending:
                self._pending_since_s = host_s
            self._pending.append(item)
            if isinstance(event, SamplesSeen):
                self._samples += len(event.block)
                self._pending_rows += len(event.block)
            elif isinstance(event, REMEMBERED):
                self._latest[type(event)] = item
            if (
                self._pending_rows >= BATCH_ROWS
                or len(self._pending) >= BATCH_EVENTS
                or host_s - self._pending_since_s >= BATCH_AGE_S
            ):
                self._seal()

    def close(self, timeout_s: float = 3.0) -> None:
        """Let the process finish its file, at most `timeout_s` long; then it is killed."""
        with self._wake:
            if self._deadline_s is None:
                self._deadline_s = time.monotonic() + timeout_s
            self._seal()
            self._wake.notify()
        self._thread.join(timeout_s + 1.0)

    # Called with the lock held.

    def _seal(self) -> None:
        if not self._pending:
            return
        if len(self._queue) >= self._queue_batches:
            self._count(dropped=len(self._queue.popleft()))
        self._queue.append(self._pending)
        self._pending, self._pending_rows = [], 0
        self._wake.notify()

    def _count(self, dropped: int = 0, respawns: int = 0, fault: str | None = None) -> None:
        was = self._counters
        self._counters = SinkCounters(
            was.dropped + dropped,
            was.respawns + respawns,
            was.faults + (fault is not None),
            was.last_fault if fault is None else fault,
        )

    # The feeder thread.

    def _feed(self) -> None:
        idle_since_s = time.monotonic()
        while True:
            self._read_status()
            ready = self._process_ready()
            with self._wake:
                if not self._queue and self._deadline_s is None:
                    self._wake.wait(POLL_S)
                if self._queue or not self._pending:
                    idle_since_s = time.monotonic()
                elif time.monotonic() - idle_since_s >= BATCH_AGE_S:
                    self._seal()  # the stream paused: do not keep its last samples waiting
                if self._over(keep_s=FINISH_S) or (
                    self._deadline_s is not None and not self._queue
                ):
                    break
                batch = self._queue.popleft() if ready and self._queue else None
                self._room.notify()
            if batch is None:
                time.sleep(0.0 if ready else POLL_S / 4)
            elif not self._write(batch):
                with self._wake:
                    self._count(dropped=len(batch))
        self._finish()

    def _over(self, keep_s: float = 0.0) -> bool:
        return self._deadline_s is not None and time.monotonic() >= self._deadline_s - keep_s

    def _process_ready(self) -> bool:
        """Start the process where none runs and its pause is over; true where one runs."""
        now_s = time.monotonic()
        if self._process is not None and self._process.poll() is not None:
            self._lost(f"the viewer's process ended with code {self._process.returncode}")
        if self._process is None and now_s >= self._retry_s:
            try:
                self._process = start_process(self._settings)
            except OSError as error:
                self._lost(f"the viewer's process cannot be started: {error}")
                return False
            self._started_s = self._progress_s = now_s
            self._settings = dataclasses.replace(self._settings, fresh=False)
            with self._wake:
                known = sorted(self._latest.values(), key=lambda item: item[0])
            if known and self._failures:
                self._write(known)
        return self._process is not None

    def _lost(self, fault: str) -> None:
        """Forget the process and set the pause before the next."""
        if self._process is not None:
            self._read_status()
            end(self._process)
            if time.monotonic() - self._started_s >= STEADY_S:
                self._failures = 0
        self._process = None
        pause_s = BACKOFF_S[min(self._failures, len(BACKOFF_S) - 1)]
        self._failures += 1
        self._retry_s = time.monotonic() + pause_s
        with self._wake:
            self._count(respawns=1, fault=fault)

    def _write(self, batch: list[Item]) -> bool:
        """Write one batch; false where the process died, stalled or the time is over."""
        if self._process is None or self._process.stdin is None:
            return False
        body = pickle.dumps(batch, protocol=pickle.HIGHEST_PROTOCOL)
        left = memoryview(HEADER.pack(len(body)) + body)
        pipe = self._process.stdin.fileno()
        poll = select.poll()
        poll.register(pipe, select.POLLOUT)
        self._progress_s = time.monotonic()
        while left:
            try:
                left = left[os.write(pipe, left) :]
                self._progress_s = time.monotonic()
            except BlockingIOError:
                poll.poll(POLL_S * 1e3)
                if self._over(keep_s=FINISH_S):
                    return False
                if time.monotonic() - self._progress_s >= self._stall_s:
                    self._lost(f"the viewer's process read nothing for {self._stall_s:g} s")
                    return False
            except OSError as error:
                self._lost(f"the viewer's process is gone: {error.strerror}")
                return False
        return True

    def _read_status(self) -> None:
        """Take what the process reported; a fault is a JSON string on a line."""
        if self._process is None or self._process.stdout is None:
            return
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self._process.stdout.fileno(), 65536):
                self._status += chunk
        *lines, self._status = self._status.split(b"\n")
        for line in lines:
            with self._wake, contextlib.suppress(json.JSONDecodeError):
                self._count(fault=str(json.loads(line)))

    def _finish(self) -> None:
        with self._wake:
            self._count(dropped=sum(len(batch) for batch in self._queue))
            self._queue.clear()
            left_s = max(0.0, (self._deadline_s or 0.0) - time.monotonic())
        process = self._process
        if process is None or process.stdin is None:
            return
        process.stdin.close()  # the process takes the end of its input as "finish"
        try:
            process.wait(left_s)
        except subprocess.TimeoutExpired:
            with self._wake:
                self._count(fault="the viewer's process did not finish in time and was killed")
        self._read_status()
        end(process)
        self._process = None


def start_process(settings: ProcessSettings) -> subprocess.Popen[bytes]:
    """Start `ahrsd.viewer.process` with this interpreter and this import path; raises OSError."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        "RUST_LOG": os.environ.get("RUST_LOG", "off"),  # faults come as status lines instead
        "OPENBLAS_NUM_THREADS": "1",
    }
    process = subprocess.Popen(
        [
            sys.executable,
            "-P",
            "-m",
            "ahrsd.viewer.process",
            settings.to_json(),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
        env=environment,
        process_group=0,  # Ctrl-C is for the daemon, which then lets the process finish
    )
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            os.set_blocking(pipe.fileno(), False)
    with contextlib.suppress(OSError):  # more than this user may have: the default size will do
        if process.stdin is not None:
            fcntl.fcntl(process.stdin.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    return process


def end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process if it still runs, reap it and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
