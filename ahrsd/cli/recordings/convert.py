"""`ahrsd convert FILE -o OUT.parquet`: a recording of another program as a table of ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.files import columns_option, refuse_unwritable
from ahrsd.cli.long_work import byte_progress
from ahrsd.errors import AhrsdError
from ahrsd.printable import counted

if TYPE_CHECKING:
    from ahrsd.recording.column_names import ColumnMap


@click.command()
@click.argument("recording", metavar="FILE", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The table, OUT.parquet.")
@click.option("--list", "only_list", is_flag=True, help="Only list what FILE contains.")
@click.option("--topic", "topics", multiple=True, metavar="T",
              help="Topic to use if FILE has several sensors; may be repeated.")  # fmt: skip
@click.option("--compass", type=click.IntRange(min=0), metavar="N",
              help="Number of the magnetometer, from 0, in an autopilot's log.")  # fmt: skip
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
def command(
    recording: Path,
    output: Path | None,
    only_list: bool,
    topics: tuple[str, ...],
    compass: int | None,
    rate_hz: float | None,
    columns: ColumnMap,
) -> None:
    """Convert FILE into a Parquet table that states unit, frame, clock, source and corrections.

    FILE may be any recording: a ROS 1 bag, a ROS 2 recording, the log of an autopilot, a foreign
    CSV (with --columns), or one of ours. Every other command opens these files directly, too.
    """
    from ahrsd.offline.convert import convert_recording, save
    from ahrsd.recording.foreign.sensors import Choice
    from ahrsd.recording.opening import listed

    if only_list:
        for line in listed(recording):
            click.echo(line)
        return
    if output is None:
        raise AhrsdError("nothing to do: give -o OUT.parquet, or --list to see what FILE holds")
    if output.suffix != ".parquet":
        raise AhrsdError(f"-o {output}: the table is written as Parquet; name it *.parquet")
    refuse_unwritable(output, [recording])
    with byte_progress(recording) as progress:
        table = convert_recording(recording, Choice(topics, compass, columns), rate_hz, progress)
    save(table, output)
    rows = len(next(iter(table.columns.values())))
    click.echo(f"{output}: {counted(rows, 'row')}, {', '.join(table.columns)}")
    for name in (
        "format",
        "source",
        "mag source",
        "mag unit",
        "gyro source",
        "frame",
        "clock",
        "undone",
    ):
        if name in table.facts:
            click.echo(f"  {name}: {table.facts[name]}")
    for note in table.notes:
        click.echo(f"  note: {note}")
