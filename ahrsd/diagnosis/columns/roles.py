"""What the further columns of a recording are: roles by name and unit, and which can be used.

A column that cannot be used is refused with a sentence, never silently: `prepared` returns them.

Whatever a file calls its columns, a person is shown one short line (`shown`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_ATTITUDE = re.compile(r"^(ref_q[wxyz]|vn_|ref_|est_)")
# an attitude measured by others: the motion, and the cause of nothing that is read
_REFERENCE = re.compile(r"^ref_q[wxyz]$")
# what the sensor itself makes of the same readings: it moves with every error and causes none
_OWN_OUTPUT = re.compile(
    r"^(vn_|est_|dcm|q(uat)?(ernion)?_?[wxyz0-3]|uncomp|delta_|lin_?acc|(mag|gyro|accel)_(?!temp)"
    r"|(yaw|pitch|roll)(_?(angle|rate|std|sigma|uncertainty))?(_(deg|rad)(_s)?)?$)"
)
#: characters of a name that are shown
SHOWN_CHARACTERS = 48


@dataclass(frozen=True, slots=True)
class Role:
    """A kind of covariate.

    pattern:   of the column's name
    zero:      where its effect counts as zero: at 0, or at the recording's mean
    limits:    of believable values in its unit;  beyond: what the column looks like outside
    constant:  it is of use even if it never changes
    """

    words: str
    pattern: str
    zero: Literal["zero", "mean"]
    limits: tuple[float, float]
    beyond: str
    constant: bool = False


#: In order: the first pattern that fits decides.
ROLES: Mapping[str, Role] = {
    "temperature": Role("temperature, degC", r"temp(erature)?(_|$)", "mean", (-80, 200), "kelvin"),
    "pressure": Role("pressure, kPa", r"pressure", "mean", (0.1, 2e5), "another unit"),
    "latitude": Role("latitude, deg", r"^lat(itude)?(_|$)", "zero", (-90, 90), "no latitude", True),
    "position": Role(
        "position, m",
        r"^position_(north|east|down)_m$",
        "mean",
        (-1e6, 1e6),
        "another unit",
        constant=True,  # a straight leg along one axis
    ),
    "altitude": Role(
        "altitude, height or depth, m",
        r"(altitude|height|depth|^alt)(_\w+)*_m$",
        "mean",
        (-1.2e4, 1e5),
        "another unit",
    ),
    "angle": Role(
        "angle of a joint, rudder or arm",
        r"(angle|joint|rudder|steering|turret|arm|pan|tilt)\w*_(rad|deg)$",
        "zero",
        (-1e3, 1e3),
        "encoder counts",
    ),
    "rpm": Role(
        "revolutions per minute",
        r"(^|_)rpm($|_)",
        "zero",
        (-3e5, 3e5),
        "another unit",
        constant=True,  # of a rotor that turns steadily
    ),
    "speed": Role("speed, m/s", r"(speed|velocity)\w*_m_s$", "zero", (-1e3, 1e3), "another unit"),
    "ping": Role(
        "sync or transmit pulses, 0 or 1", r"(ping|sync|pulse|transmit)", "zero", (0, 1), "no 0/1"
    ),
    "switch": Role(
        "a device that is switched, 0 or 1",
        r"(switch|lamp|light|gripper|pump|relay|degauss)|_on$",
        "zero",
        (0, 1),
        "no 0/1",
    ),
    "current": Role("electric current, A", r"current|_a$", "zero", (-2e3, 2e3), "milliampere"),
    "throttle": Role("throttle or duty", r"throttle|pwm|duty", "zero", (-1e4, 1e4), "another unit"),
    "voltage": Role("voltage, V", r"voltage|_v$", "mean", (-1e3, 1e3), "millivolt"),
}
#: What effects may need that is no covariate's role.
SENSORS = ("accel",)


def role_of(name: str, values: Array) -> str | None:
    """The role of a column, None where it has none that an effect knows."""
    lower = name.lower()
    if _ATTITUDE.match(lower):
        return None
    named = _role_by_name(lower)
    if named is not None:
        return named
    known = values[np.isfinite(values)]
    if len(known) and np.isin(known, (0.0, 1.0)).all() and known.any():
        return "switch" if _longest_on(known) > priors.SWITCH_ROWS else "ping"
    return None


@lru_cache
def _role_by_name(lower: str) -> str | None:
    return next((role for role, row in ROLES.items() if re.search(row.pattern, lower)), None)


def named(covariates: Mapping[str, Array], role: str) -> tuple[str, ...]:
    """The columns of that role that can be used, in the order of the recording."""
    return tuple(
        name
        for name, values in covariates.items()
        if role_of(name, values) == role and not fault(name, values)
    )


def reference(role: str, values: Array) -> float:
    """Where the effect of that column counts as zero: calibration and term refer to it."""
    return float(np.mean(values)) if ROLES[role].zero == "mean" else 0.0


def fault(name: str, values: Array) -> str:
    """Why a filled column cannot be used, in one sentence; empty where it can."""
    role = role_of(name, values)
    if role is None:
        return ""
    row = ROLES[role]
    missing = np.count_nonzero(~np.isfinite(values))
    if missing:
        return f"column {shown(name)} was left out: {missing} of {len(values)} values are missing"
    low, high = float(np.min(values)), float(np.max(values))
    if low < row.limits[0] or high > row.limits[1]:
        return (
            f"column {shown(name)} was left out: {low:g} to {high:g} is no {row.words}; it looks "
            f"like {row.beyond}"
        )
    if role == "angle" and name.endswith("_rad") and high - low > 50.0:
        return f"column {shown(name)} was left out: {low:g} to {high:g} rad looks like degrees"
    if not row.constant and high - low <= 1e-9 * max(abs(low), abs(high), 1e-9):
        return f"column {shown(name)} was left out: it is {low:g} throughout, so nothing follows it"
    return ""


def prepared(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track with usable covariates only, short holes filled, and a sentence per refusal.

    Columns without a role are kept where they are complete: they serve to look for courses; not
    so the sensor's own outputs, which are made of the readings that are being explained, and a
    reference attitude: that it is there must not change what is said of the sensor.
    """
    kept: dict[str, Array] = {}
    notes: list[str] = []
    for name, values in track.covariates.items():
        if _OWN_OUTPUT.match(name.lower()) or _REFERENCE.match(name.lower()):
            continue
        filled, note = _filled(name, values, track.time_s)
        note = note or fault(name, filled)
        if note:
            notes.append(note)
        elif np.isfinite(filled).all():
            kept[name] = filled
        else:
            notes.append(
                f"column {shown(name)} was left out: its values are no numbers to compute with"
            )
    return replace(track, covariates=kept), tuple(notes)


@dataclass(frozen=True, slots=True, eq=False)
class Holed:
    """A column with long holes: values (N,) drawn across them;  missing (N,) rows inside them."""

    values: Array
    missing: NDArray[np.bool]
    words: str


def holed(track: Track) -> dict[str, Holed]:
    """Columns that could be a cause but for holes that are too long to guess what is in them."""
    out = {}
    for name, values in track.covariates.items():
        good, time_s = np.isfinite(values), track.time_s
        share = 1.0 - np.count_nonzero(good) / max(len(values), 1)
        if not _filled(name, values, time_s)[1] or share > priors.COLUMN_HOLES:
            continue
        filled = np.interp(time_s, time_s[good], values[good])
        if role_of(name, filled) is None or fault(name, filled):
            continue
        before = np.maximum.accumulate(np.where(good, time_s, -np.inf))
        after = np.minimum.accumulate(np.where(good, time_s, np.inf)[::-1])[::-1]
        missing = ~good & (after - before > priors.COLUMN_GAP_S)
        if np.count_nonzero(missing) > priors.COLUMN_HOLES * len(values):
            continue
        first = int(np.argmax(missing))
        words = (
            f"column {shown(name)} has no values in "
            f"{np.count_nonzero(missing) * track.step_s:.1f} s, first at "
            f"{time_s[first]:.1f} s: readings without it were not used"
        )
        out[name] = Holed(filled, missing, words)
    return out


def _filled(name: str, values: Array, time_s: Array) -> tuple[Array, str]:
    """The column with holes of at most two seconds interpolated, or a sentence."""
    good = np.isfinite(values)
    if good.all():
        return values, ""
    share = 1.0 - np.count_nonzero(good) / max(len(values), 1)
    if share > priors.COLUMN_MISSING:
        return values, f"column {shown(name)} was left out: {share:.0%} of its values are missing"
    known_s = np.concatenate([time_s[:1], time_s[good], time_s[-1:]])
    widest = int(np.argmax(np.diff(known_s)))
    hole_s = float(known_s[widest + 1] - known_s[widest])
    usual_s = float(np.median(np.diff(time_s)))
    if hole_s > priors.COLUMN_GAP_S + usual_s and not _same_hole(time_s, known_s[widest], hole_s):
        return values, (
            f"column {shown(name)} was left out: no values from {known_s[widest]:.1f} to "
            f"{known_s[widest + 1]:.1f} s; holes of more than {priors.COLUMN_GAP_S:g} s are not "
            "guessed"
        )
    nearest = _longest_on(values[good]) and np.isin(values[good], (0.0, 1.0)).all()
    if nearest:  # a switch is on or off, never half
        before = np.maximum.accumulate(np.where(good, np.arange(len(values)), -1))
        return values[np.where(before < 0, int(np.argmax(good)), before)], ""
    return np.interp(time_s, time_s[good], values[good]), ""


def _same_hole(time_s: Array, from_s: float, hole_s: float) -> bool:
    """Whether the samples themselves pause there, so that nothing is missing."""
    inside = (time_s > from_s) & (time_s < from_s + hole_s)
    return not bool(inside.any())


def _longest_on(values: Array) -> int:
    """The longest stretch of rows that are not 0."""
    edges = np.diff(np.concatenate([[0], (values != 0).astype(np.int64), [0]]))
    lengths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    return int(lengths.max()) if len(lengths) else 0


def shown(name: str) -> str:
    """The name with what is not printable as its escape, and its middle left out if it is long."""
    if len(name) > SHOWN_CHARACTERS:
        name = f"{name[: SHOWN_CHARACTERS - 13]}...{name[-10:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
