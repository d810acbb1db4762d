"""A function over many tasks, each in a process of its own, on this machine or on a Dask cluster.

The one way in which ahrsd does many things at once: archives (`run`), Monte Carlo and the blind
trials. Answers come as they are made, each with its task, so that the order says nothing; no more
tasks are taken than the window holds, so that a million cost the memory of a few.

**Round each task** (`Guard`): a limit of time, one of memory, and a crash that stays one answer.
Memory is limited by the kernel (RLIMIT_DATA), not by looking at the resident size again and again:
it holds at the moment of the allocation, so that a task that asks for 20 GB at once takes none of
them from its neighbours, and the refusal comes up in the task's own words. What is counted is
what was asked for; Arrow's own pool reserves a gigabyte that it never touches, so the processes use
the system's allocator.

A task whose process died is tried again, because whoever killed it may have meant another;
after `TRIES` it is lost, and so it is said. That includes one that no process began with: pebble
forgets a task whose process ended while it took it, as where the code that it needs is gone, and
gives up all processes where none of them was at work then.

**On a cluster** every worker has a guard with a process for each of its threads. Dask distributes
and tries again what lay on a worker that died; it has no limits of time and memory for a task,
which is why the guard is there too. The rows' folder and the archive have to be the same for all
machines. Workers run without a nanny, which would leave them behind when it is killed.
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
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from concurrent.futures import TimeoutError as LateError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol, TypeVar

from pebble import ProcessExpired, ProcessPool

from ahrsd.errors import EXIT_BUSY, AhrsdError

# -- A process of its own round each task ----------------------------------------------------------


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
            if future.running():  # pebble would cancel it all the same, and kill its process
                continue
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


# -- A Dask cluster --------------------------------------------------------------------------------


START = "start some on every machine: dask worker {address} --no-nanny --nthreads CORES"
_WAIT_S = 5.0

_guards: dict[Limits, Guard] = {}  # of this worker
_lock = threading.Lock()


@contextmanager
def connected(address: str, limits: Limits, loads: tuple[str, ...]) -> Iterator[tuple[Ask, int]]:
    """What takes a task, and how many are done at once.  AhrsdError."""
    if importlib.util.find_spec("distributed") is None:
        raise AhrsdError("--cluster: Dask runs it; install it: pip install 'ahrsd[cluster]'")
    from distributed import Client
    from distributed.scheduler import KilledWorker

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is told in a line
    make: Any = Client
    try:
        client = make(address, timeout=_WAIT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterGoneError(
            address, f"no scheduler answers within {_WAIT_S:g} s ({error}); start one"
        ) from error
    with client:
        processes = sum(client.nthreads().values())
        if not processes:
            raise ClusterGoneError(address, f"has no workers; {START.format(address=address)}")
        executor = client.get_executor(pure=False)
        try:
            yield (
                lambda do, task, lost: executor.submit(on_worker, do, task, lost, limits, loads),
                processes,
            )
        except (CancelledError, KilledWorker) as error:
            raise ClusterGoneError(
                address,
                f"gave up ({type(error).__name__}); all rows so far are kept: start it again, "
                "then the same command",
            ) from error


class ClusterGoneError(AhrsdError):
    """No cluster, or no longer."""

    exit_code = EXIT_BUSY

    def __init__(self, address: str, what: str) -> None:
        super().__init__(f"--cluster {address}: {what}")


def on_worker(
    do: Callable[[_T], _R],
    task: _T,
    lost: Callable[[_T, Loss], _R],
    limits: Limits,
    loads: tuple[str, ...],
) -> _R:
    """The task of a Dask worker."""
    from distributed import get_worker

    worker: Any = get_worker()
    with _lock:
        if limits not in _guards:
            threads: int = worker.state.nthreads
            _guards[limits] = Guard(threads, limits, loads)
    return _guards[limits].ask(do, task, lost)


# -- Many tasks ------------------------------------------------------------------------------------


_WINDOW = 4  # tasks in flight for each process


@dataclass(frozen=True, slots=True)
class Place:
    """Where tasks are done: so many processes here, or a Dask cluster.

    loads: modules that the tasks need
    """

    jobs: int
    loads: tuple[str, ...] = ()
    cluster: str | None = None


@dataclass(frozen=True, slots=True)
class Crew:
    """Processes that do tasks.

    window: how many tasks may be in flight
    """

    ask: Ask
    window: int

    def map(
        self,
        do: Callable[[_T], _R],
        tasks: Iterable[_T],
        lost: Callable[[_T, Loss], _R],
    ) -> Iterator[tuple[_T, _R]]:
        """Every task with what `do` answers, as they come; with what `lost` makes of it where its
        process took too long, asked for too much memory, crashed or raised.

        do, lost: can be pickled; `lost` is called here, on a cluster by the worker
        """
        waiting = iter(tasks)
        flight: dict[Future[Any], _T] = {}

        def take(number: int) -> None:
            for task in islice(waiting, number):
                flight[self.ask(do, task, lost)] = task

        take(self.window)
        while flight:
            for future in wait(flight, return_when=FIRST_COMPLETED).done:
                task = flight.pop(future)
                answer = future.result()
                take(1)
                yield task, answer


@contextmanager
def crew(place: Place, limits: Limits) -> Iterator[Crew]:
    """Processes for as long as it takes; they end with this one, however it ends.  AhrsdError."""
    if place.cluster is not None:
        with connected(place.cluster, limits, place.loads) as (ask, processes):
            yield Crew(ask, _WINDOW * processes)
        return
    guard = Guard(place.jobs, limits, place.loads)
    threads = Threads(place.jobs, thread_name_prefix="crew")
    try:
        yield Crew(
            lambda do, task, lost: threads.submit(guard.ask, do, task, lost), _WINDOW * place.jobs
        )
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        guard.close()
