"""What the rows say: DuckDB over Parquet, read-only.

The table is `results`: a row's columns, and `device`: the serial number, else the vehicle, else
nothing: of recordings of which neither is known nobody can say that they are of one device.
Where recordings were examined by several versions or options, it has the newest row of each.

The answers are put into lines for a person, foreign texts made printable.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ahrsd.errors import AhrsdError
from ahrsd.fleet.drift import CALIBRATIONS, DeviceDrift, StepChange, Trend, drifts
from ahrsd.fleet.row import ANSWERED
from ahrsd.fleet.store import Store
from ahrsd.printable import counted, line, printable
from ahrsd.samples import Array

if TYPE_CHECKING:
    import duckdb

# -- Questions -------------------------------------------------------------------------------------


_T = TypeVar("_T")

_FEWEST = 3  # recordings with a finding before it recurs
_RACES = 3  # times that parts may be replaced while they are asked

#: by what a finding may recur
GROUPS = ("device", "vehicle", "place", "temperature")
_DIAGNOSED = """
    create or replace temp table diagnosed as
    select device, vehicle, place,
           (10 * floor(temperature_c / 10))::int || ' to ' ||
           (10 * floor(temperature_c / 10) + 10)::int || ' degC' as temperature,
           list_distinct(list_transform(findings, lambda one: one.effect)) as effects
    from results where findings is not null"""
_RECURRING = """
    with found as (select {what} as name, unnest(effects) as effect from diagnosed),
    sizes as (select {what} as name, count(*) as size from diagnosed group by name),
    everywhere as (select effect, count(*) as everywhere from found group by effect)
    select name, effect, count(*) as found, any_value(size) as size,
           any_value(everywhere) as everywhere, (select count(*) from diagnosed) as total
    from found join sizes using (name) join everywhere using (effect)
    where name is not null group by name, effect having count(*) >= {fewest}"""
_FAILURES = f"""
    select outcome, error, count(*) as recordings, any_value(remedy) as remedy,
           min(recording) as example
    from results where outcome not in {ANSWERED} or error is not null
    group by outcome, error order by recordings desc, outcome, error"""


@dataclass(frozen=True, slots=True)
class AnswerTable:
    """A table: names of columns, and rows."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    def json(self) -> list[dict[str, Any]]:
        """One object a row."""
        return [dict(zip(self.columns, map(_plain, row), strict=True)) for row in self.rows]


class FleetRows(AbstractContextManager["FleetRows"]):
    """The rows of a fleet in DuckDB."""

    def __init__(self, store: Store) -> None:
        if importlib.util.find_spec("duckdb") is None:
            raise AhrsdError("fleet: DuckDB answers it; install it: pip install 'ahrsd[fleet]'")
        self._store = store
        self._connection = _opened(store)

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def sql(self, query: str) -> AnswerTable:
        """The answer to one SELECT.  AhrsdError in DuckDB's words where it is none."""
        import duckdb

        try:
            parsed = duckdb.extract_statements(query)
            if len(parsed) != 1 or parsed[0].type != duckdb.StatementType.SELECT:
                raise AhrsdError("ask: one SELECT over the table `results` can be asked")
            return self._ask(query)
        except duckdb.Error as error:
            words = line(str(error).strip().partition(chr(10))[0])
            if isinstance(error, duckdb.ParserException):
                words += "; a question is drift, recurring, failures, or a SELECT over `results`"
            elif isinstance(error, duckdb.CatalogException):
                words += "; the table is `results`"
            raise AhrsdError(f"ask: {words}") from error

    def _ask(self, query: str) -> AnswerTable:
        def answer(connection: duckdb.DuckDBPyConnection) -> AnswerTable:
            found = connection.execute(query)
            names = tuple(name for name, *_ in found.description or ())
            return AnswerTable(names, found.fetchall())

        return self._retried(answer)

    def _retried(self, ask: Callable[[duckdb.DuckDBPyConnection], _T]) -> _T:
        """Ask; where a part was replaced meanwhile, over the new ones."""
        import duckdb

        for _ in range(_RACES):
            try:
                return ask(self._connection)
            except duckdb.IOException:
                self._connection.close()
                self._connection = _opened(self._store)
        return ask(self._connection)

    def empty(self) -> bool:
        """Whether no recording has a row."""
        return self._ask("select 1 from results limit 1").rows == []

    def counts(self) -> dict[str, Any]:
        """How many rows of what."""
        names = ("recordings", "devices", "vehicles", "mismatches", "seconds", "newest_utc")
        (numbers,) = self._ask(
            """select count(*), count(distinct device),
                      count(distinct vehicle), count(*) filter (mismatch), sum(seconds),
                      max(finished_utc) from results"""
        ).rows
        outcomes = "select outcome, count(*) as n from results group by outcome order by n desc"
        versions = "select distinct version from results order by version"
        return {
            **dict(zip(names, map(_plain, numbers), strict=True)),
            "outcomes": dict(self._ask(outcomes).rows),
            "versions": [version for (version,) in self._ask(versions).rows],
            "parts": len(self._store.parts()),
            "in_spool": sum(1 for _ in self._store.spool.glob("*.json")),
        }

    def failures(self) -> AnswerTable:
        """What gave no answer, or half of one, and why; the most frequent reason first."""
        return self._ask(_FAILURES)

    def recurring(self) -> AnswerTable:
        """Findings that come again on the same device, vehicle, place, or at the same temperature.

        p: the probability that of all pairs of its kind one comes so often, if it were as frequent
        there as everywhere
        """
        from scipy.stats import hypergeom  # half a second that the other questions need not wait

        out: list[tuple[Any, ...]] = []
        self._retried(lambda connection: connection.execute(_DIAGNOSED))
        for kind in GROUPS:
            rows = self._ask(_RECURRING.format(what=kind, fewest=_FEWEST)).rows
            for name, effect, found, size, everywhere, total in rows:
                p = min(1.0, len(rows) * float(hypergeom.sf(found - 1, total, everywhere, size)))
                out.append((effect, kind, name, found, size, found / size, everywhere / total, p))
        out.sort(key=lambda row: (row[-1], -row[3], row[0], row[1], str(row[2])))
        columns = ("effect", "by", "which", "found", "of", "share", "share_everywhere", "p")
        return AnswerTable(columns, out)

    def of_no_device(self) -> int:
        """Calibrations of which neither serial number nor vehicle is known: no part of `drift`."""
        query = "select count(*) from results where converged and device is null"
        ((count,),) = self._ask(query).rows
        return int(count)

    def drift(self) -> list[DeviceDrift]:
        """Every device with two calibrations or more; the largest heading error first."""
        return drifts(
            self._retried(lambda connection: connection.sql(CALIBRATIONS).to_arrow_table())
        )


def _opened(store: Store) -> duckdb.DuckDBPyConnection:
    """A connection to the rows; where a part was replaced meanwhile, to the new ones."""
    import duckdb

    for _ in range(_RACES):
        try:
            return _connected(store)
        except duckdb.IOException:
            continue
    return _connected(store)


def _connected(store: Store) -> duckdb.DuckDBPyConnection:
    """A connection that can read the rows and nothing else, and write nothing."""
    import duckdb

    spooled, parts = store.rows()
    connection = duckdb.connect()
    connection.execute("set timezone = 'UTC'; set parquet_metadata_cache = true")
    connection.register("spooled", spooled)
    connection.execute("create table spool as select * from spooled")
    connection.unregister("spooled")
    every = "select * from spool"
    if parts:
        names = ", ".join(_quoted(part) for part in parts)
        in_parts = f"select * from read_parquet([{names}], hive_partitioning = false)"
        other = "where key not in (select key from spool)"
        every = f"{every} union all {in_parts} {other}" if len(spooled) else in_parts
    connection.execute(f"create view every_row as {every}")
    connection.execute(f"create view results as {_newest(connection)}")
    connection.execute(f"set allowed_directories = [{_quoted(store.root / 'parts')}]")
    connection.execute("set enable_external_access = false")
    connection.execute("set lock_configuration = true")
    return connection


def _newest(connection: duckdb.DuckDBPyConnection) -> str:
    device = "coalesce(serial_number::varchar, vehicle) as device"
    kinds = connection.execute(
        "select count(*) from (select distinct version, options from every_row)"
    )
    (several,) = kinds.fetchone() or (0,)
    rows = f"select *, {device} from every_row"
    if several < 2:
        return rows
    return (
        f"{rows} qualify row_number() over (partition by coalesce(content_sha256, key) "
        "order by finished_utc desc, key) = 1"
    )


def _quoted(path: Path) -> str:
    return "'" + str(path.resolve()).replace("'", "''") + "'"


def _plain(value: Any) -> Any:  # noqa: ANN401 - of DuckDB
    """As JSON can hold it."""
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if value is None or isinstance(value, str | int | bool):
        return value
    return str(value)


# -- Answers as lines for a person -----------------------------------------------------------------


_MILLI = 1e3
_CELL = 60  # characters of a text in a table
_MOST = 40  # rows that are printed; --json has all
_LIKELY = 1e-2  # below this a recurring finding is told as more than chance


def table_lines(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A table with aligned columns, numbers to the right; at most so many rows."""
    listed = [list(row) for row in rows]
    shown = [[_cell(value) for value in row] for row in listed[:_MOST]]
    right = [
        all(isinstance(row[i], int | float | None) for row in listed) for i in range(len(columns))
    ]
    heads = [printable(name, _CELL) for name in columns]
    widths = [max(map(len, column)) for column in zip(heads, *shown, strict=True)]
    lines = [
        "  ".join(
            text.rjust(width) if flush else text.ljust(width)
            for text, width, flush in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in [heads, *shown]
    ]
    more = len(listed) - len(shown)
    return [
        *lines,
        *([f"... and {counted(more, 'more row', ',')}: --json has all"] if more else []),
    ]


def drift_lines(found: Sequence[DeviceDrift], of_no_device: int = 0) -> list[str]:
    """Every device, its drift, and below it its steps; what is of no known device is counted."""
    lines = [] if found else ["no device has two calibrations whose time is known"]
    for one in found[:_MOST]:
        vehicle = f", {printable(one.vehicle)}" if one.vehicle not in (None, one.device) else ""
        lines.append(
            f"{printable(one.device)}{vehicle}: {counted(one.recordings, 'calibration', ',')}, "
            f"{date(one.first_day)} to {date(one.last_day)}"
        )
        lines.append(f"  heading    {heading_words(one)}")
        lines.append(f"  hard iron  {trend_words(one.iron, 'mG')}")
        lines += [f"             {change_words(change, 'mG')}" for change in one.iron.changes]
        lines.append(f"  gyro bias  {trend_words(one.bias, 'mrad/s')}")
        lines += [f"             {change_words(change, 'mrad/s')}" for change in one.bias.changes]
        if one.by_file_date:
            lines.append(
                f"  note: of {counted(one.by_file_date, 'recording')} only the file's date is known"
            )
    if len(found) > _MOST:
        lines.append(f"... and {len(found) - _MOST} more devices: --json has all")
    if of_no_device:
        lines.append(
            f"left out: {counted(of_no_device, 'calibration', ',')} of no known device: the "
            "same `ahrsd fleet run` with --vehicle or --folders says whose they are"
        )
    return lines


def heading_words(one: DeviceDrift) -> str:
    """What headings are worth with the newest calibration and with the first."""
    return (
        f"{one.heading_sigma_deg:.2f} deg (1 sigma, worst direction) with the newest calibration; "
        f"{one.heading_kept_deg:.1f} deg off with the first (dip of 60 deg)"
    )


def trend_words(found: Trend, unit: str) -> str:
    """Drift over the time that was seen and with temperature, for 1e-3 of the values' unit.

    Nothing is said per year: a few days say nothing of one.
    """
    years = found.days / 365.25
    parts = [
        f"{_vector(slope)} +- {_vector(sigma, sign='')} {unit} {per}"
        for slope, sigma, per in (
            (years * found.per_year, years * found.per_year_sigma, f"in {found.days:.3g} days"),
            (found.per_degree, found.per_degree_sigma, "per degC"),
        )
        if np.isfinite(slope).all()
    ]
    return "; ".join(parts) or "too few calibrations for a drift"


def change_words(change: StepChange, unit: str) -> str:
    """A step in words."""
    first, last = date(change.before_day), date(change.after_day)
    when = f"on {first}" if first == last else f"between {first} and {last}"
    return f"steps by {_vector(change.size)} +- {_vector(change.sigma, sign='')} {unit} {when}"


def recurring_lines(found: AnswerTable) -> list[str]:
    """Findings that come again; what is no more than chance is left to --json."""
    rows = [row for row in found.rows if row[-1] < _LIKELY]
    if not rows:
        return ["no finding is more frequent in one group than in all recordings"]
    return table_lines(
        ("finding", "by", "which", "recordings", "share", "everywhere", "chance"),
        [
            (effect, by, which, f"{n} of {of}", f"{share:.0%}", f"{all_:.0%}", f"{p:.0e}")
            for effect, by, which, n, of, share, all_, p in rows
        ],
    )


def failure_lines(found: AnswerTable) -> list[str]:
    """Each reason, how often, what to do, and one of its recordings."""
    if not found.rows:
        return ["every recording gave an answer"]
    lines = []
    for outcome, error, number, remedy, example in found.rows[:_MOST]:
        lines.append(f"{number:,} {outcome}: {printable(error or 'no message', 400)}")
        if remedy:
            lines.append(f"  {printable(remedy, 400)}")
        lines.append(f"  for example {printable(example, 400)}")
    if len(found.rows) > _MOST:
        lines.append(f"... and {len(found.rows) - _MOST} more reasons: --json has all")
    return lines


def status_lines(name: str, body: dict[str, Any]) -> list[str]:
    """How a fleet stands."""
    outcomes = ", ".join(f"{number:,} {outcome}" for outcome, number in body["outcomes"].items())
    lines = [
        f"{name}: {counted(body['recordings'], 'recording', ',')}"
        + (f": {outcomes}" if outcomes else ""),
        f"  {counted(body['devices'], 'device')}, {counted(body['vehicles'], 'vehicle')}; "
        f"{counted(body['mismatches'], 'recording', ',')} with a mismatch",
        f"  {counted(body['parts'], 'part')}, {counted(body['in_spool'], 'row', ',')} in the "
        "spool; "
        f"version {', '.join(body['versions']) or 'none'}",
    ]
    run = body["run"]
    if body["at_work"] and run:
        left_s = 60.0 * (run["total"] - run["done"]) / max(run["per_minute"], 1e-9)
        lines.append(
            f"  at work (process {run['process']}): {run['done']:,} of {run['total']:,}, "
            f"{run['failed']:,} failed, {run['per_minute']:.3g} a minute, {duration(left_s)} left"
        )
    elif run and run["done"] < run["total"]:
        lines.append(
            f"  the last run stopped at {run['done']:,} of {run['total']:,} or soon after: "
            "repeat the command to continue"
        )
    return lines


def duration(seconds: float) -> str:
    """A duration for a person: 40 s, 12 min, 3.5 h, 6 days."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            number = seconds / size
            return f"{number:.1f} {unit}" if number < 10 else f"{number:,.0f} {unit}"
    return f"{seconds:.0f} s"


def date(day: float) -> str:
    """Days since 1970 as a date."""
    return str(np.datetime64(int(day), "D"))


def _vector(values: Array, sign: str = "+") -> str:
    largest = float(np.abs(values).max()) * _MILLI
    digits = 1 if largest >= 10 else 2 if largest >= 1 else 3
    return "(" + ", ".join(f"{_MILLI * value:{sign}.{digits}f}" for value in values) + ")"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    return printable(value, _CELL)
