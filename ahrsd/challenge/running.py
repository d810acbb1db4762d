"""A tool over all cases: one process per case, answers kept as they come, hashed at the end."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from ahrsd.challenge.sealing import Json, Round, close_answers, refuse_opened, write_object
from ahrsd.errors import AhrsdError

OURS = "ahrsd"
RIVALS = ("stlsq", "lasso-bic", "ruptures")
_TIMEOUT_S = 600.0


def command_of(tool: str) -> list[str]:
    """The command line of a tool; {case}, {spec} and {json} stand for files.

    AhrsdError for a tool that is neither known nor a command with these three in it.
    """
    files = ["{case}", "--spec", "{spec}", "--json", "{json}"]
    if tool == OURS:
        return [sys.executable, "-m", "ahrsd", "diagnose", *files]
    if tool in RIVALS:
        return [sys.executable, "-m", "ahrsd.challenge.rivals", tool, *files]
    parts = shlex.split(tool)
    if not {"{case}", "{json}"} <= set(parts):
        raise AhrsdError(
            f"no tool {tool!r}: there are {', '.join((OURS, *RIVALS))}, "
            "or a command line with {case}, {spec} and {json} in it"
        )
    return parts


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
    """
    refuse_opened(trial)
    command = command_of(tool)
    called = name or (tool if tool in (OURS, *RIVALS) else Path(command[0]).name)
    folder = trial.answers(called)
    folder.mkdir(parents=True, exist_ok=True)
    missing = [case for case in trial.cases if not (folder / f"{case}.json").exists()]
    finished = len(trial.cases) - len(missing)
    if done is not None:
        done(finished, len(trial.cases))
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(_answer, trial, case, command): case for case in missing}
        try:
            for future in as_completed(waiting):
                write_object(folder / f"{waiting[future]}.json", future.result())
                finished += 1
                if done is not None:
                    done(finished, len(trial.cases))
        finally:
            pool.shutdown(cancel_futures=True)
    return close_answers(trial, called)


def _answer(trial: Round, case: str, command: list[str]) -> Json:
    """What the tool said of one case; its failure in words where it said nothing."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "answer.json"
        files = {"case": trial.case(case), "spec": trial.spec(case), "json": out}
        filled = [part.format(**files) if "{" in part else part for part in command]
        begun = time.monotonic()
        try:
            ended = subprocess.run(
                filled,
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=False,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return {"case": case, "failure": str(error), "seconds": None, "answer": None}
        seconds = time.monotonic() - begun
        said = ended.stderr.strip().splitlines()
        record: Json = {
            "case": case,
            "exit": ended.returncode,
            "said": said[-1] if said else "",
            "seconds": round(seconds, 3),
            "failure": None,
            "answer": None,
        }
        try:
            record["answer"] = json.loads(out.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            record["failure"] = record["said"] or f"no answer, exit {ended.returncode}"
        return record
