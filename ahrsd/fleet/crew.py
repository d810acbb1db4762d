"""A function over many tasks, on guarded processes of this machine or of a Dask cluster.

The one way in which ahrsd does many things at once: archives (`driver`), Monte Carlo and the blind
trials. Answers come as they are made, each with its task, so that the order says nothing; no more
tasks are taken than the window holds, so that a million cost the memory of a few.

**On a cluster** every worker has a guard with a process for each of its threads. Dask distributes
and tries again what lay on a worker that died; it has no limits of time and memory for a task,
which is why the guard is there too. The rows' folder and the archive have to be the same for all
machines. Workers run without a nanny, which would leave them behind when it is killed.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from ahrsd.errors import EXIT_BUSY, AhrsdError
from ahrsd.fleet.guard import Ask, Guard, Limits, Loss

# -- A Dask cluster --------------------------------------------------------------------------------


START = "start some on every machine: dask worker {address} --no-nanny --nthreads CORES"
_WAIT_S = 5.0

_T = TypeVar("_T")
_R = TypeVar("_R")

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
