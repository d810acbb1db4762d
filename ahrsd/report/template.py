"""HTML pages by the templates beside this module: nothing loaded from elsewhere, texts escaped."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

_TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture inside a page."""

    source: str  # data URI
    alt: str
    caption: str = ""


def picture(draw: Callable[[], Figure], alt: str, caption: str = "") -> Picture:
    """Draw it."""
    from ahrsd.report import figures

    return Picture(figures.as_data_uri(draw), alt, caption)


def render(template: str, folder: Path | None = None, **values: object) -> str:
    """The page of a template; of one in `folder`, which may extend those here, if it is given."""
    return _environment(folder).get_template(template).render(values)


@cache
def _environment(folder: Path | None) -> jinja2.Environment:
    """What has read the templates once."""
    folders = [_TEMPLATES] if folder is None else [folder, _TEMPLATES]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["number"] = number
    return environment


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
