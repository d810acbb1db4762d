"""The sections of the page as HTML, made once for all browsers; each changes by itself."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ahrsd.page import sphere, view
from ahrsd.page.feed import Heard
from ahrsd.report.template import render
from ahrsd.telemetry.driving import Pace, circle_is_wanted, shown_of, tilt_is_wanted

TEMPLATES = Path(__file__).with_name("templates")
#: sections in the order of the page; each is an element of this id
SECTIONS = (
    "head",
    "alarms",
    "todo",
    "sphere",
    "marker",
    "drive",
    "heading",
    "gates",
    "candidate",
    "estimate",
    "readings",
)
#: what a status of another version may cause
_OTHER_VERSION = (KeyError, TypeError, ValueError, AttributeError, IndexError)
LOOK_ELSEWHERE = "the page does not understand this daemon, it may be another version"


class Board:
    """See the module. `may_approve`: whether this page was given an operator's token."""

    def __init__(self, *, may_approve: bool) -> None:
        self.may_approve = may_approve
        self._pace, self._fresh = Pace(), sphere.Fresh()
        self._taken_s = -math.inf

    def take(self, heard: Heard) -> None:
        """Follow what moves; once for each status."""
        if heard.status is None or heard.at_s == self._taken_s:
            return
        self._taken_s = heard.at_s
        try:
            self._pace.take(heard.status)
            self._fresh.take(_field(heard.status), float(heard.status["at_s"] or 0.0))
        except _OTHER_VERSION:
            return  # `sections` says so

    def sections(self, heard: Heard, now_s: float) -> dict[str, str]:
        """Every section by its id, at `now_s` of the monotonic clock."""
        if why := heard.away(now_s):
            return self._away(why, now_s - heard.at_s, heard.status is not None)
        try:
            return self._present(heard.status or {})
        except _OTHER_VERSION as error:
            return self._away(f"{LOOK_ELSEWHERE}: {error!r}", now_s - heard.at_s, seen=False)

    def _away(self, why: str, for_s: float, seen: bool) -> dict[str, str]:
        """No figure at all: an old one must not be taken for one of now."""
        since = time.strftime("%H:%M:%S", time.localtime(time.time() - for_s))
        text = render(
            "away.html", TEMPLATES, why=why, since=since, for_=view.span(for_s), seen=seen
        )
        return dict.fromkeys(SECTIONS, "") | {"alarms": text}

    def _present(self, status: Mapping[str, Any]) -> dict[str, str]:
        state, meaning, mode = view.state_words(status)
        shown, fresh_s = shown_of(status), float(status["at_s"] or 0.0)
        circle, tilts = circle_is_wanted(status), tilt_is_wanted(status)
        dots, marker = None, None
        if shown is not None:
            fresh = self._fresh.cells(fresh_s)
            dots = sphere.dots(shown, fresh, circle=circle, tilts=tilts)
            if view.has_readings(status):
                marker = sphere.marker(_field(status), shown.frame_b)
        values: dict[str, object] = {
            "view": view,
            "status": status,
            "pace": self._pace,
            "may_approve": self.may_approve,
            "state": state,
            "meaning": meaning,
            "mode": mode,
            "sphere": sphere,
            "dots": dots,
            "marker": marker,
        }
        return {name: render(f"{name}.html", TEMPLATES, **values) for name in SECTIONS}


def _field(status: Mapping[str, Any]) -> list[float | None]:
    """The field now by the best calibration that is known."""
    seen = status["readings"]
    if seen is None:
        return [None] * 3
    new: list[float | None] = seen["would_be_b_gauss"]
    return seen["corrected_b_gauss"] if None in new else new
