"""Evaluates a calibration on a recording: reads samples, calibration.json, references, position
and date; `ahrsd.evaluation` judges them."""

from __future__ import annotations

import csv
import datetime
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.config.config import Config
from ahrsd.errors import RecordingError
from ahrsd.evaluation import (
    Evaluation,
    EvaluationError,
    EvaluationTrack,
    HeadingReference,
    StoredCalibration,
    build_track,
    judge,
    parse_calibration,
    parse_calibrations,
)
from ahrsd.evaluation.heading import (
    Fixes,
    column_reference,
    course_reference,
    device_heading,
    fixes_from_degrees,
    fixes_of_track,
    is_place,
    optical_reference,
)
from ahrsd.events import SamplesSeen
from ahrsd.offline.replay import replay
from ahrsd.printable import printable
from ahrsd.recording.bytestream import read_chunks
from ahrsd.recording.column_names import NO_MAP, ColumnMap
from ahrsd.recording.limits import TABLE_BYTES, TABLE_ROWS, on_one_thread, refuse_beyond
from ahrsd.recording.opening import open_recording
from ahrsd.recording.table import read_table
from ahrsd.samples import Array
from ahrsd.world_field import (
    OLDEST_WMM_YEAR,
    OLDEST_YEAR,
    Model,
    WorldField,
    WorldFieldError,
    world_field,
)

_GPS_SUFFIX = ".gps.csv.gz"
_CHUNK_BYTES = 1 << 18
_GPS_TIME = ("t_s", "time_s")
_GPS_PLACE = ("lat_deg", "lon_deg")


@on_one_thread
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
    """The evaluations of a calibration on a recording, and reasons for missing ones by method.

    One evaluation, or with method "all" one for each calibration in the file, in its order. Raises
    AhrsdError.
    """
    calibrations, without = read_calibrations(calibration_path, method)
    world = world_field_at(position, date, model)  # type: ignore[arg-type]
    track, notes = read_track(recording, Config(), rate_hz, progress, columns)
    extended, fixes, place = _add_reference_file(reference_path or find_gps_file(recording), track)
    if place is not None and world is None and date is not None:
        world = world_field_at(place, date, model)  # type: ignore[arg-type]
        notes.append(f"the position is that of the middle GPS fix: {place}")
    track, fixes = extended, fixes or fixes_of_track(extended)
    references, more_notes = _references(track, fixes, heading_column, least_speed_m_s)
    found = [
        judge(
            printable(recording.name, 200),
            track,
            replace(calibration, remarks=(*notes, *more_notes, *calibration.remarks)),
            references,
            fixes=fixes,
            world=world,
            tilt_source=tilt,  # type: ignore[arg-type]
        )
        for calibration in calibrations
    ]
    return found, without


def _add_reference_file(
    path: Path | None, track: EvaluationTrack
) -> tuple[EvaluationTrack, Fixes | None, str | None]:
    """The track with the columns of another file; or the file's fixes and its middle position."""
    if path is None:
        return track, None, None
    if not is_gps_file(path):
        return add_columns(track, path), None, None
    fixes, place = read_fixes(path)
    return track, fixes, place


def _references(
    track: EvaluationTrack, fixes: Fixes | None, heading_column: str | None, least_speed_m_s: float
) -> tuple[list[HeadingReference], list[str]]:
    """The available heading references, best first, and reasons for missing ones."""
    notes: list[str] = []
    found: list[HeadingReference] = []
    if heading_column is not None:
        found.append(column_reference(track, heading_column))
    if fixes is not None:
        try:
            found.append(course_reference(fixes, least_speed_m_s))
        except EvaluationError as error:
            notes.append(str(error))
    found += [one for one in (optical_reference(track), device_heading(track)) if one is not None]
    return found, notes


def read_track(
    path: Path,
    config: Config,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
    columns: ColumnMap | None = None,
) -> tuple[EvaluationTrack, list[str]]:
    """Samples of a recording, and notes for a person. RecordingError as `replay`."""
    recording = open_recording(path, rate_hz, columns=columns or NO_MAP)
    if recording.table is not None:
        pieces = [(block, Affine.identity()) for block in recording.table.blocks()]
        return build_track(pieces), list(recording.notes)
    seen: list[SamplesSeen] = []
    done = replay(
        path,
        config,
        rate_hz=rate_hz,
        progress=progress,
        most_samples=TABLE_ROWS,
        listeners=[lambda event: seen.append(event) if isinstance(event, SamplesSeen) else None],
    )
    notes = [*done.warnings, *done.core.stream.warnings]
    return build_track([(event.block, event.present) for event in seen]), notes


def read_calibrations(
    path: Path, method: str | None
) -> tuple[list[StoredCalibration], dict[str, str]]:
    """The calibration in the file, or all with method "all"; reasons for missing ones by method.

    CalibrationFileError, EvaluationError if it cannot be read.
    """
    body = _json(path)
    if method == "all":
        return parse_calibrations(body, path.name)
    return [parse_calibration(body, path.name, method)], {}


def _json(path: Path) -> object:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise EvaluationError(
            f"{path}: cannot be read: {error.strerror}; check the path"
        ) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise EvaluationError(
            f"{path}: is no JSON: {error}; write it with `ahrsd calibrate RECORDING --json FILE`"
        ) from error


def find_gps_file(recording: Path) -> Path | None:
    """NAME.gps.csv.gz or NAME.gps.csv in the folder of NAME.*; None if there is none."""
    name = recording.name.split(".", 1)[0]
    for suffix in (_GPS_SUFFIX, _GPS_SUFFIX.removesuffix(".gz")):
        path = recording.with_name(name + suffix)
        if path.is_file():
            return path
    return None


def read_fixes(path: Path) -> tuple[Fixes, str]:
    """Fixes of a CSV with t_s (or time_s), lat_deg, lon_deg; the middle one as for --position."""
    columns = _columns(path)
    time = next((name for name in _GPS_TIME if name in columns), None)
    missing = [name for name in _GPS_PLACE if name not in columns]
    if time is None or missing:
        raise EvaluationError(
            f"{path}: has no column {(missing or ['t_s'])[0]}; "
            "a GPS file needs t_s, lat_deg, lon_deg"
        )
    lat, lon = (columns[name] for name in _GPS_PLACE)
    fixes = fixes_from_degrees(columns[time], lat, lon, f"GPS ({path.name})")
    alt = columns.get("alt_m", np.zeros(len(lat)))
    place = np.column_stack([lat, lon, np.nan_to_num(alt)])[is_place(lat, lon)]
    return fixes, ",".join(f"{value:.6f}" for value in place[len(place) // 2])


def is_gps_file(path: Path) -> bool:
    """Whether a reference file holds GPS fixes, by its header."""
    return "lat_deg" in _text(path).split("\n", 1)[0]


def add_columns(track: EvaluationTrack, path: Path) -> EvaluationTrack:
    """The track with the further columns of a reference table, at the track's instants.

    Values are taken from the nearest row, because angles must not be interpolated over a turn.
    """
    other = read_table_columns(path)
    time_s = other.pop("time_s")
    right = np.clip(np.searchsorted(time_s, track.time_s), 1, len(time_s) - 1)
    near = np.where(
        track.time_s - time_s[right - 1] <= time_s[right] - track.time_s, right - 1, right
    )
    far = np.abs(time_s[near] - track.time_s) > float(np.median(np.diff(time_s)))
    added = {name: np.where(far, np.nan, values[near]) for name, values in other.items()}
    return EvaluationTrack(
        track.time_s,
        track.raw_b_gauss,
        track.before_b_gauss,
        track.gyro_b_rad_s,
        track.accel_b_m_s2,
        track.starts,
        {**track.covariates, **added},
    )


def read_table_columns(path: Path) -> dict[str, Array]:
    """The columns of a reference table: a recording, or any CSV with time_s."""
    try:
        rows = read_table(path).rows
    except RecordingError:
        columns = _columns(path)
        if "time_s" not in columns or len(columns["time_s"]) < 2:
            raise EvaluationError(
                f"{path}: is no reference: it needs time_s and lat_deg, lon_deg, or time_s and "
                "ref_q{w,x,y,z}, position_{north,east}_m or a heading column"
            ) from None
        if not np.all(np.diff(columns["time_s"]) > 0):
            raise EvaluationError(f"{path}: time_s does not go forward; sort by time") from None
        return columns
    return {"time_s": rows.time_s, **rows.covariates}


def world_field_at(position: str | None, date: str | None, model: Model) -> WorldField | None:
    """The world field at `--position LAT,LON[,ALT]` and `--date`; None without a position.

    Raises EvaluationError if one of them is missing or unreadable, WorldFieldError if the model is
    not valid there.
    """
    if position is None:
        return None
    try:
        numbers = [float(text) for text in position.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise EvaluationError(f"--position {position}: LAT,LON[,ALT] in deg and m is needed")
    if date is None:
        raise EvaluationError("--position without --date: the field changes; give YYYY-MM-DD")
    height_m = numbers[2] if len(numbers) == 3 else 0.0
    year = decimal_year(date)
    try:
        return world_field(numbers[0], numbers[1], height_m, year, model)
    except WorldFieldError as error:
        if model == "igrf" or not OLDEST_YEAR <= year < OLDEST_WMM_YEAR:
            raise
        raise EvaluationError(f"{error}; or take --model igrf, which has older years") from error


def decimal_year(date: str) -> float:
    """Decimal year of a date YYYY-MM-DD. EvaluationError for anything else."""
    try:
        day = datetime.date.fromisoformat(date)
    except ValueError as error:
        raise EvaluationError(f"--date {date}: {error}; YYYY-MM-DD is needed") from error
    first = datetime.date(day.year, 1, 1)
    days = (datetime.date(day.year + 1, 1, 1) - first).days if day.year < datetime.MAXYEAR else 365
    return day.year + (day - first).days / days


def _columns(path: Path) -> dict[str, Array]:
    reader = csv.DictReader(io.StringIO(_text(path)))
    rows = list(reader)
    names = [name for name in reader.fieldnames or [] if name]
    return {name: np.array([_number(row.get(name)) for row in rows]) for name in names}


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")


def _text(path: Path) -> str:
    data = bytearray()
    for chunk in read_chunks(path, _CHUNK_BYTES):
        data += chunk
        refuse_beyond(path, len(data), TABLE_BYTES, "bytes of text and more", "cut it in parts")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise EvaluationError(f"{path}: cannot be read: {error}; save it as UTF-8") from error
