"""The table of asynchronous messages and the text that comes from it."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import MESSAGES, Check, encode, encode_sentence, sentence_layout

# vn100-protocol 2: name, ADOR, register, number of values; 1.5: bytes of a line
TABLE = [
    ("VNYPR", 1, 8, 3, 38),
    ("VNQTN", 2, 9, 4, 51),
    ("VNQMR", 8, 15, 13, 135),
    ("VNMAG", 10, 17, 3, 38),
    ("VNACC", 11, 18, 3, 35),
    ("VNGYR", 12, 19, 3, 44),
    ("VNMAR", 13, 20, 9, 95),
    ("VNYMR", 14, 27, 12, 122),
    ("VNYBA", 16, 239, 9, 95),
    ("VNYIA", 17, 240, 9, 95),
    ("VNIMU", 19, 54, 11, 110),
    ("VNDTV", 30, 80, 7, 75),
    ("VNHVE", 34, 115, 3, None),  # no source prints a line of it
    ("VNCMV", 253, 0, 10, None),  # firmware 1
]


def test_the_table_is_the_manuals() -> None:
    rows = [
        (row.name, row.output_type, row.register, len(row.columns)) for row in MESSAGES.values()
    ]
    assert rows == [line[:4] for line in TABLE]


@pytest.mark.parametrize(("name", "length"), [(row[0], row[4]) for row in TABLE if row[4]])
def test_lines_have_the_printed_width(name: str, length: int) -> None:
    values = [0.1] * len(MESSAGES[name].columns)
    assert len(encode_sentence(name, values)) == length


def test_printed_text_is_the_devices() -> None:
    """Lines of current firmware, rebuilt from their numbers."""
    ypr = [math.radians(angle) for angle in (10.071, 0.278, -2.026)]
    assert encode_sentence("VNYPR", ypr) == b"$VNYPR,+010.071,+000.278,-002.026*60\r\n"
    crc = encode_sentence("VNYPR", ypr, check="crc")
    assert crc == b"$VNYPR,+010.071,+000.278,-002.026*29F8\r\n"
    both = encode_sentence("VNYPR", ypr, count=543, status=0xABC)
    assert both[:-5] == b"$VNYPR,+010.071,+000.278,-002.026,T0000000543,S0ABC"


def test_layouts_are_one_object() -> None:
    assert sentence_layout("VNYMR") is sentence_layout("VNYMR", False, status=False)
    with_count = sentence_layout("VNYMR", count=True)
    assert with_count is sentence_layout("VNYMR", True)
    assert [column.name for column in with_count.columns[12:]] == ["serial_count"]


@st.composite
def messages(draw: st.DrawFn) -> tuple[str, list[float], int | None, int | None, Check]:
    """A message whose values are on the grid that its formats print."""
    name = draw(st.sampled_from(sorted(MESSAGES)))
    values = []
    for column in MESSAGES[name].columns:
        if column.printed.endswith("E"):
            values.append(float(f"{draw(st.floats(-100, 100)):.6E}"))
            continue
        decimals = int(column.printed[-2])
        most = min(180, 10 ** (int(re.findall(r"\d+", column.printed)[0]) - decimals - 2) - 1)
        number = draw(st.integers(-most * 10**decimals, most * 10**decimals)) / 10**decimals
        values.append(number / column.per_si)
    count = draw(st.none() | st.integers(0, 2**32 - 1))
    status = draw(st.none() | st.integers(0, 0xFFFF))
    return name, values, count, status, draw(st.sampled_from(["xor", "crc"]))


@settings(deadline=None)
@given(messages())
def test_decoding_inverts_encoding(
    message: tuple[str, list[float], int | None, int | None, Check],
) -> None:
    name, values, count, status, check = message
    line = encode_sentence(name, values, count, status, check)
    (frame,) = Deframer().feed(line)
    decoded = decode(frame)
    appended = [number for number in (count, status) if number is not None]
    assert isinstance(decoded, Measurement)
    assert decoded.layout is sentence_layout(name, count is not None, status is not None)
    assert decoded.values == pytest.approx((*values, *appended), rel=1e-14, abs=1e-15)
    assert encode_sentence(name, decoded.values[: len(values)], count, status, check) == line


@pytest.mark.parametrize("body", ["VNRRG,$", "VN*", "VN\n", "VNé", "VN\x7f"])
def test_what_cannot_be_in_a_sentence_is_refused(body: str) -> None:
    with pytest.raises(ValueError, match="cannot be a sentence"):
        encode(body)


def test_wrong_values_are_refused() -> None:
    with pytest.raises(ValueError, match="VNYPR has 3 values, not 2"):
        encode_sentence("VNYPR", (0, 0))
    with pytest.raises(ValueError, match="not finite"):
        encode_sentence("VNYPR", (0, math.nan, 0))
    with pytest.raises(KeyError):
        encode_sentence("VNXYZ", ())
