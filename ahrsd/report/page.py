"""Puts a report on a page: one HTML file, nothing loaded from elsewhere, every text escaped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ahrsd.events import GateResult
from ahrsd.gates import guards_a_write
from ahrsd.report.data import EstimateHistory, HeadingError, KeyFigure, RegisterChange, ReportData
from ahrsd.writeback.composition import register_lines

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

HEADING_TITLE = "Heading error before and after, on data that the estimate has not seen"

CSS = """
:root { color-scheme: light dark; --text: #202428; --soft: #667; --line: #8884; --back: #fff;
  --good: #23823b; --bad: #c33a2c; --card: #8881; }
@media (prefers-color-scheme: dark) { :root { --text: #dde2e8; --soft: #99a; --back: #14171b;
  --good: #52b96b; --bad: #ee6a5c; } }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  max-width: 760px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 .4rem; }
.verdict { font-size: 1.1rem; border-left: 4px solid var(--soft); padding-left: .7rem; }
.verdict.yes { border-color: var(--good); }
.verdict.no { border-color: var(--bad); }
.soft, figcaption { color: var(--soft); font-size: .9rem; }
figure { margin: .5rem 0; }
img { width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .3rem .6rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
.n { text-align: right; padding-right: 1.2rem; font-variant-numeric: tabular-nums;
  white-space: nowrap; }
.good { color: var(--good); font-weight: 600; }
.bad { color: var(--bad); font-weight: 600; }
pre { background: var(--card); padding: .6rem; font-size: .78rem; white-space: pre-wrap;
  overflow-wrap: anywhere; }
ul { padding-left: 1.2rem; }
@media (max-width: 500px) { table { font-size: .76rem; } th, td { padding-right: .3rem; }
  .n { white-space: normal; padding-right: .5rem; } }
"""


def write_report(path: Path, data: ReportData) -> None:
    """Write the report; raises OSError."""
    sections = [
        _summary(data),
        _heading(data),
        _warnings(data),
        _norm(data),
        _clouds(data),
        _history(data),
        _gates(data),
        _states(data),
        _registers(data),
        _made(data),
    ]
    title = escape(data.title)
    path.write_text(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{CSS}</style></head>\n<body>\n<h1>{title}</h1>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body></html>\n",
        encoding="utf-8",
    )


def before_after_figure(
    path_png: Path, heading: HeadingError, width_px: int = 1280, height_px: int = 800
) -> None:
    """Write the picture 'before and after' as a PNG of this size; raises OSError."""
    from ahrsd.report import figures

    figures.save_png(lambda: figures.heading(heading, HEADING_TITLE), path_png, width_px, height_px)


def section(title: str, *parts: str) -> str:
    """A heading and what is below it, HTML."""
    return f"<section><h2>{escape(title)}</h2>\n" + "\n".join(parts) + "</section>"


def picture(draw: Callable[[], Figure], alt: str, caption: str = "") -> str:
    """A picture inside the page, HTML."""
    from ahrsd.report import figures

    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    source = figures.as_data_uri(draw)
    return f'<figure><img alt="{escape(alt)}" src="{source}">{text}</figure>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[int] = ()) -> str:
    """Build a table; the cells are HTML already, `numeric` columns are aligned to the right."""

    def row(cells: Sequence[str], tag: str) -> str:
        marks = [' class="n"' if k in numeric else "" for k in range(len(cells))]
        inner = (f"<{tag}{m}>{c}</{tag}>" for m, c in zip(marks, cells, strict=True))
        return "<tr>" + "".join(inner) + "</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    top = row(head, "th") if any(head) else ""
    return f'<div class="scroll"><table>{top}{body}</table></div>'


def number(value: float | None, unit: str = "") -> str:
    """Three significant digits and the unit; a dash where there is no number."""
    if value is None or not np.isfinite(value):
        return "–"
    if value == 0:
        text = "0"
    elif 1e-3 <= abs(value) < 1e5:
        text = np.format_float_positional(value, precision=3, fractional=False, trim="-")
    else:
        text = f"{value:.2e}"
    return f"{text} {unit}".strip()


def _summary(data: ReportData) -> str:
    kind = {True: "verdict yes", False: "verdict no", None: "verdict"}[data.good]
    verdict = f'<p class="{kind}">{escape(data.verdict)}</p>' if data.verdict else ""
    figures = [*(data.heading.figures() if data.heading else ()), *data.summary]
    if not figures:
        return verdict
    rows = [
        [
            escape(f.name),
            escape(number(f.before, f.unit)),
            _judged_number(f),
            escape(number(f.limit, f.unit)),
        ]
        for f in figures
    ]
    return verdict + table(["", "before", "after", "limit"], rows, numeric=(1, 2, 3))


def _judged_number(figure: KeyFigure) -> str:
    text = escape(number(figure.after, figure.unit))
    if figure.limit is None or figure.after is None:
        return text
    return f'<span class="{"good" if figure.after <= figure.limit else "bad"}">{text}</span>'


def _heading(data: ReportData) -> str:
    if data.heading is None:
        return ""
    from ahrsd.report import figures

    heading = data.heading
    worst, rms = heading.figures()
    alt = (
        f"Heading error over all headings: worst {number(worst.before)} deg before and "
        f"{number(worst.after)} deg after, rms {number(rms.before)} and {number(rms.after)} deg"
    )
    shot = picture(
        lambda: figures.heading(heading, "Before and after on one scale"), alt, heading.source
    )
    return section(HEADING_TITLE, shot)


def _warnings(data: ReportData) -> str:
    if not data.warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in data.warnings)
    return section("Warnings", f"<ul>{items}</ul>")


def _norm(data: ReportData) -> str:
    if data.norm is None:
        return ""
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
    return section("Field strength", picture(lambda: figures.norm(norm), alt, caption))


def _spread(values: np.ndarray) -> str:
    return f"{number(100.0 * float(np.std(values) / np.mean(values)))} %"


def _clouds(data: ReportData) -> str:
    if data.clouds is None:
        return ""
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
    shot = picture(lambda: figures.clouds(clouds), alt, caption)
    return section("Raw and corrected field", shot)


def _history(data: ReportData) -> str:
    if not data.history:
        return ""
    return section("How the estimate settled", *[_one_history(item) for item in data.history])


def _one_history(item: EstimateHistory) -> str:
    from ahrsd.report import figures

    last = ", ".join(
        f"{label} {number(float(value))} ± {number(float(sigma))}"
        for label, value, sigma in zip(item.labels, item.value[-1], item.sigma[-1], strict=True)
    )
    text = f"{item.name}: {last} {item.unit}".rstrip()
    if item.truth is not None:
        text += f"; truth {', '.join(number(float(value)) for value in item.truth)}"
    return picture(lambda: figures.history(item), text, f"{text}. Bands are one sigma.")


def _gates(data: ReportData) -> str:
    if not data.gates:
        return ""
    counted = [gate for gate in data.gates if guards_a_write(gate.gate)]
    failing = [gate for gate in counted if not gate.ok]
    passing = [gate for gate in counted if gate.ok]
    parts = []
    if failing:
        rows = [[*_gate_cells(gate), escape(gate.advice)] for gate in failing]
        parts.append(table(["", "gate", "value", "limit", "what to do"], rows, numeric=(2, 3)))
    if passing:
        passed = table(["", "gate", "value", "limit"], map(_gate_cells, passing), numeric=(2, 3))
        count = f"{len(passing)} of {len(counted)} gates are ok"
        opened = "" if failing else " open"
        parts.append(f"<details{opened}><summary>{count}</summary>{passed}</details>")
    return section("Gates: may it be written?", *parts)


def _gate_cells(gate: GateResult) -> list[str]:
    return [
        '<span class="good">ok</span>' if gate.ok else '<span class="bad">no</span>',
        escape(gate.gate).replace(".", ".<wbr>").replace("_", "_<wbr>"),
        escape(number(gate.value, gate.unit)),
        escape(number(gate.limit, gate.unit)),
    ]


def _states(data: ReportData) -> str:
    if not data.states:
        return ""
    rows = [
        [f"{s.at_s:.1f} s", f"{escape(s.old)} → <b>{escape(s.new)}</b>", escape(s.reason)]
        for s in data.states
    ]
    return section("What happened", table(["time", "state", "why"], rows, numeric=(0,)))


def _registers(data: ReportData) -> str:
    if not data.registers:
        return ""
    return section("Registers", *[_one_register(change) for change in data.registers])


def _one_register(change: RegisterChange) -> str:
    rows = [
        [label, *[f"{value:.6f}" for value in _rows_of(values)[k]]]
        for name, values in (("before", change.before), ("after", change.after))
        for k, label in enumerate((f"{name}: C row 1", "C row 2", "C row 3", "B"))
    ]
    restore, write = (
        "\n".join(register_lines({change.register: values}))
        for values in (change.before, change.after)
    )
    return (
        f"<p><b>Register {change.register}</b>: {escape(change.outcome)}</p>"
        + table(["", "x", "y", "z"], rows, numeric=(1, 2, 3))
        + f"<pre># writes 'after'\n{escape(write)}\n# writes 'before'\n{escape(restore)}</pre>"
    )


def _rows_of(values: tuple[float, ...]) -> list[tuple[float, ...]]:
    return [values[k : k + 3] for k in range(0, 12, 3)]


def _made(data: ReportData) -> str:
    lines = []
    if data.command:
        lines.append(f"<pre>{escape(data.command)}</pre>")
    if data.seed is not None:
        lines.append(
            f'<p class="soft">Seed {data.seed}: the same seed gives the same hidden truth, motion '
            "and noise. When the daemon reads them is up to the machine, so the last digits and "
            "the moment of a step differ from run to run.</p>"
        )
    return section("How this report was made", *lines) if lines else ""
