"""What a recording holds, in lines for a person: topics, messages or columns."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from ahrsd.inputs import Received
from ahrsd.printable import counted, printable
from ahrsd.recording.bytestream import read_chunks
from ahrsd.recording.column_names import ACCEL, GYRO, MAG, TIME
from ahrsd.recording.foreign.formats import format_of, ready
from ahrsd.recording.opening import Recording, open_recording
from drivers.vn100.decode import ErrorReply, Measurement, Unused, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import Reply

_HEAD_BYTES = 4096


def listed(path: Path) -> list[str]:
    """What is in a recording, one line for each thing.  Raises RecordingError."""
    start = b"" if path.is_dir() or not path.is_file() else next(read_chunks(path, _HEAD_BYTES))
    kind = format_of(path, start)
    if kind is not None:
        ready(path, kind)
        return [f"{path.name} {kind.what}", *kind.list(path)]
    recording = open_recording(path)
    lines = [f"{recording.name} is a {recording.kind.value}"]
    if recording.table is not None:
        rows = recording.table.rows
        lines.append(f"rows: {len(rows)}, {rows.time_s[-1] - rows.time_s[0]:.1f} s")
        accel = ACCEL if np.isfinite(rows.accel_b_m_s2).any() else ()
        names = (TIME, *MAG, *GYRO, *accel, *sorted(rows.covariates))
        return lines + [f"column {name}" for name in names]
    return lines + _messages(recording)


def _messages(recording: Recording) -> list[str]:
    """One line per kind of message that a device sent, and what came to nothing."""
    deframer = Deframer()
    counts: Counter[str] = Counter()
    columns: dict[str, tuple[str, ...]] = {}
    for item in recording.inputs():
        if not isinstance(item, Received):
            continue
        for frame in deframer.feed(item.data):
            match decode(frame):
                case Measurement(layout=layout):
                    counts[layout.name] += 1
                    columns[layout.name] = tuple(column.name for column in layout.columns)
                case Reply(word=word):
                    counts[f"{word}, a reply"] += 1
                case ErrorReply():
                    counts["VNERR, an error"] += 1
                case Unused(name=name):
                    counts[f"{name}, not used"] += 1
    told = deframer.counters
    lines = [
        f"{printable(name)}  {counted(count, 'message')}"
        + (f"  {', '.join(columns[name])}" if name in columns else "")
        for name, count in counts.most_common()
    ]
    left = told.fed_bytes - told.valid_bytes
    return [
        *lines,
        f"{left:,} of {counted(told.fed_bytes, 'byte', ',')} belong to no whole message",
    ]
