"""`--limit` and `--memory` of commands that do many things, each in a process of its own."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import click

from ahrsd.errors import AhrsdError

_SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
_BYTES = {"K": 2.0**10, "M": 2.0**20, "G": 2.0**30}

_Command = Callable[..., Any]


def limit_options(
    what: str, *, limit: str | None = None, memory: str | None = None
) -> Callable[[_Command], _Command]:
    """Both for each of `what`, as `limit_s` and `memory_bytes`; 0 where there is no limit."""
    limited = click.option(
        "--limit", "limit_s", default=limit, show_default=limit or "none", callback=_seconds,
        help=f"Time for {what}: s, min, h.",
    )  # fmt: skip
    bounded = click.option(
        "--memory", "memory_bytes", default=memory, show_default=memory or "none", callback=_bytes,
        help=f"Memory for {what}: M, G.",
    )  # fmt: skip
    return lambda command: limited(bounded(command))


def _seconds(_context: click.Context, _option: click.Parameter, text: str | None) -> float:
    return _amount("--limit", text, _SECONDS)


def _bytes(_context: click.Context, _option: click.Parameter, text: str | None) -> int:
    return round(_amount("--memory", text, _BYTES))


def _amount(option: str, text: str | None, units: dict[str, float]) -> float:
    if text is None:
        return 0.0
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)", text.strip())
    factor = None if found is None else units.get(found[2].removesuffix("iB").removesuffix("B"))
    if found is None or factor is None or float(found[1]) <= 0.0:
        raise AhrsdError(f"{option} {text}: a number with one of {', '.join(filter(None, units))}")
    return float(found[1]) * factor
