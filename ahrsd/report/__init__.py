"""A report for people: one HTML file with its pictures inside, readable on a phone and in print.

`contents` says what a report may contain and fills the part that follows from the core's events,
`figures` draws (the only importer of matplotlib, loaded when a report is written), `page`
puts it on a page, `template` renders the HTML in `templates/`.

    collector = EventCollector()
    for event in core_events: collector.add(event)
    write_report(path, collector.report("ahrsd demo", summary=..., heading=...))
"""

from ahrsd.report.contents import (
    EstimateHistory,
    EventCollector,
    FieldClouds,
    FieldNorm,
    HeadingError,
    KeyFigure,
    RegisterChange,
    ReportData,
)
from ahrsd.report.page import before_after_figure, write_report

__all__ = [
    "EstimateHistory",
    "EventCollector",
    "FieldClouds",
    "FieldNorm",
    "HeadingError",
    "KeyFigure",
    "RegisterChange",
    "ReportData",
    "before_after_figure",
    "write_report",
]
