"""Pictures of how accurate calibrations are: of an evaluation, of all methods, of a Monte Carlo.

* `evaluate`: heading error, field strength and the reckoned way;
* `calibrate --method all`: hard iron and held-out spread, failures in words;
* `montecarlo`: errors over time against the Cramer-Rao bound, and the NEES.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahrsd.baselines.registry import ComparisonRow
from ahrsd.evaluation.judging import Evaluation, HeadingJudged, Reckoned
from ahrsd.montecarlo.summary import BOUNDED, SummaryRow
from ahrsd.printable import drawn
from ahrsd.report.figures import AFTER, BEFORE, GREY, MAX_POINTS, SERIES, TRUTH, save_png

# -- An evaluation ---------------------------------------------------------------------------------


_EVALUATION_PANEL_PX, _EVALUATION_ROW_PX = 560, 360


def write_evaluation_figure(path: Path, found: Evaluation) -> None:
    """As PNG: two panels per heading, one for the field, one for the way.  Raises OSError."""
    rows = len(found.headings) + 1
    save_png(
        lambda: _draw_evaluation(found, rows),
        path,
        2 * _EVALUATION_PANEL_PX,
        rows * _EVALUATION_ROW_PX + 40,
    )


def _draw_evaluation(found: Evaluation, rows: int) -> Figure:
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
        f"Track, grey {drawn(reckoned.reference)}: RMS error {pair.before.rms_percent:.1f} %, "
        f"{pair.after.rms_percent:.1f} %"
    )


def _thin(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.unique(np.linspace(0, count - 1, min(count, 2 * MAX_POINTS)).astype(np.int64))


# -- All methods -----------------------------------------------------------------------------------


_METHODS_WIDTH_PX, _METHODS_ROW_PX = 1500, 52
_AXES = "xyz"
_WORDS = 150
_WORST_SHOWN = 5.0  # times the median length of the bars; a longer one is cut and its number said


def write_methods_figure(path: Path, title: str, rows: Sequence[ComparisonRow]) -> None:
    """As PNG, one line a method.  Raises OSError."""
    save_png(
        lambda: _draw_methods(title, rows),
        path,
        _METHODS_WIDTH_PX,
        _METHODS_ROW_PX * len(rows) + 170,
    )


def _draw_methods(title: str, rows: Sequence[ComparisonRow]) -> Figure:
    figure = Figure(
        figsize=(12.5, (_METHODS_ROW_PX * len(rows) + 170) / 120.0), layout="constrained"
    )
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    _hard_iron(left, rows)
    _spread(right, rows)
    left.set_yticks(np.arange(len(rows)), [row.method for row in rows])
    left.invert_yaxis()
    figure.suptitle(drawn(title, 120))
    return figure


def _hard_iron(axes: Axes, rows: Sequence[ComparisonRow]) -> None:
    given = [
        (k, row.hard_iron_gauss) for k, row in enumerate(rows) if row.hard_iron_gauss is not None
    ]
    values = 1e3 * np.array([hard_iron for _, hard_iron in given]).reshape(-1, 3)
    reach = _reach(np.abs(values))
    for i, colour in zip(range(3), SERIES, strict=False):
        places = [k + 0.25 * (i - 1) for k, _ in given]
        axes.barh(places, np.clip(values[:, i], -reach, reach), 0.22, color=colour, label=_AXES[i])
        for place, value in zip(places, values[:, i], strict=True):
            if abs(value) > reach:
                axes.text(np.sign(value) * reach, place, f"{value:.0f}", fontsize=7, va="center")
    for k, row in enumerate(rows):
        if row.hard_iron_gauss is None:
            words = textwrap.shorten(f"no answer: {row.reason}", _WORDS, placeholder=" ...")
            text = "\n".join(textwrap.wrap(words, 75))
            axes.text(0.01, k, text, transform=axes.get_yaxis_transform(), fontsize=8, va="center")
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlabel("hard iron [mG]")
    if given:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)


def _spread(axes: Axes, rows: Sequence[ComparisonRow]) -> None:
    shown = [(k, 100 * row.held_out, row) for k, row in enumerate(rows) if row.held_out is not None]
    reach = _reach(np.array([value for _, value, _ in shown]))
    for k, value, row in shown:
        axes.barh(k, min(value, reach), 0.6, color=AFTER, alpha=1.0 if row.converged else 0.45)
        remark = "" if row.converged else " (not converged)"
        axes.text(0.02 * reach, k, f"{value:.2f} %{remark}", fontsize=8, va="center")
    for k, row in enumerate(rows):
        if row.hard_iron_gauss is not None and row.held_out is None:
            axes.text(0.02 * reach, k, "no answer on half of the data", fontsize=8, va="center")
    axes.set_xlabel("spread of |h| on held-out readings [%]")


def _reach(lengths: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    if not lengths.size:
        return 1.0
    return float(min(np.max(lengths), _WORST_SHOWN * np.median(lengths))) or 1.0


# -- A Monte Carlo ---------------------------------------------------------------------------------


_TITLES = {
    "hard_iron_gauss": ("hard iron [mG]", 1e3),
    "soft_iron": ("soft iron, Frobenius", 1.0),
    "gyro_bias_rad_s": ("gyro bias [mrad/s]", 1e3),
}
_HONEST = (0.85, 1.20)
_MONTECARLO_PANEL_PX, _MONTECARLO_ROW_PX = 420, 380


def write_montecarlo_figure(path: Path, sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> None:
    """One row of panels per set (name, rows of the summary), as PNG.  Raises OSError."""
    width = _MONTECARLO_PANEL_PX * (len(BOUNDED) + 1)
    save_png(lambda: _draw_montecarlo(sets), path, width, _MONTECARLO_ROW_PX * len(sets) + 40)


def _draw_montecarlo(sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> Figure:
    columns = len(BOUNDED) + 1
    figure = Figure(figsize=(3.4 * columns, 3.0 * len(sets) + 0.4), layout="constrained")
    grid = figure.subplots(len(sets), columns, squeeze=False)
    for line, (name, rows) in zip(grid, sets, strict=True):
        colours = _colours(rows)
        for axes, figure_name in zip(line, BOUNDED, strict=False):
            _errors(axes, figure_name, rows, colours)
        _nees(line[-1], rows, colours)
        runs = rows[0].runs if rows else 0
        line[0].set_title(f"{name}, {runs} runs: {_TITLES[BOUNDED[0]][0]}")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 6))
    return figure


def _colours(rows: Sequence[SummaryRow]) -> dict[str, str]:
    names = dict.fromkeys(row.method for row in rows)
    return {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)}


def _errors(axes: Axes, name: str, rows: Sequence[SummaryRow], colours: dict[str, str]) -> None:
    title, unit = _TITLES[name]
    first = next(iter(colours), "")
    bound = [(r.at_s, r.against_bound[name].bound) for r in rows if r.method == first]
    known = [(at_s, value * unit) for at_s, value in bound if value is not None]
    axes.plot(*zip(*known, strict=True), color=TRUTH, linewidth=4, alpha=0.5, label="bound")
    wider = [(r.at_s, r.ordinary_bound[name]) for r in rows if r.method == first]
    told = [(at_s, value * unit) for at_s, value in wider if value is not None]
    if told:
        axes.plot(*zip(*told, strict=True), "--", color=TRUTH, label="bound, ordinary")
    for method, colour in colours.items():
        found = [(r.at_s, r.against_bound[name].rmse) for r in rows if r.method == method]
        shown = [(at_s, value * unit) for at_s, value in found if value is not None]
        if shown:
            axes.plot(*zip(*shown, strict=True), "o-", color=colour, markersize=4, label=method)
    axes.set_yscale("log")
    axes.set_title(title)
    axes.set_xlabel("time [s]")


def _nees(axes: Axes, rows: Sequence[SummaryRow], colours: dict[str, str]) -> None:
    axes.axhspan(*_HONEST, color=GREY, alpha=0.2)
    for method, colour in colours.items():
        shown = [r for r in rows if r.method == method and r.nees is not None]
        if shown:
            axes.errorbar(
                [r.at_s for r in shown],
                [r.nees or 0.0 for r in shown],
                [r.nees_standard_error or 0.0 for r in shown],
                color=colour,
                marker="o",
                markersize=4,
            )
    axes.set_yscale("log")
    axes.set_title("NEES per degree of freedom")
    axes.set_xlabel("time [s]")
