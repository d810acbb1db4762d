"""`ahrsd diagnose REAL`: where simulation and recording differ, and which physics was left out."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.files import (
    columns_as_given,
    columns_option,
    make_folder,
    refuse_unwritable,
    write_json,
)
from ahrsd.cli.long_work import byte_progress
from ahrsd.daemon.heap import keep_heap
from ahrsd.errors import AhrsdError
from ahrsd.printable import LINE, printable

if TYPE_CHECKING:
    from ahrsd.diagnosis.answer.diagnosis import Diagnosis
    from ahrsd.recording.column_names import ColumnMap

_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("real", type=_PATH)
@click.option("--simulation", type=_PATH, help="A simulation of this motion, as a recording.")
@click.option("--spec", type=_PATH, help="Known noise, rate and field of the sensor, JSON.")
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
@click.option("--json", "json_path", help="The answer as JSON into this file, - for stdout.")
@click.option("--report", "folder", type=_PATH, help="Folder for a page with pictures, and more.")
def command(
    real: Path,
    simulation: Path | None,
    spec: Path | None,
    rate_hz: float | None,
    columns: ColumnMap,
    json_path: str | None,
    folder: Path | None,
) -> None:
    """Locate where REAL differs from its simulation, name the physics, show that it helps.

    Without --simulation, the simulation is made from the recording's own motion and the calibration
    that fits it best. What no effect of the library explains is located and called unknown.

    \b
    --report DIR writes  report.html    pictures and words, one file
                         diagnosis.rrd  the same for the rerun viewer
                         diagnosis.json the answer
                         model.json     the repaired model: ahrsd simulate --model; none where
                                        axes or units are wrong
    """
    from ahrsd.diagnosis.answer.text import answer_lines
    from ahrsd.offline.diagnose import diagnose_recording

    read = (real, simulation, spec)
    refuse_unwritable(json_path, read)
    if folder is not None:
        names = ("report.html", "diagnosis.rrd", "diagnosis.json", "model.json")
        make_folder(folder, names, read)
    keep_heap()
    with byte_progress(real) as progress:
        found = diagnose_recording(
            real,
            simulation=simulation,
            spec=spec,
            rate_hz=rate_hz,
            progress=progress,
            columns=columns,
        )
    if json_path is not None:
        write_json(json_path, found.to_json())
    if folder is not None:
        _write_report(folder, found, _command_line(real, simulation, spec, rate_hz, folder))
    if json_path != "-":
        click.echo("\n".join(answer_lines(found)))
        if folder is not None:
            click.echo(f"report: {folder / 'report.html'}")


def _command_line(
    real: Path, simulation: Path | None, spec: Path | None, rate_hz: float | None, folder: Path
) -> str:
    """What makes the same answer again, with the names of the files and not their folders."""
    options: list[tuple[str, object]] = [("--simulation", simulation and simulation.name)]
    options += [("--spec", spec and spec.name), ("--rate", rate_hz)]
    options += [("--columns", text) for text in columns_as_given()]
    options.append(("--report", folder.name or "."))
    words = [word for name, value in options if value is not None for word in (name, f"{value}")]
    return printable(shlex.join(["ahrsd", "diagnose", real.name, *words]), LINE)


def _write_report(folder: Path, found: Diagnosis, command_line: str) -> None:
    from ahrsd.diagnosis.repaired_model.model_file import repaired_model_of, to_text
    from ahrsd.report.diagnosis_page import write_diagnosis_report
    from ahrsd.viewer.diagnosis import write_rrd

    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_diagnosis_report(folder / "report.html", found, command_line)
        write_rrd(folder / "diagnosis.rrd", found)
        model = folder / "model.json"
        if found.model is None:  # of no other recording either
            model.unlink(missing_ok=True)
        else:
            model.write_text(to_text(repaired_model_of(found)), encoding="utf-8")
    except OSError as error:
        raise AhrsdError(f"{folder}: cannot be written: {error.strerror}") from error
    write_json(str(folder / "diagnosis.json"), found.to_json())
