"""The picture of an evaluation: heading error, field strength and the reckoned way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahrsd.evaluation.judging import Evaluation, HeadingJudged, Reckoned
from ahrsd.printable import drawn
from ahrsd.report.figures import AFTER, BEFORE, GREY, MAX_POINTS, TRUTH, save_png

_PANEL_PX, _ROW_PX = 560, 360


def write_evaluation_figure(path: Path, found: Evaluation) -> None:
    """As PNG: two panels per heading, one for the field, one for the way.  Raises OSError."""
    rows = len(found.headings) + 1
    save_png(lambda: _draw(found, rows), path, 2 * _PANEL_PX, rows * _ROW_PX + 40)


def _draw(found: Evaluation, rows: int) -> Figure:
    figure = Figure(figsize=(9.0, 3.0 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False)
    for line, judged in zip(grid, found.headings, strict=False):
        _over_heading(line[0], judged)
        _over_time(line[1], judged)
    _field(grid[-1][0], found)
    if found.reckoned is None:
        grid[-1][1].set_axis_off()
    else:
        _way(grid[-1][1], found.reckoned)
    handles, labels = grid[-1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    return figure


def _over_heading(axes: Axes, judged: HeadingJudged) -> None:
    for figures, colour in ((judged.figures.before, BEFORE), (judged.figures.after, AFTER)):
        kept = _thin(len(figures.error_deg))
        axes.plot(
            figures.reference_deg[kept], figures.error_deg[kept], ".", color=colour, markersize=3
        )
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlim(0.0, 360.0)
    axes.set_xticks(np.arange(0, 361, 90))
    axes.set_xlabel("heading [deg]")
    axes.set_ylabel("error [deg]")
    axes.set_title(f"Heading against {drawn(judged.reference)}")


def _over_time(axes: Axes, judged: HeadingJudged) -> None:
    for figures, colour in ((judged.figures.before, BEFORE), (judged.figures.after, AFTER)):
        kept = _thin(len(figures.error_deg))
        axes.plot(figures.time_s[kept], figures.error_deg[kept], ".", color=colour, markersize=3)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlabel("time [s]")
    before, after = judged.figures.before.rms_deg, judged.figures.after.rms_deg
    axes.set_title(f"RMS {before:.1f} deg before, {after:.1f} deg after")


def _field(axes: Axes, found: Evaluation) -> None:
    kept = _thin(len(found.track))
    time_s = found.track.time_s[kept]
    pair = found.field
    for figures, colour, label in ((pair.before, BEFORE, "before"), (pair.after, AFTER, "after")):
        axes.plot(time_s, figures.size_gauss[kept], color=colour, linewidth=0.8, label=label)
    if found.world is not None:
        axes.axhline(found.world.total_gauss, color=TRUTH, linestyle="--", label=found.world.model)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("|h| [gauss]")
    axes.set_title(
        f"Field: spread {100 * pair.before.spread:.1f} %, {100 * pair.after.spread:.1f} %"
    )


def _way(axes: Axes, reckoned: Reckoned) -> None:
    fixes, pair = reckoned.fixes, reckoned.figures
    axes.plot(
        fixes.east_m, fixes.north_m, color=TRUTH, linewidth=3, label=drawn(reckoned.reference)
    )
    for figures, colour in ((pair.before, BEFORE), (pair.after, AFTER)):
        axes.plot(figures.east_m, figures.north_m, color=colour, linewidth=1.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_title(
        f"Way, grey {drawn(reckoned.reference)}: RMS error {pair.before.rms_percent:.1f} %, "
        f"{pair.after.rms_percent:.1f} %"
    )


def _thin(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.unique(np.linspace(0, count - 1, min(count, 2 * MAX_POINTS)).astype(np.int64))
