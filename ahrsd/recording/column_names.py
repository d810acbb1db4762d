"""Which column of a table is what, and in which unit.

The canonical names carry their units (`mag_x_gauss`). Other names are told by the user
(`--columns mag_x=MagX:uT`) or known from a program that everybody uses; capitals and blanks do not
count. What is missing is answered with the option that would give it, and a size that is that of
another unit (tesla, mG, deg/s) with the option that names it.
"""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ahrsd.errors import AhrsdError
from ahrsd.printable import printable

TIME = "time_s"
MAG = ("mag_x_gauss", "mag_y_gauss", "mag_z_gauss")
GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
REQUIRED = (TIME, *MAG, *GYRO)
GRAVITY_M_S2 = 9.80665
DEGREE = 0.017453292519943295

#: kind -> unit as people write it, lower case -> factor to the canonical unit
UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {
        "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6,
        "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0,
    },
    "mag": {
        "gauss": 1.0, "ga": 1.0, "gs": 1.0, "mgauss": 1e-3, "milligauss": 1e-3, "ut": 1e-2,
        "µt": 1e-2, "μt": 1e-2, "microtesla": 1e-2, "nt": 1e-5, "nanotesla": 1e-5, "gamma": 1e-5,
        "tesla": 1e4, "millitesla": 10.0, "a/m": 4e-3 * math.pi,
    },
    "gyro": {
        "rad/s": 1.0, "rad_s": 1.0, "rps": 1.0, "deg/s": DEGREE, "deg_s": DEGREE, "dps": DEGREE,
        "°/s": DEGREE, "º/s": DEGREE, "mrad/s": 1e-3, "mrad_s": 1e-3, "mdps": 1e-3 * DEGREE,
        "deg/sec": DEGREE, "rad/sec": 1.0, "deg/h": DEGREE / 3600.0, "°/h": DEGREE / 3600.0,
        "rpm": math.pi / 30.0,
    },
    "accel": {
        "m/s^2": 1.0, "m/s2": 1.0, "m_s2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "g": GRAVITY_M_S2,
        "mg": 1e-3 * GRAVITY_M_S2, "ug": 1e-6 * GRAVITY_M_S2,
    },
}  # fmt: skip
#: where capitals make the difference
_EXACT = {"mag": {"G": 1.0, "mG": 1e-3, "T": 1e4, "mT": 10.0}}
_SHORT = {
    "time": TIME,
    **{name.rsplit("_", 1)[0]: name for name in MAG},
    **{f"gyro_{axis}": name for axis, name in zip("xyz", GYRO, strict=True)},
    **{f"accel_{axis}": name for axis, name in zip("xyz", ACCEL, strict=True)},
}
_KINDS = {TIME: "time", **dict.fromkeys(MAG, "mag"), **dict.fromkeys(GYRO, "gyro"),
          **dict.fromkeys(ACCEL, "accel")}  # fmt: skip
_HOW = "write NAME=COLUMN:UNIT, for example --columns mag_x=MagX:uT,gyro_x=GyrX:deg/s,time=t:ms"


@dataclass(frozen=True, slots=True)
class Source:
    """Where a canonical column comes from: value = factor * table[column]."""

    column: str
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """What `--columns` says: canonical name -> source; empty where it was not given."""

    sources: Mapping[str, Source]

    def __bool__(self) -> bool:
        return bool(self.sources)


NO_MAP = ColumnMap({})


def parse_columns(texts: Iterable[str]) -> ColumnMap:
    r"""`mag_x=MagX:uT,...` of one or several options; a comma of a name is written `\,`.

    A minus in front of a column turns its sign. Raises AhrsdError naming the entry.
    """
    sources: dict[str, Source] = {}
    for entry in (part for text in texts for part in re.split(r"(?<!\\),", text)):
        entry = entry.replace("\\,", ",").strip()
        if not entry:
            continue
        key, equals, value = entry.partition("=")
        name = _SHORT.get(key.strip().lower(), key.strip())
        if not equals or not name or not value.strip():
            raise AhrsdError(f"--columns {printable(entry)}: is no entry; {_HOW}")
        if name in sources:
            raise AhrsdError(f"--columns {printable(entry)}: {name} is given twice; {_HOW}")
        sources[name] = _source(entry, name, value.strip())
    return ColumnMap(sources)


def _source(entry: str, name: str, value: str) -> Source:
    column, colon, unit = value.rpartition(":")
    kind = _KINDS.get(name)
    if not colon:
        return Source(value)
    factor = 1.0 if kind is None else _factor_or_number(kind, unit.strip())
    if kind is not None and factor is None:
        units = ", ".join(_one_of_each({**_EXACT.get(kind, {}), **UNITS[kind]}))
        raise AhrsdError(
            f"--columns {printable(entry)}: {printable(unit)!r} is no unit of {name}; it may be "
            f"{units}, or a number: one unit of the file, in our unit"
        )
    if kind is None:  # a covariate keeps its unit, and its name may hold a colon
        return Source(value)
    return Source(column.strip(), factor or 1.0)


def _one_of_each(units: Mapping[str, float]) -> list[str]:
    """One way of writing each unit, the first."""
    first = {factor: unit for unit, factor in reversed(list(units.items()))}
    return [unit for unit, factor in units.items() if first[factor] == unit]


def _factor(kind: str, unit: str) -> float | None:
    """Factor from a unit as people write it, None where it is none of this kind."""
    exact = _EXACT.get(kind, {}).get(unit)
    return exact if exact is not None else UNITS[kind].get(unit.lower())


def _factor_or_number(kind: str, unit: str) -> float | None:
    """The same of the option, where counts of a converter have a number for a unit."""
    try:
        number = float(unit)
    except ValueError:
        return _factor(kind, unit)
    return number if 0.0 < number < math.inf else None


def with_unit(name: str, unit: str) -> str:
    """A column's name with the unit that stands elsewhere; as it is where that is none, or its own.

    The names that we write have theirs.
    """
    unit = unit.strip(" []()")
    factor = next((one for kind in UNITS if (one := _factor(kind, unit)) is not None), None)
    if factor is None or (name in _KINDS and _factor(_KINDS[name], unit) == 1.0):
        return name
    return f"{name} [{unit}]"


def _program(*entries: tuple[str, str, float]) -> dict[str, Source]:
    """Vector columns by their stem: ("mag", "UncompMag", 1.0) -> mag_x_gauss from UncompMagX."""
    names = {"mag": MAG, "gyro": GYRO, "accel": ACCEL}
    return {
        name: Source(f"{stem}{axis}", factor)
        for kind, stem, factor in entries
        for name, axis in zip(names[kind], "XYZ", strict=True)
    }


#: names that programs write, best first; the exporter of VectorNav's SDK has times in ns
_PROGRAMS: tuple[dict[str, Source], ...] = (
    {"time_s": Source("TimeStartup", 1e-9), "temperature_c": Source("Temperature"),
     "pressure_kpa": Source("Pressure")},
    _program(("mag", "UncompMag", 1.0), ("gyro", "UncompGyro", 1.0), ("accel", "UncompAcc", 1.0)),
    _program(("gyro", "UncompAngularRate", 1.0), ("accel", "UncompAccel", 1.0)),
    _program(("mag", "Mag", 1.0), ("gyro", "AngularRate", 1.0), ("accel", "Accel", 1.0)),
    {"time_s": Source("TimeGps", 1e-9)},
)  # fmt: skip
#: the parts of ROS messages that hold a vector, with the factor from their unit
_ROS_PARTS = (
    ("magnetic_field", MAG, 1e4),
    ("angular_velocity", GYRO, 1.0),
    ("linear_acceleration", ACCEL, 1.0),
)
#: of `rostopic echo -p`, and of bagpy; best first
_ROS_TIMES = (("field.header.stamp", 1e-9), ("%time", 1e-9), ("Time", 1.0))
_WITH_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$")
_NUMBER = "NUMBER"
_COUNTS = re.compile(r"(?i)(counts?|lsb|raw|adc)$")
_WORDS = {"time": "time|stamp", "mag": "mag|field", "gyro": "gyr|ang|rate|omega", "accel": "acc"}
_ANGLE = re.compile("(?:angle|euler)(?!.*(?:rate|vel|speed))")  # which is no rate
#: what stands before the axis in names of two letters: mx, b_y, w[2], a.z
_LETTERS = {"mag": "[mbh]", "gyro": "[gw]", "accel": "a"}
_SDK_MARKS = {"TimeStartup", "TimeGps", "UncompMagX", "AngularRateX"}


@dataclass(frozen=True, slots=True)
class Resolved:
    """sources: canonical name -> source, all required ones; covariates: name -> column."""

    sources: dict[str, Source]
    covariates: dict[str, str]
    notes: tuple[str, ...]


class ColumnError(ValueError):
    """What is wrong with the names, and the remedy."""

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(what)
        self.what, self.remedy = what, remedy


def resolve(names: Sequence[str], given: ColumnMap = NO_MAP) -> Resolved:
    """Where each canonical column comes from.  Raises ColumnError."""
    double = [name for name, count in Counter(names).items() if count > 1 and name.strip()]
    present = set(names)
    sources: dict[str, Source] = {}
    for name, source in given.sources.items():
        sources[name] = _found(name, source, names)
    notes: list[str] = []
    plain = {name.strip().lower().replace(" ", "_"): name for name in reversed(names)}
    recased = []
    for name in (*REQUIRED, *ACCEL):
        if name in sources:
            continue
        if name in present:
            sources[name] = Source(name)
        elif name in plain:
            sources[name] = Source(plain[name])
            recased.append(printable(plain[name]))
    if recased:
        notes.append(f"columns {', '.join(recased[:3])} ... were read without their capitals")
    if _SDK_MARKS & present:
        notes += _of_programs(sources, present)
    notes += _of_ros(sources, names)
    notes += _with_units(sources, names)
    used = {source.column for source in sources.values()}
    for name in double:
        if name in used:
            raise ColumnError(f"has the column {printable(name)} twice", "rename one of them")
    missing = [name for name in REQUIRED if name not in sources]
    if missing:
        raise ColumnError(f"has no column {', '.join(missing)}", _remedy(missing, names, used))
    further = {name for name in sources if name not in _KINDS}
    covariates = _covariates(names, used, further)
    return Resolved(sources, covariates, tuple(notes))


def _found(name: str, source: Source, names: Sequence[str]) -> Source:
    if source.column in names:
        return source
    if source.column.startswith("-") and source.column[1:] in names:
        return Source(source.column[1:], -source.factor)
    near = difflib.get_close_matches(source.column, names[:1000], n=1, cutoff=0.5)
    hint = f"is {printable(near[0])} meant?" if near else f"it has {_some(names)}"
    raise ColumnError(f"has no column {printable(source.column)} (--columns, for {name})", hint)


def _some(names: Sequence[str]) -> str:
    listed = ", ".join(printable(name, 30) for name in names[:12])
    return f"{listed}, ... ({len(names)} in all)" if len(names) > 12 else listed


def _of_programs(sources: dict[str, Source], present: set[str]) -> list[str]:
    taken = []
    for program in _PROGRAMS:
        vectors = [name for name in program if name in _KINDS and name != TIME]
        for name, source in program.items():
            whole = name not in vectors or all(
                program[one].column in present for one in vectors if _KINDS[one] == _KINDS[name]
            )
            if name not in sources and source.column in present and whole:
                sources[name] = source
                taken.append(source.column)
    if not taken:
        return []
    return [f"the columns are those of VectorNav's SDK: {', '.join(taken[:3])}, ... were taken"]


def _of_ros(sources: dict[str, Source], names: Sequence[str]) -> list[str]:
    """Columns of `rostopic echo -p` and of tools that write paths of messages."""
    taken: list[str] = []
    for part, wanted, factor in _ROS_PARTS:
        ends = re.compile(rf"(?:^|[./]){part}([./])x$")
        stems = [name[:-1] for name in names if ends.search(name)]
        whole = len(stems) == 1 and all(f"{stems[0]}{axis}" in names for axis in "xyz")
        if not whole or any(name in sources for name in wanted):
            continue
        for name, axis in zip(wanted, "xyz", strict=True):
            sources[name] = Source(f"{stems[0]}{axis}", factor)
        taken.append(f"{stems[0]}x")
    if taken and TIME not in sources:
        clock = next(((name, unit) for name, unit in _ROS_TIMES if name in names), None)
        if clock is not None:
            sources[TIME] = Source(*clock)
            taken.append(clock[0])
    if not taken:
        return []
    shown = ", ".join(printable(name) for name in taken)
    return [f"the columns are those of ROS messages: {shown} (T, rad/s, m/s^2) were taken"]


def _with_units(sources: dict[str, Source], names: Sequence[str]) -> list[str]:
    """Columns whose names end in their unit in brackets, where only one can be meant."""
    matches = [(name, _WITH_UNIT.match(name)) for name in names[:1000]]
    told = [(match[1].lower(), match[2], name) for name, match in matches if match is not None]
    taken: list[str] = []
    for wanted in ((TIME,), MAG, GYRO, ACCEL):
        if any(name in sources for name in wanted):
            continue
        kind = _KINDS[wanted[0]]
        found = [_only(kind, axis, told) for axis in ("xyz" if len(wanted) > 1 else ("",))]
        known = [one for one in found if one is not None]
        if len(known) == len(wanted):
            sources.update(zip(wanted, known, strict=True))
            taken.append(printable(known[0].column))
    if not taken:
        return []
    return [f"names and units are those in the file's names: {', '.join(taken)} ... were taken"]


def _only(kind: str, axis: str, told: Sequence[tuple[str, str, str]]) -> Source | None:
    """The one column of this kind and axis; None where there is none, or several.

    A time needs no word for it, in whatever language, where only one column has such a unit.
    """
    of_kind = [
        (stem, Source(name, factor))
        for stem, unit, name in told
        if (factor := _factor(kind, unit)) is not None
    ]
    if axis:
        found = [source for stem, source in of_kind if _is_axis(kind, axis, stem)]
    else:
        named = [source for stem, source in of_kind if re.search(_WORDS[kind], stem)]
        found = named or [source for _, source in of_kind]
    return found[0] if len(found) == 1 else None


def _is_axis(kind: str, axis: str, low: str) -> bool:
    """Whether a name, lower case, is that of this axis of this vector; the first is x, or 0.

    A unit at its end does not count.
    """
    stem, _, unit = low.rpartition("_")
    low = stem if stem and _factor(kind, unit) is not None else low
    place = rf"(^|[^a-z]){axis}([^a-z]|$)|{axis}$|[\[_.]{'xyz'.index(axis)}\]?$"
    letter = rf"^{_LETTERS[kind]}[_.\[]?({axis}|{'xyz'.index(axis)})\]?$"
    worded = re.search(_WORDS[kind], low) and re.search(place, low)
    angle = kind == "gyro" and _ANGLE.search(low)
    return bool((worded and not angle) or re.search(letter, low))


def _remedy(missing: Sequence[str], names: Sequence[str], used: set[str]) -> str:
    """The option that names the missing columns, as far as the others are alike."""
    others = [name for name in names[:1000] if name not in used and name.strip()]
    alike = [(name, _alike(name, others)) for name in missing]
    alike += zip(ACCEL, (_axis_of("accel", axis, others) for axis in "xyz"), strict=True)
    short = {long: key for key, long in _SHORT.items()}
    guessed = [
        f"{short[name]}={printable(column)}{_unit_of(name, column)}"
        for name, column in alike
        if column is not None
    ]
    meant = next((column for _, column in alike if column is not None), None)
    hint = f" (is {printable(meant)} meant? --columns {','.join(guessed)})" if meant else ""
    if any(one.endswith(f":{_NUMBER}") for one in guessed):
        hint += f"; {_NUMBER}: one unit of the file, in gauss, rad/s, m/s^2 or s"
    return f"a table needs {', '.join(REQUIRED)}{hint or '; other names and units: --columns'}"


def _alike(name: str, others: Sequence[str]) -> str | None:
    folded = {other.lower(): other for other in reversed(others)}
    found = difflib.get_close_matches(name, folded, n=1, cutoff=0.5)
    if name == TIME:
        words = ("time|stamp|^t$", "date")  # beside a date, a time of day is what tells the rows
        times = [other for word in words for other in others if re.search(word, other.lower())]
        return times[0] if times else None
    kind, axis = name.split("_")[:2]
    return _axis_of(kind, axis, others) or (folded[found[0]] if found else None)


def _axis_of(kind: str, axis: str, others: Sequence[str]) -> str | None:
    return next((other for other in others if _is_axis(kind, axis, other.lower())), None)


def _unit_of(name: str, column: str) -> str:
    """`:unit` where the column's own name ends in one."""
    kind = _KINDS[name]
    tail = re.split(r"[\s_\[(.]+", column.rstrip(" )]"))[-1]
    two = "_".join(re.split(r"[\s_\[(.]+", column.rstrip(" )]"))[-2:])
    for text in (two, tail):
        if _factor(kind, text) is not None and text.lower() not in ("s", name):
            return f":{text}"
    unknown = _WITH_UNIT.match(column)
    return f":{_NUMBER}" if unknown is not None or _COUNTS.search(column) else ""


def _covariates(names: Sequence[str], used: set[str], taken: set[str]) -> dict[str, str]:
    """Printable name -> column of everything else; the first of equal names."""
    out: dict[str, str] = {}
    for column in names:
        name = printable(column.strip())
        if not name or column in used or name in out or name in taken:
            continue
        out[name] = column
    return out


# -- Another unit, by the size of what was read ----------------------------------------------------


@dataclass(frozen=True, slots=True)
class VectorRange:
    """Where the median magnitude of a vector must lie, and what it looks like elsewhere.

    impossible: no axis of any such sensor reads more
    """

    columns: tuple[str, str, str]
    minimum: float
    maximum: float
    impossible: float
    unit: str
    above: tuple[tuple[float, str], ...]  # from this magnitude on it looks like that unit
    below: tuple[float, float, str] | None = None  # between these it looks like that unit


# Above 10 G no VN-100 reads (2.5 G full scale), above 100 G no compass; 20 rad/s is a sustained
# 1150 deg/s, 200 rad/s is above the 4000 deg/s of the fastest gyros.
RANGES = (
    VectorRange(
        MAG,
        0.01,
        10.0,
        100.0,
        "gauss",
        ((5000.0, "nT"), (200.0, "mG"), (10.0, "uT")),
        (1e-5, 1e-3, "T"),
    ),
    VectorRange(GYRO, 0.0, 20.0, 200.0, "rad/s", ((20.0, "deg/s"),)),
)


def other_unit(
    median: float, limits: VectorRange, sources: Mapping[str, Source]
) -> tuple[str, str] | None:
    """What is wrong with a vector of this median magnitude, and the remedy; None: nothing."""
    if limits.minimum <= median <= limits.maximum:
        return None
    own = [sources.get(name, Source(name)) for name in limits.columns]
    factor = abs(own[0].factor)
    native = median / factor  # as the file has it
    guess = next((unit for level, unit in limits.above if native > level), None)
    if limits.below is not None and limits.below[0] <= native <= limits.below[1]:
        guess = limits.below[2]
    if factor != 1.0 and limits.minimum < native <= limits.maximum and guess is None:
        guess = limits.unit
    words = f"it looks like {guess}" if guess else "it looks like another unit or a dead sensor"
    read_as = limits.unit if factor == 1.0 else f"times {factor:g} is {median:.4g} {limits.unit}"
    name = printable(own[0].column)
    return (
        f"columns {name} ... : median magnitude {native:.4g} {read_as}, {words}",
        f"convert it to {limits.unit}{_with_option(limits, [one.column for one in own], guess)}",
    )


def _with_option(limits: VectorRange, columns: list[str], unit: str | None) -> str:
    if unit is None:
        return ""
    short = [name.removesuffix("_gauss").removesuffix("_rad_s") for name in limits.columns]
    pairs = [
        f"{a}={printable(b).replace(',', chr(92) + ',')}:{unit}"
        for a, b in zip(short, columns, strict=True)
    ]
    return f", or say so: --columns {','.join(pairs)}"
