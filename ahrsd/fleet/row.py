"""What a row holds, and how the answers about one recording become one.

One row is one recording: its columns are named with their units and are all there, empty where the
recording does not say. `COLUMNS` is the whole table; the store makes Parquet of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ahrsd.errors import RecordingError
from ahrsd.events import Event, SamplesSeen
from ahrsd.printable import LINE, printable

if TYPE_CHECKING:
    from ahrsd.diagnosis.answer.diagnosis import Diagnosis

Row = dict[str, Any]

AXES = "xyz"
#: the iron and the bias with their standard deviations: where each is in the answer
VECTORS = (("hard_iron", "gauss", "hard_iron_gauss"), ("gyro_bias", "rad_s", "gyro_bias_rad_s"))

#: name -> text, number, whole, yes (or no), time (UTC), numbers, texts, findings
COLUMNS: dict[str, str] = {
    "key": "text",
    "stamp": "text",
    "content_sha256": "text",
    "recording": "text",
    "size_bytes": "whole",
    "version": "text",
    "options": "text",
    "outcome": "text",
    "error": "text",
    "remedy": "text",
    "serial_number": "whole",
    "vehicle": "text",
    "place": "text",
    "recorded_utc": "time",
    "recorded_by": "text",
    "temperature_c": "number",
    "samples": "whole",
    "duration_s": "number",
    "converged": "yes",
    "verdict": "text",
    **{
        f"{name}_{part}{axis}_{unit}": "number"
        for name, unit, _ in VECTORS
        for part in ("", "sigma_")
        for axis in AXES
    },
    "soft_iron": "numbers",
    "field_gauss": "number",
    "heading_sigma_deg": "number",
    "mismatch": "yes",
    "p_value": "number",
    "unexplained": "yes",
    "findings": "findings",
    "warnings": "texts",
    "finished_utc": "time",
    "seconds": "number",
    "cpu_s": "number",
    "tries": "whole",
}

DONE, PARTLY, REFUSED = "done", "partly done", "refused"
UNREADABLE = "unreadable"
ANSWERED = (DONE, PARTLY)  # every other outcome is a failure: these, and those of `processes`

_EARLIEST_S, _LATEST_S = 946684800.0, 4102444800.0  # 2000 to 2100: what a stamp of UTC can be
_IN_NAME = re.compile(
    r"(?<!\d)(20\d\d)[-_]?([01]\d)[-_]?([0-3]\d)(?:[-_T ]?([0-2]\d)[-_:]?([0-5]\d)[-_:]?([0-5]\d))?"
)
_WORDS = 12  # findings and warnings that are kept


class Calibrated(Protocol):
    """What `calibrate` answers, as far as a row takes it."""

    @property
    def events(self) -> tuple[Event, ...]: ...  # noqa: D102
    @property
    def facts(self) -> Mapping[str, str]: ...  # noqa: D102
    def json(self, method: str) -> dict[str, object]: ...  # noqa: D102
    def reasons(self) -> list[str]: ...  # noqa: D102
    def all_warnings(self) -> list[str]: ...  # noqa: D102


def error_words(errors: Mapping[str, Exception]) -> dict[str, str | None]:
    """`error` and `remedy` by command; the recording's name is in neither, so that the same error
    of a thousand recordings is the same text."""
    whats: dict[str, list[str]] = {}
    remedies = []
    for command, error in errors.items():
        if isinstance(error, RecordingError):
            whats.setdefault(error.what, []).append(command)
            remedies.append(error.remedy)
        else:
            whats.setdefault(str(error), []).append(command)
    said = "; ".join(f"{' and '.join(commands)}: {what}" for what, commands in whats.items())
    return {
        "error": printable(said, LINE) or None,
        "remedy": printable("; ".join(dict.fromkeys(remedies)), LINE) or None,
    }


def calibration_columns(result: Calibrated) -> Row:
    """What `calibrate` says."""
    body: Any = result.json("magyc")
    out: Row = {
        "samples": body["samples"],
        "converged": body["converged"],
        "verdict": "; ".join(result.reasons()) or "calibrated",
        "warnings": [printable(words, LINE) for words in result.all_warnings()[:_WORDS]],
        "serial_number": (body["device"] or {}).get("serial"),
    }
    blocks = [event.block for event in result.events if isinstance(event, SamplesSeen)]
    warm = [block.covariates.get("temperature_c") for block in blocks]
    measured = np.concatenate([values for values in warm if values is not None] or [np.empty(0)])
    if np.isfinite(measured).any():
        out["temperature_c"] = float(np.nanmean(measured))
    if body.get("duration_s") is None:
        return out
    out |= {name: body[name] for name in ("duration_s", "field_gauss")}
    out["soft_iron"] = [value for row in body["soft_iron"] for value in row]
    out["heading_sigma_deg"] = body["heading_error_deg"]["expected_worst"]
    for name, unit, place in VECTORS:
        sigmas = body["standard_deviation"][place]
        for axis, value, sigma in zip(AXES, body[place], sigmas, strict=True):
            out[f"{name}_{axis}_{unit}"], out[f"{name}_sigma_{axis}_{unit}"] = value, sigma
    return out


def diagnosis_columns(found: Diagnosis) -> Row:
    """What `diagnose` says."""
    return {
        "mismatch": found.mismatch,
        "p_value": finite(found.p_value),
        "unexplained": found.unexplained.detected,
        "findings": [
            {
                "effect": one.effect,
                "probability": finite(one.confidence),
                "frame": one.where.frame,
                "words": printable(one.words, LINE),
            }
            for one in found.findings[:_WORDS]
        ],
    }


def recorded(
    result: Calibrated | None, name: str, modified_s: float | None
) -> dict[str, str | None]:
    """When it was recorded and by what that is known: the recording itself, else its name, else
    the file's own date, which a copy may have changed."""
    said = {} if result is None else result.facts
    if (told := _time(said.get("recorded_utc") or said.get("wall_utc"))) is not None:
        return _when(told, "the recording")
    first = () if result is None else (e for e in result.events if isinstance(e, SamplesSeen))
    start_s = next((float(event.block.time_s[0]) for event in first), 0.0)
    if _EARLIEST_S < start_s < _LATEST_S:
        return _when(datetime.fromtimestamp(start_s, UTC), "its time stamps")
    if (named := _named(name)) is not None:
        return _when(named, "its name")
    if modified_s is None:
        return {"recorded_utc": None, "recorded_by": None}
    return _when(datetime.fromtimestamp(modified_s, UTC), "the file's date")


def now_utc() -> str:
    """As times stand in a row."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _when(at: datetime, by: str) -> dict[str, str | None]:
    return {
        "recorded_utc": at.astimezone(UTC).isoformat(timespec="milliseconds"),
        "recorded_by": by,
    }


def _time(text: str | None) -> datetime | None:
    try:
        found = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    found = found if found.tzinfo else found.replace(tzinfo=UTC)
    return found if _EARLIEST_S < found.timestamp() < _LATEST_S else None


def _named(name: str) -> datetime | None:
    if (found := _IN_NAME.search(name)) is None:
        return None
    try:
        return datetime(*(int(part or 0) for part in found.groups()), tzinfo=UTC)  # type: ignore[misc,arg-type]
    except ValueError:
        return None


def finite(value: float) -> float | None:
    """As JSON can hold it."""
    return float(value) if math.isfinite(value) else None


def whole(parts: Iterable[Row]) -> Row:
    """All columns, later parts over earlier ones; what nobody says is empty."""
    out: Row = dict.fromkeys(COLUMNS)
    for part in parts:
        if unknown := part.keys() - COLUMNS.keys():
            raise KeyError(f"no column {sorted(unknown)}")
        out |= part
    return out
