"""What untouched real recordings leave: the sizes of `ahrsd/diagnosis/one_model/priors.py`.

    python tests/benchmarks/diagnosis/bench_remainder_priors.py --measured SIZES.json [--only WORD]
    python tests/benchmarks/diagnosis/bench_remainder_priors.py --table SIZES.json

The first fits the richest model to each untouched recording beside the project and keeps, for each
component of the ordinary remainder, how likely each size is beside all others (some five minutes of
CPU; it goes on where it stopped).  The second finds the lognormal law of each size that makes all
recordings together likeliest, and prints it as it stands in the module.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bench_ordinary import AT_REST, DISTURBED, DOUBTFUL, FOLDERS, RECORDINGS
from scipy.optimize import minimize

from ahrsd.diagnosis import roles
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.hygiene import hygiene, put_right
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.null import fit_null
from ahrsd.diagnosis.one_model import priors, rich
from ahrsd.diagnosis.one_model.evidence import evaluated
from ahrsd.diagnosis.pauses import without_jumps
from ahrsd.diagnosis.problem import problem_of
from ahrsd.diagnosis.track import Spec
from ahrsd.errors import RecordingError
from ahrsd.offline.diagnose import load_track

GRID = np.arange(-4.5, 4.6, 0.5)  # of the logarithm of a size about its present median
LEAST_SPREAD = 0.3


def untouched(words: list[str]) -> Iterator[tuple[str, Path]]:
    paths = sorted(p for folder in FOLDERS for p in (RECORDINGS / folder).glob("*.csv.gz"))
    for path in paths:
        name = f"{path.parent.name}/{path.name.removesuffix('.csv.gz')}"
        aside = (*DISTURBED, *DOUBTFUL, *AT_REST, ".gps", "vnraw")
        if not any(word in name for word in aside) and any(word in name for word in words):
            yield name, path


def profiles(path: Path) -> dict[str, list[list[float]]]:
    """Of each component: log sizes, log likelihood at each without the size's own prior."""
    track, _ = load_track(path)
    track, _ = without_jumps(roles.prepared(track)[0])
    problem, cold = problem_of(put_right(track, hygiene(track)), Spec(), {}, LIMITS)
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    found = rich.richest(problem, fit.filtered, EFFECTS)
    made, remainder, keys, at = found.base.made, found.base.remainder, found.base.whole, found.at
    products = made.products(keys, priors.NOISE_STEP_REAL)
    laws = [made.seen[key].component.law for key in keys]
    out, begin = {}, 0
    for key, law in zip(keys, laws, strict=True):
        if key in remainder and len(law.start):
            middle = law.start[0]
            found = []
            for step in GRID:
                psi = at.psi.copy()
                psi[begin] = middle + step
                own, _ = law.log_prior(psi[begin : begin + len(law.start)])
                found.append(evaluated(products, laws, at.log_noise, psi).nats - own)
            unit = getattr(law, "unit", 1.0)
            out[key] = [(middle + GRID + np.log(unit)).tolist(), found]
        begin += len(law.start)
    return out


def law_of(curves: list[list[list[float]]]) -> priors.Size:
    """Median and spread that make these recordings together likeliest."""
    step = GRID[1] - GRID[0]

    def cost(x: np.ndarray) -> float:
        mean, spread = x[0], LEAST_SPREAD + abs(x[1])
        total = 0.0
        for at, nats in curves:
            t, like = np.array(at), np.array(nats)
            law = -0.5 * ((t - mean) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi))
            total += np.logaddexp.reduce(like - like.max() + law) + np.log(step)
        return -total + 0.5 * (x[1] / 1.5) ** 2

    middle = float(np.mean([at[int(np.argmax(nats))] for at, nats in curves]))
    found = min(
        (minimize(cost, [middle + d, 0.7], method="Nelder-Mead") for d in (-1.0, 0.0, 1.0)),
        key=lambda one: one.fun,
    )
    return priors.Size(float(np.exp(found.x[0])), LEAST_SPREAD + abs(float(found.x[1])), np.inf)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--measured", type=Path, help="fit, and keep the profiles in this file")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    parser.add_argument("--table", type=Path, help="a file of profiles")
    given = parser.parse_args()
    if given.measured:
        known = json.loads(given.measured.read_text()) if given.measured.exists() else {}
        for name, path in untouched(given.only):
            if name in known:
                continue
            try:
                known[name] = profiles(path)
            except (RecordingError, ValueError) as why:
                print(f"{name}: {why}")
                continue
            best = {k: float(np.exp(at[int(np.argmax(v))])) for k, (at, v) in known[name].items()}
            print(name, {k: f"{v:.2g}" for k, v in best.items()}, flush=True)
            given.measured.write_text(json.dumps(known) + "\n", encoding="utf-8")
    if given.table:
        known = json.loads(given.table.read_text())
        for key in priors.ORDINARY:
            found = law_of([one[key] for one in known.values() if key in one])
            most = priors.ORDINARY[key].most
            print(f'    "{key}": Size({found.median:.2e}, {found.spread:.2f}, {most:g}),')


if __name__ == "__main__":
    main()
