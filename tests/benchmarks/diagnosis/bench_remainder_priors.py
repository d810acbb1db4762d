"""What untouched real recordings leave: the sizes of `ahrsd/diagnosis/priors.py`.

    python tests/benchmarks/diagnosis/bench_remainder_priors.py --measured SIZES.json [--only WORD]
    python tests/benchmarks/diagnosis/bench_remainder_priors.py --table SIZES.json
    python tests/benchmarks/diagnosis/bench_remainder_priors.py --judge SIZES.json

The first fits the richest model to each untouched recording beside the project and keeps, for each
component of the ordinary remainder, how likely each size is beside all others, and of each effect
how large it comes out alone beside them (some two minutes of CPU; it goes on where it stopped).
The second finds the lognormal law of each size that makes all recordings together likeliest, and
prints it as it stands in the module, and the size of each effect that one in ten is beyond, as its
row of the library has it (`ordinary`), and of each course.  The third diagnoses each recording with
the sizes that all others have: no recording is judged by what was measured on it.
"""

from __future__ import annotations

import argparse
import copy
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.data_quality.preparation import prepare
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.decision.members import size_of
from ahrsd.diagnosis.inference.diagnose import build_and_fit_null, diagnose
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import evaluate
from ahrsd.diagnosis.inference.search.search_space import build_search_space
from ahrsd.diagnosis.track import Spec
from ahrsd.errors import RecordingError
from ahrsd.offline.diagnose import load_track

RECORDINGS = Path(__file__).parents[3] / ".." / "shared" / "recordings"
FOLDERS = ("broad", "repoimu", "fiumarg", "arducopter", "vn100", "vn100_distorters")
#: by the recordings' README, parts of names: something was put on or stands there, a current flows
DISTURBED = ("_disturbed_", "vn7", "vn30", "log171_MAG2")
#: of these it says that something changed while they were made, and not what
DOUBTFUL = ("hand_2023_thumatti", "hand_2023_ashutosh")
#: stood still: nothing but noise is to be seen
AT_REST = ("static_2025", "F00379")
GRID = np.arange(-4.5, 4.6, 0.5)  # of the logarithm of a size about its present median
LEAST_SPREAD = 0.5


def untouched(words: list[str]) -> Iterator[tuple[str, Path]]:
    paths = sorted(p for folder in FOLDERS for p in (RECORDINGS / folder).glob("*.csv.gz"))
    for path in paths:
        name = f"{path.parent.name}/{path.name.removesuffix('.csv.gz')}"
        aside = (*DISTURBED, *DOUBTFUL, *AT_REST, ".gps", "vnraw")
        if not any(word in name for word in aside) and any(word in name for word in words):
            yield name, path


def measured(path: Path) -> dict[str, Any]:
    """What a recording leaves: `profiles` of the remainder, `effects` that nobody put there."""
    track = prepare(load_track(path)[0]).corrected_track()
    problem, fit = build_and_fit_null(track, Spec())
    found = richest_model.fit_richest_model(problem, fit.filtered, EFFECTS)
    return {"profiles": profiles(found), "effects": sizes(found)}


def profiles(found: richest_model.FittedPoint) -> dict[str, list[list[float]]]:
    """Of each component: log sizes, log likelihood at each without the size's own prior."""
    made, remainder, keys, at = found.base.made, found.base.remainder, found.base.whole, found.at
    products = made.products(keys, priors.NOISE_STEP_REAL)
    laws = [made.seen[key].component.law for key in keys]
    out, begin = {}, 0
    for key, law in zip(keys, laws, strict=True):
        if key in remainder and len(law.start):
            middle = law.start[0]
            nats = []
            for step in GRID:
                psi = at.psi.copy()
                psi[begin] = middle + step
                own, _ = law.log_prior(psi[begin : begin + len(law.start)])
                nats.append(evaluate(products, laws, at.log_noise, psi).nats - own)
            unit = getattr(law, "unit", 1.0)
            out[key] = [(middle + GRID + np.log(unit)).tolist(), nats]
        begin += len(law.start)
    return out


def sizes(found: richest_model.FittedPoint) -> dict[str, list[float]]:
    """Of each effect in its likeliest setting, and each course: size and nats that it gains."""
    all_sets, space = build_search_space(found, EFFECTS, ())
    base = all_sets.judge({*found.base.remainder, LAG})
    scan = candidate_scan(all_sets.made, base.keys, base.at)
    out = {}
    for name, keys in {**space.effects, **{key: [key] for key in space.courses}}.items():
        if keys == [LAG]:
            continue
        worth = scan.log_bayes_factors(keys)
        key = max(worth, key=lambda one: worth[one])
        with_it = all_sets.judge(base.names | {key}, base)
        out[name] = [size_of(all_sets, with_it, key), with_it.score - base.score]
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


def ordinary_effects(known: list[dict[str, Any]]) -> dict[str, float]:
    """Of each effect the size that one in ten of all recordings is beyond; none where it is nil."""
    out = {}
    beyond = round(len(known) / 10)
    for name in sorted({name for one in known for name in one["effects"]}):
        found = [one["effects"].get(name, [0.0, 0.0]) for one in known]
        sizes = sorted((size for size, nats in found if nats > 0.0), reverse=True)
        if len(sizes) > beyond:
            out[name] = float(sizes[beyond])
    return out


def laws_of(known: list[dict[str, Any]]) -> dict[str, priors.Size]:
    """The law of each component of the remainder."""
    out = {}
    for key, now in priors.ORDINARY.items():
        curves = [one["profiles"][key] for one in known if key in one["profiles"]]
        found = law_of(curves)
        out[key] = priors.Size(min(found.median, now.most / 3.0), found.spread, now.most)
    return out


def measure(path: Path, words: list[str]) -> None:
    known = json.loads(path.read_text()) if path.exists() else {}
    for name, recording in untouched(words):
        if name in known:
            continue
        try:
            known[name] = measured(recording)
        except (RecordingError, ValueError) as why:
            print(f"{name}: {why}")
            continue
        asked = {k: round(v[0], 4) for k, v in known[name]["effects"].items() if v[1] > 0.0}
        print(name, asked, flush=True)
        path.write_text(json.dumps(known) + "\n", encoding="utf-8")


def table(path: Path) -> None:
    known = list(json.loads(path.read_text()).values())
    for key, size in laws_of(known).items():
        print(f'    "{key}": Size({size.median:.2e}, {size.spread:.2f}, {size.most:g}),')
    for name, most in ordinary_effects(known).items():
        print(f"    {name}: ordinary = {most:.2g}")


def library_of(ordinary: dict[str, float]) -> dict[str, Effect]:
    """The library with these ordinary sizes."""
    rows = {name: copy.copy(row) for name, row in EFFECTS.items()}
    for name, row in rows.items():
        row.ordinary = ordinary.get(name, 0.0)
    return rows


def judge(path: Path, words: list[str]) -> None:
    known = json.loads(path.read_text())
    laws, courses = priors.ORDINARY, priors.ORDINARY_COURSE
    for name, recording in untouched(words):
        others = [one for key, one in known.items() if key != name]
        ordinary = ordinary_effects(others)
        priors.ORDINARY = laws_of(others)
        priors.ORDINARY_COURSE = {
            key.removeprefix("free "): size for key, size in ordinary.items() if key not in EFFECTS
        }
        begin = time.process_time()
        said = diagnose(load_track(recording)[0], library=library_of(ordinary))
        names = [f"{one.effect} ({one.evidence_nats:.0f})" for one in said.findings]
        left = said.unexplained
        where = f"unknown {left.where.frame} {left.size:.3g}" if left.where else "nothing else"
        print(f"{name}: {names}, {where}, {time.process_time() - begin:.1f} s", flush=True)
        priors.ORDINARY, priors.ORDINARY_COURSE = laws, courses


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--measured", type=Path, help="fit, and keep what is found in this file")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    parser.add_argument("--table", type=Path, help="a file of measurements")
    parser.add_argument("--judge", type=Path, help="the same: each by what the others leave")
    given = parser.parse_args()
    if given.measured:
        measure(given.measured, given.only)
    if given.table:
        table(given.table)
    if given.judge:
        judge(given.judge, given.only)


if __name__ == "__main__":
    main()
