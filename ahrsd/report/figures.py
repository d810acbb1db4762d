"""The pictures of a report, drawn with matplotlib without a display.

Colours and grey text are chosen to read on white and on black; SVG backgrounds are transparent.
Orange is before, blue is after, everywhere in the project.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ahrsd.report.contents import EstimateHistory, FieldClouds, FieldNorm, HeadingError
from ahrsd.samples import Array

BEFORE, AFTER, TRUTH = "#e67d28", "#2f86e8", "#888888"
SERIES = ("#d9534f", "#3f9d4b", "#4f7fe0", "#c9962b", "#b455b4", "#2fa3a3")
GREY = "#808080"
WIDTH_IN = 5.0
MAX_POINTS = 1500
STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.edgecolor": GREY,
    "axes.labelcolor": GREY,
    "axes.titlecolor": GREY,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "text.color": GREY,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "axes.grid": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.hashsalt": "ahrsd",
    "savefig.dpi": 160,  # of clouds of points, which are pixels inside the SVG
}


def as_data_uri(draw: Callable[[], Figure]) -> str:
    """Draw, and give the picture as an SVG data URI; the same data give the same bytes."""
    with rc_context(STYLE):
        stream = io.BytesIO()
        draw().savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def save_png(draw: Callable[[], Figure], path: Path, width_px: int, height_px: int) -> None:
    """Draw on white into a PNG of exactly this size; raises OSError."""
    with rc_context({**STYLE, "text.color": "#404040", "axes.labelcolor": "#404040"}):
        figure = draw()
        dpi = width_px / figure.get_figwidth()
        figure.set_size_inches(width_px / dpi, height_px / dpi)
        FigureCanvasAgg(figure)
        figure.savefig(path, format="png", dpi=dpi, facecolor="white")


def _figure(height_in: float, rows: int = 1, columns: int = 1, **options: object) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    figure.subplots(rows, columns, **options)  # type: ignore[call-overload]
    return figure


def _thin(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(np.int64))


def heading(data: HeadingError, title: str) -> Figure:
    """Heading error over the heading: both on one scale, and below it the rest enlarged."""
    figure = _figure(4.2, 2, 1, sharex=True, height_ratios=[3, 2])
    both, enlarged = figure.axes
    shown = _thin(len(data.heading_deg))
    turn = np.mod(data.heading_deg, 360.0)
    for axes in (both, enlarged):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
    for axes, error, colour, label in (
        (both, data.before_deg, BEFORE, "before"),
        (both, data.after_deg, AFTER, "after"),
        (enlarged, data.after_deg, AFTER, "after"),
    ):
        _dots(axes, turn[shown], error[shown], colour)
        axes.plot(*binned(turn, error), color=colour, linewidth=2.0, label=label)
    if data.limit_deg is not None:
        for sign in (-1.0, 1.0):
            enlarged.axhline(sign * data.limit_deg, color=TRUTH, linewidth=1.2, linestyle="--")
    reach = max(float(np.max(np.abs(data.after_deg))), data.limit_deg or 0.0, 1e-3)
    enlarged.set_ylim(-1.25 * reach, 1.25 * reach)
    legend_above(figure, both)
    both.set_title(title)
    limit = "" if data.limit_deg is None else f" (dashed: limit {data.limit_deg:g} deg)"
    enlarged.set_title(f"After, enlarged{limit}")
    for axes in (both, enlarged):
        axes.set_ylabel("error [deg]")
        axes.set_xlim(0.0, 360.0)
    enlarged.set_xticks(np.arange(0, 361, 45))
    enlarged.set_xlabel("heading [deg]")
    return figure


def binned(turn_deg: Array, error_deg: Array, width_deg: float = 10.0) -> tuple[Array, Array]:
    """Median error in each `width_deg` of heading that has data; nan where it has none."""
    which = np.floor(turn_deg / width_deg).astype(np.int64)
    middles = np.arange(0, int(360 / width_deg))
    medians = [np.median(error_deg[which == k]) if np.any(which == k) else np.nan for k in middles]
    return np.asarray((middles + 0.5) * width_deg, float), np.array(medians, dtype=np.float64)


def norm(data: FieldNorm) -> Figure:
    """Field strength over time, before and after."""
    figure = _figure(2.8)
    axes = figure.axes[0]
    shown = _thin(len(data.time_s))
    for values, colour, label in (
        (data.before_gauss, BEFORE, "with the registers in place"),
        (data.after_gauss, AFTER, "with the newest estimate"),
    ):
        axes.plot(data.time_s[shown], values[shown], color=colour, linewidth=1.2, label=label)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("field strength [gauss]")
    axes.set_ylim(bottom=0.0)
    legend_above(figure)
    return figure


def clouds(data: FieldClouds) -> Figure:
    """Raw and corrected field seen along each axis, with the fitted ellipse and the circle."""
    figure = _figure(2.3, 1, 3)
    corrected = (data.raw_b_gauss - data.hard_iron_gauss) @ np.linalg.inv(data.soft_iron).T
    shown = _thin(len(corrected))
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    spread = data.soft_iron @ data.soft_iron.T  # outline of a projected ellipsoid
    for axes, (i, j) in zip(figure.axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        pair = np.ix_((i, j), (i, j))
        ellipse = data.field_gauss * np.linalg.cholesky(spread[pair]) @ circle
        centre = data.hard_iron_gauss[[i, j]]
        _cloud(axes, data.raw_b_gauss[shown][:, [i, j]], ellipse + centre[:, None], BEFORE)
        _cloud(axes, corrected[shown][:, [i, j]], data.field_gauss * circle, AFTER)
        axes.plot(*centre, "+", color=BEFORE, markersize=9, markeredgewidth=2)
        axes.plot(0.0, 0.0, "+", color=AFTER, markersize=9, markeredgewidth=2)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"{'xyz'[i]} [gauss]")
        axes.set_ylabel(f"{'xyz'[j]} [gauss]", labelpad=-2)
        axes.tick_params(labelsize=8)
    handles = [
        Line2D([], [], color=BEFORE, marker=".", label="raw, and its ellipsoid"),
        Line2D([], [], color=AFTER, marker=".", label="corrected, and its sphere"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return figure


def _cloud(axes: Axes, points: Array, outline: Array, colour: str) -> None:
    _dots(axes, points[:, 0], points[:, 1], colour)
    axes.plot(outline[0], outline[1], color=colour, linewidth=1.0)


def history(data: EstimateHistory) -> Figure:
    """An estimate over time with its 1-sigma band, and the truth where it is known."""
    figure = _figure(2.8)
    axes = figure.axes[0]
    for k, label in enumerate(data.labels):
        colour = SERIES[k % len(SERIES)]
        value, sigma = data.value[:, k], data.sigma[:, k]
        axes.plot(data.time_s, value, color=colour, linewidth=1.5, label=label)
        axes.fill_between(
            data.time_s, value - sigma, value + sigma, color=colour, alpha=0.2, linewidth=0
        )
        if data.truth is not None:
            axes.axhline(data.truth[k], color=colour, linewidth=1.0, linestyle=":")
    axes.set_ylim(*settled_range(data))
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{data.name.lower()} [{data.unit}]" if data.unit else data.name.lower())
    handles = axes.get_legend_handles_labels()[0]
    if data.truth is not None:
        handles.append(Line2D([], [], color=TRUTH, linestyle=":", label="truth"))
    legend_above(figure, handles=handles)
    return figure


def legend_above(
    figure: Figure, axes: Axes | None = None, handles: list[Any] | None = None
) -> None:
    """One legend above the picture, where no curve runs; of these axes or of the first."""
    shown = handles or (axes or figure.axes[0]).get_legend_handles_labels()[0]
    figure.legend(
        handles=shown,
        loc="outside upper center",
        ncols=len(shown),
        columnspacing=1.0,
        handlelength=1.2,
    )


_BANDS = 4.0  # standard deviations at the end that are seen on both sides


def settled_range(data: EstimateHistory) -> tuple[float, float]:
    """What the estimate settled to, as wide as its uncertainty at the end lets one see.

    First guesses and their standard deviations leave the picture.
    """
    late = data.value[len(data.value) // 2 :]
    band = _BANDS * np.nanmin(data.sigma[len(data.sigma) // 2 :], axis=0)
    values = [late - band, late + band]
    if data.truth is not None:
        values.append(np.broadcast_to(data.truth, late.shape))
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = max(0.05 * (high - low), 1e-9)
    return low - margin, high + margin


def _dots(axes: Axes, x: Array, y: Array, colour: str) -> None:
    axes.plot(x, y, ".", color=colour, markersize=2.0, alpha=0.4, rasterized=True)
