"""Content of messages: total, typed, and with little work."""

from __future__ import annotations

import math
import struct

import pytest
from counted_calls import counted_calls
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.vn100.decode import Decoded, ErrorReply, Measurement, Undecodable, Unused, decode
from drivers.vn100.deframer import Deframer, Packet, Sentence
from drivers.vn100.errors import ERRORS, DeviceRefused, DriverError, Remedy, device_error
from drivers.vn100.messages import (
    Reply,
    binary_layout,
    encode,
    encode_packet,
    encode_sentence,
    sentence_layout,
)


def decoded(body: str) -> Decoded:
    (frame,) = Deframer().feed(encode(body))
    return decode(frame)


# ── sentences ────────────────────────────────────────────────────────────────────────────────────


def test_values_are_si() -> None:
    result = decoded("VNYPR,+180.000,-090.000,+000.000")
    assert isinstance(result, Measurement)
    assert result.layout is sentence_layout("VNYPR")
    assert result.values == pytest.approx((math.pi, -math.pi / 2, 0), rel=1e-15)


@pytest.mark.parametrize("appended", ["T0000000543,S00AB", "S00AB,T0000000543"])
def test_count_and_status_in_either_order(appended: str) -> None:
    result = decoded(f"VNMAG,+00.1000,-00.2000,+00.3000,{appended}")
    assert isinstance(result, Measurement)
    assert result.layout is sentence_layout("VNMAG", count=True, status=True)
    assert result.values == (0.1, -0.2, 0.3, 543, 0xAB)


@pytest.mark.parametrize(
    "values",
    [
        "1,2",
        "1,2,3,4",
        "1,2,3,T1,T2",
        "1,2,3,S1,S2",
        "1,2,T5",
        "1,2,3,T",
        "1,2,3,SXYZ",
        "1,2,3,T1,S1,S1",
        "1,2,nan",
        "1,2,inf",
        "1,2,1e999",
        "1,2,--3",
        "1,2,",
        "1,2, 3",
        "1,2,1_0",
        "1,2,0x1",
        "1,2,-0.0.1",
        "",
    ],
)
def test_bad_values_are_undecodable(values: str) -> None:
    result = decoded(f"VNMAG,{values}")
    assert isinstance(result, Undecodable)
    assert result.what.startswith("VNMAG: ")


@pytest.mark.parametrize(
    ("body", "result"),
    [
        ("VNRRG,08,1,2,3", Reply("VNRRG", 8, ("1", "2", "3"))),
        ("VNRRG,239", Reply("VNRRG", 239, ())),
        ("VNWRG,5,9600", Reply("VNWRG", 5, ("9600",))),
        ("VNASY,0", Reply("VNASY", None, ("0",))),
        ("VNWNV", Reply("VNWNV", None, ())),
        ("VNERR,0C", ErrorReply(12)),
        ("VNERR,ff", ErrorReply(255)),
        ("VNERR", Undecodable("VNERR without an error code", 0)),
        ("VNERR,08,Invalid Register", ErrorReply(8)),
        ("VNERR,Invalid Parameter", ErrorReply(7)),
        ("VNERR,INSUFFICIENT_BAUD_RATE", ErrorReply(0x0C)),
        ("VNERR,SerialBufferOverflow", ErrorReply(2)),
        ("VNERR,XY", Undecodable("VNERR without an error code", 0)),
        ("VNRRG", Undecodable("VNRRG without a register number", 0)),
        ("VNRRG,-1", Undecodable("VNRRG without a register number", 0)),
        ("VNGPS,1", Unused("VNGPS", 0)),
    ],
)
def test_replies_and_errors(body: str, result: Decoded) -> None:
    assert decoded(body) == result


text = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E, exclude_characters="$*"))
words = st.sampled_from(["VNYPR", "VNIMU", "VNRRG", "VNWRG", "VNERR", "VNASY", "VNQQQ", "VN"])


@settings(deadline=None)
@given(words, text)
def test_no_text_raises(word: str, rest: str) -> None:
    result = decode(Sentence(f"{word},{rest}", 3, 0))
    assert isinstance(result, Measurement | Reply | ErrorReply | Undecodable | Unused)
    if isinstance(result, Measurement):
        assert all(map(math.isfinite, result.values))


# ── packets ──────────────────────────────────────────────────────────────────────────────────────

LAYOUT = binary_layout(0x15, (0x2009, 0x0C1E, 0x0001))  # every kind of number


def packet(values: list[float], offset: int = 0) -> Packet:
    return Packet(LAYOUT, encode_packet(LAYOUT, values), offset)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_values_are_undecodable(bad: float) -> None:
    values = [float(number) for number in range(20)]
    values[2] = bad
    broken = packet(values, offset=77)
    what = "FA 15 2009 0C1E 0001: pitch_rad is not finite"
    assert decode(broken) == Undecodable(what, 77)


def test_whole_nanoseconds_are_available() -> None:
    layout = binary_layout(0x02, (0x0001,))
    data = layout.header + struct.pack("<QH", 2**63 + 1, 0)
    assert layout.unpack(data) == (2**63 + 1,)


# ── errors ───────────────────────────────────────────────────────────────────────────────────────


def test_the_error_table() -> None:
    assert sorted(ERRORS) == [*range(1, 13), 255]
    by_outcome = {
        outcome: sorted(code for code, row in ERRORS.items() if row.outcome is outcome)
        for outcome in Remedy
    }
    assert by_outcome == {
        Remedy.RETRY: [2, 3],
        Remedy.STOP: [4, 5, 6, 7, 8, 9, 255],
        Remedy.RESET: [1, 10],
        Remedy.BANDWIDTH: [11, 12],
    }


def test_refusal_has_command_and_reason() -> None:
    error = DeviceRefused(0x0C)
    assert isinstance(error, DriverError)
    assert (error.code, error.error.outcome) == (12, Remedy.BANDWIDTH)
    assert str(error) == (
        "the device answered error 0C (insufficient baud rate): lower rates or raise the baud"
    )
    assert "error 55 (unknown error)" in str(DeviceRefused(0x55))
    assert device_error(0x55).outcome is Remedy.STOP


# ── speed ────────────────────────────────────────────────────────────────────────────────────────


def test_parsing_needs_few_interpreter_calls() -> None:
    """Measured: 26 calls a sentence and 16 a packet, by Python 3.11.

    Messages per second: `benchmarks/daemon/bench_parse.py`.
    """
    layout, count = binary_layout(0x06, (0x0001, 0x083F)), 400
    sentence = encode_sentence("VNYMR", [0.125 * axis for axis in range(12)])
    packet = encode_packet(layout, [1.0, 0, *(0.5 * axis for axis in range(11)), 0])
    for message, limit in ((sentence, 30), (packet, 18)):
        calls, values = counted_calls(lambda stream=message * count: parsed(stream))
        print(f"{calls / count:.1f} calls a message of {len(message)} bytes")
        assert values == count
        assert calls < limit * count


def parsed(stream: bytes) -> int:
    """How many measurements come of a stream in chunks of 4096 bytes."""
    deframer = Deframer()
    chunks = (stream[at : at + 4096] for at in range(0, len(stream), 4096))
    return sum(
        isinstance(decode(frame), Measurement) for chunk in chunks for frame in deframer.feed(chunk)
    )
