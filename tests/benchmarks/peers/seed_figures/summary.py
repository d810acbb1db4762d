"""From the runs to what the page says of them: means, spreads, numbers of runs and failures."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

Said = dict[str, Any]


def of(runs: Said) -> Said:
    """Everything that the page is made from."""
    five, dive = runs["chapter5"], runs["dive"]
    return {
        "schema": "ahrsd.seeds/1",
        "judge": five["judge"],
        "chapter5": {
            motion: {kind: methods(rows) for kind, rows in five[motion].items()}
            for motion in ("slow", "rov")
        },
        "parts": {kind: parts(rows) for kind, rows in five["slow"].items()},
        "figure 4": {kind: methods(rows) for kind, rows in five["figure 4"].items()},
        "dive": {
            "hard_iron_scale": dive["hard_iron_scale"],
            "without": table([run["without"] for run in dive["runs"]]),
            "exp1": table([run["exp1"] for run in dive["runs"]]),
            "exp2": table(dive["exp2"]),
            "parts": parts(dive["runs"]),
        },
        "norms": runs["norms"],
    }


def methods(rows: list[Said]) -> Said:
    """Of runs with `seed` and `methods`, first and last seed and a summary of each method."""
    seeds = [row["seed"] for row in rows]
    return {"seeds": [min(seeds), max(seeds)], "methods": table([row["methods"] for row in rows])}


def table(rows: list[Said]) -> Said:
    """Of runs that have an answer or a failure by name, a summary by name."""
    return {name: one([row[name] for row in rows if name in row]) for name in _names(rows)}


def _names(rows: list[Said]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def one(answers: list[Said]) -> Said:
    """Mean and standard deviation of every number over the answers; failures by their words."""
    failures = Counter(x["failure"] for x in answers if x.get("failure"))
    good = [x for x in answers if not x.get("failure")]
    out: Said = {"runs": len(answers), "answers": len(good), "failures": dict(failures)}
    for key in good[0] if good else ():
        values = [x[key] for x in good if x[key] is not None]
        if key != "failure" and values:
            out[key] = {
                "mean": _plain(np.mean(values, axis=0)),
                "std": _plain(np.std(values, axis=0, ddof=1 if len(values) > 1 else 0)),
                "of": len(values),
            }
    return out


def parts(rows: list[Said]) -> Said:
    """Median heading RMSE on growing parts of the data, and how many runs had an answer there."""
    known = [row["parts"] for row in rows if row["parts"]]
    columns = list(zip(*known, strict=True))
    good = [[x for x in column if x is not None] for column in columns]
    return {
        "runs": len(known),
        "answers": [len(column) for column in good],
        "median_deg": [float(np.median(column)) if column else None for column in good],
    }


def _plain(values: Any) -> Any:
    rounded = np.vectorize(lambda v: float(f"{v:.6g}"))(values)
    return rounded.tolist()
