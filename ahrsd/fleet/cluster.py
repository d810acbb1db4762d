"""The same task on a Dask cluster: every worker has a guard with a process for each of its threads.

Dask distributes and tries again what lay on a worker that died; it has no limits of time and memory
for a task, which is why the guard is there too. The rows' folder and the archive have to be the
same for all machines. Workers run without a nanny, which would leave them behind when it is killed.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any

from ahrsd.errors import EXIT_BUSY, AhrsdError
from ahrsd.fleet.archive import ArchiveEntry
from ahrsd.fleet.guard import Guard, Task
from ahrsd.fleet.work import Answer, Orders

START = "start some on every machine: dask worker {address} --no-nanny --nthreads CORES"
_WAIT_S = 20.0

_guards: dict[int, Guard] = {}  # of this worker, by their limits of memory
_lock = threading.Lock()


@contextmanager
def connected(
    address: str, orders: Orders, task: Task, loads: tuple[str, ...]
) -> Iterator[tuple[Callable[[ArchiveEntry], Future[Answer]], int]]:
    """What takes a recording, and how many are examined at once.  AhrsdError."""
    if importlib.util.find_spec("distributed") is None:
        raise AhrsdError("--cluster: Dask runs it; install it: pip install 'ahrsd[cluster]'")
    from distributed import Client
    from distributed.scheduler import KilledWorker

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is told in a line
    make: Any = Client
    try:
        client = make(address, timeout=_WAIT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterGoneError(address, f"no scheduler answers ({error}); start one") from error
    with client:
        processes = sum(client.nthreads().values())
        if not processes:
            raise ClusterGoneError(address, f"has no workers; {START.format(address=address)}")
        executor = client.get_executor(pure=False)
        try:
            yield lambda entry: executor.submit(on_worker, entry, orders, task, loads), processes
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


def on_worker(entry: ArchiveEntry, orders: Orders, task: Task, loads: tuple[str, ...]) -> Answer:
    """The task of a Dask worker."""
    from distributed import get_worker

    worker: Any = get_worker()
    with _lock:
        if orders.memory_bytes not in _guards:
            threads: int = worker.state.nthreads
            _guards[orders.memory_bytes] = Guard(threads, orders.memory_bytes, task, loads)
    return _guards[orders.memory_bytes].examine(entry, orders)
