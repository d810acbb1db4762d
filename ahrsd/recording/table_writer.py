"""Writes the tables that `table` reads: CSV, plain or gzipped, and Parquet, by the suffix."""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path

import pyarrow
import pyarrow.csv
import pyarrow.parquet

from ahrsd.samples import Array

TABLE_SUFFIXES = (".csv", ".csv.gz", ".parquet")


def is_table(path: Path) -> bool:
    """Whether the name asks for a table."""
    return path.name.endswith(TABLE_SUFFIXES)


def write_table(
    path: Path, columns: Mapping[str, Array], facts: Mapping[str, str] | None = None
) -> None:
    """Write columns of equal length, every digit of them.  Raises OSError.

    facts: for the metadata of a Parquet file. The gzip header carries no time, so the same columns
    give the same bytes.
    """
    table = pyarrow.table(dict(columns))
    if facts:
        table = table.replace_schema_metadata(dict(facts))
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(table, path)
        return
    sink = pyarrow.BufferOutputStream()
    sink.write((",".join(columns) + "\n").encode())  # the writer's own header would be quoted
    pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(include_header=False))
    content = sink.getvalue().to_pybytes()
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
