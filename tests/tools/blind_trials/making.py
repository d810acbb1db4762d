"""Cases from the generator, which is run as a program of its own and never imported."""

from __future__ import annotations

import json
import os
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from ahrsd.errors import AhrsdError
from ahrsd.fleet.processes import Limits, Loss, Place, crew, end_with
from blind_trials.sealing import Json, Round, read_object, seal

GENERATOR = "blind_trials.world"
_AT_ONCE = 10  # cases of one run of the generator
_LIMIT_S = 600.0  # of such a run
RECORDINGS = Path(__file__).resolve().parents[4] / "shared" / "recordings"  # beside the checkout


def make(
    folder: Path,
    key_path: Path,
    ring: str,
    cases: int,
    *,
    seed: int | None = None,
    jobs: int = 1,
    recordings: Path | None = None,
    done: Callable[[int, int], None] | None = None,
) -> Round:
    """Generate and seal.  The seed is drawn in secret where none is given.

    done: called with cases written and all. AhrsdError where the folder is in use or the
    generator fails.
    """
    if folder.exists() and any(folder.iterdir()):
        raise AhrsdError(f"{folder}: is not empty; name a new folder")
    if key_path.resolve().is_relative_to(folder.resolve()):
        raise AhrsdError(f"{key_path}: lies among the cases; keep the key elsewhere")
    drawn = secrets.randbits(63) if seed is None else seed
    command = [
        *(sys.executable, "-m", GENERATOR, "--cases", str(cases), "--ring", ring),
        *("--seed", str(drawn), "--recordings", str(recordings or RECORDINGS)),
        *("-o", str(folder.resolve())),
    ]
    key_path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=key_path.resolve().parent) as scratch:
        keys = _generated(command, cases, jobs, Path(scratch), done)
    truths = sorted((one for key in keys for one in key["cases"]), key=lambda one: str(one["id"]))
    whole = {**keys[0], "cases": truths}
    key_path.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    return seal(folder, key_path)


def _generated(
    command: list[str],
    cases: int,
    jobs: int,
    scratch: Path,
    done: Callable[[int, int], None] | None,
) -> list[Json]:
    """The keys of all parts, in any order."""
    firsts = range(0, cases, _AT_ONCE)
    keys: list[Json] = []
    written = 0
    with crew(Place(jobs), Limits(time_s=_LIMIT_S)) as processes:
        make_part = partial(_part, command, cases, scratch)
        for first, words in processes.map(make_part, firsts, _lost):
            if words:
                raise AhrsdError(f"the generator failed: {words}")
            keys.append(read_object(scratch / f"{first}.json"))
            written += len(keys[-1]["cases"])
            if done is not None:
                done(written, cases)
    return keys


def _part(command: list[str], cases: int, scratch: Path, first: int) -> str:
    """Run the generator for some cases; its last words where it failed, else none."""
    last = min(first + _AT_ONCE, cases)
    key = scratch / f"{first}.json"
    ended = subprocess.run(
        [*command, "--some", str(first), str(last), "--key", str(key)],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=partial(end_with, os.getpid()),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        check=False,
        text=True,
    )
    said = ended.stderr.strip().splitlines()
    return (said[-1] if said else f"exit {ended.returncode}") if ended.returncode else ""


def _lost(_first: int, loss: Loss) -> str:
    return loss.words
