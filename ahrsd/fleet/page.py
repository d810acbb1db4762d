"""The fleet's page out of its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ahrsd.errors import AhrsdError
from ahrsd.fleet.drift import DeviceDrift, Trend
from ahrsd.fleet.questions import FleetRows
from ahrsd.fleet.store import Store
from ahrsd.fleet.words import change_words, date, trend_words
from ahrsd.printable import LINE, counted, printable
from ahrsd.report.fleet_page import (
    DeviceLine,
    Drawing,
    FailureLine,
    FindingLine,
    FleetPage,
    write_fleet_report,
)

_DEVICES, _DRAWN, _FINDINGS, _FAILURES = 40, 6, 60, 30  # at most on the page
_CHANCE = 0.01
_MISMATCHES = """
    select device, count(*) filter (mismatch), count(mismatch) from recordings group by device"""


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
            f"{counted(counts['devices'], 'device', ',')}: {outcomes}. "
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
