"""Answers of the questions as lines for a person; foreign texts are made printable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ahrsd.fleet.drift import DeviceDrift, StepChange, Trend
from ahrsd.fleet.questions import AnswerTable
from ahrsd.printable import counted, printable
from ahrsd.samples import Array

_MILLI = 1e3
_CELL = 60  # characters of a text in a table
_MOST = 40  # rows that are printed; --json has all
_LIKELY = 1e-2  # below this a recurring finding is told as more than chance


def table_lines(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A table with aligned columns, numbers to the right; at most so many rows."""
    listed = [list(row) for row in rows]
    shown = [[_cell(value) for value in row] for row in listed[:_MOST]]
    right = [
        all(isinstance(row[i], int | float | None) for row in listed) for i in range(len(columns))
    ]
    heads = [printable(name, _CELL) for name in columns]
    widths = [max(map(len, column)) for column in zip(heads, *shown, strict=True)]
    lines = [
        "  ".join(
            text.rjust(width) if flush else text.ljust(width)
            for text, width, flush in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in [heads, *shown]
    ]
    more = len(listed) - len(shown)
    return [
        *lines,
        *([f"... and {counted(more, 'more row', ',')}: --json has all"] if more else []),
    ]


def drift_lines(found: Sequence[DeviceDrift], of_no_device: int = 0) -> list[str]:
    """Every device, its drift, and below it its steps; what is of no known device is counted."""
    lines = [] if found else ["no device has two calibrations whose time is known"]
    for one in found[:_MOST]:
        vehicle = f", {printable(one.vehicle)}" if one.vehicle not in (None, one.device) else ""
        lines.append(
            f"{printable(one.device)}{vehicle}: {counted(one.recordings, 'calibration', ',')}, "
            f"{date(one.first_day)} to {date(one.last_day)}"
        )
        lines.append(f"  heading    {heading_words(one)}")
        lines.append(f"  hard iron  {trend_words(one.iron, 'mG')}")
        lines += [f"             {change_words(change, 'mG')}" for change in one.iron.changes]
        lines.append(f"  gyro bias  {trend_words(one.bias, 'mrad/s')}")
        lines += [f"             {change_words(change, 'mrad/s')}" for change in one.bias.changes]
        if one.by_file_date:
            lines.append(
                f"  note: of {counted(one.by_file_date, 'recording')} only the file's date is known"
            )
    if len(found) > _MOST:
        lines.append(f"... and {len(found) - _MOST} more devices: --json has all")
    if of_no_device:
        lines.append(
            f"left out: {counted(of_no_device, 'calibration', ',')} of no known device: in "
            "another OUT, --vehicle or --folders say whose they are"
        )
    return lines


def heading_words(one: DeviceDrift) -> str:
    """What headings are worth with the newest calibration and with the first."""
    return (
        f"{one.heading_sigma_deg:.2f} deg (1 sigma, worst direction) with the newest calibration; "
        f"{one.heading_kept_deg:.1f} deg off with the first (dip of 60 deg)"
    )


def trend_words(found: Trend, unit: str) -> str:
    """Drift over the time that was seen and with temperature, for 1e-3 of the values' unit.

    Nothing is said per year: a few days say nothing of one.
    """
    years = found.days / 365.25
    parts = [
        f"{_vector(slope)} +- {_vector(sigma, sign='')} {unit} {per}"
        for slope, sigma, per in (
            (years * found.per_year, years * found.per_year_sigma, f"in {found.days:.3g} days"),
            (found.per_degree, found.per_degree_sigma, "per degC"),
        )
        if np.isfinite(slope).all()
    ]
    return "; ".join(parts) or "too few calibrations for a drift"


def change_words(change: StepChange, unit: str) -> str:
    """A step in words."""
    first, last = date(change.before_day), date(change.after_day)
    when = f"on {first}" if first == last else f"between {first} and {last}"
    return f"steps by {_vector(change.size)} +- {_vector(change.sigma, sign='')} {unit} {when}"


def recurring_lines(found: AnswerTable) -> list[str]:
    """Findings that come again; what is no more than chance is left to --json."""
    rows = [row for row in found.rows if row[-1] < _LIKELY]
    if not rows:
        return ["no finding is more frequent anywhere than everywhere"]
    return table_lines(
        ("finding", "by", "which", "recordings", "share", "everywhere", "chance"),
        [
            (effect, by, which, f"{n} of {of}", f"{share:.0%}", f"{all_:.0%}", f"{p:.0e}")
            for effect, by, which, n, of, share, all_, p in rows
        ],
    )


def failure_lines(found: AnswerTable) -> list[str]:
    """Each reason, how often, what to do, and one of its recordings."""
    if not found.rows:
        return ["every recording gave an answer"]
    lines = []
    for outcome, error, number, remedy, example in found.rows[:_MOST]:
        lines.append(f"{number:,} {outcome}: {printable(error or 'no words', 400)}")
        if remedy:
            lines.append(f"  {printable(remedy, 400)}")
        lines.append(f"  for example {printable(example, 400)}")
    if len(found.rows) > _MOST:
        lines.append(f"... and {len(found.rows) - _MOST} more reasons: --json has all")
    return lines


def status_lines(name: str, body: dict[str, Any]) -> list[str]:
    """How a fleet stands."""
    outcomes = ", ".join(f"{number:,} {outcome}" for outcome, number in body["outcomes"].items())
    lines = [
        f"{name}: {counted(body['recordings'], 'recording', ',')}"
        + (f": {outcomes}" if outcomes else ""),
        f"  {counted(body['devices'], 'device')}, {counted(body['vehicles'], 'vehicle')}; "
        f"{counted(body['mismatches'], 'recording', ',')} with a mismatch",
        f"  {counted(body['parts'], 'part')}, {counted(body['in_spool'], 'row', ',')} in the "
        "spool; "
        f"version {', '.join(body['versions']) or 'none'}",
    ]
    run = body["run"]
    if body["at_work"] and run:
        left_s = 60.0 * (run["total"] - run["done"]) / max(run["per_minute"], 1e-9)
        lines.append(
            f"  at work (process {run['process']}): {run['done']:,} of {run['total']:,}, "
            f"{run['failed']:,} failed, {run['per_minute']:.3g} a minute, {duration(left_s)} left"
        )
    elif run and run["done"] < run["total"]:
        lines.append(
            f"  the last run stopped at {run['done']:,} of {run['total']:,} or soon after: "
            "the same command goes on"
        )
    return lines


def duration(seconds: float) -> str:
    """A duration for a person: 40 s, 12 min, 3.5 h, 6 days."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            number = seconds / size
            return f"{number:.1f} {unit}" if number < 10 else f"{number:,.0f} {unit}"
    return f"{seconds:.0f} s"


def date(day: float) -> str:
    """Days since 1970 as a date."""
    return str(np.datetime64(int(day), "D"))


def _vector(values: Array, sign: str = "+") -> str:
    largest = float(np.abs(values).max()) * _MILLI
    digits = 1 if largest >= 10 else 2 if largest >= 1 else 3
    return "(" + ", ".join(f"{_MILLI * value:{sign}.{digits}f}" for value in values) + ")"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    return printable(value, _CELL)
