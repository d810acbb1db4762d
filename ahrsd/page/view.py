"""What the page shows, out of a status: words, numbers with unit and sigma, and the sphere. Pure.

The sphere of directions stands as two discs seen from above the vehicle, ahead at the top. Left the
half below the vehicle, right the half above it, each in Lambert's equal-area projection: a share of
a disc is the same share of its half of the sphere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahrsd.calibration_json import UNKNOWN_HEADING_DEG
from ahrsd.evidence.coverage import CELLS, cell_centres, cells_of
from ahrsd.evidence.values import Bools
from ahrsd.gates import GATES, guards_a_write
from ahrsd.printable import counted, line
from ahrsd.samples import Array
from ahrsd.telemetry.driving import (
    LEVEL,
    TILTED,
    Pace,
    Shown,
    about,
    circle_is_wanted,
    drive_next,
    shown_of,
    tilt_is_wanted,
)
from ahrsd.telemetry.words import STATES, explain_json, holding, old_reading, turned_deg

# -- Words and numbers -----------------------------------------------------------------------------


Status = Mapping[str, Any]
NONE = "–"
_ALARMING = frozenset({"FAULT", "FLASH_TORN", "LOCKED"})
_MEANINGS = {gate.gate: gate.meaning for gate in GATES}


@dataclass(frozen=True, slots=True)
class Alarm:
    """What a person must know first. kind: "alarm" or "warning"."""

    kind: str
    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its unit; sigma is one standard deviation in the same unit."""

    name: str
    value: str
    unit: str = ""
    sigma: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Bar:
    """How much of something was shown."""

    name: str
    percent: int
    left: str
    wanted: bool


@dataclass(frozen=True, slots=True)
class GateRow:
    """A gate for a person."""

    name: str
    meaning: str
    value: str
    limit: str
    since: str
    advice: str
    left: str


@dataclass(frozen=True, slots=True)
class Candidate:
    """What would be written, or was. `refusal`: why it cannot be approved now, empty if it can."""

    id: str
    change: str
    written: bool
    lines: tuple[str, ...]
    refusal: str


# -- What must be known first ----------------------------------------------------------------------


def alarms(status: Status) -> list[Alarm]:
    """Alarms first, then warnings."""
    explained = explain_json(status)
    state, link = str(explained["state"]), status["link"]
    found = []
    if state in _ALARMING:
        found.append(Alarm("alarm", state, f"{explained['meaning']}. {explained['next']}"))
    if not link["open"]:
        found.append(Alarm("alarm", "The device is gone", str(explained["stream"])))
    elif old := old_reading(status):
        found.append(Alarm("alarm", "The sensor is silent", old))
    elif explained["stream"]:
        found.append(Alarm("warning", "Stream", str(explained["stream"])))
    found += [Alarm("alarm", "Sensor", text) for text in status["sensors"]]
    if explained["estimator"]:
        found.append(Alarm("alarm", "Estimator", str(explained["estimator"])))
    if explained["mismatch"]:
        found.append(Alarm("warning", "Something changed", str(explained["mismatch"])))
    if error := (status.get("capture") or {}).get("error"):
        found.append(Alarm("warning", "Capture", str(error)))
    found += [Alarm("warning", "File", text) for text in status["complaints"]]
    found += [Alarm("warning", "Stream", text) for text in status["warnings"]]
    shown = [Alarm(one.kind, one.title, line(one.text)) for one in found]
    return sorted(shown, key=lambda one: one.kind)


def next_step(status: Status, *, may_approve: bool) -> str:
    """The one thing to do; a command line only where the page cannot do it."""
    words = line(explain_json(status)["next"])
    if may_approve and "ahrsd operator approve" in words:
        return "Look at the candidate below, then approve it there."
    return sentence(words)


def countdown(status: Status, pace: Pace) -> str:
    """When the last gate opens, at the present rate; empty where no gate is shut."""
    shut = [gate["gate"] for gate in holding(status)[0]]
    if (last := pace.slowest(shut)) is not None:
        return about(last[1])
    still = pace.standing(shut)
    if not still:
        return ""
    return f"time not known: {counted(len(still), 'gate')} made no progress lately"


# -- What was shown --------------------------------------------------------------------------------


def bars(status: Status, pace: Pace) -> list[Bar]:
    """The circle and the tilts; nothing where neither is known."""
    shown = shown_of(status)
    if shown is None:
        return []
    circle, tilts = circle_is_wanted(status), tilt_is_wanted(status)
    rows = ((LEVEL, shown.level_share, circle), (TILTED, shown.tilted_share, tilts))
    return [
        Bar(
            name,
            math.floor(100 * share),
            "" if share >= 1.0 or not wanted else about(pace.left_s(name)),
            wanted,
        )
        for name, share, wanted in rows
    ]


def drive(status: Status) -> str:
    """What to drive next, in words."""
    if words := drive_next(status):
        return sentence(words)
    if status["motion"]["regime"] == "unknown":
        return "Not known: the stream has no acceleration, so the direction of down is not known."
    if any(gate["gate"].startswith("heldout") for gate in holding(status)[0]):
        return (
            "Keep turning: enough directions are covered; now the estimate is tested on new data."
        )
    return "Nothing more: all directions that the gates require are covered."


# -- Heading, estimate, readings -------------------------------------------------------------------


def heading_figures(status: Status) -> list[Figure]:
    """Heading now, as it would be, and the difference."""
    seen = _present(status)
    now = None if seen is None else seen["heading_deg"]
    new = None if seen is None else seen["heading_would_be_deg"]
    sigma = (status["estimate"] or {}).get("heading_sigma_deg")
    known = sigma is not None and sigma < UNKNOWN_HEADING_DEG
    change = None if now is None or new is None else turned_deg(now, new)
    late = "" if new is not None else "once the estimate has converged"
    return [
        Figure("Heading now", number(now, "03.0f"), "°"),
        Figure(
            "As it would be",
            number(new, "05.1f"),
            "°",
            f"{sigma:.2f}°" if known and new is not None else "",
            late,
        ),
        Figure("Difference", number(change, "+z.1f"), "°"),
    ]


def estimate_figures(status: Status) -> list[Figure]:
    """Hard iron, soft iron and gyro bias with sigma; empty where there is no estimate."""
    estimate = status["estimate"]
    if estimate is None:
        return []
    iron = _axes("Hard iron", estimate["hard_iron_gauss"], estimate["sigma_hard_iron_gauss"], 1e3)
    turn = math.degrees(1.0)
    bias = _axes("Gyro bias", estimate["gyro_bias_rad_s"], estimate["sigma_gyro_bias_rad_s"], turn)
    return [
        *[Figure(name, f"{v:+.1f}", "mG", f"{s:.1f}") for name, v, s in iron],
        *[Figure(name, f"{v:+.3f}", "°/s", f"{s:.3f}") for name, v, s in bias],
    ]


def estimate_words(status: Status) -> str:
    """How far the estimate is."""
    estimate = status["estimate"]
    if estimate is None:
        return "none yet: it begins after about a minute of turning"
    done = "converged" if estimate["converged"] else "not converged yet"
    unseen = ", ".join(estimate["unobservable"])
    return f"{done}; not determined by the motion: {unseen}" if unseen else done


def reading_figures(status: Status) -> list[Figure]:
    """Field, rates of turn and attitude now."""
    seen = _present(status)
    rate = status["stream"]["samples_per_s"]
    found = [Figure("Samples", number(rate, ".0f"), "Hz")]
    if seen is None:
        return found
    field = _size(seen["corrected_b_gauss"])
    new = _size(seen["would_be_b_gauss"])
    turning = _size(seen["gyro_b_rad_s"])
    return [
        Figure("Roll", number(seen["roll_deg"], "+z.0f"), "°"),
        Figure("Pitch", number(seen["pitch_deg"], "+z.0f"), "°"),
        Figure("Turning", number(turning, ".1f", math.degrees(1.0)), "°/s"),
        Figure("Field now", number(field, ".0f", 1e3), "mG"),
        Figure("Field as it would be", number(new, ".0f", 1e3), "mG"),
        *found,
    ]


def _present(status: Status) -> Mapping[str, Any] | None:
    """The readings, where they are of now and the device is there."""
    seen: Mapping[str, Any] | None = status.get("readings")
    return None if seen is None or old_reading(status) or not status["link"]["open"] else seen


def has_readings(status: Status) -> bool:
    """Whether there are readings of now."""
    return _present(status) is not None


# -- Gates and the write ---------------------------------------------------------------------------


def gates_counted(status: Status) -> tuple[int, int]:
    """How many gates are open, of how many that guard what a person approves."""
    guards = [gate for gate in status["gates"] if guards_a_write(gate["gate"])]
    return sum(gate["ok"] for gate in guards), len(guards)


def gate_rows(status: Status, pace: Pace) -> list[GateRow]:
    """The gates that hold the next step; those not measured for one reason share a row."""
    rows, unmeasured = [], dict[str, list[Mapping[str, Any]]]()
    for gate in holding(status)[0]:
        if gate["value"] is None:
            unmeasured.setdefault(gate["advice"], []).append(gate)
        else:
            left_s = pace.left_s(gate["gate"])
            rows.append(_gate_row(gate, "" if left_s is None else about(left_s)))
    for advice, gates in unmeasured.items():
        names = [gate["gate"] for gate in gates]
        more = f" and {counted(len(names) - 1, 'more gate')}" if len(names) > 1 else ""
        meaning = "not measured yet: " + ", ".join(names)
        rows.append(GateRow(names[0] + more, meaning, NONE, "", _since(gates[0]), line(advice), ""))
    return rows


def _gate_row(gate: Mapping[str, Any], left: str) -> GateRow:
    unit = gate["unit"]
    value, limit = (
        NONE if gate[key] is None else f"{gate[key]:.3g} {unit}".strip()
        for key in ("value", "limit")
    )
    if not unit and limit == "1" and value in ("0", "1"):
        value, limit = ("yes" if value == "1" else "no"), "yes"
    meaning = _MEANINGS.get(gate["gate"], "")
    return GateRow(gate["gate"], meaning, value, limit, _since(gate), line(gate["advice"]), left)


def state_words(status: Status) -> tuple[str, str, str]:
    """State of the write-back, its meaning, and the mode."""
    state, mode = str(status["write_back"]["state"]), str(status["mode"])
    now = str(status["mode_now"])
    return state, STATES.get(state, ""), mode if now == mode else f"{mode} (now {now})"


def others_that_hold(status: Status) -> list[str]:
    """What holds the next step beside the gates."""
    return [line(text) for text in holding(status)[1]]


def candidate(status: Status) -> Candidate | None:
    """What would be written, once there is something."""
    back = status["write_back"]
    proposal = back["proposal"]
    if proposal is None:
        return None
    change = proposal["heading_change_deg"]
    words = "" if change is None else f"heading changes by up to {change:.1f}°"
    waits, lines = back["state"] == "QUALIFIED", tuple(map(line, proposal["lines"]))
    refusal = "" if waits else f"not to be approved now: {STATES.get(back['state'], '')}"
    return Candidate(str(proposal["id"]), words, back["transaction"] is not None, lines, refusal)


def device_words(status: Status) -> str:
    """Which device, on which port."""
    device, link = status["device"], status["link"]
    name = "device not asked" if device is None else f"{device['model']} {device['serial']}"
    return line(f"{name} on {link['port']}")


# -- Numbers and times in words --------------------------------------------------------------------


def sentence(words: str) -> str:
    """The words with a capital and a full stop; one that begins with a name stays as it is."""
    first = words[:1].upper() + words[1:]
    return first if first.endswith((".", "!", "?")) or "`" in words[-12:] else f"{first}."


def number(value: float | None, form: str, factor: float = 1.0) -> str:
    """The number in the form; a dash where there is none."""
    return NONE if value is None else format(value * factor, form)


def span(seconds: float) -> str:
    """How long something has lasted."""
    seconds = max(seconds, 0.0)
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def _since(gate: Mapping[str, Any]) -> str:
    return "" if gate["for_s"] is None else f"for {span(gate['for_s'])}"


def _axes(
    name: str, values: Sequence[float], sigmas: Sequence[float], factor: float
) -> Iterable[tuple[str, float, float]]:
    for axis, value, sigma in zip("xyz", values, sigmas, strict=True):
        yield f"{name} {axis}", value * factor, sigma * factor


def _size(vector: Sequence[float | None]) -> float | None:
    known = [value for value in vector if value is not None]
    return math.hypot(*known) if len(known) == len(vector) else None


# -- The sphere ------------------------------------------------------------------------------------


WIDTH, HEIGHT = 360, 196
RADIUS = 80.0
MIDDLES = ((90.0, 100.0), (270.0, 100.0))  # of the disc below and of that above


@dataclass(frozen=True, slots=True)
class Dots:
    """Cells as paths of SVG, drawn with round caps: a dot each.

    shown: seen and counted; fresh: seen just now; wanted: to be shown still; other: the rest
    """

    shown: str
    fresh: str
    wanted: str
    other: str


def dots(shown: Shown, fresh: Bools, *, circle: bool, tilts: bool) -> Dots:
    """The dots of what was shown. circle, tilts: whether more of them is wanted."""
    at = project(cell_centres(), shown.frame_b)
    wanted = ((shown.level & circle) | (shown.tilted & tilts)) & ~shown.seen
    new = fresh & ~shown.seen
    rest = ~shown.seen & ~new & ~wanted
    return Dots(*[_path(at[chosen]) for chosen in (shown.seen, new, wanted & ~new, rest)])


def project(directions_b: Array, frame_b: Array) -> Array:
    """(N, 3) vectors to (N, 2) places in the picture. frame_b: rows ahead, right, down."""
    unit = directions_b / np.linalg.norm(directions_b, axis=1, keepdims=True)
    ahead, right, down = (unit @ frame_b.T).T
    above = down < 0
    from_axis = np.sqrt(np.maximum(1.0 - np.abs(down), 0.0)) * RADIUS
    level = np.maximum(np.hypot(ahead, right), 1e-12)
    middle = np.where(above[:, None], MIDDLES[1], MIDDLES[0])
    return np.asarray(middle + (from_axis / level)[:, None] * np.column_stack([right, -ahead]))


def marker(field_b: Sequence[float | None], frame_b: Array) -> tuple[float, float] | None:
    """Where the field is seen now; None where it is not known."""
    known = [value for value in field_b if value is not None]
    if len(known) < 3 or not np.any(known):
        return None
    x, y = project(np.array([known], dtype=float), frame_b)[0]
    return round(float(x), 1), round(float(y), 1)


class Fresh:
    """Cells that were seen in the newest minutes: shown, but not counted before a verdict."""

    def __init__(self, keep_s: float = 120.0) -> None:
        self._keep_s = keep_s
        self._last_s = np.full(CELLS, -np.inf)

    def take(self, field_b: Sequence[float | None], at_s: float) -> None:
        """The direction at `at_s`; a time that fell begins anew."""
        if np.max(self._last_s) > at_s:
            self._last_s[:] = -np.inf
        if None not in field_b:
            self._last_s[cells_of(np.array([field_b], dtype=float))] = at_s

    def cells(self, at_s: float) -> Bools:
        """(CELLS,) seen within the time that is kept."""
        return np.asarray(self._last_s >= at_s - self._keep_s)


def _path(places: Array) -> str:
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in places.tolist())
