"""Announced sigmas beside the Cramer-Rao bound, over motions put together from pieces.

    python tests/benchmarks/estimator/bench_regimes.py --runs 120
    python tests/benchmarks/estimator/bench_regimes.py --runs 120 --seed 1000 --at-once 32
    python tests/benchmarks/estimator/bench_regimes.py --regimes --rates 10 40 100 --runs 6

Each run draws two to five pieces (level circles, roll, pitch, rest, eight headings with stops,
straight), a rate, a lag of the field and whether readings are held, and compares what the estimator
says at the end with the bound of the whole data, belief included (`montecarlo/cramer_rao.py`).
The bound takes the gyro's bias to be constant and the estimator lets it walk, so iron is judged
apart.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))
import crooked
import pieces

from ahrsd.estimator.parameters import (
    AS_SPECIFIED,
    ASSEMBLED,
    EstimatorParameters,
    Imperfections,
)
from ahrsd.samples import Array

INSTRUMENTS: dict[str, Imperfections | None] = {
    "perfect": None,
    "specified": AS_SPECIFIED,
    "assembled": ASSEMBLED,
    "iron-still": replace(ASSEMBLED, iron_gauss=1e-9),
}

REGIMES = {
    "circles, roll": (("circles", 100.0), ("roll", 60.0)),
    "roll, circles": (("roll", 60.0), ("circles", 100.0)),
    "eight, roll": (("eight", 80.0), ("roll", 40.0)),
    "rest, circles, pitch": (("rest", 60.0), ("circles", 60.0), ("pitch", 40.0)),
}


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One run: announced sigma over the bound (9,) of iron and (3,) of the gyro's bias.

    told: the bound's hard iron is known to a tenth of what is believed without data
    worst: largest error of any number, in its announced sigmas
    """

    seed: int
    name: str
    converged: bool
    told: bool
    iron: Array
    bias: Array
    nees: float
    worst: float
    cpu_s: float


def drawn(seed: int) -> tuple[list[tuple[str, float]], dict[str, float]]:
    """Pieces and how they are recorded."""
    rng = np.random.default_rng([seed, 7])
    kinds = rng.choice(pieces.KINDS, rng.integers(2, 6))
    motion = [(str(kind), float(rng.uniform(30, 100))) for kind in kinds]
    rate = float(rng.choice([10.0, 20.0, 40.0, 100.0], p=[0.3, 0.3, 0.3, 0.1]))
    lag_s = float(rng.choice([0.0, 0.025]))
    hold = int(rng.choice([1, 10])) if rate == 100.0 else 1
    return motion, {"rate_hz": rate, "lag_s": lag_s, "hold": hold}


def judged(
    motion: Sequence[tuple[str, float]],
    seed: int,
    at_once: int,
    instrument: Imperfections | None = None,
    **how: float,
) -> Judged:
    """One run of the estimator beside the bound; instrument: of which kind it is, None: perfect."""
    hold, parameters = int(how.get("hold", 1)), pieces.IDEAL
    made = pieces.drive(motion, seed, **how)
    if instrument is not None:
        made = crooked.imperfect(made, instrument, np.random.default_rng([seed, 11]), hold)
        parameters = EstimatorParameters()
    begun = time.process_time()
    found = pieces.answer(made, at_once=at_once, parameters=parameters)
    cpu_s = time.process_time() - begun
    if found is None:
        raise SystemExit(f"no answer to {motion}")
    bound = pieces.bound_sigmas(made, hold=hold, kind=instrument)
    ratio = np.sqrt(np.diag(found.covariance)) / bound
    name = " ".join(f"{kind}:{seconds:.0f}" for kind, seconds in motion)
    worst = float(np.max(np.abs(made.errors(found)) / np.sqrt(np.diag(found.covariance))))
    told = bool(np.all(bound[6:9] < 0.05))
    return Judged(
        seed, f"{name} {how}", found.converged, told, ratio[:9], ratio[9:],
        pieces.nees_of(made, found), worst, cpu_s,
    )  # fmt: skip


def run(seed: int, at_once: int, instrument: Imperfections | None = None) -> Judged:
    """The run that this seed draws; the lag of an instrument is its own."""
    motion, how = drawn(seed)
    if instrument is not None:
        how["lag_s"] = 0.0
    return judged(motion, seed, at_once, instrument, **how)


def table(title: str, runs: Sequence[Judged]) -> None:
    """Quantiles, and the shares of numbers below 0.9 and above 1.5 times the bound."""
    if not runs:
        return
    print(f"{title}: {len(runs)} runs, {sum(r.converged for r in runs)} converged")
    for name, each in (("iron", [r.iron for r in runs]), ("bias", [r.bias for r in runs])):
        all_ = np.concatenate(each)
        low, middle, high = np.quantile(all_, [0.0, 0.5, 0.95])
        most = all_.max()
        print(
            f"  {name}: least {low:.2f}, median {middle:.2f}, 95 % {high:.2f}, most {most:.2f}; "
            f"below 0.9: {np.mean(all_ < 0.9):.1%}, above 1.5: {np.mean(all_ > 1.5):.1%}"
        )
    nees = [r.nees for r in runs]
    far = np.mean([r.worst > 3.0 for r in runs])
    print(
        f"  NEES/dof: mean {np.mean(nees):.2f}, median {np.median(nees):.2f}, "
        f"most {max(nees):.1f}; some number beyond 3 sigma in {far:.1%} of the runs"
    )


def main() -> int:
    """Print the tables, and the runs that stand out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--at-once", type=int, default=1, help="1: a stream, 32: a recording")
    parser.add_argument("--regimes", action="store_true", help="four named changes of regime")
    parser.add_argument("--instrument", choices=INSTRUMENTS, default="perfect")
    parser.add_argument("--rates", type=float, nargs="+", default=[40.0])
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.runs)
    found = []
    if given.regimes:
        for name, motion in REGIMES.items():
            for rate in given.rates:
                for lag_s in (0.0, 0.025):
                    some = [
                        judged(motion, s, given.at_once, rate_hz=rate, lag_s=lag_s) for s in seeds
                    ]
                    table(f"{name}, {rate:g} Hz, lag {1e3 * lag_s:g} ms", some)
                    found += some
    else:
        found = [run(seed, given.at_once, INSTRUMENTS[given.instrument]) for seed in seeds]
    table("all", found)
    table("hard iron told", [r for r in found if r.told])
    table("converged", [r for r in found if r.converged])
    for r in found:
        if r.iron.min() < 0.9 or r.iron.max() > 1.5:
            state = ("" if r.told else "not told, ") + ("" if r.converged else "not ") + "converged"
            print(
                f"  seed {r.seed}: {r.iron.min():.2f} to {r.iron.max():.2f}, {state}, "
                f"{r.nees:.1f}: {r.name}"
            )
    print(f"CPU of the estimator: {sum(r.cpu_s for r in found):.1f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
