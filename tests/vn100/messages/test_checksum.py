"""Checks against the manual's worked examples and against their plain definitions."""

from __future__ import annotations

from functools import reduce
from operator import xor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.vn100.deframer import packet_intact
from drivers.vn100.messages import crc16, xor8

# vn100-protocol 1.1: body, XOR, CRC
WORKED = [
    (b"VNRRG,8", 0x4B, 0x040E),
    (b"VNYPR,+010.071,+000.278,-002.026", 0x60, 0x29F8),
    (b"VNWNV", 0x57, 0xDBDF),
    (b"VNRST", 0x4D, 0x6542),
    (b"VNRFS", 0x5F, 0xE923),
    (b"VNASY,0", 0x4F, 0x4158),
    (b"VNASY,1", 0x4E, 0x5179),
    (b"VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0", 0x76, 0x8445),
    (b"VNERR,03", 0x72, 0xB43A),
]
MANUAL_PACKET = bytes.fromhex("FA01080093502E42833EF13F48B504BB9288")


def crc16_bit_by_bit(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


@pytest.mark.parametrize(("body", "by_xor", "by_crc"), WORKED)
def test_worked_examples(body: bytes, by_xor: int, by_crc: int) -> None:
    assert (xor8(body), crc16(body)) == (by_xor, by_crc)


def test_crc_check_value() -> None:
    assert crc16(b"123456789") == 0x31C3


def test_running_crc_of_the_manuals_packet() -> None:
    running = "1021 B239 BE99 6CCF 38DF ADF7 FBC1 3E9F 9F00 8D68 EF99 5C0D 6107 3B03 9288 8800 0000"
    for end, value in enumerate(running.split(), start=2):
        assert crc16(MANUAL_PACKET[1:end]) == int(value, 16)
    assert packet_intact(MANUAL_PACKET)


@settings(deadline=None)
@given(st.integers(0, 700).flatmap(lambda size: st.binary(min_size=size, max_size=size)))
def test_any_length_agrees_with_the_definition(data: bytes) -> None:
    assert xor8(data) == reduce(xor, data, 0)
    assert crc16(data) == crc16_bit_by_bit(data)


@settings(deadline=None)
@given(st.integers(0, 17 * 8 - 1))
def test_every_single_bit_error_of_a_packet_is_seen(bit: int) -> None:
    damaged = bytearray(MANUAL_PACKET)
    damaged[1 + bit // 8] ^= 1 << bit % 8
    assert not packet_intact(bytes(damaged))
