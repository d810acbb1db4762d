"""The page of a fleet: its devices worst first, their drift, findings by vehicle, failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from ahrsd.errors import AhrsdError
from ahrsd.fleet.drift import DeviceDrift, Trend
from ahrsd.fleet.questions import FleetRows, change_words, date, trend_words
from ahrsd.fleet.store import Store
from ahrsd.printable import LINE, counted, drawn, printable
from ahrsd.report.figures import GREY, SERIES
from ahrsd.report.template import picture, render
from ahrsd.samples import Array

# -- What it shows ---------------------------------------------------------------------------------


_AXES = "xyz"
_MILLI = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One device's calibrations over time: hard iron and gyro bias (n, 3), with their sigmas.

    steps: for each of the two, days between which it stepped
    """

    device: str
    day: Array
    hard_iron_gauss: Array
    hard_iron_sigma_gauss: Array
    gyro_bias_rad_s: Array
    gyro_bias_sigma_rad_s: Array
    steps: tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DeviceLine:
    """A device in the fleet's table; iron_drift_mg: from first to last, without steps."""

    device: str
    vehicle: str
    calibrations: int
    newest: str
    heading_sigma_deg: float
    heading_kept_deg: float
    iron_drift_mg: float | None
    steps: int
    mismatches: str


@dataclass(frozen=True, slots=True)
class FindingLine:
    """How often a vehicle's recordings show a finding; everywhere: how often all do."""

    vehicle: str
    effect: str
    found: int
    of: int
    share: float
    everywhere: float
    more: bool


@dataclass(frozen=True, slots=True)
class FailureLine:
    """A reason, how often, what to do."""

    outcome: str
    words: str
    recordings: int
    remedy: str


@dataclass(frozen=True, slots=True)
class FleetPage:
    """What the page shows; more: devices and failures that are not on it; empty: no rows."""

    title: str
    verdict: str
    devices: Sequence[DeviceLine]
    drawings: Sequence[Drawing]
    findings: Sequence[FindingLine]
    failures: Sequence[FailureLine]
    more: str
    command: str
    empty: bool


def write_fleet_report(path: Path, page: FleetPage) -> None:
    """Write it.  OSError where it cannot be written."""
    pictures = [
        (
            drawing.device,
            drawing.words,
            picture(partial(_draw, drawing), f"drift of {drawing.device}"),
        )
        for drawing in page.drawings
    ]
    text = render("fleet.html", title=page.title, page=page, pictures=pictures)
    path.write_text(text, encoding="utf-8")


def _draw(drawing: Drawing) -> Figure:
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    when = drawing.day.astype("datetime64[D]") + np.round((drawing.day % 1.0) * 86400e3).astype(
        "timedelta64[ms]"
    )
    rows = (
        ("hard iron [mG]", drawing.hard_iron_gauss, drawing.hard_iron_sigma_gauss),
        ("gyro bias [mrad/s]", drawing.gyro_bias_rad_s, drawing.gyro_bias_sigma_rad_s),
    )
    for one, (label, values, sigmas), steps in zip(axes, rows, drawing.steps, strict=True):
        for k, colour in zip(range(3), SERIES, strict=False):
            one.errorbar(
                when, _MILLI * values[:, k], _MILLI * sigmas[:, k], fmt=".", markersize=4,
                linewidth=0.8, color=colour, label=_AXES[k],
            )  # fmt: skip
        for begin, end in steps:
            one.axvspan(_at(begin), _at(end), color=GREY, alpha=0.3, linewidth=1.0)
        one.set_ylabel(label)
    axes[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    axes[0].set_title(drawn(drawing.device), loc="right")
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    axes[1].xaxis.set_major_locator(locator)
    axes[1].xaxis.set_major_formatter(
        ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
    )
    return figure


def _at(day: float) -> np.datetime64:
    return np.datetime64(round(day * 86400e3), "ms")


# -- Out of the rows -------------------------------------------------------------------------------


_DEVICES, _DRAWN, _FINDINGS, _FAILURES = 40, 6, 60, 30  # at most on the page
_CHANCE = 0.01
_MISMATCHES = """
    select device, count(*) filter (mismatch), count(mismatch) from results group by device"""


def write_page(output: Path, path: Path) -> None:
    """The page of the fleet in `output`.  AhrsdError where it cannot be written."""
    with FleetRows(Store(output)) as rows:
        page = _page(output, rows)
    try:
        write_fleet_report(path, page)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error


def _page(output: Path, rows: FleetRows) -> FleetPage:
    counts, drifts = rows.counts(), rows.drift()
    mismatches = {name: f"{n} of {of}" for name, n, of in rows.sql(_MISMATCHES).rows}
    failures = rows.failures().rows
    outcomes = ", ".join(f"{number:,} {outcome}" for outcome, number in counts["outcomes"].items())
    more = len(drifts) - _DEVICES
    return FleetPage(
        title=f"Fleet {printable(output.resolve().name)}",
        verdict=(
            f"{counted(counts['recordings'], 'recording', ',')} of "
            f"{counted(counts['devices'], 'device', ',')}: {outcomes or 'no row yet'}. "
            f"{counts['mismatches']:,} differ from what their calibration predicts."
        ),
        devices=[_line(one, mismatches.get(one.device, "–")) for one in drifts[:_DEVICES]],
        drawings=[_drawing(one) for one in drifts[:_DRAWN] if one.recordings > 2],
        findings=_findings(rows),
        failures=[
            FailureLine(
                outcome, printable(error or "", LINE), number, printable(remedy or "", LINE)
            )
            for outcome, error, number, remedy, _ in failures[:_FAILURES]
        ],
        more=f"{counted(more, 'more device', ',')}: ahrsd fleet ask OUT drift --json"
        if more > 0
        else "",
        command=f"ahrsd fleet status {printable(output, 500)} --report DIR",
        empty=not counts["recordings"],
    )


def _line(one: DeviceDrift, mismatches: str) -> DeviceLine:
    slope = one.iron.per_year * one.iron.days / 365.25
    return DeviceLine(
        device=printable(one.device),
        vehicle=printable(one.vehicle or "–"),
        calibrations=one.recordings,
        newest=date(one.last_day),
        heading_sigma_deg=one.heading_sigma_deg,
        heading_kept_deg=one.heading_kept_deg,
        iron_drift_mg=1e3 * float(np.linalg.norm(slope)) if np.isfinite(slope).all() else None,
        steps=len(one.iron.changes) + len(one.bias.changes),
        mismatches=mismatches,
    )


def _drawing(one: DeviceDrift) -> Drawing:
    series = one.series
    words = [f"hard iron {trend_words(one.iron, 'mG')}"]
    words += [f"hard iron {change_words(change, 'mG')}" for change in one.iron.changes]
    words += [f"gyro bias {change_words(change, 'mrad/s')}" for change in one.bias.changes]
    return Drawing(
        printable(one.device),
        series.day,
        series.values[:, :3],
        series.sigmas[:, :3],
        series.values[:, 3:],
        series.sigmas[:, 3:],
        (_steps(one.iron), _steps(one.bias)),
        tuple(words),
    )


def _steps(found: Trend) -> tuple[tuple[float, float], ...]:
    return tuple((change.before_day, change.after_day) for change in found.changes)


def _findings(rows: FleetRows) -> Sequence[FindingLine]:
    """Those that come again on a vehicle, by vehicle."""
    found = [row for row in rows.recurring().rows if row[1] == "vehicle"]
    lines = [
        FindingLine(printable(name), printable(effect), n, of, share, everywhere, p < _CHANCE)
        for effect, _, name, n, of, share, everywhere, p in found
    ]
    return sorted(lines, key=lambda one: (one.vehicle, -one.share))[:_FINDINGS]
