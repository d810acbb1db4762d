"""`ahrsd explain`: why nothing is written, and what would change that."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.commands.running import connected, socket_options, tell


@click.command()
@socket_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def command(path: Path | None, directory: Path | None, json_path: str | None) -> None:
    """Say which gate holds a write back, since when, and what to do about it.

    Exit 75 where no daemon answers.
    """
    from ahrsd.serving.explain import explain_lines

    tell(connected(path, directory), "explain", json_path, explain_lines)
