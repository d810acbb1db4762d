"""`ahrsd status`: how the running daemon stands."""

from __future__ import annotations

import click

from ahrsd.cli.running import DaemonPlace, place_options, print_answer


@click.command()
@place_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def command(place: DaemonPlace, json_path: str | None) -> None:
    """Show device, stream, motion, estimate and write-back of the running daemon.

    Exit 75 where no daemon answers.
    """
    from ahrsd.telemetry.lines import status_lines

    print_answer(place, "status", json_path, status_lines)
