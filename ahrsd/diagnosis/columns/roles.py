"""What the further columns of a recording are: roles by name and unit, and which are usable.

A column that cannot be used is refused with a sentence, never silently: `prepare_columns` returns
these sentences.

Whatever a file calls its columns, a person sees one short line (`label`).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

_ATTITUDE = re.compile(r"^(ref_q[wxyz]|vn_|ref_|est_)")
# attitude from another system: it describes the motion and causes no reading
_REFERENCE = re.compile(r"^ref_q[wxyz]$")
# computed by the sensor from the same readings: it follows every error and causes none
_OWN_OUTPUT = re.compile(
    r"^(vn_|est_|dcm|q(uat)?(ernion)?_?[wxyz0-3]|uncomp|delta_|lin_?acc|(mag|gyro|accel)_(?!temp)"
    r"|(yaw|pitch|roll)(_?(angle|rate|std|sigma|uncertainty))?(_(deg|rad)(_s)?)?$)"
)
#: largest number of characters of a displayed name
LABEL_CHARACTERS = 48
#: values of a column that are looked at before all of them are
_LOOKED_AT = 8
#: names whose role is remembered: more than a table may have
_NAMES_REMEMBERED = 4096


@dataclass(frozen=True, slots=True)
class Role:
    """A kind of covariate.

    pattern:   of the column's name
    zero:      value at which its effect counts as zero: 0, or the mean of the recording
    limits:    of plausible values in its unit;  beyond: what the column is likely to be outside
               them
    constant:  whether it is useful even if it never changes
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
    "latitude": Role(
        "latitude, deg", r"^lat(itude)?(_|$)", "zero", (-90, 90), "another quantity", True
    ),
    "position": Role(
        "position, m",
        r"^position_(north|east|down)_m$",
        "mean",
        (-1e6, 1e6),
        "another unit",
        constant=True,  # along one axis, on a straight leg
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
        "sync or transmit pulses, 0 or 1",
        r"(ping|sync|pulse|transmit)",
        "zero",
        (0, 1),
        "values other than 0 and 1",
    ),
    "switch": Role(
        "a device that is switched, 0 or 1",
        r"(switch|lamp|light|gripper|pump|relay|degauss)|_on$",
        "zero",
        (0, 1),
        "values other than 0 and 1",
    ),
    "current": Role("electric current, A", r"current|_a$", "zero", (-2e3, 2e3), "milliampere"),
    "throttle": Role("throttle or duty", r"throttle|pwm|duty", "zero", (-1e4, 1e4), "another unit"),
    "voltage": Role("voltage, V", r"voltage|_v$", "mean", (-1e3, 1e3), "millivolt"),
}
#: What effects may need in addition to covariates.
SENSORS = ("accel",)


def role_of(name: str, values: Array) -> str | None:
    """The role of a column, None if no effect uses such a column."""
    lower = name.lower()
    if _ATTITUDE.match(lower):
        return None
    named = _role_by_name(lower)
    if named is not None:
        return named
    if _has_other_levels(values[:: max(len(values) // _LOOKED_AT, 1)]):  # most columns, quickly
        return None
    known = values[np.isfinite(values)]
    if len(known) and not _has_other_levels(known) and known.any():
        return "switch" if _longest_nonzero_interval(known) > priors.SWITCH_ROWS else "ping"
    return None


def _has_other_levels(values: Array) -> bool:
    """Whether any of the finite values is neither 0 nor 1."""
    return bool((np.isfinite(values) & (values != 0.0) & (values != 1.0)).any())


@lru_cache(maxsize=_NAMES_REMEMBERED)
def _role_by_name(lower: str) -> str | None:
    return next((role for role, row in ROLES.items() if re.search(row.pattern, lower)), None)


def usable_columns(covariates: Mapping[str, Array], role: str) -> tuple[str, ...]:
    """The usable columns of a role, in the order of the recording."""
    return tuple(
        name
        for name, values in covariates.items()
        if role_of(name, values) == role and not refusal_reason(name, values)
    )


def zero_reference(role: str, values: Array) -> float:
    """Value at which the effect of that column counts as zero, for calibration and term alike."""
    return float(np.mean(values)) if ROLES[role].zero == "mean" else 0.0


def refusal_reason(name: str, values: Array) -> str:
    """Why a column without gaps cannot be used, in one sentence; empty if it can."""
    role = role_of(name, values)
    if role is None:
        return ""
    row = ROLES[role]
    missing = np.count_nonzero(~np.isfinite(values))
    if missing:
        return f"column {label(name)} was left out: {missing} of {len(values)} values are missing"
    low, high = float(np.min(values)), float(np.max(values))
    if low < row.limits[0] or high > row.limits[1]:
        return (
            f"column {label(name)} was left out: its range {low:g} to {high:g} is not plausible "
            f"for a column of this name ({row.words}); it looks like {row.beyond}"
        )
    if role == "angle" and name.endswith("_rad") and high - low > 50.0:
        return (
            f"column {label(name)} was left out: its range {low:g} to {high:g} rad looks like "
            "degrees"
        )
    if not row.constant and high - low <= 1e-9 * max(abs(low), abs(high), 1e-9):
        return (
            f"column {label(name)} was left out: it is {low:g} throughout, so it can explain "
            "nothing"
        )
    return ""


def prepare_columns(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track with usable covariates only, short gaps filled, and a sentence for each refusal.

    Complete columns without a role are kept: they are compared with time series of the residual.
    Not kept are the sensor's own outputs, which are computed from the readings that are to be
    explained, and a reference attitude, whose presence must not change what is reported about the
    sensor.
    """
    kept: dict[str, Array] = {}
    notes: list[str] = []
    for name, values in track.covariates.items():
        if _OWN_OUTPUT.match(name.lower()) or _REFERENCE.match(name.lower()):
            continue
        filled, note = _fill_gaps(name, values, track.time_s)
        note = note or refusal_reason(name, filled)
        if note:
            notes.append(note)
        elif np.isfinite(filled).all():
            kept[name] = filled
        else:
            notes.append(f"column {label(name)} was left out: some of its values are not finite")
    return replace(track, covariates=kept), tuple(notes)


@dataclass(frozen=True, slots=True, eq=False)
class ColumnWithGaps:
    """A column with long gaps.

    values: (N,) interpolated across them;  missing: (N,) rows inside them;  words: a note on them
    """

    values: Array
    missing: NDArray[np.bool]
    words: str


def find_columns_with_gaps(track: Track) -> dict[str, ColumnWithGaps]:
    """Columns that could be a cause, apart from gaps too long to interpolate."""
    out = {}
    for name, values in track.covariates.items():
        good, time_s = np.isfinite(values), track.time_s
        share = 1.0 - np.count_nonzero(good) / max(len(values), 1)
        if not _fill_gaps(name, values, time_s)[1] or share > priors.COLUMN_HOLES:
            continue
        filled = np.interp(time_s, time_s[good], values[good])
        if role_of(name, filled) is None or refusal_reason(name, filled):
            continue
        before = np.maximum.accumulate(np.where(good, time_s, -np.inf))
        after = np.minimum.accumulate(np.where(good, time_s, np.inf)[::-1])[::-1]
        missing = ~good & (after - before > priors.COLUMN_GAP_S)
        if np.count_nonzero(missing) > priors.COLUMN_HOLES * len(values):
            continue
        first = int(np.argmax(missing))
        words = (
            f"column {label(name)} has no values in "
            f"{np.count_nonzero(missing) * track.step_s:.1f} s, first at "
            f"{time_s[first]:.1f} s: readings in these gaps were not used"
        )
        out[name] = ColumnWithGaps(filled, missing, words)
    return out


def _fill_gaps(name: str, values: Array, time_s: Array) -> tuple[Array, str]:
    """The column with short gaps filled, or the reason for its refusal.

    Gaps of at most COLUMN_GAP_S are interpolated; a column of 0 and 1 keeps its last value.
    """
    good = np.isfinite(values)
    if good.all():
        return values, ""
    present = int(np.count_nonzero(good))
    if 1.0 - present / max(len(values), 1) > priors.COLUMN_MISSING:
        return values, (
            f"column {label(name)} was left out: it has {counted(present, 'value')} in "
            f"{counted(len(values), 'row')}"
        )
    known_s = np.concatenate([time_s[:1], time_s[good], time_s[-1:]])
    usual_s = float(np.median(np.diff(time_s)))
    gaps = [
        (begin, end)
        for begin, end in itertools.pairwise(known_s)
        if end - begin > priors.COLUMN_GAP_S + usual_s and _has_samples(time_s, begin, end)
    ]
    if gaps:
        begin, end = max(gaps, key=lambda one: one[1] - one[0])
        return values, (
            f"column {label(name)} was left out: no values from {begin:.1f} to {end:.1f} s; "
            f"gaps of more than {priors.COLUMN_GAP_S:g} s are not filled"
        )
    nearest = _longest_nonzero_interval(values[good]) and np.isin(values[good], (0.0, 1.0)).all()
    if nearest:  # a switch is on or off, never half
        before = np.maximum.accumulate(np.where(good, np.arange(len(values)), -1))
        return values[np.where(before < 0, int(np.argmax(good)), before)], ""
    return np.interp(time_s, time_s[good], values[good]), ""


def _has_samples(time_s: Array, begin_s: float, end_s: float) -> bool:
    """Whether there are samples between two times: where they pause no value is missing."""
    return bool(np.any((time_s > begin_s) & (time_s < end_s)))


def _longest_nonzero_interval(values: Array) -> int:
    """Number of rows in the longest interval without 0."""
    edges = np.diff(np.concatenate([[0], (values != 0).astype(np.int64), [0]]))
    lengths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    return int(lengths.max()) if len(lengths) else 0


def label(name: str) -> str:
    """The name with unprintable characters escaped; if it is long, without its middle."""
    if len(name) > LABEL_CHARACTERS:
        name = f"{name[: LABEL_CHARACTERS - 13]}...{name[-10:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
