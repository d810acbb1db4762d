"""`--columns`: names and units of a foreign table, on every command that takes a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])


def _parsed(_context: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> object:
    from ahrsd.recording.column_names import parse_columns

    return parse_columns(texts)


def columns_option(command: _Command) -> _Command:
    """The option, which gives the command a `ColumnMap` as `columns`."""
    return click.option(
        "--columns",
        multiple=True,
        callback=_parsed,
        metavar="NAME=COLUMN:UNIT,...",
        help="Names and units of a foreign table: mag_x=MagX:uT,gyro_x=GyrX:deg/s,time=t:ms; a "
        "minus before COLUMN turns its sign (docs/guide/recordings.md).",
    )(command)
