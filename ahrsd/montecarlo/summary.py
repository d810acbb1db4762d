"""From the runs of a Monte Carlo to its figures: RMSE against the bound, NEES, means and spreads.

RMSE over runs is the root of the mean square of an error's norm; beside it stands the root of the
mean square of the bounds of the same runs. Its ratio has a standard error by the jackknife: with
few runs of very different bounds it is large, and no goal is met or missed within it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ahrsd.montecarlo.accuracy import FIGURES, HEADINGS
from ahrsd.samples import Array

Record = Mapping[str, Any]
BOUNDED = ("hard_iron_gauss", "soft_iron", "gyro_bias_rad_s")
_ENTRIES = [f"A{i}{j}" for i in "123" for j in "123"]
#: names of Table 5.1's columns; A with det A = 1, mG, mrad/s
PARAMETERS = (*_ENTRIES, "b1", "b2", "b3", "wb1", "wb2", "wb3")
_PARAMETER_KEYS = (("soft_iron", 9, 1.0), ("hard_iron_gauss", 3, 1e3), ("gyro_bias_rad_s", 3, 1e3))


@dataclass(frozen=True, slots=True)
class Ratio:
    """An RMSE beside the bound's; None where there is no answer or no bound.

    standard_error: of `over_bound`; normalised: RMS of each run's error over its own bound
    """

    rmse: float | None
    bound: float | None
    over_bound: float | None
    standard_error: float | None
    normalised: float | None


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """One method at one time, over all runs.

    answered: runs with an answer, of `runs`; unconverged: of those, how many the method itself does
    not trust; failures: how often which words
    mean, spread: of each of `PARAMETERS`, over the answers; None where not estimated
    bound_sigma: RMS over the runs of the bound's standard deviation of each of `PARAMETERS`
    ordinary_bound: RMS over the runs of the bound with an ordinary instrument's and an ordinary
        place's imperfections, by name of `BOUNDED` and `HEADINGS`
    against_bound: by name of `BOUNDED` and `HEADINGS`; rms: of the other figures
    nees: mean per degree of freedom
    """

    method: str
    at_s: float
    runs: int
    answered: int
    unconverged: int
    failures: dict[str, int]
    mean: list[float | None]
    spread: list[float | None]
    bound_sigma: list[float | None]
    ordinary_bound: dict[str, float | None]
    against_bound: dict[str, Ratio]
    rms: dict[str, float | None]
    nees: float | None
    nees_spread: float | None
    nees_standard_error: float | None
    cpu_s: float | None

    def json(self) -> dict[str, object]:
        """As written by `--json`."""
        return asdict(self)


def summarise(records: Sequence[Record]) -> list[SummaryRow]:
    """One row per method and time, in the order in which the runs did them."""
    order = [(r["method"], r["at_s"]) for r in records[0]["results"]] if records else []
    bounds = {b["at_s"]: k for k, b in enumerate(records[0]["bounds"])} if records else {}
    return [
        _row(
            [record["results"][k] for record in records],
            [record["bounds"][bounds[at_s]] for record in records],
        )
        for k, (_, at_s) in enumerate(order)
    ]


def _row(results: Sequence[Record], bounds: Sequence[Record]) -> SummaryRow:
    good = [(r, b) for r, b in zip(results, bounds, strict=True) if r["failure"] is None]
    answers = [r for r, _ in good]
    parameters = _parameters(answers)
    nees = _column(answers, "nees")
    cpu = [r["cpu_s"] for r in results if r["cpu_s"] is not None]
    failures = Counter(r["failure"] for r in results if r["failure"] is not None)
    few = len(nees) < 2
    return SummaryRow(
        method=results[0]["method"],
        at_s=results[0]["at_s"],
        runs=len(results),
        answered=len(answers),
        unconverged=sum(not r["converged"] for r in answers),
        failures=dict(failures.most_common()),
        mean=_numbers(parameters.mean(axis=0)) if answers else [None] * len(PARAMETERS),
        spread=_numbers(parameters.std(axis=0)) if answers else [None] * len(PARAMETERS),
        bound_sigma=_bound_sigma(bounds),
        ordinary_bound=_ordinary(bounds),
        against_bound={name: _ratio(good, name) for name in (*BOUNDED, *HEADINGS)},
        rms={
            name: _rms(_column(answers, name)) for name in FIGURES if name not in (*BOUNDED, "nees")
        },
        nees=float(np.mean(nees)) if len(nees) else None,
        nees_spread=None if few else float(np.std(nees, ddof=1)),
        nees_standard_error=None if few else float(np.std(nees, ddof=1) / np.sqrt(len(nees))),
        cpu_s=float(np.mean(cpu)) if cpu else None,
    )


def _parameters(answers: Sequence[Record]) -> Array:
    rows = [
        np.concatenate(
            [
                np.full(size, np.nan) if r[key] is None else unit * np.ravel(r[key])
                for key, size, unit in _PARAMETER_KEYS
            ]
        )
        for r in answers
    ]
    return np.array(rows, dtype=np.float64)


def _bound_sigma(bounds: Sequence[Record]) -> list[float | None]:
    known = [b["sigma"] for b in bounds if b["sigma"] is not None]
    if not known:
        return [None] * len(PARAMETERS)
    rms = np.sqrt(np.mean(np.square(known), axis=0))
    entry = np.zeros((3, 3), dtype=int)
    entry[np.triu_indices(3)] = np.arange(6)
    entry = np.maximum(entry, entry.T)
    return _numbers(np.r_[rms[entry.ravel()], 1e3 * rms[6:]])


def _ordinary(bounds: Sequence[Record]) -> dict[str, float | None]:
    known = [b["ordinary"] for b in bounds if b["ordinary"] is not None]
    return {name: _rms(np.array([b[name] for b in known])) for name in (*BOUNDED, *HEADINGS)}


def _numbers(values: Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _column(answers: Sequence[Record], name: str) -> Array:
    values = [r["errors"][name] for r in answers if r["errors"][name] is not None]
    return np.array(values, dtype=np.float64)


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _ratio(good: Sequence[tuple[Record, Record]], name: str) -> Ratio:
    pairs = [(r["errors"][name], b[name]) for r, b in good]
    errors = np.array([e for e, _ in pairs if e is not None], dtype=np.float64)
    both = np.array([(e, c) for e, c in pairs if e is not None and c is not None]).reshape(-1, 2)
    bounds = np.array([b[name] for _, b in good if b[name] is not None], dtype=np.float64)
    bound = _rms(bounds)
    if len(both) == 0:
        return Ratio(_rms(errors), bound, None, None, None)
    e2, c2 = np.square(both).T
    ratio = float(np.sqrt(e2.sum() / c2.sum()))
    error = None
    if len(both) > 1:
        without = np.sqrt((e2.sum() - e2) / (c2.sum() - c2))
        n = len(both)
        error = float(np.sqrt((n - 1) / n * np.sum(np.square(without - without.mean()))))
    return Ratio(_rms(errors), bound, ratio, error, float(np.sqrt(np.mean(e2 / c2))))


def accuracy_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """Errors, bound and ratios as text, one line per method and time ([R] Table 5.2 and more)."""
    head = (
        f"{'method':<19} {'at s':>5} {'answers':>9} {'hard iron mG':>13} {'x bound':>13} "
        f"{'soft iron F':>12} {'x bound':>8} {'geodesic':>9} {'gyro mrad/s':>12} {'x bound':>8} "
        f"{'heading deg':>12} {'(10 mG)':>8} {'NEES/dof':>10} {'CPU s':>6}"
    )
    return [head, *(line for row in rows for line in _lines(row))]


def _lines(row: SummaryRow) -> list[str]:
    hard, soft, gyro = (row.against_bound[name] for name in BOUNDED)
    error = "" if hard.standard_error is None else f"+-{hard.standard_error:.2f}"
    answers = f"{row.answered}/{row.runs}" + (f"-{row.unconverged}" if row.unconverged else "")
    nees = "-" if row.nees is None else f"{row.nees:.2f}"
    spread = "" if row.nees_standard_error is None else f"+-{row.nees_standard_error:.2f}"
    line = (
        f"{row.method:<19} {row.at_s:>5g} {answers:>9} {_text(hard.rmse, 1e3):>13} "
        f"{_text(hard.over_bound, digits=2) + error:>13} {_text(soft.rmse):>12} "
        f"{_text(soft.over_bound, digits=2):>8} {_text(row.rms['soft_iron_geodesic']):>9} "
        f"{_text(gyro.rmse, 1e3):>12} {_text(gyro.over_bound, digits=2):>8} "
        f"{_text(row.rms['heading_deg']):>12} {_text(row.rms['heading_10mg_deg']):>8} "
        f"{nees + spread:>10} {_text(row.cpu_s, digits=2):>6}"
    )
    failures = [f"{'':<19} {times} x {words}" for words, times in row.failures.items()]
    return [line, *failures]


def _text(value: float | None, factor: float = 1.0, digits: int = 3) -> str:
    return "-" if value is None else f"{value * factor:#.{digits + 1}g}".rstrip(".")


def bound_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """The bound at each time, RMS over the runs; and that of an ordinary instrument and place."""
    out = []
    for at_s in dict.fromkeys(row.at_s for row in rows):
        row = next(r for r in rows if r.at_s == at_s)
        plain = {name: row.against_bound[name].bound for name in (*BOUNDED, *HEADINGS)}
        for label, known in (("bound", plain), ("bound, ordinary", row.ordinary_bound)):
            hard, soft, gyro, heading, noisy = (known[name] for name in (*BOUNDED, *HEADINGS))
            out.append(
                f"{label:<19} {at_s:>5g} {'':>9} {_text(hard, 1e3):>13} {'':>13} {_text(soft):>12} "
                f"{'':>8} {'':>9} {_text(gyro, 1e3):>12} {'':>8} {_text(heading):>12} "
                f"{_text(noisy):>8}"
            )
    return out


def parameter_lines(rows: Sequence[SummaryRow], truth: Sequence[float]) -> list[str]:
    """[R] Table 5.1: mean and spread over the runs of every parameter at the last time.

    The bound's line is the smallest spread of unbiased answers.
    """
    last = max((row.at_s for row in rows), default=0.0)
    shown = [k for k, name in enumerate(PARAMETERS) if name not in ("A21", "A31", "A32")]
    table = [f"{'':<19} " + " ".join(f"{PARAMETERS[k]:>16}" for k in shown)]
    digits = [5 if PARAMETERS[k] in _ENTRIES else 4 for k in shown]
    cells = [f"{truth[k]:.{d}f}" for k, d in zip(shown, digits, strict=True)]
    table.append(f"{'truth':<19} " + " ".join(f"{cell:>16}" for cell in cells))
    if rows:
        sigma = [next(row for row in rows if row.at_s == last).bound_sigma[k] for k in shown]
        cells = [
            "-" if value is None else f"+-{value:.{d}f}"
            for value, d in zip(sigma, digits, strict=True)
        ]
        table.append(f"{'bound':<19} " + " ".join(f"{cell:>16}" for cell in cells))
    for row in rows:
        if row.at_s == last and row.answered:
            cells = [
                _cell(row.mean[k], row.spread[k], d) for k, d in zip(shown, digits, strict=True)
            ]
            table.append(f"{row.method:<19} " + " ".join(f"{cell:>16}" for cell in cells))
    return table


def heading_lines(sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> list[str]:
    """[R] Table 5.2: heading RMSE in degrees by method and set (name, rows) at the last time.

    Of readings with 10 mG of noise, behind it of readings without; the bound's line is what a
    method at the bound may expect.
    """
    table = [f"{'method':<19} " + " ".join(f"{name:>22}" for name, _ in sets)]
    for method in dict.fromkeys(row.method for _, rows in sets for row in rows):
        cells = []
        for _, rows in sets:
            found = [row.rms for row in rows if row.method == method]
            cells.append(_headings(found[-1] if found else {}))
        table.append(f"{method:<19} " + " ".join(f"{cell:>22}" for cell in cells))
    bounds = [
        _headings({name: rows[-1].against_bound[name].bound for name in HEADINGS} if rows else {})
        for _, rows in sets
    ]
    return [*table, f"{'bound':<19} " + " ".join(f"{cell:>22}" for cell in bounds)]


def _headings(figures: Mapping[str, float | None]) -> str:
    quiet, noisy = (figures.get(name) for name in HEADINGS)
    return f"{_text(noisy)} ({_text(quiet)})"


def _cell(mean: float | None, spread: float | None, digits: int) -> str:
    return "-" if mean is None or spread is None else f"{mean:.{digits}f}+-{spread:.{digits}f}"
