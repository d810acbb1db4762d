"""A process of its own round each task: a limit of time, one of memory, and a crash that stays one
answer.

Memory is limited by the kernel (RLIMIT_DATA), not by looking at the resident size again and again:
it holds at the moment of the allocation, so that a task that asks for 20 GB at once takes none of
them from its neighbours, and the refusal comes up in the task's own words. What is counted is
what was asked for; Arrow's own pool reserves a gigabyte that it never touches, so the processes use
the system's allocator.

A task whose process died is tried again, because whoever killed it may have meant another;
after `TRIES` it is lost, and so it is said. That includes one that no process began with: pebble
forgets a task whose process ended while it took it, as where the code that it needs is gone, and
gives up all processes where none of them was at work then. On a cluster every Dask worker has a
guard.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import multiprocessing
import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, wait
from concurrent.futures import TimeoutError as LateError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Protocol, TypeVar

from pebble import ProcessExpired, ProcessPool

from ahrsd.errors import AhrsdError

TOO_SLOW, TOO_LARGE, CRASHED, BUG = "too slow", "out of memory", "crashed", "internal error"
TRIES = 3
_RECYCLED = 500  # tasks after which a process is replaced: whatever leaked is gone
_PR_SET_PDEATHSIG = 1
_START_S = 120.0
_LOOKS_S = 0.5
#: read by the processes when they load numpy and Arrow
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}

_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True, slots=True)
class Limits:
    """Of each task; 0 is none.

    begin_s: within which a process begins with it, as many as tasks are asked for at once
    """

    time_s: float = 0.0
    memory_bytes: int = 0
    begin_s: float = _START_S


@dataclass(frozen=True, slots=True)
class Loss:
    """What is known of a task that gave no answer.

    outcome: TOO_SLOW, TOO_LARGE, CRASHED or BUG
    """

    outcome: str
    words: str
    tries: int
    seconds: float


class _NotBegunError(Exception):
    """No process took the task, or the one that did ended at that moment."""


class Ask(Protocol):
    """What takes a task: `Guard.ask`, but at once."""

    def __call__(  # noqa: D102
        self, do: Callable[[_T], _R], task: _T, lost: Callable[[_T, Loss], _R]
    ) -> Future[_R]: ...


class Guard:
    """Processes that do tasks; `ask` may be called from as many threads.

    loads: modules that the tasks need, which a process loads before its first one
    """

    def __init__(self, processes: int, limits: Limits, loads: tuple[str, ...] = ()) -> None:
        if multiprocessing.current_process().daemon:
            raise AhrsdError(
                "a process of this Dask worker may not start others: start it with --no-nanny"
            )
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        self._processes, self._limits, self._loads = processes, limits, loads
        self._closed, self._lock = False, threading.Lock()
        # the processes belong to the thread that starts them: this one, which outlives them
        self._pool = self._started()

    def _started(self) -> ProcessPool:
        pool = ProcessPool(
            self._processes,
            max_tasks=_RECYCLED,
            initializer=_begin,
            initargs=(os.getpid(), self._limits.memory_bytes, self._loads),
            context=multiprocessing.get_context("spawn"),
        )
        pool.schedule(_ready, timeout=_START_S).result()
        return pool

    def _in_place_of(self, broken: ProcessPool) -> None:
        """Other processes, unless another thread has started them."""
        with self._lock:
            if self._pool is broken and not self._closed:
                broken.stop()  # type: ignore[no-untyped-call]
                broken.join()
                self._pool = self._started()

    def ask(self, do: Callable[[_T], _R], task: _T, lost: Callable[[_T, Loss], _R]) -> _R:
        """What `do` answers to a task, or `lost` where it has no answer; it waits for it."""
        found = self._answer(do, task)
        return lost(task, found) if isinstance(found, Loss) else found

    def _answer(self, do: Callable[[_T], _R], task: _T) -> _R | Loss:
        for number in range(1, TRIES + 1):
            begun = time.monotonic()
            pool = self._pool
            try:
                future = pool.schedule(do, args=[task], timeout=self._limits.time_s or None)
                error = self._error(future)
            except RuntimeError as closed:  # all its processes ended
                error = BrokenProcessPool(str(closed))
            if error is None:
                return future.result()
            outcome, words = self._loss(error)
            if self._closed:
                raise CancelledError
            if isinstance(error, BrokenProcessPool):
                self._in_place_of(pool)
            if outcome == CRASHED and number < TRIES:
                continue
            return Loss(outcome, words, number, time.monotonic() - begun)
        raise AssertionError("the last try returns")

    def _error(self, future: Future[_R]) -> BaseException | None:
        """Wait for a task; its error, _NotBegunError where no process began with it."""
        until = time.monotonic() + self._limits.begin_s
        while not wait([future], _LOOKS_S).done:
            if self._closed:  # the pool leaves what it was at without an answer
                raise CancelledError
            if time.monotonic() > until and future.cancel():
                return _NotBegunError()
        return future.exception()

    def _loss(self, error: BaseException) -> tuple[str, str]:
        """The outcome that an error of a process is, and its words."""
        if isinstance(error, LateError):
            return TOO_SLOW, f"stopped after {self._limits.time_s:g} s"
        if isinstance(error, MemoryError):
            mib = self._limits.memory_bytes >> 20
            return TOO_LARGE, f"asked for more than {mib} MiB"
        if isinstance(error, ProcessExpired):
            code = error.exitcode
            how = f"by signal {-code} ({_signal(-code)})" if code < 0 else f"with code {code}"
            return CRASHED, f"its process ended {how}, {TRIES} times"
        if isinstance(error, BrokenProcessPool | _NotBegunError):
            return CRASHED, f"no process could begin with it, {TRIES} times"
        return BUG, f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the processes; what they were at has no answer."""
        self._closed = True
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()


def _signal(number: int) -> str:
    return signal.Signals(number).name if number in signal.valid_signals() else "unknown"


def end_with(parent: int) -> None:
    """In a new process: be killed as soon as the one that started it has died."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before that took effect
        os._exit(1)


def _begin(parent: int, memory_bytes: int, loads: tuple[str, ...]) -> None:
    """In a new process: end with the parent, load what a task needs, and hold the limits."""
    end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver's to answer
    logging.getLogger("ahrsd").setLevel(logging.CRITICAL)  # what a task has to say: in its answer
    for name in loads:  # now, so that the limit of time is the task's alone
        importlib.import_module(name)
    if memory_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))


def _ready() -> int:
    return os.getpid()
