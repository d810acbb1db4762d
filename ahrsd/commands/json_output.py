"""`--json FILE`, `-` for stdout: written whole or not at all."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

import click

from ahrsd.errors import AhrsdError


def refuse_unwritable(target: str | Path | None) -> None:
    """Raise AhrsdError before any work is done for a file that cannot be written."""
    if target is None or str(target) == "-":
        return
    path = Path(target)
    if path.is_dir():
        raise AhrsdError(f"{path}: is a folder; name a file")
    if not path.parent.is_dir():
        raise AhrsdError(f"{path}: {path.parent} is no folder; make it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise AhrsdError(f"{path}: cannot be written: permission denied; name another file")


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
