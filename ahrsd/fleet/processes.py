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

Each thread that asks has a process and a pipe of its own, and nothing is shared between them: a
process that is killed while it takes or answers a task holds up no other one, as it would where all
wait for one queue with its lock. A task whose process died is tried again, because whoever killed
it may have meant another; after `TRIES` it is lost, and the answer says so.

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
import pickle
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import connection
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeVar

from ahrsd.errors import EXIT_BUSY, AhrsdError

# -- A process of its own round each task ----------------------------------------------------------


TOO_SLOW, TOO_LARGE, CRASHED, BUG = "too slow", "out of memory", "crashed", "internal error"
TRIES = 3
_RECYCLED = 500  # tasks after which a process is replaced: whatever leaked is gone
_PR_SET_PDEATHSIG = 1
_START_S = 120.0  # within which a process has loaded what the tasks need
_END_S = 5.0  # within which a process ends that has closed its pipe; it is killed then
#: read by the processes when they load numpy and Arrow
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}

_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True, slots=True)
class Limits:
    """Of each task; 0 is none."""

    time_s: float = 0.0
    memory_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Loss:
    """What is known of a task that gave no answer.

    outcome: TOO_SLOW, TOO_LARGE, CRASHED or BUG
    """

    outcome: str
    words: str
    tries: int
    seconds: float


class Ask(Protocol):
    """What takes a task: `Guard.ask`, but at once."""

    def __call__(  # noqa: D102
        self, do: Callable[[_T], _R], task: _T, lost: Callable[[_T, Loss], _R]
    ) -> Future[_R]: ...


class Guard:
    """Processes that do tasks, one for each thread that calls `ask`.

    loads: modules that the tasks need, which a process loads before its first one
    """

    def __init__(self, limits: Limits, loads: tuple[str, ...] = ()) -> None:
        if multiprocessing.current_process().daemon:
            raise AhrsdError(
                "a process of this Dask worker may not start others: start it with --no-nanny"
            )
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        self._limits, self._loads = limits, loads
        self._closed, self._lock = False, threading.Lock()
        self._processes: dict[int, _Process] = {}  # by the thread that uses it

    def ask(self, do: Callable[[_T], _R], task: _T, lost: Callable[[_T, Loss], _R]) -> _R:
        """What `do` answers to a task, or `lost` where it has no answer; it waits for it."""
        begun = time.monotonic()
        message = pickle.dumps((do, task))
        for number in range(1, TRIES + 1):
            outcome, answer = self._answer(message)
            if self._closed:
                raise CancelledError
            if outcome is None:
                return answer  # type: ignore[no-any-return]
            if outcome != CRASHED:
                return lost(task, Loss(outcome, answer, number, time.monotonic() - begun))
        words = f"{answer}, {TRIES} times"
        return lost(task, Loss(CRASHED, words, TRIES, time.monotonic() - begun))

    def _answer(self, message: bytes) -> tuple[str | None, Any]:
        """None and the answer, or an outcome without one and its words."""
        process = self._process()
        if not process.is_ready():
            process.end()
            return CRASHED, "no process could begin with it"
        time_s = self._limits.time_s or None
        try:
            reply = process.exchange(message, time_s)
        except TimeoutError:
            process.end()
            return TOO_SLOW, f"stopped after {time_s:g} s"
        except _ProcessEndedError as ended:
            return CRASHED, f"its process ended {ended}"
        outcome, answer = pickle.loads(reply)
        if outcome == TOO_LARGE:
            answer = f"asked for more than {self._limits.memory_bytes >> 20} MiB"
        return outcome, answer

    def _process(self) -> _Process:
        """The calling thread's; another one where that has ended or done enough."""
        thread = threading.get_ident()
        with self._lock:
            if self._closed:
                raise CancelledError
            process = self._processes.get(thread)
            if process is None or process.has_ended() or process.tasks >= _RECYCLED:
                if process is not None:
                    process.end()
                process = self._processes[thread] = _Process(self._limits, self._loads)
            return process

    def close(self) -> None:
        """End the processes; what they were at has no answer."""
        with self._lock:
            self._closed = True
            for process in self._processes.values():
                process.end()


class _ProcessEndedError(Exception):
    """A process ended while it had a task; how it did."""


class _Process:
    """A process that does one task after the other, used by the thread that starts it.

    The kernel ends it with that thread (`end_with`).
    """

    _starting = threading.Lock()  # multiprocessing keeps a set of all processes

    def __init__(self, limits: Limits, loads: tuple[str, ...]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, its_pipe = context.Pipe()
        arguments = (its_pipe, os.getpid(), limits.memory_bytes, loads)
        self._process = context.Process(target=_do_tasks, args=arguments, daemon=True)
        with self._starting:
            self._process.start()
        its_pipe.close()
        self.tasks = 0

    def is_ready(self) -> bool:
        """Wait until it has loaded what the tasks need; False where it does not come to that."""
        if self.tasks:
            return True
        try:
            return self._receive(_START_S) == _READY
        except (_ProcessEndedError, TimeoutError):
            return False

    def exchange(self, message: bytes, time_s: float | None) -> bytes:
        """Its reply to a task.  _ProcessEndedError; TimeoutError after `time_s`."""
        self.tasks += 1
        try:
            self._pipe.send_bytes(message)
        except OSError:
            raise _ProcessEndedError(self._how()) from None
        return self._receive(time_s)

    def _receive(self, time_s: float | None) -> bytes:
        ready = connection.wait([self._pipe, self._process.sentinel], time_s)
        if not ready:
            raise TimeoutError
        with suppress(EOFError, OSError):  # its end of the pipe is closed: it ends as well
            if self._pipe.poll():
                return self._pipe.recv_bytes()
        raise _ProcessEndedError(self._how())

    def _how(self) -> str:
        connection.wait([self._process.sentinel], _END_S)
        self.end()
        code = self._process.exitcode or 0
        return f"by signal {-code} ({_signal(-code)})" if code < 0 else f"with code {code}"

    def has_ended(self) -> bool:
        """Whether it runs no more."""
        return bool(connection.wait([self._process.sentinel], 0.0))

    def end(self) -> None:
        """Kill it, where it has not ended."""
        with self._starting:
            self._process.kill()
            self._process.join()


def _signal(number: int) -> str:
    return signal.Signals(number).name if number in signal.valid_signals() else "unknown"


def end_with(parent: int) -> None:
    """In a new process: be killed as soon as the one that started it has died."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before that took effect
        os._exit(1)


_READY = b"ready"


def _do_tasks(
    pipe: Connection[Any, Any], parent: int, memory_bytes: int, loads: tuple[str, ...]
) -> None:
    """In a new process: load what a task needs, hold the limit, and answer one task at a time."""
    end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver's to answer
    logging.getLogger("ahrsd").setLevel(logging.CRITICAL)  # what a task has to say: in its answer
    for name in loads:  # now, so that the limit of time is the task's alone
        importlib.import_module(name)
    if memory_bytes:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    pipe.send_bytes(_READY)
    while True:
        pipe.send_bytes(_reply(pipe.recv_bytes()))


def _reply(message: bytes) -> bytes:
    """An outcome, None where there is an answer, with the answer or words, as bytes."""
    try:
        do, task = pickle.loads(message)
        return pickle.dumps((None, do(task)))
    except MemoryError:
        return pickle.dumps((TOO_LARGE, ""))
    except Exception as error:  # noqa: BLE001 - whatever a task's own code raises
        return pickle.dumps((BUG, f"{type(error).__name__}: {error}"))


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
    with _lock:
        if limits not in _guards:
            _guards[limits] = Guard(limits, loads)
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
    guard = Guard(limits, place.loads)
    threads = Threads(place.jobs, thread_name_prefix="crew")
    try:
        yield Crew(
            lambda do, task, lost: threads.submit(guard.ask, do, task, lost), _WINDOW * place.jobs
        )
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        guard.close()
