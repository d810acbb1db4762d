"""A function over many tasks, on guarded processes of this machine or of a Dask cluster.

The one way in which ahrsd does many things at once: archives (`driver`), Monte Carlo and the blind
trials. Answers come as they are made, each with its task, so that the order says nothing; no more
tasks are taken than the window holds, so that a million cost the memory of a few.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import ThreadPoolExecutor as Threads
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from ahrsd.fleet.guard import Ask, Guard, Limits, Loss

_WINDOW = 4  # tasks in flight for each process

_T = TypeVar("_T")
_R = TypeVar("_R")


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
        from ahrsd.fleet.cluster import connected

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
