"""A tool over all cases: one process per case, answers kept as they come, hashed at the end."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from ahrsd.errors import AhrsdError
from blind_trials.sealing import (
    Json,
    Round,
    close_answers,
    read_object,
    refuse_opened,
    write_object,
)

OURS = "ahrsd"
RIVALS = ("stlsq", "lasso-bic", "ruptures")
_TIMEOUT_S = 600.0
_TRIED = 10  # cases that say nothing of any tool: one that answered none of so many cannot run here
_NOT_FOUND = 127  # the exit code that every shell gives to a program that it cannot start
#: last words of a tool that lacks a package: of our rivals, and of any program in Python
_LACKS = re.compile(r"\S+ needs [\w.]+; install |(ModuleNotFoundError|ImportError):")


def command_of(tool: str) -> list[str]:
    """The command line of a tool; {case}, {spec} and {json} stand for files.

    AhrsdError for a tool that is neither known nor a command with these three in it.
    """
    files = ["{case}", "--spec", "{spec}", "--json", "{json}"]
    if tool == OURS:
        return [sys.executable, "-m", "ahrsd", "diagnose", *files]
    if tool in RIVALS:
        return [sys.executable, "-m", "blind_trials.rivals", tool, *files]
    parts = shlex.split(tool)
    if not {"{case}", "{json}"} <= set(parts):
        raise AhrsdError(
            f"no tool {tool!r}: there are {', '.join((OURS, *RIVALS))}, "
            "or a command line with {case}, {spec} and {json} in it"
        )
    return parts


def could_not_run(record: Json) -> str | None:
    """Why the tool did not run at all on a case; None where it did, whatever came of it."""
    if isinstance(record.get("answer"), dict):
        return None
    why = str(record.get("failure") or "")
    absent = record.get("exit") == _NOT_FOUND or _LACKS.match(why)
    return (why or f"exit {_NOT_FOUND}") if absent else None


def refuse_unable(tool: str) -> None:
    """AhrsdError, with what to install, for a tool that cannot run here."""
    command = command_of(tool)
    if tool in RIVALS:
        checked = subprocess.run(
            [sys.executable, "-m", "blind_trials.rivals", tool, "--check"],
            check=False,
            capture_output=True,
            text=True,
        )
        if checked.returncode:
            words = checked.stderr.strip().splitlines() or [f"exit {checked.returncode}"]
            raise AhrsdError(f"--tool {tool} cannot run here: {words[-1]}")
    elif shutil.which(command[0]) is None:
        raise AhrsdError(
            f"--tool: there is no program {command[0]} here; install it or give its whole path"
        )


def answered_nothing(records: Iterable[Json]) -> str | None:
    """The last words of a tool that has no answer to any of these cases; None where it has one."""
    found = list(records)
    if not found or any(isinstance(record.get("answer"), dict) for record in found):
        return None
    return str(found[-1].get("failure") or "no answer")


def _kept(folder: Path, cases: Sequence[str]) -> dict[str, Json]:
    """The answers of a run that was stopped, without those of a tool that could not run."""
    paths = {case: folder / f"{case}.json" for case in cases}
    found = {case: read_object(path) for case, path in paths.items() if path.exists()}
    if answered_nothing(found.values()):
        return {}
    return {case: record for case, record in found.items() if could_not_run(record) is None}


def run(
    trial: Round,
    tool: str,
    *,
    name: str | None = None,
    jobs: int = 1,
    done: Callable[[int, int], None] | None = None,
) -> str:
    """Answer every case that has no answer yet, then close the answers; their hash.

    name: the folder of the answers, the tool's name if None. A stopped run goes on where it was.
    AhrsdError for a tool that cannot run, before the first case or as soon as it shows.
    """
    refuse_opened(trial)
    command = command_of(tool)
    refuse_unable(tool)
    called = name or (tool if tool in (OURS, *RIVALS) else Path(command[0]).name)
    folder = trial.answers(called)
    folder.mkdir(parents=True, exist_ok=True)
    records = _kept(folder, trial.cases)
    if done is not None:
        done(len(records), len(trial.cases))
    for case, record in _answers(
        trial, [c for c in trial.cases if c not in records], command, jobs
    ):
        records[case] = record
        why = could_not_run(record)
        if len(records) >= min(_TRIED, len(trial.cases)):
            why = why or answered_nothing(records.values())
        if why:
            raise AhrsdError(f"{called} cannot run here: {why}; no answers were closed")
        write_object(folder / f"{case}.json", record)
        if done is not None:
            done(len(records), len(trial.cases))
    return close_answers(trial, called)


def _answers(
    trial: Round, cases: Sequence[str], command: list[str], jobs: int
) -> Iterator[tuple[str, Json]]:
    """Case and record as they come; what has not begun is dropped where the caller stops."""
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(_answer, trial, case, command): case for case in cases}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _answer(trial: Round, case: str, command: list[str]) -> Json:
    """What the tool said of one case; its failure in words where it said nothing."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "answer.json"
        files = {"case": trial.case(case), "spec": trial.spec(case), "json": out}
        filled = [part.format(**files) if "{" in part else part for part in command]
        ended = _timed(filled, Path(scratch) / "stderr")
        record: Json = {
            "case": case,
            "exit": ended.code,
            "said": ended.printed,
            "seconds": round(ended.seconds, 3),
            "cpu_seconds": round(ended.cpu_seconds, 3),
            "failure": None,
            "answer": None,
        }
        try:
            record["answer"] = json.loads(out.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            record["failure"] = ended.printed or f"no answer, exit {ended.code}"
        return record


@dataclass(frozen=True, slots=True)
class _Ended:
    code: int
    printed: str  # the last line on stderr
    seconds: float
    cpu_seconds: float


def _timed(command: list[str], errors: Path) -> _Ended:
    """Run to the end or to the time limit; wall and CPU seconds of this process alone."""
    begun = time.monotonic()
    try:
        with errors.open("wb") as stderr:
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
    except OSError as error:
        return _Ended(_NOT_FOUND, str(error), 0.0, 0.0)
    limit = threading.Timer(_TIMEOUT_S, process.kill)
    limit.start()
    _, status, used = os.wait4(process.pid, 0)
    limit.cancel()
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return _Ended(
        process.returncode,
        lines[-1] if lines else "",
        time.monotonic() - begun,
        used.ru_utime + used.ru_stime,
    )
