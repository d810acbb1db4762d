"""`ahrsd status`: how the running daemon stands."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.commands.running import connected, socket_options, tell


@click.command()
@socket_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def command(path: Path | None, directory: Path | None, json_path: str | None) -> None:
    """Show device, stream, motion, estimate and write-back of the running daemon.

    Exit 75 where no daemon answers.
    """
    from ahrsd.serving.lines import status_lines

    tell(connected(path, directory), "status", json_path, status_lines)
