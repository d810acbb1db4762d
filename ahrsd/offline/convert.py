"""Converts any recording to one table with metadata: unit, frame, clock, source, decompensation.

Device streams go through the daemon's pipeline, so that the table holds what `calibrate` would use.
Disagreements between the axes of field, gyro and gravity are reported, never corrected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ahrsd import __version__
from ahrsd.config.config import Config
from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.events import Event, SamplesSeen
from ahrsd.offline.replay import replay
from ahrsd.offline.track import axis_disagreements, track_of
from ahrsd.recording.column_names import ACCEL, GYRO, MAG, TIME
from ahrsd.recording.foreign.sensors import Choice
from ahrsd.recording.limits import TABLE_ROWS
from ahrsd.recording.opening import Recording, RecordingKind, open_recording
from ahrsd.recording.table import write_table
from ahrsd.samples import Array, SampleBlock

_UNITS = "time_s s, mag gauss, gyro rad/s, accel m/s^2 (specific force); others by their names"
_CLOCKS = {
    RecordingKind.TABLE: "time_s of the table",
    RecordingKind.BYTES: "the device's where it sends one, else even steps at its rate",
    RecordingKind.CAPTURE: "the device's where it sends one, else the host's times of arrival",
}


@dataclass(frozen=True, slots=True, eq=False)
class Converted:
    """Columns of the table by name, facts for its metadata, notes for a person."""

    columns: dict[str, Array]
    facts: dict[str, str]
    notes: tuple[str, ...]


def convert_recording(
    path: Path,
    choice: Choice,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> Converted:
    """Read the recording as columns. Raises RecordingError."""
    recording = open_recording(path, rate_hz, columns=choice.columns, choice=choice)
    if recording.table is not None:
        blocks, notes = list(recording.table.blocks()), list(recording.notes)
    else:
        blocks, notes = _replay_samples(recording, rate_hz, progress)
    if not blocks:
        raise RecordingError(path, "holds no samples", "record again")
    found = axis_disagreements(track_of(blocks))
    agree = "not compared: it turns too little" if found is None else "field and gyro agree"
    agreement = found or []
    facts = {
        "format": f"{recording.kind.value} of ahrsd",
        "frame": "the sensor's own axes, as recorded",
        "clock": _CLOCKS[recording.kind],
        "undone": "nothing"
        if recording.kind is RecordingKind.TABLE
        else "registers 23 and 84, where known",
        **recording.facts,
        "file": recording.name,
        "unit": _UNITS,
        "axes": "; ".join(agreement) or agree,
        "notes": "\n".join(notes),
        "ahrsd": __version__,
    }
    return Converted(_join_columns(blocks), facts, (*notes, *agreement))


def _replay_samples(
    recording: Recording, rate_hz: float | None, progress: Callable[[int], None] | None
) -> tuple[list[SampleBlock], list[str]]:
    seen: list[SampleBlock] = []

    def keep(event: Event) -> None:
        if isinstance(event, SamplesSeen):
            seen.append(event.block)

    done = replay(
        recording.path, Config(), rate_hz=rate_hz, listeners=[keep], progress=progress,
        most_samples=TABLE_ROWS, opened=recording,
    )  # fmt: skip
    return seen, [*done.warnings, *done.core.stream.warnings]


def _join_columns(blocks: list[SampleBlock]) -> dict[str, Array]:
    """Columns of all blocks; nan where a block lacks a covariate."""
    out = {TIME: np.concatenate([block.time_s for block in blocks])}
    for names, pick in ((MAG, "raw_b_gauss"), (GYRO, "gyro_b_rad_s"), (ACCEL, "accel_b_m_s2")):
        values = np.concatenate([getattr(block, pick) for block in blocks])
        if names is not ACCEL or np.isfinite(values).any():
            out |= dict(zip(names, values.T, strict=True))
    for name in dict.fromkeys(name for block in blocks for name in block.covariates):
        out[name] = np.concatenate(
            [block.covariates.get(name, np.full(len(block), np.nan)) for block in blocks]
        )
    return out


def save(table: Converted, path: Path) -> None:
    """Write the table as Parquet, completely or not at all. Raises AhrsdError."""
    part = path.with_name(f".{path.stem}.part.parquet")
    facts = {f"ahrsd.{name}": text for name, text in table.facts.items()}
    try:
        write_table(part, table.columns, facts)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}; check the path") from error
