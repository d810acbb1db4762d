"""A tool over all cases: one process per case, answers kept as they come, hashed at the end.

Each case is a task of `fleet.processes`: its process starts the tool, and the tool ends with it, at
the limit of time and wherever a run is killed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ahrsd.errors import AhrsdError
from ahrsd.fleet.processes import Limits, Loss, Place, crew, end_with
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
TIMEOUT_S = 600.0  # of a case
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
    missing = [case for case in trial.cases if case not in records]
    with crew(Place(jobs), Limits(time_s=TIMEOUT_S)) as processes:
        for case, record in processes.map(partial(_answer, trial, command), missing, _lost):
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


def _answer(trial: Round, command: list[str], case: str) -> Json:
    """What the tool said of one case; its failure in words where it said nothing."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "answer.json"
        files = {"case": trial.case(case), "spec": trial.spec(case), "json": out}
        filled = [part.format(**files) if "{" in part else part for part in command]
        ended = _timed(filled, Path(scratch) / "stderr")
        record = _record(case, ended)
        try:
            record["answer"] = json.loads(out.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            record["failure"] = ended.printed or f"no answer, exit {ended.code}"
        return record


def _lost(case: str, loss: Loss) -> Json:
    """The record of a case whose process took too long or died."""
    return _record(case, _Ended(None, "", loss.seconds, None)) | {"failure": loss.words}


def _record(case: str, ended: _Ended) -> Json:
    return {
        "case": case,
        "exit": ended.code,
        "said": ended.printed,
        "seconds": round(ended.seconds, 3),
        "cpu_seconds": None if ended.cpu_seconds is None else round(ended.cpu_seconds, 3),
        "failure": None,
        "answer": None,
    }


@dataclass(frozen=True, slots=True)
class _Ended:
    """code, cpu_seconds: None where the tool had to be ended"""

    code: int | None
    printed: str  # the last line on stderr
    seconds: float
    cpu_seconds: float | None


def _timed(command: list[str], errors: Path) -> _Ended:
    """Run to the end; wall and CPU seconds of this process alone."""
    begun = time.monotonic()
    try:
        with errors.open("wb") as stderr:
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                preexec_fn=partial(end_with, os.getpid()),  # noqa: PLW1509 - one thread here
            )
    except OSError as error:
        return _Ended(_NOT_FOUND, str(error), 0.0, 0.0)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return _Ended(
        process.returncode,
        lines[-1] if lines else "",
        time.monotonic() - begun,
        used.ru_utime + used.ru_stime,
    )
