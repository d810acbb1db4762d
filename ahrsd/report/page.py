"""Puts a report on a page: one HTML file with its pictures inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ahrsd.gates import guards_a_write
from ahrsd.report.contents import EstimateHistory, HeadingError, RegisterChange, ReportData
from ahrsd.report.template import Picture, number, picture, render
from drivers.vn100.registers import register_lines

HEADING_TITLE = "Heading error before and after, on data that the estimate has not seen"


def write_report(path: Path, data: ReportData) -> None:
    """Write the report; raises OSError."""
    gates = [gate for gate in data.gates if guards_a_write(gate.gate)]
    page = render(
        "report.html",
        title=data.title,
        data=data,
        key_figures=[*(data.heading.figures() if data.heading else ()), *data.summary],
        heading_title=HEADING_TITLE,
        heading=_heading(data),
        norm=_norm(data),
        clouds=_clouds(data),
        history=[_history(item) for item in data.history],
        failing=[gate for gate in gates if not gate.ok],
        passing=[gate for gate in gates if gate.ok],
        registers=[_register(change) for change in data.registers],
    )
    path.write_text(page, encoding="utf-8")


def before_after_figure(
    path_png: Path, heading: HeadingError, width_px: int = 1280, height_px: int = 800
) -> None:
    """Write the picture 'before and after' as a PNG of this size; raises OSError."""
    from ahrsd.report import figures

    figures.save_png(lambda: figures.heading(heading, HEADING_TITLE), path_png, width_px, height_px)


def _heading(data: ReportData) -> Picture | None:
    if data.heading is None:
        return None
    from ahrsd.report import figures

    heading = data.heading
    worst, rms = heading.figures()
    alt = (
        f"Heading error over all headings: worst {number(worst.before)} deg before and "
        f"{number(worst.after)} deg after, rms {number(rms.before)} and {number(rms.after)} deg"
    )
    return picture(
        lambda: figures.heading(heading, "Before and after on one scale"), alt, heading.source
    )


def _norm(data: ReportData) -> Picture | None:
    if data.norm is None:
        return None
    from ahrsd.report import figures

    norm = data.norm
    known = np.isfinite(norm.after_gauss)
    alt = f"Field strength over time: it varies by {_spread(norm.before_gauss)} before"
    if known.any():
        alt += f" and by {_spread(norm.after_gauss[known])} with the estimate"
    caption = (
        "The earth's field is equally strong whichever way the vehicle points. What varies here "
        "is iron, or a field of the surroundings."
    )
    return picture(lambda: figures.norm(norm), alt, caption)


def _spread(values: np.ndarray) -> str:
    return f"{number(100.0 * float(np.std(values) / np.mean(values)))} %"


def _clouds(data: ReportData) -> Picture | None:
    if data.clouds is None:
        return None
    from ahrsd.report import figures

    clouds = data.clouds
    centre = ", ".join(number(float(value)) for value in clouds.hard_iron_gauss)
    alt = (
        f"Field in the sensor frame along each axis: raw points on an ellipsoid around ({centre}) "
        f"gauss, corrected points on a sphere of {number(clouds.field_gauss)} gauss"
    )
    caption = (
        "Hard iron moves the centre (+), soft iron bends the sphere into an ellipsoid. Points that "
        "cover only a part of it determine only a part of the calibration."
    )
    return picture(lambda: figures.clouds(clouds), alt, caption)


def _history(item: EstimateHistory) -> Picture:
    from ahrsd.report import figures

    last = ", ".join(
        f"{label} {number(float(value))} ± {number(float(sigma))}"
        for label, value, sigma in zip(item.labels, item.value[-1], item.sigma[-1], strict=True)
    )
    text = f"{item.name}: {last} {item.unit}".rstrip()
    if item.truth is not None:
        text += f"; truth {', '.join(number(float(value)) for value in item.truth)}"
    return picture(lambda: figures.history(item), text, f"{text}. Bands are one sigma.")


def _register(change: RegisterChange) -> dict[str, object]:
    """Both values by rows, and the commands that write each."""
    restore, write = (
        "\n".join(register_lines({change.register: values}))
        for values in (change.before, change.after)
    )
    rows = [
        (label, values[3 * k : 3 * k + 3])
        for name, values in (("before", change.before), ("after", change.after))
        for k, label in enumerate((f"{name}: C row 1", "C row 2", "C row 3", "B"))
    ]
    return {
        "number": change.register,
        "outcome": change.outcome,
        "rows": rows,
        "write": write,
        "restore": restore,
    }
