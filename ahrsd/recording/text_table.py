"""Text of any program to columns: encodings, comment lines, separators, decimal commas, cut rows.

What can be read without guessing at a value is read, and a note says what was done; what cannot
ends in one line.  Row numbers are those of the file, as editors count.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow
import pyarrow.csv

from ahrsd.errors import RecordingError
from ahrsd.printable import counted, printable
from ahrsd.recording.bytestream import read_chunks, wide_text_note, wide_text_of
from ahrsd.recording.column_names import REQUIRED, with_unit
from ahrsd.recording.foreign.recognised import recognised
from ahrsd.recording.limits import (
    HEADER_BYTES,
    TABLE_BYTES,
    TABLE_COLUMNS,
    TABLE_ROWS,
    refuse_beyond,
)

_CHUNK_BYTES = 1 << 18
csv.field_size_limit(HEADER_BYTES + 1)  # of a quoted name; 128 KiB as it comes
_MARK = b"\xef\xbb\xbf"  # of UTF-8
_ERASED = 16  # bytes FF at the end that no text has
_COMMENTS = (b"#", b"%", b"//")
_ROSTOPIC = b"%time,"  # how the names of `rostopic echo -p` begin, which are no comment
_COMMENT_LINE = re.compile(rb"(?m)^(?:#|%|//)[^\n]*(?:\n|\Z)")
_SEPARATOR_LINE = re.compile(rb"^\"?sep=(.)\"?\s*$", re.IGNORECASE)
_SEPARATORS = (b",", b";", b"\t", b"|")
_CALLED = {b";": "semicolons", b"\t": "tabs", b" ": "blanks", b"|": "bars"}
_RULE = re.compile(rb"(?m)^[ \t]*[|+]?[ \t]*:?[-=]{3,}[-=+|: \t]*(?:\n|\Z)")  # of a drawn table
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?$")
_QUOTED_COMMA = re.compile(rb'"(\s*[+-]?\d+),(\d+(?:[eE][+-]?\d+)?\s*)"')
#: mark between thousands, decimal point, the cell
_THOUSANDS = tuple(
    (
        mark,
        point,
        re.compile(rf"[-+]?\d{{1,3}}(?:{re.escape(mark)}\d{{3}})+(?:{re.escape(point)}\d*)?"),
    )
    for mark, point in ((",", "."), (".", ","), ("'", "."), ("\u2019", "."), ("\u00a0", ","))
)
#: minus signs of typesetting in front of a number: U+2212, the en dash, the full-width one
_MINUS = re.compile(rb"(?:\xe2\x88\x92|\xe2\x80\x93|\xef\xbc\x8d)(?=[\d.,])")
_WRONG_SHARE, _WRONG_FEW = 0.01, 3  # rows with another number of cells that are left out
_OF_TABLES = (b"time_s", b"mag_x_gauss", b"TimeStartup,")  # names in the first line
_PREAMBLE_BYTES = 16384  # in front of the names
_ROWS_THAT_TELL = 2
#: a quoted cell of a few lines: whatever begins with a quote and has none for longer is no cell
_LONG_CELL = re.compile(
    rb'(?m)(?<![^,;\t\n])"(?:[^"\n]|""){0,4096}(?:\n(?:[^"\n]|""){0,4096}){1,8}"(?=[,;\t\n]|\Z)'
)
_LESS = "keep fewer of them, or cut the recording in parts"
_MISSING = ["", "nan", "NaN", "NAN", "-nan", "null", "NULL", "None", "N/A", "n/a", "NA", "#N/A",
            "-nan(ind)", "nan(ind)", "-1.#IND", "1.#QNAN", "-1.#QNAN", "1.#INF", "-1.#INF",
            "1.#IND", "--", "-"]  # fmt: skip


@dataclass(slots=True)
class TextTable:
    """columns by name; first_row: number in the file of the first row below the names."""

    table: pyarrow.Table
    first_row: int
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Text:
    """UTF-8 text whose lines end in LF; `at` is where the first row below the names begins."""

    data: bytearray
    names: list[str]
    separator: str
    at: int
    first_row: int


def is_table_text(start: bytes) -> bool:
    """Whether the first bytes of a file are a table's beyond doubt, whatever it is called.

    Its first line has a name that only tables have; or two whole lines that follow each other have
    as many cells, at least those that a table needs, and all but the time are numbers. A message
    of a VN-100 is none.
    """
    if (encoding := wide_text_of(start)) is not None:
        start = start.decode(encoding, "ignore").encode("utf-8")
    lines = re.split(rb"[\r\n]+", start.removeprefix(_MARK).lstrip())
    if b"$VN" not in lines[0] and any(name in lines[0] for name in _OF_TABLES):
        return True
    lines = [line for line in lines[:-1] if line.strip() and not line.startswith(_COMMENTS)]
    message = re.search(rb"(?m)^[$!]|\$VN|^VN[A-Z]{3},", start)  # of a VN-100, or NMEA
    if len(lines) < _ROWS_THAT_TELL or message or any(byte < 9 for byte in start):
        return False
    mark = _separator_of(lines[-1])
    rows = [line.split() if mark == b" " else line.split(mark) for line in lines]
    tell = rows[-_ROWS_THAT_TELL:]
    return all(
        len(row) == len(tell[0]) >= len(REQUIRED)
        and sum(_is_numbers(cell, mark) for cell in row) >= len(REQUIRED) - 1
        for row in tell
    )


def read_text_table(path: Path) -> TextTable:
    """The columns of a text file.  Raises RecordingError naming what is wrong, where."""
    notes: list[str] = []
    data, cut = _gathered(path, notes)
    data = _plain_text(path, data, notes)
    if (found := recognised(bytes(data[:4096]))) is not None:
        raise RecordingError(path, found.what, found.remedy)
    data = _in_one_line(data)
    text = _with_header(path, data, notes)
    _drop_comments(text, notes)
    _take_units(text, notes)
    if text.separator != " ":
        _drop_empty_rows(text, notes)
    _drop_repeated_header(text, notes)
    _drop_cut_row(text, cut, notes)
    refuse_beyond(path, text.data.count(b"\n", text.at), TABLE_ROWS, "rows", _LESS)
    return TextTable(_parsed(path, text, notes), text.first_row, notes)


def _gathered(path: Path, notes: list[str]) -> tuple[bytearray, bool]:
    """The unpacked text, not beyond the limit; whether it was cut off."""
    data = bytearray()
    told: list[str] = []
    for chunk in read_chunks(path, _CHUNK_BYTES, told):
        data += chunk
        refuse_beyond(path, len(data), TABLE_BYTES, "bytes of text and more", _LESS)
        if len(data) > HEADER_BYTES and not _has_lines(data):
            raise RecordingError(
                path,
                f"has no line end within its first {HEADER_BYTES:,} bytes",
                "it is no table of text; give a CSV file",
            )
    notes += told
    return data, bool(told)


def _has_lines(data: bytearray) -> bool:
    return any(end in data[: HEADER_BYTES + 2] for end in (b"\n", b"\r"))


def _plain_text(path: Path, data: bytearray, notes: list[str]) -> bytearray:
    """UTF-8 without marks, NUL bytes and stray returns."""
    if (encoding := wide_text_of(bytes(data[:400]))) is not None:
        notes.append(wide_text_note(encoding))
        data = bytearray(data.decode(encoding, "replace").encode("utf-8"))
    if _MARK in data[:3] or b"\n" + _MARK in data:  # at the end of one file another may begin
        data = bytearray(re.sub(b"(?m)^" + _MARK, b"", bytes(data)))
    if (erased := len(data) - len(data.rstrip(b"\xff"))) >= _ERASED:
        del data[-erased:]
        notes.append(f"it ends in {erased} bytes of erased memory (FF): left out")
    if nuls := len(data) - len(data.rstrip(b"\0")):
        del data[-nuls:]
        notes.append(f"it ends in {nuls} NUL bytes (the recorder lost its power): left out")
        if not data:
            raise RecordingError(path, "holds nothing but NUL bytes", "record again")
    if (nuls := data.count(b"\0")) > 0:
        data = bytearray(re.sub(rb"\0+", b"\n", bytes(data)))
        notes.append(f"{nuls} NUL bytes amid the rows were left out")
    if not data.isascii():
        try:
            data.decode("utf-8")
        except UnicodeDecodeError:
            data = bytearray(data.decode("cp1252", "replace").encode("utf-8"))
    if b"\r" in data:
        data = bytearray(re.sub(rb"\r+\n|\r", b"\n", bytes(data)))
    return data


def _in_one_line(data: bytearray) -> bytearray:
    """Quoted cells that go over several lines, such as a line of a device with its end, in one."""
    if b'"' not in data:
        return data
    return bytearray(_LONG_CELL.sub(lambda cell: cell[0].replace(b"\n", b" "), bytes(data)))


def _with_header(path: Path, data: bytearray, notes: list[str]) -> _Text:
    """The names and where the rows begin; comment lines, blank lines and `sep=` before them."""
    at = row = 0
    separator: bytes | None = None
    comment = b""
    while True:
        end = data.find(b"\n", at)
        line = bytes(data[at : end if end >= 0 else len(data)]).strip()
        row += 1
        after = end + 1 if end >= 0 else len(data)
        if (found := _SEPARATOR_LINE.match(line)) is not None:
            separator = found[1]
        elif line.startswith(_ROSTOPIC):
            break
        elif line.startswith(_COMMENTS):
            comment = line
        elif line:
            break
        if end < 0:
            raise RecordingError(path, "is no CSV table: it has no rows", "record again")
        at = after
    if separator is None and (found_at := _names_behind(data, at)) > at:
        lines = data.count(b"\n", at, found_at)
        notes.append(f"left out in front of the names: {counted(lines, 'line')}")
        row, at = row + lines, found_at
        end = data.find(b"\n", at)
        line, after = bytes(data[at:end]).strip(), end + 1
    if _is_numbers(line, separator) and comment:  # as numpy writes the names
        line, row, after = comment.lstrip(b"#%/ "), row - 1, at
    mark = separator or _separator_of(line)
    refuse_beyond(path, line.count(mark) + 1, TABLE_COLUMNS, "columns", _LESS)
    names = _split(line.decode("utf-8", "replace"), mark.decode())
    if _is_numbers(line, mark):
        raise RecordingError(
            path,
            f"row {row} holds numbers where the columns' names should be",
            "write their names in front: time_s,mag_x_gauss,...",
        )
    if mark != b",":
        words = _CALLED.get(mark, repr(mark.decode()))
        notes.append(f"the columns are separated by {words}: read as such")
    if mark == b" ":
        rows = re.sub(rb"(?m)^ +| +$", b"", re.sub(rb"[ \t]+", b" ", bytes(data[after:])))
        data, after = bytearray(rows), 0
    return _Text(data, names, mark.decode(), after, row + 1)


def _names_behind(data: bytearray, at: int) -> int:
    """Where the names begin below lines of another kind (a title, the device, a date), else `at`.

    The names are as many as the cells of a row of numbers below them, and the first line's are not.
    """
    start = at
    lines = [bytes(line) for line in data[at : at + _PREAMBLE_BYTES].split(b"\n")[:-1]]
    mark = _separator_of(lines[0]) if lines else b","
    if not lines or len(_cells(lines[0], mark)) >= len(REQUIRED):
        return start
    for line, *below in zip(lines, lines[1:], lines[2:], strict=False):
        mark = _separator_of(line)
        count = len(_cells(line, mark))
        rows = (row for row in below if len(_cells(row, mark)) == count)
        names = count >= len(REQUIRED) and not _is_numbers(line, mark)
        if names and any(_numbers_in(row, mark) >= len(REQUIRED) - 1 for row in rows):
            return at
        at += len(line) + 1
    return start


def _cells(line: bytes, mark: bytes) -> list[bytes]:
    return line.split() if mark == b" " else line.split(mark)


def _numbers_in(line: bytes, mark: bytes) -> int:
    return sum(_is_numbers(cell.strip(b' "'), mark) for cell in _cells(line, mark) if cell.strip())


def _take_units(text: _Text, notes: list[str]) -> None:
    """A line below the names that has no number in it, above one that has: their units."""
    end = text.data.find(b"\n", text.at)
    below = text.data.find(b"\n", end + 1)
    if end < 0 or below < 0:
        return
    mark = text.separator.encode()
    line, row = bytes(text.data[text.at : end]), bytes(text.data[end + 1 : below])
    wordy = bool(line.strip()) and _numbers_in(line, mark) == 0
    if not wordy or _numbers_in(row, mark) < len(REQUIRED) - 1:
        return
    units = _split(line.decode("utf-8", "replace"), text.separator)
    if len(units) != len(text.names) or units == text.names:
        return
    text.names = [with_unit(name, unit) for name, unit in zip(text.names, units, strict=True)]
    text.at, text.first_row = end + 1, text.first_row + 1
    notes.append("the line below the names has their units: read as such")


def _separator_of(line: bytes) -> bytes:
    best = max(_SEPARATORS, key=line.count)
    if line.count(best):
        return best
    return b" " if b" " in line else b","


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [name.strip() for name in next(csv.reader(io.StringIO(line), delimiter=separator), [])]


def _is_numbers(line: bytes, separator: bytes | None) -> bool:
    """Whether all cells of a line are numbers, so that it names no columns."""
    mark = separator or _separator_of(line)
    cells = _cells(line, mark)
    try:
        for cell in cells:
            float(cell.replace(b",", b".") if mark == b";" else cell)
    except ValueError:
        return False
    return True


def _drop_comments(text: _Text, notes: list[str]) -> None:
    body = bytes(text.data[text.at :]) if any(b"\n" + c in text.data for c in _COMMENTS) else b""
    if text.separator == "|" and _RULE.search(bytes(text.data), text.at):
        text.data, text.at = bytearray(_RULE.sub(b"", bytes(text.data[text.at :]))), 0
        body = body and bytes(text.data)
    if body and (count := len(_COMMENT_LINE.findall(body))):
        text.data, text.at = bytearray(_COMMENT_LINE.sub(b"", body)), 0
        notes.append(f"left out amid the rows: {counted(count, 'comment line')}")


def _drop_empty_rows(text: _Text, notes: list[str]) -> None:
    """Rows of separators alone, as spreadsheets leave them below the last one."""
    plain = text.separator.encode()
    if not any(b"\n" + begins in text.data for begins in (plain, b" ", b'""')):
        return  # no row begins with an empty cell: by far the quickest to see
    mark = re.escape(plain)
    empty = re.compile(rb'(?m)^[ "]*' + mark + rb'[" ' + mark + rb"]*(?:\n|\Z)")
    body, count = empty.subn(b"", bytes(memoryview(text.data)[text.at :]))
    if count:
        text.data, text.at = bytearray(body), 0
        notes.append(f"left out, without a cell: {counted(count, 'row')}")


def _drop_repeated_header(text: _Text, notes: list[str]) -> None:
    """A logger that was started again writes its names again."""
    if not text.names or text.data.find(text.names[0].encode(), text.at) < 0:
        return
    first = re.escape(text.names[0].encode())
    body = bytes(text.data[text.at :])
    if not text.names[0] or not re.search(rb"(?m)^\"?" + first + rb"\"?\s*[,;\t ]", body):
        return
    lines = body.split(b"\n")
    kept = [line for line in lines if _split_safe(line, text) != text.names]
    if len(kept) < len(lines):
        text.data, text.at = bytearray(b"\n".join(kept)), 0
        notes.append(
            f"left out amid the rows: {counted(len(lines) - len(kept), 'more line')} of names"
        )


def _split_safe(line: bytes, text: _Text) -> list[str]:
    if not line[:1].strip(b"-+.0123456789 "):  # a row of numbers, which most are
        return []
    return _split(line.decode("utf-8", "replace"), text.separator)


def _drop_cut_row(text: _Text, cut: bool, notes: list[str]) -> None:
    """The last row where the file ends within it."""
    if len(text.data) == text.at or text.data.endswith(b"\n"):
        return
    start = max(text.data.rfind(b"\n") + 1, text.at)
    cells = text.data.count(text.separator.encode(), start) + 1
    if cut or cells < len(text.names):
        del text.data[start:]
        notes.append("the last row is cut off: left out")


def _parsed(path: Path, text: _Text, notes: list[str]) -> pyarrow.Table:
    names = _as_wide_as_rows(text)
    wrong: list[pyarrow.csv.InvalidRow] = []
    count = 0

    def left_out(row: pyarrow.csv.InvalidRow) -> str:
        nonlocal count
        count += 1
        wrong[:] = wrong or [row]
        return "skip"

    if not bytes(memoryview(text.data)[text.at :]).strip():
        return pyarrow.Table.from_arrays([pyarrow.nulls(0) for _ in names], names=names)
    _plain_minus(text, notes)
    decimal = _decimal_of(text, notes)
    try:
        table = pyarrow.csv.read_csv(
            pyarrow.BufferReader(pyarrow.py_buffer(memoryview(text.data)[text.at :])),
            pyarrow.csv.ReadOptions(
                use_threads=False, column_names=[str(k) for k in range(len(names))]
            ),
            pyarrow.csv.ParseOptions(delimiter=text.separator, invalid_row_handler=left_out),
            pyarrow.csv.ConvertOptions(decimal_point=decimal, null_values=_MISSING),
        )
    except (pyarrow.ArrowInvalid, pyarrow.ArrowKeyError, UnicodeDecodeError) as error:
        words = printable(str(error).splitlines()[0], 200)
        raise RecordingError(path, f"is no CSV table: {words}", "repair that row") from error
    if count:
        row = (wrong[0].number or 1) + text.first_row - 1
        words = f"{wrong[0].actual_columns} cells where {wrong[0].expected_columns} are named"
        if count > max(_WRONG_FEW, _WRONG_SHARE * (table.num_rows + count)):
            raise RecordingError(
                path, f"row {row} has {words} ({counted(count, 'such row')})", "repair them"
            )
        notes.append(
            f"left out for another number of cells: {counted(count, 'row')}, first row {row}"
        )
    if decimal == ",":
        notes.append("the numbers have decimal commas: read as such")
    keep = [k for k, name in enumerate(names) if name or table.column(k).null_count < len(table)]
    return table.select(keep).rename_columns([names[k] or f"column {k + 1}" for k in keep])


def _as_wide_as_rows(text: _Text) -> list[str]:
    """The names, with one more or less where each row ends in a separator and they do not."""
    end = text.data.find(b"\n", text.at)
    first = bytes(text.data[text.at : end if end >= 0 else len(text.data)]).rstrip(b"\r")
    cells = len(_split(first.decode("utf-8", "replace"), text.separator)) if first else 0
    names = list(text.names)
    while (
        cells > len(names)
        and cells <= TABLE_COLUMNS
        and not _split(first.decode("utf-8", "replace"), text.separator)[len(names)]
    ):
        names.append("")
    while names and not names[-1] and 0 < cells < len(names):
        names.pop()
    return names


def _plain_minus(text: _Text, notes: list[str]) -> None:
    """Numbers with the minus that a typesetter or a spreadsheet put there have a plain one."""
    if _MINUS.search(text.data, text.at):
        text.data = bytearray(_MINUS.sub(b"-", bytes(text.data[text.at :])))
        text.at = 0
        notes.append("the numbers have minus signs of typesetting: read as such")


def _decimal_of(text: _Text, notes: list[str]) -> str:
    """The decimal mark of the numbers; marks between their thousands are taken out.

    A comma in a table whose columns it separates stands in quotes.
    """
    lines = bytes(text.data[text.at : text.at + 16384]).decode("utf-8", "replace").split("\n")[:40]
    rows = csv.reader(lines[:-1], delimiter=text.separator)
    cells = [cell.strip() for row in rows for cell in row]
    decimal = "," if any(_DECIMAL_COMMA.match(cell) for cell in cells) else "."
    for mark, point, grouped in _THOUSANDS:
        if any(grouped.fullmatch(cell) and _is_told(cell, mark, point) for cell in cells):
            decimal = point
            _drop_thousands(text, mark, point)
            notes.append(f"the numbers have {mark!r} between their thousands: read as such")
            break
    if decimal == "," and text.separator == ",":  # the reader of columns knows no such quotes
        body = _QUOTED_COMMA.sub(rb"\1.\2", bytes(text.data[text.at :]))
        text.data, text.at, decimal = bytearray(body), 0, "."
        notes.append("the numbers have decimal commas: read as such")
    return decimal


def _is_told(cell: str, mark: str, point: str) -> bool:
    """Whether such a cell can be nothing else: with both marks, or with two of the one."""
    return (mark in cell and point in cell) or cell.count(mark) > 1 or mark == "'"


def _drop_thousands(text: _Text, mark: str, point: str) -> None:
    """In whole cells, which are quoted where the mark is also the separator."""
    m, p, quote = re.escape(mark), re.escape(point), '"' if mark == text.separator else '"?'
    edge = re.escape(text.separator)
    cell = (
        rf"(?m)(^|{edge})(\s*{quote}[-+]?\d{{1,3}}(?:{m}\d{{3}})+(?:{p}\d*)?{quote}\s*)(?=$|{edge})"
    )
    body = bytes(text.data[text.at :]).decode("utf-8", "replace")
    body = re.sub(cell, lambda found: found[1] + found[2].replace(mark, ""), body)
    text.data, text.at = bytearray(body.encode()), 0
