"""A diagnosis for the rerun viewer: innovations before and after, what was named, what is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ahrsd.diagnosis.answer.diagnosis import Contribution, Diagnosis, Drawn
from ahrsd.diagnosis.answer.text import answer_lines, headline, ordinary_residual, where_text
from ahrsd.samples import Array
from ahrsd.viewer.blueprint import X, Y, Z

_TIME = "device_time"
_BEFORE, _AFTER = "innovation/before", "innovation/after"
_AXES = "xyz"


def write_rrd(path: Path, found: Diagnosis) -> None:
    """Write the recording.  OSError where it cannot be written."""
    path.unlink(missing_ok=True)
    stream = rr.RecordingStream("ahrsd diagnosis", recording_id=found.recording or "diagnosis")
    drawn = found.drawn
    effects = (
        [] if drawn is None else [_entity(k, one) for k, one in enumerate(drawn.contributions)]
    )
    frames = [] if drawn is None else [one.frame for one in drawn.courses if len(one.course)]
    stream.set_sinks(rr.FileSink(str(path), write_footer=True))
    stream.send_blueprint(_blueprint(effects, [str(frame) for frame in frames]))
    stream.log("verdict", rr.TextDocument("\n".join(answer_lines(found))), static=True)
    if drawn is not None:
        _series(stream, drawn)
        _spans(stream, found, drawn)
    stream.flush()
    stream.disconnect()


def _entity(number: int, one: Contribution) -> str:
    return f"effect/{one.effect}_{number}"


def _series(stream: rr.RecordingStream, drawn: Drawn) -> None:
    _send(stream, _BEFORE, drawn.time_s, drawn.before)
    _send(stream, _AFTER, drawn.time_s, drawn.after)
    for number, added in enumerate(drawn.contributions):
        _send(stream, _entity(number, added), added.time_s, added.added * 1e3)
    for one in drawn.courses:
        if len(one.course):
            edges = np.asarray(one.cut.edges_s)
            _send(stream, f"left/{one.frame}", 0.5 * (edges[1:] + edges[:-1]), one.course * 1e3)


def _send(stream: rr.RecordingStream, entity: str, time_s: Array, values: Array) -> None:
    """(N, 3) values as three lines."""
    lines_ = rr.SeriesLines(
        colors=[X, Y, Z], names=[f"{entity.rsplit('/', maxsplit=1)[-1]} {a}" for a in _AXES]
    )
    stream.log(entity, lines_, static=True)
    stream.send_columns(
        entity,
        indexes=[rr.TimeColumn(_TIME, duration=time_s)],
        columns=rr.Scalars.columns(scalars=np.nan_to_num(values)),
    )


def _spans(stream: rr.RecordingStream, found: Diagnosis, drawn: Drawn) -> None:
    """Each located span as a line of the log, at its beginning."""
    for finding in found.findings:
        for begin, _ in finding.where.intervals_s:
            stream.set_time(_TIME, duration=float(max(begin, drawn.time_s[0])))
            stream.log("log", rr.TextLog(f"{headline(finding)}: {where_text(finding.where)}"))
    left = found.unexplained.where
    told = rr.TextLog("unknown, here", level=rr.TextLogLevel.WARN)
    if ordinary_residual(found) is not None:
        told = rr.TextLog("ordinary residual, here", level=rr.TextLogLevel.INFO)
    for begin, _ in () if left is None else left.intervals_s:
        stream.set_time(_TIME, duration=float(max(begin, drawn.time_s[0])))
        stream.log("log", told)


def _blueprint(effects: list[str], frames: list[str]) -> rrb.Blueprint:
    innovations = rrb.Vertical(
        rrb.TimeSeriesView(origin="/", contents=[_BEFORE], name="innovations before, sigma"),
        rrb.TimeSeriesView(origin="/", contents=[_AFTER], name="innovations after, sigma"),
    )
    named = [
        rrb.TimeSeriesView(origin="/", contents=[entity], name=f"{entity}, mG or mrad/s")
        for entity in effects
    ]
    left = [
        rrb.TimeSeriesView(
            origin="/", contents=[f"left/{frame}"], name=f"left: {frame}, mG, mrad/s"
        )
        for frame in frames
    ]
    text = rrb.Vertical(
        rrb.TextDocumentView(origin="verdict", name="verdict"), rrb.TextLogView(origin="log")
    )
    columns = (
        [innovations, rrb.Vertical(*(named + left)), text] if named + left else [innovations, text]
    )
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)
