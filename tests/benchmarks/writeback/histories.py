"""Random histories of a daemon that writes, judged by an observer outside of it.

    python tests/benchmarks/writeback/histories.py --histories 100000 --seed 1 --json FILE

Parts: `histories` (write_histories.py), `moments` (every event at every moment of an
ordinary history, with --moments), `clients` (a driver that saves all of RAM, --clients N), `aside`
(every event at every moment of what follows from such a save in a trial, with --aside) and `real`
(whole histories with the estimator itself, --real N).
Done in chunks: the file is written after each, and a later call with the same seed and file goes on
where this one ended (`--seconds` ends each part). Exit code 1 where a violation was seen; each is
named with its seed and number, and `--only NUMBER` tells that history's story.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from campaign import added

Tally = dict[str, Any]
MOST_NAMED = 200


def histories_chunk(chunk: range, seed: int) -> Tally:
    """Random histories with the fitted sphere."""
    return played("run_one", chunk, seed)


def moments_chunk(chunk: range, seed: int) -> Tally:
    """Every event at every moment; the number counts through events, moments and streams."""
    return played("run_moment", chunk, seed)


def clients_chunk(chunk: range, seed: int) -> Tally:
    """Random histories with a driver on a shared port that saves."""
    return played("run_with_client", chunk, seed)


def aside_chunk(chunk: range, seed: int) -> Tally:
    """Every event at every moment behind a client's save in a trial."""
    return played("run_aside", chunk, seed)


def played(how: str, chunk: range, seed: int) -> Tally:
    """These histories with the fitted sphere."""
    import write_histories
    from scripted_world import fitted

    tally = write_histories.HistoriesTally()
    with fitted():
        for number in chunk:
            getattr(write_histories, how)(number, seed, tally)
    return dict(vars(tally))


def real_chunk(chunk: range, seed: int) -> Tally:
    """Whole histories with the estimator and the gates as they come."""
    import write_histories

    tally = write_histories.HistoriesTally()
    for number in chunk:
        write_histories.run_real(number, seed, tally)
    return dict(vars(tally))


PARTS: dict[str, tuple[int, Callable[[range, int], Tally]]] = {
    "histories": (100, histories_chunk),
    "moments": (50, moments_chunk),
    "clients": (100, clients_chunk),
    "aside": (50, aside_chunk),
    "real": (1, real_chunk),
}


def work(task: tuple[str, int, int, int]) -> tuple[int, float, Tally]:
    """One chunk, in a process of its own, and the processor's seconds that it took."""
    name, index, wanted, seed = task
    size, do = PARTS[name]
    begun = time.process_time()
    tally = do(range(index * size, min((index + 1) * size, wanted)), seed)
    return index, time.process_time() - begun, tally


def run_part(
    name: str, wanted: int, options: argparse.Namespace, found: Tally, keep: Callable[[], None]
) -> None:
    """Do the chunks of a part that are not in `found` yet, and add them to it."""
    size = PARTS[name][0]
    begun, done = time.monotonic(), set(found.setdefault("chunks", []))
    tasks = [(name, k, wanted, options.seed) for k in range(-(-wanted // size)) if k not in done]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for index, took_cpu_s, tally in pool.imap_unordered(work, tasks):
            found["tally"] = added(found["tally"], tally) if "tally" in found else tally
            del found["tally"]["wrong"][MOST_NAMED:]
            found["chunks"] = sorted([*found["chunks"], index])
            found["runs"] = sum(min(size, wanted - k * size) for k in found["chunks"])
            found["cpu_s"] = round(found.get("cpu_s", 0.0) + took_cpu_s, 1)
            keep()
            took_s, wrong = time.monotonic() - begun, sum(found["tally"]["violations"].values())
            print(
                f"\r{name}: {found['runs']} of {wanted}, {wrong} violations, {took_s:.0f} s, "
                f"{found['runs'] / found['cpu_s']:.1f} a second of processor ",
                end="",
                file=sys.stderr,
            )
            if took_s > options.seconds:
                pool.terminate()
                break
    print(file=sys.stderr)
    keep()


def tell(number: int, seed: int) -> None:
    """One history, step by step."""
    import write_histories
    from scripted_world import fitted

    tally = write_histories.HistoriesTally()
    with fitted():
        world = write_histories.run_one(number, seed, tally)
    lines = [(at_s, 2, f"{state} <- {why}") for at_s, state, why in world.states]
    lines += [(at_s, 1, text) for at_s, text in world.notes]
    lines += [(at_s, 0, f"unit {serial} is at the cable") for at_s, serial in world.cable.attached]
    lines += [(at_s, 0, f"the vehicle's iron is {v}") for at_s, v in world.unit.vehicle.moved]
    lines += [
        (c.at_s, 0, f"unit {c.serial}: {c.what} by {c.who} {c.register or ''} {c.asked}")
        for c in world.cable.log()
    ]
    lines += [(at_s, 0, label) for at_s, label in world.moments if "VN" not in label]
    for at_s, _, text in sorted(lines, key=lambda line: line[:2]):
        print(f"{at_s:8.3f} s  {text}")
    print("\n".join(tally.wrong) or "nothing that must not be was seen")


def main() -> int:
    """Run the parts; exit code 1 where something was seen that must not be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--histories", type=int, default=100_000)
    parser.add_argument("--moments", type=int, default=0, help="-1: all there are")
    parser.add_argument("--clients", type=int, default=0)
    parser.add_argument("--aside", type=int, default=0, help="-1: all there are")
    parser.add_argument("--real", type=int, default=0, help="with the estimator itself")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1, choices=[1, 2])
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most, per part")
    parser.add_argument("--json", type=Path, help="result; what is there already is not repeated")
    parser.add_argument("--only", type=int, help="tell the story of one history")
    options = parser.parse_args()
    if options.only is not None:
        tell(options.only, options.seed)
        return 0
    result: Tally = {"seed": options.seed, "python": platform.python_version(), "parts": {}}
    if options.json is not None and options.json.exists():
        result = json.loads(options.json.read_text())
        if result["seed"] != options.seed:
            parser.error(f"{options.json} is of seed {result['seed']}")

    def keep() -> None:
        if options.json is not None:
            options.json.write_text(json.dumps(result, indent=1) + "\n")

    if options.moments < 0 or options.aside < 0:
        import write_histories

        every = {"moments": write_histories.moments(), "aside": write_histories.aside_moments()}
        for name, most in every.items():
            setattr(options, name, most if getattr(options, name) < 0 else getattr(options, name))
    for name in PARTS:
        if wanted := getattr(options, name):
            run_part(name, wanted, options, result["parts"].setdefault(name, {}), keep)
    wrong = [
        f"{name}: {kind} {count}"
        for name, part in result["parts"].items()
        for kind, count in part["tally"]["violations"].items()
    ]
    print("\n".join(wrong) or "nothing that must not be was seen")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
