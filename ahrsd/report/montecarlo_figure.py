"""The picture of a Monte Carlo: errors over time against the Cramer-Rao bound, and the NEES."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahrsd.montecarlo.summary import BOUNDED, SummaryRow
from ahrsd.report.figures import GREY, SERIES, TRUTH, save_png

_TITLES = {
    "hard_iron_gauss": ("hard iron [mG]", 1e3),
    "soft_iron": ("soft iron, Frobenius", 1.0),
    "gyro_bias_rad_s": ("gyro bias [mrad/s]", 1e3),
}
_HONEST = (0.85, 1.20)
_PANEL_PX, _ROW_PX = 420, 380


def write_montecarlo_figure(path: Path, sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> None:
    """One row of panels per set (name, rows of the summary), as PNG.  Raises OSError."""
    width = _PANEL_PX * (len(BOUNDED) + 1)
    save_png(lambda: _draw(sets), path, width, _ROW_PX * len(sets) + 40)


def _draw(sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> Figure:
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
