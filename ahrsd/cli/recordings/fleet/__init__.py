"""`ahrsd fleet`: every recording of an archive calibrated and diagnosed, and what all say."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli import WholeGroup
from ahrsd.cli.files import columns_option, make_folder
from ahrsd.cli.long_work import fleet_progress, limit_options
from ahrsd.cli.recordings.fleet import answers
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError
from ahrsd.fleet.row import Calibrated
from ahrsd.fleet.run import ROLES, Examiner, Orders, summary
from ahrsd.printable import counted

if TYPE_CHECKING:
    from ahrsd.diagnosis.answer.diagnosis import Diagnosis
    from ahrsd.fleet.run import Progress
    from ahrsd.recording.column_names import ColumnMap


# -- What is done with each recording --------------------------------------------------------------


def calibrated(path: Path, orders: Orders) -> Calibrated:
    """`ahrsd calibrate` of one recording of an archive."""
    from ahrsd.config.config import Config
    from ahrsd.offline.calibrate import calibrate

    return calibrate(path, Config(), rate_hz=orders.rate_hz, columns=orders.columns)


def diagnosed(path: Path, orders: Orders) -> Diagnosis:
    """`ahrsd diagnose` of one recording of an archive."""
    from ahrsd.offline.diagnose import diagnose_recording

    return diagnose_recording(path, rate_hz=orders.rate_hz, columns=orders.columns)


EXAMINER = Examiner(calibrated, diagnosed)
LOADS = ("ahrsd.offline.calibrate", "ahrsd.offline.diagnose")  # slow to import


# -- A run over an archive -------------------------------------------------------------------------


_FOLDER = click.Path(path_type=Path)


@click.group(cls=WholeGroup)
def command() -> None:
    """Calibrate and diagnose an archive of recordings; one recording is one row, exactly once.

    A run may be killed at any moment: the same command continues with what is missing.
    """


@command.command()
@click.argument("archive")
@click.option("-o", "--output", type=_FOLDER, required=True, help="The folder of the rows.")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; default: one for each core.")
@click.option("--cluster", metavar="tcp://...", help="A Dask scheduler, instead of processes here.")
@limit_options("a recording", limit="600s", memory="2G")
@click.option(
    "--retry-failed", "again", is_flag=True, help="Repeat the recordings that gave no answer."
)
@click.option("--folders", metavar="LEVEL,...", help="The folder levels, from the top: "
              "vehicle, place, serial, or -.  [default: vehicle]")  # fmt: skip
@click.option("--vehicle", help="The vehicle of all recordings.")
@click.option("--place", help="The place of all recordings.")
@click.option("--match", "patterns", multiple=True, metavar="GLOB",
              help="File names that are recordings; default: by their suffixes.")  # fmt: skip
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
@click.option("--report", "folder", type=_FOLDER, help="Folder for a page about the fleet.")
def run(
    archive: str,
    output: Path,
    jobs: int | None,
    cluster: str | None,
    limit_s: float,
    memory_bytes: int,
    again: bool,
    folders: str | None,
    vehicle: str | None,
    place: str | None,
    patterns: tuple[str, ...],
    rate_hz: float | None,
    columns: ColumnMap,
    folder: Path | None,
) -> None:
    """Give every recording of ARCHIVE a row: a folder, or an address such as s3://bucket/dives.

    What takes too long or too much memory, crashes or is no recording is a row with its reason.
    --vehicle, --place and --folders also change the rows that are there.
    Exit 1 where not one recording gave an answer; 75 where another run is at work, or the cluster
    is gone.
    """
    from ahrsd.fleet.archive import Archive
    from ahrsd.fleet.processes import Place
    from ahrsd.fleet.run import run as run_fleet

    if folder is not None:
        make_folder(folder, ("report.html",))
    levels = _levels(folders or "vehicle")
    given = {name for name in levels if folders and name in ROLES}
    given |= {name for name, value in (("vehicle", vehicle), ("place", place)) if value}
    orders = Orders(
        out=str(output.resolve()),
        columns=columns,
        rate_hz=rate_hz,
        levels=levels,
        vehicle=vehicle,
        place=place,
        limit_s=limit_s,
        memory_bytes=memory_bytes,
        again=again,
        relabel=tuple(given),
    )
    where = Place(jobs or os.cpu_count() or 1, LOADS, cluster)
    source = Archive(archive if "://" in archive else str(Path(archive).resolve()), patterns)
    with fleet_progress() as show:
        done = run_fleet(
            source, orders, EXAMINER, where, lambda p: show(p.done, p.total, p.failed, p.per_minute)
        )
    for line in _end_lines(done, output):
        click.echo(line)
    if folder is not None:
        answers.write_page(output, folder)
    raise SystemExit(EXIT_NO if done.done and done.failed == done.done else EXIT_DONE)


def _end_lines(done: Progress, output: Path) -> list[str]:
    """What a run says in the end."""
    lines = [f"{output}: {counted(done.done, 'recording', ',')}: {summary(done.outcomes)}"]
    if done.before:
        lines.append(f"  {counted(done.before, 'recording', ',')} had a row already")
    if done.relabelled:
        lines.append(
            f"  {counted(done.relabelled, 'row', ',')} of these: another vehicle, place or serial "
            "number, as given now"
        )
    if done.left_out:
        names = ", ".join(f"{number} {suffix}" for suffix, number in done.left_out.most_common(5))
        lines.append(f"  left out, no recordings by their names: {names} (--match takes others)")
    if done.linked:
        folders = f"{counted(done.linked, 'folder', ',')} that an entry only links to"
        lines.append(
            f"  not entered: {folders}, such as {done.first_linked}; give what it leads to as "
            "an archive of its own, with the same -o"
        )
    if done.failed:
        lines.append(f"  why: ahrsd fleet ask {output} failures")
    return lines


def _levels(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if wrong := [name for name in names if name not in (*ROLES, "-")]:
        raise AhrsdError(f"--folders {wrong[0]}: a level is one of {', '.join(ROLES)}, or -")
    return names


for _other in (answers.status, answers.compact, answers.ask):
    command.add_command(_other)
