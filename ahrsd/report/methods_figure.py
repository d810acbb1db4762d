"""The picture of `calibrate --method all`: hard iron and held-out spread, failures in words."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahrsd.baselines.comparison import ComparisonRow
from ahrsd.printable import drawn
from ahrsd.report.figures import AFTER, GREY, SERIES, save_png

_WIDTH_PX, _ROW_PX = 1500, 52
_AXES = "xyz"
_WORDS = 150
_WORST_SHOWN = 5.0  # times the median length of the bars; a longer one is cut and its number said


def write_methods_figure(path: Path, title: str, rows: Sequence[ComparisonRow]) -> None:
    """As PNG, one line a method.  Raises OSError."""
    save_png(lambda: _draw(title, rows), path, _WIDTH_PX, _ROW_PX * len(rows) + 170)


def _draw(title: str, rows: Sequence[ComparisonRow]) -> Figure:
    figure = Figure(figsize=(12.5, (_ROW_PX * len(rows) + 170) / 120.0), layout="constrained")
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
    axes.set_xlabel("spread of |h| on readings that it has not seen [%]")


def _reach(lengths: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    if not lengths.size:
        return 1.0
    return float(min(np.max(lengths), _WORST_SHOWN * np.median(lengths))) or 1.0
