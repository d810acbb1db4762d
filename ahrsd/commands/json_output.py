"""`--json FILE`, `-` for stdout: written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ahrsd.errors import AhrsdError


def write_json(target: str, value: object) -> None:
    """Write `value` to a file or to stdout.  AhrsdError where the file cannot be written."""
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    if target == "-":
        click.echo(text, nl=False)
        return
    path = Path(target)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
