"""`ahrsd replay RECORDING`: the pipeline of `run` over a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli import Number
from ahrsd.cli.files import columns_option, refuse_unwritable, write_json
from ahrsd.cli.long_work import byte_progress
from ahrsd.config.config import Config, load_config
from ahrsd.errors import AhrsdError

if TYPE_CHECKING:
    from ahrsd.recording.column_names import ColumnMap


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--config", "path", type=click.Path(path_type=Path), help="Configuration, TOML.")
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
@click.option("--speed", type=Number(0.0), default=0.0,
              help="0: as fast as it goes (default); 1: real time.")  # fmt: skip
@click.option("--json", "json_path", help="Summary as JSON into this file, - for stdout.")
@click.option("--rerun", "rerun_path", type=click.Path(path_type=Path), help="Write an .rrd file.")
def command(
    recording: Path,
    path: Path | None,
    rate_hz: float | None,
    columns: ColumnMap,
    speed: float,
    json_path: str | None,
    rerun_path: Path | None,
) -> None:
    """Run the daemon's pipeline over RECORDING: a capture, a byte stream or a table.

    A capture of `ahrsd run` is replayed with its own configuration and takes the same decisions,
    which `decision_sha256` shows.
    """
    from ahrsd.offline.replay import replay
    from ahrsd.report.summary import summary_json, summary_lines
    from ahrsd.viewer.sink import RerunSink

    refuse_unwritable(json_path, (recording, path))
    refuse_unwritable(rerun_path, (recording, path))
    config = load_config(path) if path else Config()
    viewer = None if rerun_path is None else RerunSink(rerun_path, wait=True)
    try:
        with byte_progress(recording) as progress:
            done = replay(
                recording,
                config,
                rate_hz=rate_hz,
                speed=speed,
                viewer=viewer,
                progress=progress,
                columns=columns,
            )
    finally:
        if viewer is not None:
            viewer.close(10.0)
    if json_path is not None:
        write_json(json_path, summary_json(done.core, done.recording.name, done.warnings))
    if json_path != "-":
        for line in summary_lines(done.core, done.recording.name, done.warnings):
            click.echo(line)
    if viewer is not None and (fault := viewer.counters.last_fault):
        raise AhrsdError(f"{rerun_path}: is not whole: {fault}")
