"""Cases from the generator, which is run as a program of its own and never imported."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from ahrsd.errors import AhrsdError
from blind_trials.sealing import Round, seal

GENERATOR = "blind_trials.world"
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
    command = [
        *(sys.executable, "-m", GENERATOR, "--cases", str(cases), "--ring", ring),
        *("--jobs", str(jobs), "--recordings", str(recordings or RECORDINGS)),
        *("-o", str(folder.resolve()), "--key", str(key_path.resolve())),
        *(() if seed is None else ("--seed", str(seed))),
    ]
    _follow(command, done)
    return seal(folder, key_path)


def _follow(command: list[str], done: Callable[[int, int], None] | None) -> None:
    """Run the generator; its first line has the number of cases, then a line comes for each."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        if process.stdout is None or process.stderr is None:
            raise AssertionError("pipes were asked for")
        total = int((process.stdout.readline().split() or ["0"])[0])
        for number, _line in enumerate(process.stdout, start=1):
            if done is not None:
                done(number, total)
        said = process.stderr.read().strip().splitlines()
    if process.returncode != 0:
        raise AhrsdError(f"the generator failed: {said[-1] if said else process.returncode}")
