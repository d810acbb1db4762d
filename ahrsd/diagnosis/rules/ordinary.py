"""What real recordings ordinarily leave beside the names, and whether this one leaves more.

No real recording is what a calibration and a library say to the last nat: a room's field differs
from place to place, a sensor is not quite linear, a mount gives.  "Unknown" said of all of them
says nothing.  So the sizes of what is left (`remainder_sizes`) are held against those of untouched
real recordings: nothing was put on them, no large current flowed.

A component is there where it is worth as much beside the others as an unknown must be.  It is there
in a share of the recordings only, and its size there is spread in its logarithm as a Student t
(heavy tails: a few recordings are far off), with one spread for all components, since of some a few
recordings have any.  The limit of a component is what 95 % of such recordings stay below, those in
which it is not there counted.  So a course on the sensor itself, which next to none has, is soon
beyond the ordinary, and a field that differs from place to place is not.

    within   every component that is there is below its limit: what is left is ordinary, and is told
             with its size
    beyond   one is not: unknown
    sensor   it is located as a course in time on the sensor, as an unlogged current or a magnet is:
             what its quick part leaves looks like a bit of every component, so its size says little
    cleaner  beside its largest field the recording leaves less than real ones do: of a simulation,
             or of a sensor better than any that was measured, these sizes say nothing, and whatever
             stands out of its noise is unknown, however small
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from ahrsd.diagnosis.answer.diagnosis import Component, Diagnosis, Ordinary, Unexplained
from ahrsd.diagnosis.answer.ordinary_text import SIMULATED, limit_text, told_size
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.remainder_sizes import Left, Size

#: share of ordinary recordings that stay below a limit
LEVEL = 0.95
#: gauss and rad/s: what is smaller is not there, whatever it is worth
LEAST = 1e-3
#: recordings in which a component must be there before any size of it is ordinary
FEWEST = 3
#: of the logarithms' Student t
FREEDOM = 4.0
_ROUNDS = 100
#: words and frame of each component, and its unit
COMPONENTS = {
    "sensor_course": ("a course in time on the sensor", "sensor", "gauss"),
    "by_attitude": ("a field by attitude", "sensor", "gauss"),
    "world": ("a field that differs from time to time and place to place", "world", "gauss"),
    "gyro_course": ("a course in time of the gyro", "gyro", "rad/s"),
    "by_rate": ("an error of the gyro by its rates", "gyro", "rad/s"),
}


@dataclass(frozen=True, slots=True)
class Row:
    """A size of untouched recordings.

    median: of the recordings in which it is there, gauss, rad/s or degrees
    spread: of its logarithm about that
    seen, asked: in how many it is there, and of how many
    """

    median: float
    spread: float
    seen: int
    asked: int

    def up_to(self, level: float = LEVEL) -> float:
        """What the next recording stays below with this probability, whether it is there or not.

        0 where next to no recording has any: then to have some is not ordinary.
        """
        if self.seen < FEWEST:
            return 0.0
        beyond = (1.0 - level) * self.asked / self.seen
        return self._at(1.0 - beyond) if beyond < 1.0 else 0.0

    def from_on(self, level: float = LEVEL) -> float:
        """What the next one in which it is there stays above."""
        return self._at(1.0 - level) if self.seen else 0.0

    def _at(self, probability: float) -> float:
        wide = self.spread * np.sqrt(1.0 + 1.0 / self.seen)  # the median is not known better
        return float(self.median * np.exp(wide * stdtrit(FREEDOM, probability)))


@dataclass(frozen=True, slots=True)
class Table:
    """Everything that was measured on so many recordings.

    components: by name;  field, heading, gyro: everything together, gauss, degrees, rad/s
    beside: the fields but for the largest component, gauss
    """

    recordings: int
    components: Mapping[str, Row]
    field: Row
    heading: Row
    gyro: Row
    beside: Row


#: of `python tests/benchmarks/diagnosis/bench_ordinary.py`, which prints it
TABLE = Table(
    recordings=19,
    components={
        "sensor_course": Row(1.721e-02, 1.013, 2, 19),
        "by_attitude": Row(8.838e-03, 1.013, 16, 19),
        "world": Row(1.095e-02, 1.013, 13, 19),
        "gyro_course": Row(4.919e-03, 1.013, 5, 19),
        "by_rate": Row(1.933e-02, 1.013, 9, 19),
    },
    field=Row(1.390e-02, 0.828, 19, 19),
    heading=Row(2.219, 0.885, 19, 19),
    gyro=Row(1.933e-02, 1.545, 19, 19),
    beside=Row(5.110e-03, 0.979, 19, 19),
)


def table_of(measured: Sequence[Left]) -> Table:
    """The table of untouched recordings; a few that are far off hardly move it."""
    sizes = {
        name: [one.size for left in measured for one in left.sizes if one.component == name
               and is_there(one)]
        for name in COMPONENTS
    }  # fmt: skip
    shared = spread_of(list(sizes.values()))
    asked = len(measured)

    def whole(values: Sequence[float]) -> Row:
        there = [value for value in values if value > 0.0]
        return _row(there, spread_of([there]), asked)

    return Table(
        asked,
        {name: _row(values, shared, asked) for name, values in sizes.items()},
        field=whole([left.field_gauss for left in measured]),
        heading=whole([left.heading_deg for left in measured]),
        gyro=whole([left.gyro_rad_s for left in measured]),
        beside=whole([left.beside_gauss for left in measured]),
    )


def _row(values: Sequence[float], spread: float, asked: int) -> Row:
    return Row(float(np.median(values)) if values else 0.0, spread, len(values), asked)


def spread_of(rows: Sequence[Sequence[float]]) -> float:
    """The likeliest scale of the logarithms about the median of their row."""
    logs = [np.log(row) for row in rows if len(row) > 1]
    if not logs:
        return 1.0
    off = np.concatenate([row - np.median(row) for row in logs])
    freed = len(off) / (len(off) - len(logs))  # each row's median was taken out of it
    square = float(np.mean(off**2))
    for _ in range(_ROUNDS):
        weight = (FREEDOM + 1.0) / (FREEDOM + off**2 / max(square, 1e-12))
        square = float(np.mean(weight * off**2)) * freed
    return float(np.sqrt(square))


def is_there(one: Size) -> bool:
    """Whether a component is known to be there beside the others."""
    return one.evidence_nats > LIMITS.unknown_nats and one.size > LEAST


def is_course_on_sensor(unknown: Unexplained) -> bool:
    """Whether it is located as something that changes with time on the sensor."""
    where = unknown.where
    return bool(unknown.course) and where is not None and where.frame == "sensor"


def held_against(left: Left, table: Table = TABLE, *, on_sensor: bool = False) -> Ordinary:
    """The sizes of what is left, beside what recordings ordinarily leave."""
    told = tuple(_beside(one, table) for one in left.sizes)
    least = table.beside.from_on()
    reasons = [_more(one) for one in told if one.there and one.size > one.up_to]
    if on_sensor:
        reasons.append("it changes with time on the sensor, as an unlogged current does")
    why = "beyond the ordinary: " + ", ".join(reasons) if reasons else None
    if left.beside_gauss < least:
        why = (
            "cleaner than the real recordings of which this would be ordinary: beside its largest "
            f"part it leaves {told_size(left.beside_gauss, 'gauss')}, they "
            f"{told_size(least, 'gauss')} or more"
        )
    return Ordinary(
        within=why is None,
        why=why,
        field_gauss=left.field_gauss,
        field_up_to_gauss=table.field.up_to(),
        heading_deg=left.heading_deg,
        heading_up_to_deg=table.heading.up_to(),
        gyro_rad_s=left.gyro_rad_s,
        gyro_up_to_rad_s=table.gyro.up_to(),
        beside_gauss=left.beside_gauss,
        beside_from_gauss=least,
        recordings=table.recordings,
        components=told,
    )


def _beside(one: Size, table: Table) -> Component:
    words, frame, unit = COMPONENTS[one.component]
    return Component(
        one.component,
        words,
        frame,
        one.size,
        table.components[one.component].up_to(),
        unit,
        one.heading_deg,
        one.evidence_nats,
        is_there(one),
    )


def _more(one: Component) -> str:
    return f"{one.words}, {told_size(one.size, one.unit)} where {limit_text(one)} is ordinary"


def beyond_ordinary(found: Diagnosis, *, simulated: bool = False) -> Diagnosis:
    """The answer in which what is left is unknown only where it is beyond the ordinary.

    Its address, evidence and `p_value` stay: that something is left is as sure as before.
    simulated: known to be no real recording, of which nothing is ordinary
    """
    left = found.unexplained
    if not left.detected or left.ordinary is None or not left.ordinary.within:
        return found
    if simulated:
        told = replace(left.ordinary, within=False, why=SIMULATED)
        return replace(found, unexplained=replace(left, ordinary=told))
    left = replace(left, detected=False)
    return replace(found, unexplained=left, mismatch=bool(found.findings))
