"""The picture of the peers: every method's error over the bound, one panel per figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahrsd.montecarlo.summary import BOUNDED, SummaryRow
from ahrsd.report.figures import GREY, SERIES, TRUTH, save_png

_TITLES = {
    "hard_iron_gauss": "hard iron, RMSE / bound",
    "soft_iron": "soft iron, RMSE / bound",
    "gyro_bias_rad_s": "gyro bias, RMSE / bound",
}
_WIDTH_PX, _ROW_PX = 1500, 34


def write_peers_figure(
    path: Path, sets: Sequence[tuple[str, Sequence[SummaryRow]]], ours: Sequence[str]
) -> None:
    """One line per method, one mark per set (name, rows at one time), as PNG.  Raises OSError.

    ours: methods that are drawn on a ground of their own.
    """
    lines = len(sets[0][1])
    save_png(lambda: _draw(sets, ours), path, _WIDTH_PX, _ROW_PX * lines + 160)


def _draw(sets: Sequence[tuple[str, Sequence[SummaryRow]]], ours: Sequence[str]) -> Figure:
    methods = [row.method for row in sets[0][1]]
    figure = Figure(figsize=(12.5, 0.28 * len(methods) + 1.3), layout="constrained")
    panels = figure.subplots(1, len(BOUNDED), sharey=True)
    for axes, name in zip(panels, BOUNDED, strict=True):
        _panel(axes, name, sets)
        axes.set_title(_TITLES[name])
        for line in (k for k, method in enumerate(methods) if method in ours):
            axes.axhspan(line - 0.5, line + 0.5, color=GREY, alpha=0.15, linewidth=0)
    panels[0].set_yticks(range(len(methods)), methods)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(sets) + 1)
    return figure


def _panel(axes: Axes, name: str, sets: Sequence[tuple[str, Sequence[SummaryRow]]]) -> None:
    axes.axvline(1.0, color=TRUTH, linewidth=3, alpha=0.5, label="bound")
    for k, (label, rows) in enumerate(sets):
        shown = [
            (ratio, line + 0.1 * (k - (len(sets) - 1) / 2))
            for line, row in enumerate(rows)
            if (ratio := row.against_bound[name].over_bound) is not None
        ]
        axes.plot(
            [ratio for ratio, _ in shown],
            [line for _, line in shown],
            "o",
            color=SERIES[k % len(SERIES)],
            markersize=4,
            label=label,
        )
    axes.set_xscale("log")
