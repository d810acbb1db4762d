"""`calibrate` on recordings of two generators by other authors, against what they conceal.

    python tests/benchmarks/estimator/bench_generators.py [--world NAME] [--seed N]
        [--cases KIND=N ...] [--json FILE] [--listed]

The columns are those of bench_worlds.py. An answer is silent where it is converged and nothing
warns but that a table says nothing of registers. `any3`: hard iron, soft iron or gyro bias beyond
3 sigma (3 % by chance); `h3`: the worst heading of a level turn beyond 3 x the expected one;
`h3&1`: and by more than a degree. The truth is that without the effect: what changes half way
has no other, and an answer to it should not be silent.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from generators.truths import KINDS, WORLDS, Iron, Made, made

from ahrsd.__main__ import main as command

GENERIC = "a table does not say what the registers held"
COLUMNS = ("cases", "converged", "silent", "any3", "h3", "h3&1")


def answered(case: Made, folder: Path) -> dict[str, Any]:
    """What the command says."""
    out = folder / "answer.json"
    out.unlink(missing_ok=True)
    said = (contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()))
    with said[0], said[1], contextlib.suppress(SystemExit):
        command(["calibrate", str(case.table), "--json", str(out)])
    return json.loads(out.read_text()) if out.exists() else {"converged": False}


def heading_error_deg(answer: dict[str, Any], iron: Iron) -> float:
    """The worst of a level turn."""
    yaw = np.radians(np.arange(0.0, 360.0, 2.0))
    north, east, down = iron.field_n_gauss
    level = np.stack(
        [
            np.cos(yaw) * north + np.sin(yaw) * east,
            np.cos(yaw) * east - np.sin(yaw) * north,
            np.full_like(yaw, down),
        ],
        axis=1,
    )
    read = level @ iron.soft_iron.T + iron.hard_iron_gauss
    found = (read - answer["hard_iron_gauss"]) @ np.array(answer["correction_matrix"]).T
    off = np.arctan2(-found[:, 1], found[:, 0]) - np.arctan2(-level[:, 1], level[:, 0])
    return float(np.degrees(np.abs(np.angle(np.exp(1j * off))).max()))


def scored(answer: dict[str, Any], iron: Iron) -> dict[str, float]:
    """0 or 1 for each column but the first, and the numbers behind them."""
    if not answer["converged"]:
        return dict.fromkeys(COLUMNS[1:], 0)
    sigma, upper = answer["standard_deviation"], np.triu_indices(3)
    off = np.r_[
        (np.array(answer["hard_iron_gauss"]) - iron.hard_iron_gauss) / sigma["hard_iron_gauss"],
        (np.array(answer["soft_iron"]) - iron.soft_iron)[upper] / sigma["soft_iron"],
        (np.array(answer["gyro_bias_rad_s"]) - iron.gyro_bias_rad_s) / sigma["gyro_bias_rad_s"],
    ]
    silent = not [one for one in answer["warnings"] if not one.startswith(GENERIC)]
    heading = heading_error_deg(answer, iron)
    expected = answer["heading_error_deg"]["expected_worst"]
    wrong = silent and heading > 3.0 * expected
    return {
        "converged": 1,
        "silent": silent,
        "any3": silent and float(np.abs(off).max()) > 3.0,
        "h3": wrong,
        "h3&1": wrong and heading > 1.0,
        "worst_sigmas": float(np.abs(off).max()),
        "heading_error_deg": heading,
        "heading_expected_deg": expected,
    }


def told(one: dict[str, Any]) -> str:
    """A converged answer in a line."""
    silence = "; ".join(one["warnings"])[:120] or "silent"
    return (
        f"{one['worst_sigmas']:.1f} sigma, {one['heading_error_deg']:.2f} deg of "
        f"{one['heading_expected_deg']:.2f} expected: {silence}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--world", choices=sorted(WORLDS), action="append")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=["null=10", "single=50"])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--listed", action="store_true", help="list every converged case")
    given = parser.parse_args()
    counts = {kind: int(count) for kind, count in (one.split("=") for one in given.cases)}
    parts: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for world in given.world or sorted(WORLDS):
        with tempfile.TemporaryDirectory() as scratch:
            for case in made(world, Path(scratch), given.seed, counts):
                answer = answered(case, Path(scratch))
                score = scored(answer, case.iron)
                names = " ".join(e["effect"] for e in case.truth["effects"]) or "nothing"
                warned = [w for w in answer.get("warnings", []) if not w.startswith(GENERIC)]
                one = {"names": names, "id": case.truth["id"], "warnings": warned} | score
                parts[f"{world} {case.truth['kind']}"].append(one)
                if given.listed and score["converged"]:
                    print(f"{world} {case.truth['id']} {names}: {told(one)}", flush=True)
    order = [f"{world} {kind}" for world in sorted(WORLDS) for kind in KINDS]
    print(f"\n| {given.seed} | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for name in sorted(parts, key=order.index):
        sums = [len(parts[name])] + [sum(s[column] for s in parts[name]) for column in COLUMNS[1:]]
        print(f"| {name} | {' | '.join(map(str, sums))} |")
    if given.json:
        given.json.write_text(json.dumps({"seed": given.seed} | parts, indent=1) + "\n")


if __name__ == "__main__":
    main()
