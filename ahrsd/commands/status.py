"""`ahrsd status`: how the running daemon stands."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.commands.json_output import write_json
from ahrsd.commands.running import connected, socket_options


@click.command()
@socket_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def command(path: Path | None, directory: Path | None, json_path: str | None) -> None:
    """Show device, stream, motion, estimate and write-back of the running daemon.

    Exit 75 where no daemon answers.
    """
    from ahrsd.serving.lines import status_lines

    with connected(path, directory) as daemon:
        status = daemon.ask("status")
    if json_path is not None:
        write_json(json_path, status)
    if json_path != "-":
        click.echo("\n".join(status_lines(status)))
