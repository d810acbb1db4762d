"""A function over tasks: one answer per task, whichever process dies, and a bounded number in
flight.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import psutil
import pytest
from patience import PATIENCE_S

from ahrsd.fleet.processes import (
    BUG,
    CRASHED,
    TOO_LARGE,
    TOO_SLOW,
    TRIES,
    Crew,
    Limits,
    Loss,
    Place,
    crew,
)


def squared(number: int) -> tuple[int, object]:
    return number, number**2


def going_wrong(number: int) -> tuple[int, object]:
    """Every fifth task fails, each in another way."""
    if number == 5:
        time.sleep(600.0)
    if number == 10:
        return 10, len(bytearray(4 << 30))
    if number == 15:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 20:
        raise KeyError("nobody foresaw it")
    return squared(number)


def words(number: int, loss: Loss) -> tuple[int, object]:
    return number, (loss.outcome, loss.words, loss.tries)


def blas(_: int) -> tuple[int, object]:
    return 0, os.environ["OPENBLAS_NUM_THREADS"]


def own_process(folder: Path, number: int) -> int:
    (folder / str(os.getpid())).touch()
    time.sleep(0.1)
    return number


def is_running(process: int) -> bool:
    """Whether a process runs; one that has ended may wait long to be reaped by another program."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def failed(_: int, loss: Loss) -> int:
    raise AssertionError(loss)


def test_every_task_has_one_answer_including_failures():
    tasks = range(25)
    with crew(Place(2), Limits(time_s=4.0, memory_bytes=1 << 30)) as workers:
        found = list(workers.map(going_wrong, tasks, words))
        again = dict(workers.map(squared, tasks, words))  # with the remaining processes
    assert sorted(task for task, _ in found) == list(tasks)
    assert all(task == answer[0] for task, answer in found)
    by_task = {task: answer[1] for task, answer in found}
    assert by_task.pop(5) == (TOO_SLOW, "stopped after 4 s", 1)
    assert by_task.pop(10) == (TOO_LARGE, "asked for more than 1024 MiB", 1)
    assert by_task.pop(15) == (CRASHED, "its process ended by signal 9 (SIGKILL), 3 times", TRIES)
    assert by_task.pop(20) == (BUG, "KeyError: 'nobody foresaw it'", 1)
    assert by_task == {task: task**2 for task in tasks if task not in (5, 10, 15, 20)}
    assert again == {task: (task, task**2) for task in tasks}


def test_killed_process_loses_no_task_and_all_processes_end(tmp_path):
    found: list[int] = []
    with crew(Place(2), Limits()) as workers:
        for number, (task, answer) in enumerate(
            workers.map(partial(own_process, tmp_path), range(30), failed)
        ):
            assert task == answer
            found.append(answer)
            if number == 10:
                os.kill(int(min(tmp_path.iterdir()).name), signal.SIGKILL)
    assert sorted(found) == list(range(30))
    processes = [int(path.name) for path in tmp_path.iterdir()]
    assert len(processes) >= 2
    end_s = time.monotonic() + PATIENCE_S
    while any(is_running(process) for process in processes):
        assert time.monotonic() < end_s
        time.sleep(0.02)


class GoneThere:
    """A task whose code exists in the parent and not in the process that receives it."""

    def __init__(self, number: int, here: int) -> None:
        self.number, self.here = number, here

    def __reduce__(self):
        return found_here, (self.number, self.here)


def found_here(number: int, here: int) -> GoneThere:
    if here not in (0, os.getpid()):
        raise ModuleNotFoundError("No module named 'moved_meanwhile'")
    return GoneThere(number, here)


def number_of(task: GoneThere) -> int:
    return task.number


def told(_: GoneThere, loss: Loss) -> tuple[str, str, int]:
    return loss.outcome, loss.words, loss.tries


def test_task_that_no_process_can_load_fails_and_others_continue():
    tasks = [GoneThere(number, os.getpid() if number == 1 else 0) for number in range(5)]
    with crew(Place(1), Limits()) as workers:
        found = {task.number: answer for task, answer in workers.map(number_of, tasks, told)}
    assert found.pop(1) == (BUG, "ModuleNotFoundError: No module named 'moved_meanwhile'", 1)
    assert found == {number: number for number in (0, 2, 3, 4)}


def test_tasks_are_lost_where_processes_do_not_start():
    with crew(Place(1, loads=("no_such_module",)), Limits()) as workers:
        ((_, found),) = workers.map(squared, [3], words)
    assert found == (3, (CRASHED, "no process could begin with it, 3 times", TRIES))


def as_function(number: int) -> object:
    return lambda: number


def test_answer_that_cannot_be_sent_is_a_failure():
    with crew(Place(1), Limits()) as workers:
        ((_, (outcome, said, tries)),) = workers.map(as_function, [3], of_function)
    assert (outcome, tries) == (BUG, 1)
    assert "lambda" in said


def of_function(_: int, loss: Loss) -> object:
    return loss.outcome, loss.words, loss.tries


def ends_at_once(number: int) -> tuple[int, object]:
    raise SystemExit(3)


def test_task_that_ends_its_process_is_lost_with_its_exit_code():
    with crew(Place(1), Limits()) as workers:
        ((_, found),) = workers.map(ends_at_once, [1], words)
    assert found == (1, (CRASHED, "its process ended with code 3, 3 times", TRIES))


class KilledOnce:
    """A task whose first process is killed while it takes it, so that it never begins."""

    def __init__(self, folder: Path, number: int, here: int = 0) -> None:
        self.folder, self.number, self.here = folder, number, here

    def __reduce__(self):
        return taken, (self.folder, self.number, os.getpid())


def taken(folder: Path, number: int, here: int) -> KilledOnce:
    if here != os.getpid() and number == 1 and not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return KilledOnce(folder, number)


def its_number(task: KilledOnce) -> int:
    time.sleep(0.05)
    return task.number


def test_process_killed_while_it_takes_a_task_holds_up_no_other(tmp_path):
    tasks = [KilledOnce(tmp_path, number) for number in range(8)]
    begun = time.monotonic()
    with crew(Place(2), Limits()) as workers:
        found = [answer for _, answer in workers.map(its_number, tasks, failed)]
    assert sorted(found) == list(range(8))
    assert (tmp_path / "killed").exists()
    assert time.monotonic() - begun < PATIENCE_S


def test_processes_hold_one_blas_thread(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with crew(Place(1), Limits()) as workers:
        ((_, found),) = workers.map(blas, [0], words)
    assert found == (0, "1")


def test_tasks_in_flight_are_limited_by_the_window():
    flying: list[tuple[int, Future[int]]] = []
    most = taken = 0

    def ask(do, task, lost):
        nonlocal most
        future: Future[int] = Future()
        flying.append((task, future))
        most = max(most, len(flying))
        if len(flying) == 5 or task == 99:
            for number, one in flying:
                one.set_result(do(number))
            flying.clear()
        return future

    def tasks():
        nonlocal taken
        for number in range(100):
            taken += 1
            yield number

    answers = Crew(ask, 5).map(lambda number: -number, tasks(), failed)
    assert next(answers)[1] <= 0
    assert taken <= 6
    assert len(list(answers)) == 99
    assert most == 5


def test_no_process_remains_after_an_exception(tmp_path):
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), crew(Place(2), Limits()) as workers:
        for _ in workers.map(partial(own_process, tmp_path), range(1000), failed):
            raise ZeroDivisionError
    assert not any(is_running(int(path.name)) for path in tmp_path.iterdir())
    deadline = time.monotonic() + 5.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    assert threading.active_count() == before
