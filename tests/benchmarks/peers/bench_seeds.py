"""The figures that the seeds print, beside the same methods here, ours and the floor.

    python tests/benchmarks/peers/bench_seeds.py
        # short: half a minute
    python tests/benchmarks/peers/bench_seeds.py
        --runs 100 --jobs 2 --cache DIR --output docs/validation

[R] Rodriguez-Martinez, thesis, PUC Chile 2023, chapters 5 and 6; [M] Rodriguez-Martinez & Troni,
Figure 4; [L] Lichlyter, thesis, Mississippi State 2022, chapter 3. `--cache` keeps each run: what
was stopped or is to be larger goes on; another version of the code needs another folder. `--output`
gets seeds.md and seeds/figures.json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from seed_figures import chapter5, dive, norms, page, summary

PARTS = {"norms": norms.everything, "chapter5": chapter5.everything, "dive": dive.everything}


class Runs:
    """Runs of any function, one after the other or in processes; each is kept where asked."""

    def __init__(self, jobs: int, cache: Path | None) -> None:
        self.jobs, self.cache = jobs, cache

    def each(
        self, what: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
    ) -> list[Any]:
        """Results in the order of the tasks; what is in the cache is not run again."""
        path = None if self.cache is None else self.cache / f"{function.__name__}.jsonl"
        known = {} if path is None else kept(path)
        missing = [task for task in tasks if json.dumps(task) not in known]
        for task, result in self._done(function, missing):
            known[json.dumps(task)] = json.loads(json.dumps(result))
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                with path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([task, result]) + "\n")
            sys.stderr.write(f"{what}: {' '.join(map(str, task[:3]))}\n")
        return [known[json.dumps(task)] for task in tasks]

    def _done(
        self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[tuple[Any, ...], Any]]:
        if self.jobs == 1 or len(tasks) < 2:
            for task in tasks:
                yield task, function(*task)
            return
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read by the processes' numpy
        with ProcessPoolExecutor(self.jobs, mp_context=get_context("spawn")) as pool:
            waiting = {pool.submit(function, *task): task for task in tasks}
            for future in as_completed(waiting):
                yield waiting[future], future.result()


def kept(path: Path) -> dict[str, Any]:
    """Results by task; a last line that was cut is run again."""
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            task, result = json.loads(line)
        except json.JSONDecodeError:
            continue
        found[json.dumps(task)] = result
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, print the page, write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--runs", type=int, default=1, help="of [R]'s sets; 1 is the short form")
    parser.add_argument("--jobs", type=int, default=1, help="processes beside each other")
    parser.add_argument("--cache", type=Path, help="folder of the runs already done")
    parser.add_argument("--output", type=Path, help="folder for seeds.md and seeds/figures.json")
    chosen = parser.parse_args(arguments)
    if chosen.runs < 1 or chosen.jobs < 1:
        parser.error("--runs and --jobs must be at least 1")
    each = Runs(chosen.jobs, chosen.cache).each
    runs = {part: everything(chosen.runs, each) for part, everything in PARTS.items()}
    figures = summary.of(json.loads(json.dumps(runs)))
    text = page.page(figures)
    if chosen.output is not None:
        (chosen.output / "seeds").mkdir(parents=True, exist_ok=True)
        said = json.dumps(figures, indent=1) + "\n"
        (chosen.output / "seeds" / "figures.json").write_text(said, encoding="utf-8")
        (chosen.output / "seeds.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
