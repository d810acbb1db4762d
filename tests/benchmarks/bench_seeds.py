"""The figures that the seeds print, beside the same methods here, ours and the floor.

    python tests/benchmarks/bench_seeds.py                                     # short: a minute
    python tests/benchmarks/bench_seeds.py --full --jobs 2 --cache DIR --output docs/validation

[R] Rodriguez-Martinez, thesis, PUC Chile 2023, chapters 5 and 6; [M] Rodriguez-Martinez & Troni,
Figure 4; [L] Lichlyter, thesis, Mississippi State 2022, chapter 3. `--cache` keeps the runs of each
part; a part that is there is not run again. `--output` gets seeds.md and seeds/figures.json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from seeds import chapter5, dive, norms, page, summary

PARTS = {"norms": norms.everything, "dive": dive.everything, "chapter5": chapter5.everything}


def each_of(jobs: int) -> chapter5.Each:
    """Runs one after the other, or in so many processes; says how far it is."""

    def one_by_one(
        what: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
    ) -> list[Any]:
        out = []
        for task in tasks:
            out.append(function(*task))
            _say(what, len(out), len(tasks))
        return out

    def beside(
        what: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]
    ) -> list[Any]:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read by the processes' numpy
        out = []
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            for future in [pool.submit(function, *task) for task in tasks]:
                out.append(future.result())
                _say(what, len(out), len(tasks))
        return out

    return one_by_one if jobs == 1 else beside


def _say(what: str, done: int, of: int) -> None:
    if done == of or done % 10 == 0:
        sys.stderr.write(f"{what}: {done} of {of}\n")


def runs_of(part: str, full: bool, jobs: int, cache: Path | None) -> Any:
    """All runs of a part, from the cache where it has them."""
    kept = None if cache is None else cache / f"{part}-{'full' if full else 'short'}.json"
    if kept is not None and kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    found = PARTS[part](full, each_of(jobs))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(found), encoding="utf-8")
    return json.loads(json.dumps(found))  # names of numbers become text, as from the cache


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, print the page, write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--full", action="store_true", help="as many runs as the seeds have")
    parser.add_argument("--jobs", type=int, default=1, help="processes beside each other")
    parser.add_argument("--cache", type=Path, help="folder of the runs of each part")
    parser.add_argument("--output", type=Path, help="folder for seeds.md and seeds/figures.json")
    chosen = parser.parse_args(arguments)
    runs = {part: runs_of(part, chosen.full, chosen.jobs, chosen.cache) for part in PARTS}
    figures = summary.of(runs, full=chosen.full)
    text = page.page(figures)
    if chosen.output is not None:
        (chosen.output / "seeds").mkdir(parents=True, exist_ok=True)
        said = json.dumps(figures, indent=1) + "\n"
        (chosen.output / "seeds" / "figures.json").write_text(said, encoding="utf-8")
        (chosen.output / "seeds.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
