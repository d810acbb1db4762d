"""`ahrsd evaluate RECORDING --calibration FILE`: what a calibration is worth, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli import Number
from ahrsd.cli.files import columns_option, make_folder, refuse_unwritable, write_json
from ahrsd.cli.long_work import byte_progress
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError

if TYPE_CHECKING:
    from ahrsd.evaluation import Evaluation

_TILTS = ("auto", "gravity", "accelerometer", "device")
_MODELS = ("wmm", "igrf")


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), required=True,
              help="calibration.json of `ahrsd calibrate --json`.")  # fmt: skip
@click.option("--method", help="Which one, if that file has several; all: each one, in one "
              "table.")  # fmt: skip
@click.option("--reference", "reference_path", type=click.Path(path_type=Path),
              help="GPS fixes, or a table with attitude or heading; default: NAME.gps.csv.gz next "
              "to RECORDING, and the columns of RECORDING.")  # fmt: skip
@click.option("--heading-column", help="A column of RECORDING or of --reference to compare with.")
@click.option("--position", help="LAT,LON[,ALT] in deg and m, for the world's field.")
@click.option("--date", help="YYYY-MM-DD of the recording, for the world's field.")
@click.option("--model", type=click.Choice(_MODELS), default="wmm", show_default=True,
              help="WMM from 2015 or IGRF from 1900, both to the end of 2029.")  # fmt: skip
@click.option("--tilt", type=click.Choice(_TILTS), default="auto", show_default=True,
              help="Which way is up: gravity steadied by the gyro, each sample's accelerometer, or "
              "the device's own roll and pitch.")  # fmt: skip
@click.option("--min-speed", "least_speed_m_s", type=Number(0.1), default=4.0,
              show_default=True, help="The course is used above this speed. [m/s]")  # fmt: skip
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
@click.option("--json", "json_path", help="All figures into this file, - for stdout.")
@click.option("--figure", "figure_path", type=click.Path(path_type=Path), help="Picture, PNG.")
@click.option("--report", "folder", type=click.Path(path_type=Path),
              help="Folder for evaluation.json and evaluation.png.")  # fmt: skip
def command(
    recording: Path,
    calibration_path: Path,
    json_path: str | None,
    figure_path: Path | None,
    folder: Path | None,
    **options: object,
) -> None:
    """Judge a calibration on RECORDING, preferably one that it was not made from.

    Heading against GPS course, an optical attitude or another heading; the spread of the corrected
    field; dead reckoning. "Before" is what the device has in its registers. Exit 1 where the
    calibration is worse than that.
    """
    read = (recording, calibration_path)
    refuse_unwritable(json_path, read)
    refuse_unwritable(figure_path, read)
    if folder is not None:
        make_folder(folder, ("evaluation.json", "evaluation.png"), read)
        json_path = json_path or str(folder / "evaluation.json")
        figure_path = figure_path or folder / "evaluation.png"
    from ahrsd.evaluation import judging
    from ahrsd.offline.evaluate import evaluate

    with byte_progress(recording) as progress:
        found, without = evaluate(recording, calibration_path, progress=progress, **options)  # type: ignore[arg-type]
    several = options["method"] == "all"
    if json_path is not None:
        write_json(
            json_path,
            judging.comparison_json(found, without)
            if several
            else judging.evaluation_json(found[0]),
        )
    if figure_path is not None:
        _draw(figure_path, found[0])
    if json_path != "-":
        lines = (
            judging.comparison_lines(found, without)
            if several
            else judging.evaluation_lines(found[0])
        )
        click.echo("\n".join(lines))
    raise SystemExit(EXIT_DONE if found[0].better else EXIT_NO)


def _draw(path: Path, found: Evaluation) -> None:
    from ahrsd.report.accuracy_figures import write_evaluation_figure

    try:
        write_evaluation_figure(path, found)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
