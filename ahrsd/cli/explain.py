"""`ahrsd explain`: why nothing is written, and what would change that."""

from __future__ import annotations

import click

from ahrsd.cli.running import DaemonPlace, place_options, print_answer


@click.command()
@place_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def command(place: DaemonPlace, json_path: str | None) -> None:
    """Say which gate holds a write back, since when, and what to do about it.

    Exit 75 where no daemon answers.
    """
    from ahrsd.telemetry.explain import explain_lines

    print_answer(place, "explain", json_path, explain_lines)
