"""`ahrsd evaluate RECORDING --calibration FILE`: what a calibration is worth, before and after."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.json_output import make_folder, refuse_unwritable, write_json
from ahrsd.cli.progress import byte_progress
from ahrsd.cli.recording_options import columns_option
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError
from ahrsd.printable import printable

if TYPE_CHECKING:
    from ahrsd.evaluation import Evaluation, EvaluationTrack, Fixes, HeadingReference
    from ahrsd.recording.column_names import ColumnMap

_TILTS = ("auto", "gravity", "accelerometer", "device")
_MODELS = ("wmm", "igrf")


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), required=True,
              help="calibration.json of `ahrsd calibrate --json`.")  # fmt: skip
@click.option("--method", help="Which one, where that file holds several; all: each, in one "
              "table.")  # fmt: skip
@click.option("--reference", "reference_path", type=click.Path(path_type=Path),
              help="GPS fixes, or a table with attitude or heading; else NAME.gps.csv.gz beside "
              "RECORDING, and what its columns hold.")  # fmt: skip
@click.option("--heading-column", help="A column of RECORDING or of --reference to compare with.")
@click.option("--position", help="LAT,LON[,ALT] in deg and m, for the world's field.")
@click.option("--date", help="YYYY-MM-DD of the recording, for the world's field.")
@click.option("--model", type=click.Choice(_MODELS), default="wmm", show_default=True,
              help="WMM from 2015 or IGRF from 1900, both to the end of 2029.")  # fmt: skip
@click.option("--tilt", type=click.Choice(_TILTS), default="auto", show_default=True,
              help="Which way is up: gravity steadied by the gyro, each sample's accelerometer, or "
              "the device's own roll and pitch.")  # fmt: skip
@click.option("--min-speed", "least_speed_m_s", type=click.FloatRange(0.1), default=4.0,
              show_default=True, help="Course counts above this speed. [m/s]")  # fmt: skip
@click.option("--rate", "rate_hz", type=float, help="Messages per second, where none has a time.")
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
    """Judge a calibration on RECORDING, best one that it was not made from.

    Heading against GPS course, an optical attitude or another heading; the spread of the corrected
    field; dead reckoning. "Before" is what the device has in its registers. Exit 1 where the
    calibration is worse than that.
    """
    refuse_unwritable(json_path)
    refuse_unwritable(figure_path)
    if folder is not None:
        json_path, figure_path = _into(folder, json_path, figure_path)
    with byte_progress(recording) as progress:
        found, without = evaluate(recording, calibration_path, progress=progress, **options)  # type: ignore[arg-type]
    from ahrsd.evaluation import text

    several = options["method"] == "all"
    if json_path is not None:
        write_json(
            json_path,
            text.comparison_json(found, without) if several else text.evaluation_json(found[0]),
        )
    if figure_path is not None:
        _draw(figure_path, found[0])
    if json_path != "-":
        lines = (
            text.comparison_lines(found, without) if several else text.evaluation_lines(found[0])
        )
        click.echo("\n".join(lines))
    raise SystemExit(EXIT_DONE if found[0].better else EXIT_NO)


def evaluate(
    recording: Path,
    calibration_path: Path,
    *,
    method: str | None = None,
    reference_path: Path | None = None,
    heading_column: str | None = None,
    position: str | None = None,
    date: str | None = None,
    model: str = "wmm",
    tilt: str = "auto",
    least_speed_m_s: float = 4.0,
    rate_hz: float | None = None,
    columns: ColumnMap | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[list[Evaluation], dict[str, str]]:
    """The evaluations that the command prints, and by method why one is none.  Raises AhrsdError.

    One evaluation, or with method "all" one for each calibration in the file, in its order.
    """
    from dataclasses import replace

    from ahrsd.cli import evaluate_sources as sources
    from ahrsd.config.loading import Config
    from ahrsd.evaluation import judge
    from ahrsd.evaluation.references import fixes_of_track

    calibrations, without = sources.read_calibrations(calibration_path, method)
    world = sources.place_and_date(position, date, model)  # type: ignore[arg-type]
    track, said = sources.read_track(recording, Config(), rate_hz, progress, columns)
    beside, fixes, place = _beside(reference_path or sources.gps_beside(recording), track)
    if place is not None and world is None and date is not None:
        world = sources.place_and_date(place, date, model)  # type: ignore[arg-type]
        said.append(f"the position is that of the middle GPS fix: {place}")
    track, fixes = beside, fixes or fixes_of_track(beside)
    references, more = _references(track, fixes, heading_column, least_speed_m_s)
    found = [
        judge(
            printable(recording.name, 200),
            track,
            replace(calibration, remarks=(*said, *more, *calibration.remarks)),
            references,
            fixes=fixes,
            world=world,
            tilt_source=tilt,  # type: ignore[arg-type]
        )
        for calibration in calibrations
    ]
    return found, without


def _beside(
    path: Path | None, track: EvaluationTrack
) -> tuple[EvaluationTrack, Fixes | None, str | None]:
    """The track with the columns of another file, or its fixes and the place of the middle one."""
    from ahrsd.cli import evaluate_sources as sources

    if path is None:
        return track, None, None
    if not sources.is_gps(path):
        return sources.with_columns_of(track, path), None, None
    fixes, place = sources.read_fixes(path)
    return track, fixes, place


def _references(
    track: EvaluationTrack, fixes: Fixes | None, heading_column: str | None, least_speed_m_s: float
) -> tuple[list[HeadingReference], list[str]]:
    """What there is to compare with, best first, and why something is not."""
    from ahrsd.evaluation import EvaluationError
    from ahrsd.evaluation.references import column, course, device_heading, optical

    said: list[str] = []
    found: list[HeadingReference] = []
    if heading_column is not None:
        found.append(column(track, heading_column))
    if fixes is not None:
        try:
            found.append(course(fixes, least_speed_m_s))
        except EvaluationError as error:
            said.append(str(error))
    found += [one for one in (optical(track), device_heading(track)) if one is not None]
    return found, said


def _into(
    folder: Path, json_path: str | None, figure_path: Path | None
) -> tuple[str | None, Path | None]:
    make_folder(folder, ("evaluation.json", "evaluation.png"))
    return json_path or str(folder / "evaluation.json"), figure_path or folder / "evaluation.png"


def _draw(path: Path, found: Evaluation) -> None:
    from ahrsd.report.evaluation_figure import write_evaluation_figure

    try:
        write_evaluation_figure(path, found)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
