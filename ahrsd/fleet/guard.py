"""A process of its own round each recording: a limit of time, one of memory, and a crash that stays
one row.

Memory is limited by the kernel (RLIMIT_DATA), not by looking at the resident size again and again:
it holds at the moment of the allocation, so that a recording that asks for 20 GB at once takes none
of them from its neighbours, and the refusal comes up in the task's own words. What is counted is
what was asked for; Arrow's own pool reserves a gigabyte that it never touches, so the processes use
the system's allocator.

A recording whose process died is tried again, because whoever killed it may have meant another;
after `TRIES` its end is its row. On a cluster every Dask worker has a guard with one process.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import logging
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, wait
from concurrent.futures import TimeoutError as LateError
from typing import TYPE_CHECKING

from ahrsd.errors import AhrsdError
from ahrsd.fleet import row as rows
from ahrsd.fleet.archive import ArchiveEntry, sweep
from ahrsd.fleet.work import Answer, Orders, keep_loss

if TYPE_CHECKING:
    from pebble import ProcessPool

TRIES = 3
_RECYCLED = 500  # recordings after which a process is replaced: whatever leaked is gone
_PR_SET_PDEATHSIG = 1
_START_S = 120.0
_LOOKS_S = 0.5
#: read by the processes when they load numpy and Arrow
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
Task = Callable[[ArchiveEntry, Orders], Answer]


class Guard:
    """Processes that do a task; `examine` may be called from as many threads.

    loads: modules that the task needs, which a process loads before its first recording
    """

    def __init__(
        self, processes: int, memory_bytes: int, task: Task, loads: tuple[str, ...] = ()
    ) -> None:
        if importlib.util.find_spec("pebble") is None:
            raise AhrsdError("fleet: pebble runs it; install it: pip install 'ahrsd[fleet]'")
        if multiprocessing.current_process().daemon:
            raise AhrsdError(
                "a process of this Dask worker may not start others: start it with --no-nanny"
            )
        from pebble import ProcessPool

        sweep()
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        self._task, self._memory_bytes, self._closed = task, memory_bytes, False
        self._pool: ProcessPool = ProcessPool(
            processes,
            max_tasks=_RECYCLED,
            initializer=_begin,
            initargs=(os.getpid(), memory_bytes, loads),
            context=multiprocessing.get_context("spawn"),
        )
        # the processes belong to the thread that starts them: this one, which outlives them
        self._pool.schedule(_ready, timeout=_START_S).result()

    def examine(self, entry: ArchiveEntry, orders: Orders) -> Answer:
        """The answer about a recording, whose row is on the disk; it waits for it."""
        for number in range(1, TRIES + 1):
            begun = time.monotonic()
            future = self._pool.schedule(
                self._task, args=[entry, orders], timeout=orders.limit_s or None
            )
            while not wait([future], _LOOKS_S).done:
                if self._closed:  # the pool leaves what it was at without an answer
                    raise CancelledError
            error = future.exception()
            if error is None:
                answer: Answer = future.result()
                return answer
            outcome, words = self._loss(error, orders)
            if self._closed:
                raise CancelledError
            if outcome == rows.CRASHED and number < TRIES:
                continue
            spent = time.monotonic() - begun
            return keep_loss(entry, orders, outcome, words, tries=number, seconds=spent)
        raise AssertionError("the last try returns")

    def _loss(self, error: BaseException, orders: Orders) -> tuple[str, str]:
        """The outcome that an error of a process is, and its words."""
        from pebble import ProcessExpired

        if isinstance(error, LateError):
            return rows.TOO_SLOW, f"stopped after {orders.limit_s:g} s (--limit)"
        if isinstance(error, MemoryError):
            return rows.TOO_LARGE, f"asked for more than {self._memory_bytes >> 20} MiB (--memory)"
        if isinstance(error, ProcessExpired):
            code = error.exitcode
            how = f"by signal {-code} ({_signal(-code)})" if code < 0 else f"with code {code}"
            return rows.CRASHED, f"its process ended {how}, {TRIES} times"
        return rows.BUG, f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the processes; what they were at has no row yet."""
        self._closed = True
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()


def _signal(number: int) -> str:
    return signal.Signals(number).name if number in signal.valid_signals() else "unknown"


def _begin(parent: int, memory_bytes: int, loads: tuple[str, ...]) -> None:
    """In a new process: end with the parent, load what a recording needs, and hold the limits."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before that took effect
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver's to answer
    logging.getLogger("ahrsd").setLevel(logging.CRITICAL)  # what a recording has to say: in its row
    for name in loads:  # now, so that the limit of time is the recording's alone
        importlib.import_module(name)
    if memory_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))


def _ready() -> int:
    return os.getpid()
