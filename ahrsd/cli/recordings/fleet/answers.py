"""`ahrsd fleet status|compact|ask`: what the rows of a fleet say."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.cli.files import make_folder, refuse_unwritable, write_json
from ahrsd.printable import counted

_FOLDER = click.Path(path_type=Path)
_QUESTIONS = ("drift", "recurring", "failures")  # any other is a SELECT


@click.command()
@click.argument("output", metavar="OUT", type=_FOLDER)
@click.option("--json", "json_path", help="The same as JSON into this file, - for stdout.")
@click.option("--report", "folder", type=_FOLDER, help="Folder for a page about the fleet.")
def status(output: Path, json_path: str | None, folder: Path | None) -> None:
    """How many rows there are, of what, and whether a run is at work."""
    from ahrsd.fleet.questions import FleetRows, status_lines
    from ahrsd.fleet.store import Store

    refuse_unwritable(json_path)
    store = Store(output)
    store.check()
    with FleetRows(store) as rows:
        body = rows.counts()
    body["at_work"], body["run"] = store.at_work(), store.told()
    if json_path is not None:
        write_json(json_path, body)
    if json_path != "-":
        for line in status_lines(str(output), body):
            click.echo(line)
    if folder is not None:
        make_folder(folder, ("report.html",))
        write_page(output, folder)


@click.command()
@click.argument("output", metavar="OUT", type=_FOLDER)
def compact(output: Path) -> None:
    """Move rows that a run left in the spool into Parquet; a run does it by itself."""
    from ahrsd.fleet.store import Store

    store = Store(output)
    store.check()
    with store.alone():
        moved = store.compact()
    click.echo(
        f"{output}: {counted(moved, 'row', ',')} moved; {counted(len(store.parts()), 'part')}"
    )


@click.command()
@click.argument("output", metavar="OUT", type=_FOLDER)
@click.argument("question", metavar="drift|recurring|failures|SELECT")
@click.option("--json", "json_path", help="The whole answer as JSON into this file, - for stdout.")
def ask(output: Path, question: str, json_path: str | None) -> None:
    """Answer a question from the rows of OUT.

    \b
    drift       hard iron, gyro bias and heading error of each device over time and temperature,
                with standard deviations and change points; largest heading error first
    recurring   findings that are more frequent on a device, a vehicle, at a place or a temperature
    failures    recordings that gave no answer, and why
    SELECT ...  one query over the table `results`; nothing can be written
    """
    from ahrsd.fleet.questions import (
        AnswerTable,
        FleetRows,
        drift_lines,
        failure_lines,
        recurring_lines,
        table_lines,
    )
    from ahrsd.fleet.store import Store

    refuse_unwritable(json_path)
    answer: AnswerTable
    with FleetRows(Store(output)) as rows:
        if question == "drift":
            found = rows.drift()
            body = [one.json() for one in found]
            lines = drift_lines(found, rows.of_no_device())
        else:
            if question == "recurring":
                answer = rows.recurring()
                lines = recurring_lines(answer)
            elif question == "failures":
                answer = rows.failures()
                lines = failure_lines(answer)
            else:
                answer = rows.sql(question)
                lines = table_lines(answer.columns, answer.rows)
            body = answer.json()
        if question in _QUESTIONS and rows.empty():
            lines = [f"{output}: no recording has a row yet"]
    if json_path is not None:
        write_json(json_path, body)
    if json_path != "-":
        for line in lines:
            click.echo(line)


def write_page(output: Path, folder: Path) -> None:
    """The page of a fleet, in a folder that `make_folder` has made."""
    from ahrsd.fleet.page import write_page

    path = folder / "report.html"
    write_page(output, path)
    click.echo(f"report: {path}")
