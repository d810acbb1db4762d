"""Register rows and their text, against the manual's own lines and against float32 arithmetic."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.vn100.messages import MESSAGES
from drivers.vn100.registers import (
    REGISTERS,
    RegisterValueError,
    as_stored,
    check,
    format_command,
    format_reply,
    parse,
    same,
)

WIRE = Path(__file__).parents[2] / "fixtures" / "vn100" / "wire_examples.json"
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
NO_CALIBRATION = (*IDENTITY, 0.0, 0.0, 0.0)

F32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
SENSIBLE = st.floats(-10, 10, width=32).map(lambda x: 0.0 if abs(x) < 1e-9 else x)

# (register, values, text behind the word): lines of UM001 and of recorded conversations
PRINTED = [
    (1, ("VN-200T-CR",), "01,VN-200T-CR"),
    (3, (100130608,), "03,0100130608"),
    (4, ("3.1.0.0",), "04,3.1.0.0"),
    (7, (40,), "07,40"),
    (6, (1, 1), "06,1,1"),
    (8, (-114.314, 0.058, -1.773), "08,-114.314,+000.058,-001.773"),
    (18, (0.013, 0.354, -9.801), "18,+00.013,+00.354,-09.801"),
    (
        80,
        (0.665016, -0.119, -0.409, -0.025, 0.011, -0.084, -6.702),
        "80,+0.665016,-000.119,-000.409,-000.025,+000.011,-000.084,-006.702",
    ),
    (23, NO_CALIBRATION, "23,1,0,0,0,1,0,0,0,1,0,0,0"),
    (26, IDENTITY, "26,1,0,0,0,1,0,0,0,1"),
    (30, (0, 0, 0, 0, 1, 0, 1), "30,0,0,0,0,1,0,1"),
    (44, (1, 2, 5), "44,1,2,5"),
    (50, (37.2, 0.0, 0.0), "50,37.2,0,0"),
    (51, (1, 0.1, 0.01), "51,1,0.1,0.01"),
    (75, (1, 4, 0x01, 0x0101), "75,1,4,01,0101"),
    (75, (3, 400, 0x01, 0x0321), "75,3,400,01,0321"),
    (75, (1, 16, 0x15, 0x0001, 0x000C, 0x0014), "75,1,16,15,0001,000C,0014"),
    (76, (0, 1, 0), "76,0,1,00"),
    (82, (0, 0, 0, 0, 0), "82,0,0,0,0,0"),
    (
        83,
        (0, 0, 0, 0, 1000, 0.0, 0.0, 0.0, 0.0),
        "83,0,0,0,0,1000,0.000,+00.00000000,+000.00000000,+00000.000",
    ),
    (21, (7.1384e-05, 0.0, 1.00211, 0.0, 0.0, -9.79375), "21,7.1384E-05,0,1.00211,0,0,-9.79375"),
]


@pytest.mark.parametrize(("register", "values", "text"), PRINTED)
def test_reply_is_what_the_device_prints(register, values, text):
    assert format_reply(register, values) == text


@pytest.mark.parametrize(("register", "values", "text"), PRINTED)
def test_parse_inverts_the_reply(register, values, text):
    assert parse(register, text.split(",")[1:]) == values


@pytest.mark.parametrize(
    ("register", "values", "text"),
    [
        (23, NO_CALIBRATION, "23,1,0,0,0,1,0,0,0,1,0,0,0"),
        (
            23,
            (1.02, 0.01, 0, 0.01, 0.98, 0, 0, 0, 1.01, 0.05, -0.03, 0.1),
            "23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1",
        ),
        (75, (2, 4, 0x01, 0x0128), "75,2,4,01,0128"),
        (76, (0, 1, 0), "76,0,1,00"),
        (6, (14,), "06,14"),
        (44, (2, 3, 5), "44,2,3,5"),
        (5, (921600,), "05,921600"),
        (
            74,
            (7.1384e-05, -0.0, 1e-9, 1 / 3, 0, 0, 0),
            "74,0.000071384,0,0.000000001,0.33333334,0,0,0",
        ),
    ],
)
def test_command_text(register, values, text):
    assert format_command(register, values) == text


def test_every_register_line_of_the_wire_examples_parses_and_prints_again():
    seen = 0
    for case in json.loads(WIRE.read_text()):
        line = case["ascii"] or ""
        if case["category"] != "valid" or line[:6] not in ("$VNRRG", "$VNWRG"):
            continue
        _, number, *tokens = line[1:].split("*")[0].split(",")
        if not tokens:
            continue
        seen += 1
        values = parse(int(number), tokens)
        again = [str(int(number)), *format_reply(int(number), values).split(",")[1:]]
        short_width_of_old_firmware = {"rrg15_response", "rrg27_response", "rrg19_response"}
        if case["name"] not in short_width_of_old_firmware:
            assert again == [str(int(number)), *tokens], case["name"]
        assert same(int(number), values, parse(int(number), tokens))
        expected = case["fields"].get("values")
        if expected and "model" not in case["name"]:
            assert [float(v) for v in values if not isinstance(v, str)] == [
                float(v) for v in expected if not isinstance(v, str)
            ]
    assert seen >= 25


@given(values=st.lists(SENSIBLE, min_size=12, max_size=12))
def test_command_round_trips_float32_in_fixed_point(values):
    text = format_command(84, tuple(values))
    assert "e" not in text.lower()
    assert len(f"$VNWRG,{text}*00\r\n") <= 256
    sent = [struct.unpack("<f", struct.pack("<f", float(t)))[0] for t in text.split(",")[1:]]
    assert sent == [struct.unpack("<f", struct.pack("<f", v))[0] for v in values]


@given(value=F32)
def test_values_rounded_by_the_device_are_equal(value):
    printed = f"{np.float32(value):G}"
    assert same(50, (value, 0.0, 0.0), parse(50, [printed, "0", "0"]))
    assert same(50, (value, 0.0, 0.0), (float(np.float32(value)), 0.0, 0.0))


@given(value=st.floats(1e-30, 1e30), sign=st.sampled_from([-1.0, 1.0]))
def test_change_in_the_sixth_digit_is_a_difference(value, sign):
    changed = float(np.float32(sign * value * 1.00002))
    assert not same(50, (sign * value, 0.0, 0.0), (changed, 0.0, 0.0))
    assert not same(50, (sign * value, 0.0, 0.0), (-sign * value, 0.0, 0.0))


def test_nan_and_infinity_never_match():
    assert not same(50, (math.nan, 0.0, 0.0), (math.nan, 0.0, 0.0))
    assert not same(50, (math.inf, 0.0, 0.0), (math.inf, 0.0, 0.0))


def test_same_compares_integers_text_and_lengths_exactly():
    assert same(44, (0, 1, 5), (0, 1, 5))
    assert not same(44, (0, 1, 5), (0, 1, 4))
    assert same(0, ("hull 7",), ("hull 7",))
    assert not same(0, ("hull 7",), ("hull 8",))
    assert not same(75, (1, 8, 6, 1, 0x083F), (1, 8, 6, 1, 0x003F))
    assert not same(75, (0, 1, 0), (1, 8, 6, 1, 0x003F))
    assert same(
        83,
        (1, 1, 0, 0, 1000, 2026.88, 59.123456789, 10.0, 4.0),
        parse(
            83,
            ("1", "1", "0", "0", "1000", "2026.880", "+59.12345679", "+010.00000000", "+00004.000"),
        ),
    )


@pytest.mark.parametrize(
    ("register", "tokens", "code", "says"),
    [
        (23, ["1"] * 11, 0x05, "b2"),
        (23, ["1"] * 13, 0x06, "13 values"),
        (23, ["nan", *["1"] * 11], 0x07, "c00: 'nan'"),
        (23, ["-0.0.1", *["1"] * 11], 0x07, "'-0.0.1'"),
        (23, ["1e999", *["1"] * 11], 0x07, "'1e999'"),
        (23, ["1_0", *["1"] * 11], 0x07, "'1_0'"),
        (23, [" 1", *["1"] * 11], 0x07, "' 1'"),
        (44, ["0", "1", "256"], 0x07, "converge_rate: '256'"),
        (44, ["0", "1", "-1"], 0x07, "'-1'"),
        (44, ["0", "1", "5.5"], 0x07, "'5.5'"),
        (44, ["0", "1", "٣"], 0x07, "'٣'"),
        (75, ["1", "8", "1FFFF", "0001"], 0x07, "groups: '1FFFF'"),
        (75, ["1", "8"], 0x05, "groups"),
        (9999, [], 0x08, "no register 9999"),
    ],
)
def test_parse_error_names_register_field_and_token(register, tokens, code, says):
    with pytest.raises(RegisterValueError, match=str(register)) as caught:
        parse(register, tokens)
    assert caught.value.code == code
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("register", "values", "code", "says"),
    [
        (23, (math.nan, *NO_CALIBRATION[1:]), 0x07, "finite"),
        (23, (1e39, *NO_CALIBRATION[1:]), 0x07, "f32"),
        (36, (11.0, *[4.0] * 8), 0x07, "0.0..10.0"),
        (7, (30,), 0x07, "adof"),
        (5, (100000,), 0x07, "baud"),
        (30, (0, 0, 0, 0, 2, 0, 1), 0x07, "serial_checksum"),
        (
            75,
            (
                4,
                8,
                0,
            ),
            0x07,
            "async_mode",
        ),
        (75, (1, 8, 0x06, 0x0001), 0x05, "2 field words"),
        (75, (1, 8, 0x06, 1, 1, 1), 0x06, "2 field words"),
        (75, (1, 8, 0x04, 0x2000), 0x07, "unknown length"),
        (75, (1, 8, 0x100, 0x0001), 0x07, "unknown length"),
        (75, (1, 8, 0x01, 0x8000, 0x0001), 0x07, "unknown length"),
        (26, (1, 0, 0, 0, 1, 0, 0, 0, 1.001), 0x07, "1.0"),
        (26, (1, 0, 0, 0, 1, 0, 0, 0.1, 0.99), 0x07, "product"),
        (26, (-1, 0, 0, 0, 1, 0, 0, 0, 1), 0x07, "left-handed"),
        (0, ("x" * 21,), 0x07, "20"),
        (0, ("a,b",), 0x07, "a,b"),
        (47, NO_CALIBRATION, 0x09, "read only"),
        (227, (800, 2, 200.0, 100.0), 0x09, "never written"),
        (206, ("1",), 0x09, "never written"),
        (22, ("1",), 0x09, "old firmware"),
    ],
)
def test_command_refuses_what_the_device_would(register, values, code, says):
    with pytest.raises(RegisterValueError) as caught:
        format_command(register, values)
    assert caught.value.code == code
    assert says in str(caught.value)


def test_tiny_values_are_refused_and_removed_by_as_stored():
    dust = (1.1234567e-20, 0.0, 0.0) * 4
    with pytest.raises(RegisterValueError, match="as_stored"):
        format_command(84, tuple(v or 3.3e-25 for v in dust))
    assert as_stored(84, (1.0 / 3, 1e-17, *IDENTITY[2:], 0.0, 0.0, 0.0)) == (
        float(np.float32(1 / 3)),
        0.0,
        *IDENTITY[2:],
        0.0,
        0.0,
        0.0,
    )


def test_a_rotation_within_float_rounding_is_accepted():
    c, s = math.cos(0.3), math.sin(0.3)
    values = (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
    check(26, as_stored(26, values))
    assert format_command(26, values).startswith("26,0.9553365,-0.29552022,0,")


def test_map_is_complete_and_defaults_fit_their_rows():
    assert set(REGISTERS) == {
        *range(10), 15, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 30, 32, 33, 34, 35, 36, 37, 38,
        39, 40, 43, 44, 46, 47, 48, 50, 51, 54, 74, 75, 76, 77, 80, 82, 83, 84, 85, 115, 116, 206,
        227, 239, 240,
    }  # fmt: skip
    checked = 0
    for row in REGISTERS.values():
        assert set(row.defaults) <= set(row.generations)
        for values in row.defaults.values():
            check(row.id, values)
            assert parse(row.id, format_reply(row.id, values).split(",")[1:]) == values
            checked += 1
    assert checked >= 50


def test_defaults_are_the_manuals():
    assert format_reply(85, REGISTERS[85].defaults[3]) == "85,0,4,4,4,0,0,3,3,3,0"
    assert format_reply(32, REGISTERS[32].defaults[2]) == "32,3,0,0,0,3,0,0,500000,0"
    assert REGISTERS[44].defaults == {2: (1, 3, 5), 3: (0, 1, 5)}
    assert REGISTERS[5].defaults[3] == (115200,)
    assert (REGISTERS[6].defaults[2], REGISTERS[7].defaults[2]) == ((14,), (40,))


def test_measurement_rows_print_as_the_messages_of_the_same_values():
    for message in MESSAGES.values():
        if message.register not in (0, 115):  # heave: the manual prints no format for it
            formats = [field.printed for field in REGISTERS[message.register].fields]
            assert formats == [column.printed for column in message.columns], message.name
            assert message.output_type in REGISTERS[6].fields[0].allowed
