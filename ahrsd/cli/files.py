"""Files of a command: `--columns` of the recordings that it reads, and what it writes.

What it writes is refused before any work, told where one is replaced, whole or not. A file that can
be made again is replaced, and a line says so. What cannot (a recording of a device) is never
replaced: `capture` asks for another name.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import click

from ahrsd.errors import AhrsdError

# -- Recordings that it reads ----------------------------------------------------------------------


_Command = TypeVar("_Command", bound=Callable[..., Any])


_COLUMNS_AS_GIVEN = "ahrsd.columns"


def _parsed(context: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> object:
    from ahrsd.recording.column_names import parse_columns

    context.meta[_COLUMNS_AS_GIVEN] = texts
    return parse_columns(texts)


def columns_as_given() -> tuple[str, ...]:
    """The texts of `--columns` of the command that runs."""
    given: tuple[str, ...] = click.get_current_context().meta.get(_COLUMNS_AS_GIVEN, ())
    return given


def columns_option(command: _Command) -> _Command:
    """The option, which gives the command a `ColumnMap` as `columns`."""
    return click.option(
        "--columns",
        multiple=True,
        callback=_parsed,
        metavar="NAME=COLUMN:UNIT,...",
        help="Names and units of a foreign table: mag_x=MagX:uT,gyro_x=GyrX:deg/s,time=t:ms; a "
        "minus before COLUMN negates it (docs/guide/recordings.md).",
    )(command)


# -- Files that it writes --------------------------------------------------------------------------


def refuse_unwritable(target: str | Path | None, inputs: Iterable[Path | None] = ()) -> None:
    """Raise AhrsdError before any work is done for a file that cannot be written, or is an input.

    One that exists and is going to be replaced is told on stderr.
    inputs: what the command reads: a recording cannot be made again
    """
    if target is None or str(target) == "-":
        return
    path = Path(target)
    if path.is_dir():
        raise AhrsdError(f"{path}: is a folder; name a file")
    if path.exists() and any(one and one.exists() and path.samefile(one) for one in inputs):
        raise AhrsdError(f"{path}: is what this command reads; give another name")
    if not path.parent.is_dir():
        raise AhrsdError(f"{path}: {path.parent} is no folder; make it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise AhrsdError(f"{path}: cannot be written: permission denied; name another file")
    if not path.exists():  # a folder may say that it is writable and take no file
        try:
            descriptor, made = tempfile.mkstemp(prefix=f".{path.name}", dir=path.parent)
            os.close(descriptor)
            Path(made).unlink()
        except OSError as error:
            raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
    if path.is_file():
        click.echo(f"{path}: exists and will be replaced", err=True)


def make_folder(folder: Path, names: Iterable[str], inputs: Iterable[Path | None] = ()) -> None:
    """The folder of a `--report`, and every file in it as `refuse_unwritable` looks at it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AhrsdError(f"{folder}: cannot be made: {error.strerror}") from error
    read = tuple(inputs)
    for name in names:
        refuse_unwritable(folder / name, read)


def write_text(target: Path, text: str) -> None:
    """A file of text.  AhrsdError where it cannot be written."""
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise AhrsdError(f"{target}: cannot be written: {error.strerror}") from error


def write_json(target: str, value: object) -> None:
    """Write `value` to a file or to stdout.  AhrsdError where the file cannot be written."""
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    if target == "-":
        click.echo(text, nl=False)
        return
    path = Path(target)
    partial = path.with_name(path.name + ".partial")
    try:
        if path.exists() and not path.is_file():  # a pipe or a device is written, not replaced
            path.write_text(text, encoding="utf-8")
            return
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
