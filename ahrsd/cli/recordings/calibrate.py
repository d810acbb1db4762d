"""`ahrsd calibrate RECORDING`: the best estimate that the whole recording allows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.files import columns_option, make_folder, refuse_unwritable, write_json
from ahrsd.cli.long_work import byte_progress
from ahrsd.config.config import Config, load_config
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError, RecordingError
from ahrsd.printable import counted

if TYPE_CHECKING:
    from ahrsd.baselines.registry import ComparisonRow
    from ahrsd.recording.column_names import ColumnMap
    from ahrsd.report.summary import BatchResult

_ALL = "all"
_METHODS = (  # ours first; a test holds this list against `ahrsd.baselines`, slow to import
    "magyc", _ALL, "magyc-ifg", "magyc-bfg", "magical-ifg", "magical-bfg", "magical-ls",
    "magical-nls", "twostep", "ellipsoid", "magfactor3", "tls", "np", "fnp", "np-uncertain-field",
)  # fmt: skip


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--method", type=click.Choice(_METHODS), default=_METHODS[0], show_default=True)
@click.option("--config", "path", type=click.Path(path_type=Path), help="Configuration, TOML.")
@click.option(
    "--rate", "rate_hz", type=float, help="Messages per second, if messages have no time."
)
@columns_option
@click.option(
    "--model",
    "model_path",
    type=click.Path(path_type=Path),
    help=(
        "A repaired model of `diagnose --report`: its effects are removed from the readings first."
    ),
)
@click.option("--json", "json_path", help="calibration.json into this file, - for stdout.")
@click.option("--position", help="LAT,LON[,ALT] in deg and m: the world model gives the field.")
@click.option("--date", help="YYYY-MM-DD of the recording, for the world model; default: today.")
@click.option("--report", "folder", type=click.Path(path_type=Path),
              help="Folder for report.html and calibration.json.")  # fmt: skip
@click.option("--figure", "figure_path", type=click.Path(path_type=Path),
              help="With --method all: the table as a picture, PNG.")  # fmt: skip
def command(
    recording: Path,
    method: str,
    path: Path | None,
    rate_hz: float | None,
    columns: ColumnMap,
    model_path: Path | None,
    position: str | None,
    date: str | None,
    json_path: str | None,
    folder: Path | None,
    figure_path: Path | None,
) -> None:
    """Calibrate from all of RECORDING at once: a capture, a byte stream or a table.

    Exit 1 where the motion does not determine the answer; the output then says what is missing.
    """
    from ahrsd.offline.calibrate import calibrate
    from ahrsd.offline.compare_methods import describe_saturation
    from ahrsd.offline.diagnose import load_model
    from ahrsd.report.summary import estimate_lines

    read = (recording, model_path, path)
    refuse_unwritable(json_path, read)
    refuse_unwritable(figure_path, read)
    if figure_path is not None and method != _ALL:
        raise AhrsdError("--figure compares the methods: give --method all with it")
    config = _placed(load_config(path) if path else Config(), position, date)
    if folder is not None:
        _refuse_page(folder)
        make_folder(folder, ("report.html", "calibration.json"), read)
    model = None if model_path is None else load_model(model_path)
    with byte_progress(recording) as progress:
        result = calibrate(
            recording, config, rate_hz=rate_hz, progress=progress, model=model, columns=columns
        )
    if method in _METHODS[:2] and (words := describe_saturation(result)):
        raise RecordingError(
            recording, words, "record again, away from magnets and strong currents"
        )
    if folder is not None:
        result.write_report(folder / "report.html")
        write_json(str(folder / "calibration.json"), result.json(_METHODS[0]))
    if method != _METHODS[0]:
        raise SystemExit(_published(result, method, json_path, figure_path))
    if json_path is not None:
        write_json(json_path, result.json(method))
    if json_path != "-":
        click.echo(f"{result.name}: {counted(result.samples, 'sample')}, method {method}")
        for line in estimate_lines(result.estimate, result.wrong):
            click.echo(line)
        for text in result.all_warnings():
            click.echo(f"  warning: {text}")
    raise SystemExit(EXIT_DONE if result.converged else EXIT_NO)


def _placed(config: Config, position: str | None, date: str | None) -> Config:
    """The configuration with the place and the day of the recording.  AhrsdError for a bad one."""
    if position is None and date is None:
        return config
    from pydantic import ValidationError

    from ahrsd.config.sections import LocationSection

    given = config.location.model_dump()
    if position is not None:
        numbers = position.split(",")
        if len(numbers) not in (2, 3):
            raise AhrsdError(f"--position {position}: LAT,LON[,ALT] in deg and m is needed")
        names = ("latitude_deg", "longitude_deg", "height_m")
        given |= {"height_m": 0.0, **dict(zip(names, numbers, strict=False))}
    if given["latitude_deg"] is None:
        raise AhrsdError("--date without --position: the field is that of a place; give both")
    if date is not None:
        given["date"] = date
    try:
        place = LocationSection.model_validate(given, strict=False)
    except ValidationError as error:
        wrong = error.errors()[0]
        if wrong["loc"][:1] == ("date",):
            raise AhrsdError(f"--date {date}: a day as YYYY-MM-DD is needed") from None
        raise AhrsdError(
            f"--position {position}: {wrong['loc'][0]}: {wrong['msg']}; "
            "LAT,LON[,ALT] in deg and m is needed"
        ) from None
    if place.date is None:
        click.echo("--position without --date: today's field is taken", err=True)
    return config.model_copy(update={"location": place})


def _refuse_page(folder: Path) -> None:
    if folder.is_file() or folder.suffix.lower() in (".html", ".htm"):
        raise AhrsdError(f"--report {folder}: give a folder; the page is report.html in it")


def _published(
    result: BatchResult, method: str, json_path: str | None, figure_path: Path | None
) -> int:
    """One published method, or all of them beside ours in one table; the exit code."""
    from ahrsd.offline import compare_methods as published

    if method == _ALL:
        found = published.run_all_methods(result)
        rows = [published.our_row(result), *(published.method_row(result, one) for one in found)]
        ours = published.with_spread(result.json(published.OURS), rows[0])
        others = [published.published_json(result, *pair) for pair in zip(found, rows[1:])]
        body: dict[str, object] = {
            "schema": "ahrsd.calibrations/1",
            "calibrations": [ours, *others],
        }
    else:
        one = published.run_published(result, method)
        rows = [published.method_row(result, one, held_out=False)]
        body = published.published_json(result, one)
    if json_path is not None:
        write_json(json_path, body)
    if figure_path is not None:
        _draw(figure_path, result.name, rows)
    if json_path != "-":
        for line in published.format_table(rows):
            click.echo(line)
    return EXIT_DONE if rows[0].converged else EXIT_NO


def _draw(path: Path, name: str, rows: list[ComparisonRow]) -> None:
    from ahrsd.report.accuracy_figures import write_methods_figure

    try:
        write_methods_figure(path, f"All methods on {name}", rows)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
