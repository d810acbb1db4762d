"""The figures that [R] prints, beside the same methods here, ours and the bound.

    python tests/benchmarks/peers/bench_thesis.py
        --cache DIR --runs 100 --output docs/validation/thesis

[R] Rodriguez-Martinez, thesis, PUC Chile 2023. Its experiment is simulated as its tables were made:
b = m_b, 1 mG and 5 mrad/s while calibrating, 10 mG while headings are judged. It does not print the
frequencies of its motion, so both candidates are run (`ahrsd.simulation.scenarios`). A figure
counts as reproduced where it lies within one standard deviation over our runs of their mean.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np

from ahrsd.montecarlo.accuracy import heading_rms_deg
from ahrsd.montecarlo.runs import Plan, Record, run_many
from ahrsd.montecarlo.summary import accuracy_lines, bound_lines, parameter_lines, summarise
from ahrsd.samples import Array
from ahrsd.simulation import simulate

SETS, MOTIONS, AT_S = ("wam", "mam", "lam"), ("slow", "rov"), 400.0
PUBLISHED_METHODS = (
    "magical-bfg", "magical-bfg+savgol", "magical-ifg", "magical-ifg+savgol", "ellipsoid",
)  # fmt: skip
OURS = ("magyc", "magyc-stream")
INVERTED = "ellipsoid, inverted"
#: Table 5.2, heading RMSE in degrees, by method and set
HEADING_DEG = {
    "magical-bfg": (2.66, 2.74, 3.81),
    "magical-ifg": (2.65, 2.79, 3.53),
    INVERTED: (18.0, 18.0, 18.0),
}
#: its mean gyro bias of the incremental graph, mrad/s
IFG_BIAS_MRAD_S = (1.775, -2.136, 0.852)
#: its row "Ellipsoid Fit": the inverse of the soft iron, here with det 1, there of unknown scale
ELLIPSOID_ENTRIES = (0.981, -0.096)
#: of the readings that are turned into headings. 10 mG beside a field of 473 mG in A of the thesis'
#: own volume; were its A of unit volume, the same readings would be 5 % smaller against the noise
NOISE_GAUSS = {"10 mG": 0.010, "10 mG, det A = 1": 0.010 * float(np.cbrt(1.167072))}


@dataclass(frozen=True, slots=True)
class Line:
    """One printed figure beside ours: mean and standard deviation over the runs."""

    figure: str
    published: float
    method: str
    scenario: str
    motion: str
    mean: float
    spread: float
    runs: int

    @property
    def reproduced(self) -> bool:
        """Within one standard deviation of our runs."""
        return abs(self.mean - self.published) <= self.spread


def line(figure: str, published: float, method: str, plan: Plan, values: Array) -> Line:
    """From one value per run."""
    mean, spread = float(np.mean(values)), float(np.std(values, ddof=1))
    return Line(figure, published, method, plan.scenario, plan.motion, mean, spread, len(values))


def plans(methods: tuple[str, ...]) -> list[Plan]:
    """All sets, as the thesis made them."""
    return [
        Plan(kind, motion, methods=methods, at_s=(AT_S,), offset_behind_iron=True)
        for motion, kind in product(MOTIONS, SETS)
    ]


def answers(records: Sequence[Record], method: str) -> list[Record]:
    """The runs in which a method has an answer, each with its seed."""
    return [
        result | {"seed": record["seed"]}
        for record in records
        for result in record["results"]
        if result["method"] == method and result["failure"] is None
    ]


def headings(plan: Plan, records: Sequence[Record]) -> dict[tuple[str, str], list[float]]:
    """Heading RMSE by method and noise, one value per run that has an answer."""
    out = defaultdict(list)
    for record in records:
        experiment = simulate(plan.settings(record["seed"]))
        for result in (r for r in record["results"] if r["failure"] is None):
            A, method = np.array(result["soft_iron"]), result["method"]
            if method == "ellipsoid":
                A, method = np.linalg.inv(A), INVERTED
            for said, noise_gauss in NOISE_GAUSS.items():
                b = np.array(result["hard_iron_gauss"])
                out[method, said].append(heading_rms_deg(experiment, A, b, noise_gauss))
    return out


def lines(plan: Plan, records: Sequence[Record]) -> Iterator[Line]:
    """All printed figures of one set, for the method as it is and with smoothed readings."""
    for (method, said), errors in headings(plan, records).items():
        row = HEADING_DEG[method.removesuffix("+savgol")]
        published = row[SETS.index(plan.scenario)]
        yield line(f"heading RMSE, deg, {said}", published, method, plan, np.array(errors))
    for smoothed in ("", "+savgol"):
        bias = np.array([r["gyro_bias_rad_s"] for r in answers(records, "magical-ifg" + smoothed)])
        for axis, published in enumerate(IFG_BIAS_MRAD_S):
            name = f"gyro bias {'xyz'[axis]}, mrad/s"
            yield line(name, published, "magical-ifg" + smoothed, plan, 1e3 * bias[:, axis])
    for (i, j), published in zip(((0, 0), (0, 1)), ELLIPSOID_ENTRIES, strict=True):
        entries = np.array(
            [np.linalg.inv(r["soft_iron"])[i, j] for r in answers(records, "ellipsoid")]
        )
        yield line(f"soft iron {i + 1}{j + 1}", published, INVERTED, plan, entries)


def table(found: Sequence[Line]) -> list[str]:
    """One row per printed figure and method, our two motions beside each other."""
    out = [
        "| figure | set | method here | [R] | " + " | ".join(f"here, {m}" for m in MOTIONS) + " |",
        "|---" * (4 + len(MOTIONS)) + "|",
    ]
    for row in (row for row in found if row.motion == MOTIONS[0]):
        same = [
            r for r in found
            if (r.figure, r.scenario, r.method) == (row.figure, row.scenario, row.method)
        ]  # fmt: skip
        cells = [
            f"{r.mean:.3f} ± {r.spread:.3f} ({r.runs})" + (" **yes**" if r.reproduced else " no")
            for r in same
        ]
        name = f"`{row.method}`"
        out.append(
            f"| {row.figure} | {row.scenario.upper()} | {name} | {row.published:g} "
            f"| {' | '.join(cells)} |"
        )
    return out


def tables_5_1_and_5_2(plan: Plan, records: Sequence[Record], ours: Sequence[Record]) -> list[str]:
    """What `ahrsd montecarlo --hard-iron-as-read` prints, as preformatted text."""
    both = [
        a | {"results": [*b["results"], *a["results"]]} for a, b in zip(records, ours, strict=True)
    ]
    rows, truth = summarise(both), plan.settings(0).truth
    listed = [
        *truth.soft_iron.ravel().tolist(),
        *(1e3 * truth.hard_iron_gauss).tolist(),
        *(1e3 * truth.gyro_bias_rad_s).tolist(),
    ]
    text = [*accuracy_lines(rows), *bound_lines(rows), "", *parameter_lines(rows, listed)]
    return [f"\n### {plan.name}, {len(both)} runs\n", "```", *(t.rstrip() for t in text), "```"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing; write thesis.json, figures.md and tables.md."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cache", type=Path, required=True, help="folder of runs already done")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--ours", type=int, default=10, help="runs of ours, with the bound")
    parser.add_argument("--output", type=Path, default=Path("thesis-out"))
    chosen = parser.parse_args(arguments)
    found: list[Line] = []
    text: list[str] = []
    for plan, own in zip(plans(PUBLISHED_METHODS), plans(OURS), strict=True):
        sys.stderr.write(f"{plan.name}\n")
        records = run_many(plan, range(chosen.runs), resume=chosen.cache)
        ours = run_many(own, range(min(chosen.ours, chosen.runs)), resume=chosen.cache)
        found += lines(plan, records)
        text += tables_5_1_and_5_2(plan, records[: len(ours)], ours)
    chosen.output.mkdir(parents=True, exist_ok=True)
    body = [asdict(row) | {"reproduced": row.reproduced} for row in found]
    said = {"schema": "ahrsd.thesis/1", "runs": chosen.runs, "figures": body}
    for name, content in (
        ("thesis.json", json.dumps(said, indent=1)),
        ("figures.md", "\n".join(table(found))),
        ("tables.md", "\n".join(text).lstrip()),
    ):
        (chosen.output / name).write_text(content + "\n", encoding="utf-8")
    sys.stdout.write("\n".join(table(found)) + "\n")


if __name__ == "__main__":
    main()
