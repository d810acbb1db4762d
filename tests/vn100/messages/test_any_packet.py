"""Packets of every group and field, of whichever model: framed, decoded as far as a VN-100 goes."""

from __future__ import annotations

import random
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.vn100.decode import Measurement, Unused, decode
from drivers.vn100.deframer import Deframer, Packet, Sentence
from drivers.vn100.messages import (
    GROUPS,
    MAX_PACKET_BYTES,
    SYNC,
    binary_layout,
    crc16,
    encode,
    encode_packet,
)

SAT_INFO, RAW_MEAS = 14, 16
DRIVER = (0x29, (0x7FFF, 0x0210, 0x000C))  # what the ROS 2 driver asks a VN-100 for


def header_of(fields: dict[int, list[int]]) -> bytes:
    """FA, group bytes and words that announce these bits, by the place of the group's bit."""
    first = sum(1 << group for group in fields if group < 7)
    second = sum(1 << group - 7 for group in fields if group >= 7)
    words = b""
    for _, bits in sorted(fields.items()):
        low = sum(1 << bit for bit in bits if bit < 15)
        high = sum(1 << bit - 16 for bit in bits if bit > 15)
        words += struct.pack("<H", low | (0x8000 if high else 0))
        words += struct.pack("<H", high) if high else b""
    groups = bytes([first | 0x80, second]) if second else bytes([first])
    return bytes([SYNC]) + groups + words


def payload_of(fields: dict[int, list[int]], dice: random.Random) -> bytes:
    """Any bytes, with few satellites where a field counts them."""
    body = b""
    for group, bits in sorted(fields.items()):
        for bit in sorted(bits):
            row = GROUPS[group][bit]
            part = bytearray(dice.randbytes(row.size))
            if row.each:
                part[row.at] = dice.randrange(12)
                part += dice.randbytes(row.each * part[row.at])
            body += bytes(part)
    return body


def whole(header: bytes, payload: bytes) -> bytes:
    checked = header[1:] + payload
    return header[:1] + checked + struct.pack(">H", crc16(checked))


any_fields = st.dictionaries(
    st.sampled_from(sorted(GROUPS)), st.just(None), min_size=1, max_size=4
).flatmap(
    lambda groups: st.fixed_dictionaries(
        {g: st.lists(st.sampled_from(sorted(GROUPS[g])), min_size=1, unique=True) for g in groups}
    )
)


@settings(deadline=None, max_examples=150)
@given(any_fields, st.integers(0, 2**32), st.sampled_from([1, 3, 50, 5000]))
@example({3: [SAT_INFO]}, 1, 1)
@example({6: [RAW_MEAS, 18], 4: [1]}, 2, 1)
@example({12: [0, SAT_INFO, RAW_MEAS], 0: [0]}, 3, 3)
def test_every_packet_is_framed_whatever_its_groups(
    fields: dict[int, list[int]], seed: int, size: int
) -> None:
    dice = random.Random(seed)
    header = header_of(fields)
    packets = [whole(header, payload_of(fields, dice)) for _ in range(3)]
    line = encode("VNRRG,07,40")
    data = packets[0] + line + packets[1] + packets[2]
    deframer = Deframer()
    frames = [f for at in range(0, len(data), size) for f in deframer.feed(data[at : at + size])]
    deframer.drop_pending()
    frames += deframer.feed(b"")
    if len(max(packets, key=len)) > MAX_PACKET_BYTES:
        return
    bodies = [f.body if isinstance(f, Sentence) else f.data for f in frames]
    assert bodies == [packets[0], "VNRRG,07,40", packets[1], packets[2]]
    assert deframer.counters.skipped_bytes == 0
    columns = [c for g, bits in fields.items() for b in bits for c in GROUPS[g][b].columns]
    for frame in frames:
        if isinstance(frame, Packet):
            assert len(frame.layout.columns) == len(columns)
            assert isinstance(decode(frame), Unused) == (not columns)


def test_known_fields_are_decoded_among_unknown_ones() -> None:
    layout = binary_layout(*DRIVER)
    assert (layout.name, layout.size) == ("FA 29 7FFF 0210 000C", 8 + 198 + 13 + 36 + 2)
    values = [0.25 * k for k in range(len(layout.columns))]
    measured = decode(Packet(layout, encode_packet(layout, values), 0))
    assert isinstance(measured, Measurement)
    assert (
        measured.values[layout.index("uncomp_gyro_x_rad_s")]
        == values[layout.index("uncomp_gyro_x_rad_s")]
    )
    assert measured.values[layout.index("mag_z_gauss")] == values[layout.index("mag_z_gauss")]
    assert layout.left_out == (
        *("TimeGps", "PosLla", "VelNed", "TimeGpsPps", "Fix", "PosU", "PosEcef", "VelBody"),
    )


def test_columns_behind_entries_that_repeat_are_found() -> None:
    layout = binary_layout(0x18, (1 << SAT_INFO, 0x0002))  # GNSS: SatInfo; attitude: Ypr
    for satellites in (0, 3, 200):
        payload = bytes([satellites, 0]) + bytes(8 * satellites)
        packet = whole(layout.header, payload + struct.pack("<3f", 90.0, 0.0, -90.0))
        (frame,) = Deframer().feed(packet)
        measured = decode(frame)
        assert isinstance(measured, Measurement)
        assert measured.values == pytest.approx((1.570796, 0.0, -1.570796))
        assert isinstance(frame, Packet)
        assert frame.layout is layout


def test_foreign_header_within_a_damaged_packet_is_not_counted_as_damage() -> None:
    layout = binary_layout(0x06, (0x0001, 0x000E))
    good = encode_packet(layout, [1.0] * len(layout.columns))
    bad = bytearray(good)
    bad[20:24] = bytes([SYNC, 0x60, 0xB9, 0x00])
    deframer = Deframer()
    frames = deframer.feed(good + bytes(bad) + good + good)
    assert [f.offset for f in frames] == [0, 2 * len(good), 3 * len(good)]
    assert sum(deframer.counters.damage.values()) == 1


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r\r\n", b"\r", b"\r\r"])
@pytest.mark.parametrize("size", [1, 1000])
def test_altered_line_ends_are_accepted(end: bytes, size: int) -> None:
    line = encode("VNYPR,+010.071,+000.278,-002.026")[:-2] + end
    layout = binary_layout(0x01, (0x0009,))
    packet = encode_packet(layout, [1.0, 0.1, 0.2, 0.3])
    data = line + line + packet + line
    deframer = Deframer()
    frames = [f for at in range(0, len(data), size) for f in deframer.feed(data[at : at + size])]
    deframer.drop_pending()
    frames += deframer.feed(b"")
    assert [type(f) for f in frames] == [Sentence, Sentence, Packet, Sentence]
    assert deframer.counters.skipped_bytes == 0


@pytest.mark.parametrize("end", [b"\r\n", b"*XX\r\n"])
def test_lines_without_a_checksum_are_counted_and_not_used(end: bytes) -> None:
    deframer = Deframer()
    assert deframer.feed(b"$VNYPR,+010.071,+000.278,-002.026" + end) == []
    assert deframer.feed(b"$VNYPR,+010.071,+000.278,-002.026*61\r\n") == []
    assert deframer.counters.unchecked == 1
    assert deframer.counters.rejected == 2


@pytest.mark.parametrize("body", ["VNINS,1,2", "VNGPS,340,1", "VNISL,0", "VNSTV,1", "VNQTM,0"])
def test_messages_of_other_models_are_unused_and_no_damage(body: str) -> None:
    assert decode(Sentence(body, 7, 0)) == Unused(body[:5], 7)


def test_cmv_of_old_firmware_is_the_uncompensated_set() -> None:
    body = "VNCMV," + ",".join(f"{0.1 * k:+.6E}" for k in range(1, 11))
    measured = decode(Sentence(body, 0, 0))
    assert isinstance(measured, Measurement)
    names = [column.name for column in measured.layout.columns]
    assert (names[0], names[6], names[9]) == (
        *("uncomp_mag_x_gauss", "uncomp_gyro_x_rad_s", "temperature_c"),
    )
    assert measured.values == pytest.approx([0.1 * k for k in range(1, 11)])
