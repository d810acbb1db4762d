"""Groups, fields, sizes and masks of binary packets, and both directions of any layout."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer, packet_intact
from drivers.vn100.messages import (
    FIELD_MASKS,
    GROUPS,
    MAX_PACKET_BYTES,
    BinaryLayout,
    binary_layout,
    encode_packet,
    layout_of,
    packet_size,
    read_header,
)

# vn100-protocol 1.3, compact table; GNSS and INS by their length tables
SIZES = {
    0: "8 8 8 12 16 12 24 12 12 24 20 28 2 4 8",
    1: "8 8 8 2 8 8 8 4 4 1",
    2: "2 12 12 12 4 4 16 12 12 12 12 2 40",
    3: "8 8 2 1 1 24 24 12 12 12 4 4 2 28",
    4: "2 12 16 36 12 12 12 12 12 12 28 24 12 4",
    5: "2 24 24 12 12 12 12 12 12 4 4 68 64",
    6: "8 8 2 1 1 24 24 12 12 12 4 4 2 28",
}


@pytest.mark.parametrize("group", SIZES)
def test_sizes_are_the_manuals(group: int) -> None:
    ours = [struct.calcsize("<" + row.format) for row in GROUPS[group].values() if not row.each]
    sizes = SIZES[group].split() + (["2", "8"] if group in (3, 6) else [])  # of the second word
    assert list(map(str, ours)) == sizes
    fields = len(SIZES[group].split())
    assert list(GROUPS[group])[:fields] == list(range(fields))


def test_masks_are_the_manuals() -> None:
    assert FIELD_MASKS == {0: 0x3F3D, 1: 0x0191, 2: 0x1FFF, 4: 0x11FF}


@pytest.mark.parametrize(  # vn100-protocol 1.5
    ("groups", "words", "size"),
    [
        (0x01, (0x0009,), 26),
        (0x06, (0x0001, 0x000E), 52),
        (0x06, (0x0001, 0x083F), 64),
        (0x06, (0x0001, 0x003F), 62),
        (0x06, (0x0081, 0x070E), 92),
        (0x01, (0x0739,), 110),
        (0x14, (0x003E, 0x003A), 124),
    ],
)
def test_packet_sizes(groups: int, words: tuple[int, ...], size: int) -> None:
    layout = binary_layout(groups, words)
    assert layout.size == size
    assert layout is layout_of(layout.header) is binary_layout(groups, words)


def test_all_that_a_vn100_can_send_fits() -> None:
    everything = binary_layout(0x17, tuple(FIELD_MASKS.values()))
    assert everything.size == 10 + 146 + 24 + 152 + 138 + 2 <= MAX_PACKET_BYTES


@pytest.mark.parametrize(
    ("header", "size"),
    [
        ("FA 00 00 00", 0),  # no group
        ("FA 01 00 00", 0),  # no field
        ("FA 01 02 00", 14),  # TimeGps: not on a VN-100, and asked of it all the same
        ("FA 04 00 20", 0),  # reserved bit: length unknown
        ("FA 08 01 80 02 00", 18),  # a second field word
        ("FA 08 00 40", 8),  # SatInfo: 8 more for each satellite
        ("FA 08 00 80 01 00", 20),  # RawMeas, of the second word: 28 more for each
        ("FA 01 08 80 01 00", 0),  # the common group has no second word
        ("FA 81 08 01 00 01 00", 0),  # group 11
        ("FA 80 20 20 00", 31),  # GNSS3, behind a second group byte
        ("FA 81 20 01 00 20 00", 41),
        ("FA 60 B9 00 61 79", 162),  # INS 50 bytes, GNSS2 104 and more for each satellite
        ("FA 49 FF 7F FF 3F FF 3F", 198 + 142 + 142 + 10),
        ("FA 69 FF 7F FF 3F FF 1F FF 3F", 198 + 142 + 262 + 142 + 12),
        ("FA 29 FF 7F 10 02 0C 00", 8 + 198 + 13 + 36 + 2),
    ],
)
def test_headers(header: str, size: int) -> None:
    header_bytes = bytes.fromhex(header)
    assert packet_size(header_bytes) == size
    assert read_header(header_bytes, 0) == header_bytes or not size


def test_layouts_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match="needs one field word per group, got 1"):
        binary_layout(0x06, (1,))
    with pytest.raises(ValueError, match="not the header of a packet of known layout"):
        binary_layout(0x04, (0x2000,))


@st.composite
def layouts(draw: st.DrawFn) -> BinaryLayout:
    """Any layout that a VN-100 can send."""
    numbers = draw(st.sets(st.sampled_from(sorted(FIELD_MASKS)), min_size=1))
    words = []
    for number in sorted(numbers):
        mask = FIELD_MASKS[number]
        bits = [bit for bit in range(16) if mask >> bit & 1]
        words.append(sum(1 << bit for bit in draw(st.sets(st.sampled_from(bits), min_size=1))))
    return binary_layout(sum(1 << number for number in numbers), words)


LIMITS = {"H": 0xFFFF, "I": 0xFFFF_FFFF, "Q": 10 * 365 * 86400 * 10**9}


@settings(deadline=None)
@given(layouts(), st.data())
def test_decoding_inverts_encoding(layout: BinaryLayout, data: st.DataObject) -> None:
    floats = st.floats(-1e6, 1e6, width=32)
    wire = [
        data.draw(floats if code == "f" else st.integers(0, LIMITS[code])) for code in layout.codes
    ]
    values = [number / per_si for number, per_si in zip(wire, layout.per_si, strict=True)]
    packet = encode_packet(layout, values)
    assert len(packet) == layout.size
    assert packet_intact(packet)
    for number, sent, code in zip(layout.unpack(packet), wire, layout.codes, strict=True):
        assert number == pytest.approx(sent, abs=64 if code == "Q" else 0, rel=1e-7)
    (frame,) = Deframer().feed(packet)
    decoded = decode(frame)
    assert isinstance(decoded, Measurement)
    assert decoded.layout is layout
    assert decoded.values == pytest.approx(values, rel=1e-7)


@settings(deadline=None)
@given(st.integers(0, 10 * 365 * 86400 * 1_000_000), st.integers(1, 10**6))
def test_time_differences_are_good_to_a_microsecond_for_ten_years(us: int, step_us: int) -> None:
    layout = binary_layout(0x02, (1,))
    times = []
    for at in (us, us + step_us):
        body = layout.header + struct.pack("<Q", at * 1000)
        times.append(layout.unpack(body)[0] / layout.per_si[0])
    assert times[1] - times[0] == pytest.approx(step_us * 1e-6, abs=2e-7)


def test_fields_are_in_order_and_unpadded() -> None:
    layout = binary_layout(0x15, (0x0001, 0x000C, 0x0014))
    names = [column.name for column in layout.columns]
    assert names[0] == "time_startup_s"
    assert names[1:7] == [
        *(f"uncomp_accel_{axis}_m_s2" for axis in "xyz"),
        *(f"uncomp_gyro_{axis}_rad_s" for axis in "xyz"),
    ]
    assert names[7:] == [
        *(f"quat_{axis}" for axis in "xyzw"),
        *("mag_n_n_gauss", "mag_n_e_gauss", "mag_n_d_gauss"),
    ]


def test_values_that_do_not_fit_are_refused() -> None:
    count = binary_layout(0x02, (0x0080,))
    with pytest.raises(ValueError, match="FA 02 0080 has 1 values, not 2"):
        encode_packet(count, (1, 2))
    for value in (-1, 2**32, math.nan, math.inf):
        with pytest.raises(ValueError, match="FA 02 0080 cannot carry these values"):
            encode_packet(count, (value,))
    with pytest.raises(ValueError, match="cannot carry"):
        encode_packet(binary_layout(0x04, (0x0010,)), (1e39,))
