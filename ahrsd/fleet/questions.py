"""What the rows say: DuckDB over Parquet, read-only.

The table is `recordings`: a row's columns, and `device`: the serial number, else the vehicle, else
nothing: of recordings of which neither is known nobody can say that they are of one device.
Where recordings were examined by several versions or options, it has the newest row of each.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import hypergeom

from ahrsd.errors import AhrsdError
from ahrsd.fleet.row import ANSWERED, AXES
from ahrsd.fleet.store import Store
from ahrsd.fleet.trend import Series, Trend, binned, trends
from ahrsd.printable import line
from ahrsd.samples import Array

if TYPE_CHECKING:
    import duckdb

_FEWEST = 3  # recordings with a finding before it recurs
_HORIZONTAL = 0.5  # of the field, where it dips by 60 deg as in middle latitudes
_RACES = 3  # times that parts may be replaced while they are asked
_IRON, _BIAS = slice(0, 3), slice(3, 6)

_QUANTITIES = [
    f"{name}_{part}{axis}_{unit}"
    for part in ("", "sigma_")
    for name, unit in (("hard_iron", "gauss"), ("gyro_bias", "rad_s"))
    for axis in AXES
]
_USABLE = "converged and recorded_utc is not null and device is not null"
_DEVICES = f"""
    select device, max(vehicle), count(*), min(recorded_utc), max(recorded_utc),
           count(*) filter (recorded_by = 'the file''s date')
    from recordings where {_USABLE} group by device order by device"""
_SERIES = f"""
    select epoch(recorded_utc) / 86400.0 as day, temperature_c, field_gauss, heading_sigma_deg,
           {", ".join(_QUANTITIES)}
    from recordings where {_USABLE} order by device, recorded_utc, key"""
#: by what a finding may recur
GROUPS = ("device", "vehicle", "place", "temperature")
_DIAGNOSED = """
    create or replace temp table diagnosed as
    select device, vehicle, place,
           (10 * floor(temperature_c / 10))::int || ' to ' ||
           (10 * floor(temperature_c / 10) + 10)::int || ' degC' as temperature,
           list_distinct(list_transform(findings, lambda one: one.effect)) as effects
    from recordings where findings is not null"""
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
    from recordings where outcome not in {ANSWERED} or error is not null
    group by outcome, error order by recordings desc, outcome, error"""


@dataclass(frozen=True, slots=True)
class AnswerTable:
    """A table: names of columns, and rows."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    def json(self) -> list[dict[str, Any]]:
        """One object a row."""
        return [dict(zip(self.columns, map(_plain, row), strict=True)) for row in self.rows]


@dataclass(frozen=True, slots=True, eq=False)
class DeviceDrift:
    """Calibrations of one device over time and temperature.

    by_file_date: recordings of which only the file says when they were made
    heading_sigma_deg: of the newest calibration; heading_kept_deg: by how much headings would be
    off now with the first calibration, where the field dips by 60 deg
    iron, bias: drift and steps, gauss and rad/s; series: what they are fitted to
    """

    device: str
    vehicle: str | None
    recordings: int
    first_day: float
    last_day: float
    by_file_date: int
    heading_sigma_deg: float
    heading_kept_deg: float
    iron: Trend
    bias: Trend
    series: Series

    def json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "device": self.device,
            "vehicle": self.vehicle,
            "recordings": self.recordings,
            "first_utc": _date(self.first_day),
            "last_utc": _date(self.last_day),
            "by_file_date": self.by_file_date,
            "heading_sigma_deg": _plain(self.heading_sigma_deg),
            "heading_kept_deg": _plain(self.heading_kept_deg),
            "hard_iron": _trend_json(self.iron, "gauss"),
            "gyro_bias": _trend_json(self.bias, "rad_s"),
        }


class FleetRows:
    """The rows of a fleet in DuckDB; a context manager."""

    def __init__(self, store: Store) -> None:
        if importlib.util.find_spec("duckdb") is None:
            raise AhrsdError("fleet: DuckDB answers it; install it: pip install 'ahrsd[fleet]'")
        self._store = store
        self._connection = _opened(store)

    def __enter__(self) -> FleetRows:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._connection.close()

    def sql(self, query: str) -> AnswerTable:
        """The answer to one SELECT.  AhrsdError in DuckDB's words where it is none."""
        import duckdb

        try:
            parsed = duckdb.extract_statements(query)
            if len(parsed) != 1 or parsed[0].type != duckdb.StatementType.SELECT:
                raise AhrsdError("ask: one SELECT over the table `recordings` can be asked")
            return self._ask(query)
        except duckdb.Error as error:
            words = line(str(error).strip().partition(chr(10))[0])
            if isinstance(error, duckdb.ParserException):
                words += "; a question is drift, recurring, failures, or a SELECT over `recordings`"
            elif isinstance(error, duckdb.CatalogException):
                words += "; the table is `recordings`"
            raise AhrsdError(f"ask: {words}") from error

    def _ask(self, query: str) -> AnswerTable:
        found = self._retried(query)
        names = tuple(name for name, *_ in found.description or ())
        return AnswerTable(names, found.fetchall())

    def _retried(self, query: str) -> duckdb.DuckDBPyConnection:
        """Run it; where a part was replaced meanwhile, over the new ones."""
        import duckdb

        for _ in range(_RACES):
            try:
                return self._connection.execute(query)
            except duckdb.IOException:
                self._connection.close()
                self._connection = _opened(self._store)
        return self._connection.execute(query)

    def counts(self) -> dict[str, Any]:
        """How many rows of what."""
        names = ("recordings", "devices", "vehicles", "mismatches", "seconds", "newest_utc")
        (numbers,) = self._ask(
            """select count(*), count(distinct device),
                      count(distinct vehicle), count(*) filter (mismatch), sum(seconds),
                      max(finished_utc) from recordings"""
        ).rows
        outcomes = "select outcome, count(*) as n from recordings group by outcome order by n desc"
        versions = "select distinct version from recordings order by version"
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
        out: list[tuple[Any, ...]] = []
        self._retried(_DIAGNOSED)
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
        query = "select count(*) from recordings where converged and device is null"
        ((count,),) = self._ask(query).rows
        return int(count)

    def drift(self) -> list[DeviceDrift]:
        """Every device with two calibrations or more; the largest heading error first."""
        devices = self._ask(_DEVICES).rows
        columns: Any = self._retried(_SERIES).fetchnumpy()
        table = np.column_stack([_filled(columns[name]) for name in columns])
        found = list(_drifts(devices, table))
        return sorted(found, key=lambda one: -np.nan_to_num(one.heading_kept_deg))


def _drifts(devices: list[tuple[Any, ...]], table: Array) -> Iterator[DeviceDrift]:
    """Devices in the order of the table's rows."""
    ends = np.cumsum([count for _, _, count, *_ in devices])
    several = [(one, table[end - one[2] : end]) for one, end in zip(devices, ends) if one[2] > 1]
    every = [binned(Series(own[:, 0], own[:, 1], own[:, 4:10], own[:, 10:])) for _, own in several]
    irons, biases = (
        trends([Series(s.day, s.temperature_c, s.values[:, k], s.sigmas[:, k]) for s in every])
        for k in (_IRON, _BIAS)
    )
    for (one, own), series, iron, bias in zip(several, every, irons, biases, strict=True):
        device, vehicle, count, first, last, by_file = one
        moved = np.linalg.norm(series.values[-1, _IRON] - series.values[0, _IRON])
        kept = np.degrees(np.arctan2(moved, _HORIZONTAL * own[-1, 2]))
        yield DeviceDrift(
            device, vehicle, count, _day(first), _day(last), by_file,
            float(own[-1, 3]), float(kept), iron, bias, series,
        )  # fmt: skip


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
    connection.execute(f"create view recordings as {_newest(connection)}")
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


def _filled(column: Any) -> Array:  # noqa: ANN401 - numpy's, masked where there are nulls
    return np.ma.filled(np.ma.asarray(column, dtype=np.float64), np.nan)


def _day(at: Any) -> float:  # noqa: ANN401 - a datetime, UTC without a zone
    return float(np.datetime64(at, "ms").astype(np.int64)) / 86400e3


def _date(day: float) -> str:
    return str(np.datetime64(round(day * 86400.0), "s"))


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


def _trend_json(found: Trend, unit: str) -> dict[str, Any]:
    return {
        "days": found.days,
        f"per_year_{unit}": _plain(found.per_year.tolist()),
        f"per_year_sigma_{unit}": _plain(found.per_year_sigma.tolist()),
        f"per_degc_{unit}": _plain(found.per_degree.tolist()),
        f"per_degc_sigma_{unit}": _plain(found.per_degree_sigma.tolist()),
        f"scatter_{unit}": _plain(found.scatter.tolist()),
        "changes": [
            {
                "after_utc": _date(change.before_day),
                "until_utc": _date(change.after_day),
                f"size_{unit}": _plain(change.size.tolist()),
                f"sigma_{unit}": _plain(change.sigma.tolist()),
                "chi2": change.chi2,
            }
            for change in found.changes
        ],
    }
