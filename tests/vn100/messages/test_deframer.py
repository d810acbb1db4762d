"""Laws of the deframer: independent of chunks, undamaged messages are found, and bytes add up."""

from __future__ import annotations

import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.vn100.deframer import (
    KEPT_SKIPPED_BYTES,
    LONGEST_LINE,
    Cause,
    Deframer,
    Packet,
    Sentence,
    Skipped,
)
from drivers.vn100.messages import (
    MAX_PACKET_BYTES,
    BinaryLayout,
    binary_layout,
    crc16,
    encode,
    encode_packet,
    encode_sentence,
)

CALIBRATION = binary_layout(0x06, (0x0001, 0x083F))
LAYOUTS = (
    CALIBRATION,
    binary_layout(0x01, (0x0739,)),
    binary_layout(0x02, (0x0001,)),
    binary_layout(0x17, (0x3F3D, 0x0191, 0x1FFF, 0x11FF)),
)
LINE = encode_sentence("VNYPR", (0.1, -0.2, 0.3))
PACKET = encode_packet(CALIBRATION, range(len(CALIBRATION.columns)))


def bodies(frames: list[Sentence | Packet]) -> list[str | bytes]:
    return [frame.data if isinstance(frame, Packet) else frame.body for frame in frames]


def finish(deframer: Deframer) -> list[Sentence | Packet]:
    deframer.drop_pending()
    return deframer.feed(b"")


def check_sums(deframer: Deframer) -> None:
    counters = deframer.counters
    accounted = counters.valid_bytes + counters.skipped_bytes + deframer.pending
    assert counters.fed_bytes == accounted
    assert deframer.pending < MAX_PACKET_BYTES + 30  # behind a packet, a header that is not whole


# ── streams of messages and noise ────────────────────────────────────────────────────────────────

HEADERS = [layout.header for layout in LAYOUTS]
ugly = st.sampled_from(
    [
        b"\xfa",
        b"$",
        b"$V",
        b"$VN",
        b"$VNYPR,",
        b"*60\r\n",
        b"\n",
        b"\r",
        b"$GPVTG,T*00\r\n",
        *HEADERS,
    ]
)
noise = st.lists(st.binary(max_size=12) | ugly, max_size=6).map(b"".join)


@st.composite
def packets(draw: st.DrawFn) -> bytes:
    """A packet of any content, sync bytes and starts of lines included."""
    layout = draw(st.sampled_from(LAYOUTS))
    free = layout.size - len(layout.header) - 2
    content = draw(st.binary(min_size=free, max_size=free) | ugly.map(lambda b: (b * free)[:free]))
    return packet_of(layout, content)


def packet_of(layout: BinaryLayout, content: bytes) -> bytes:
    """A packet with these very bytes behind its header."""
    checked = layout.header[1:] + content.ljust(layout.size - len(layout.header) - 2, b"\0")
    return b"\xfa" + checked + crc16(checked).to_bytes(2, "big")


def nest(inner: bytes) -> bytes:
    """A packet of 110 bytes with another message in the middle."""
    return packet_of(LAYOUTS[1], bytes(20) + inner)


angles = st.tuples(*[st.floats(-3.1, 3.1)] * 3)
sentences = angles.map(lambda values: encode_sentence("VNYPR", values)) | st.sampled_from(
    [encode("VNRRG,08,1,2,3"), encode("VNERR,03", crc=True), encode("VNWNV")]
)
messages = packets() | sentences
nested = (packets() | sentences).filter(lambda inner: len(inner) < 80).map(nest)
streams = st.lists(st.tuples(noise, messages), max_size=6)


def contains_in_order(found: list[str | bytes], wanted: list[str | bytes]) -> bool:
    rest = iter(found)
    return all(any(message == other for other in rest) for message in wanted)


def body_of(message: bytes) -> str | bytes:
    return message[1 : message.index(b"*")].decode() if message[:1] == b"$" else message


@given(streams, noise)
@settings(max_examples=300, deadline=None)
def test_noise_between_messages_loses_none(stream: list[tuple[bytes, bytes]], tail: bytes) -> None:
    deframer = Deframer()
    frames = deframer.feed(b"".join(dirt + message for dirt, message in stream) + tail)
    check_sums(deframer)
    frames += finish(deframer)
    assert contains_in_order(bodies(frames), [body_of(message) for _, message in stream])


mixtures = st.lists(st.tuples(noise, messages | nested), max_size=6)


@given(mixtures, st.randoms(use_true_random=False))
@settings(max_examples=300, deadline=None)
def test_completed_message_is_predicted_correctly(
    stream: list[tuple[bytes, bytes]], rng: random.Random
) -> None:
    """Cut behind each message, or anywhere: what is told before is what comes."""
    deframer = Deframer()
    for dirt, message in stream:
        data = dirt + message
        at = sorted(rng.sample(range(len(data)), min(rng.choice((0, 0, 1, 3)), len(data))))
        for start, stop in zip([0, *at], [*at, len(data)], strict=True):
            told = deframer.completes(data[start:stop])
            frames = deframer.feed(data[start:stop])
            bodies_told = [f.body if isinstance(f, Sentence) else "" for f in frames]
            assert told is None or bodies_told == [told]


def test_completed_message_is_predicted_only_in_sync() -> None:
    deframer = Deframer()
    for message in (PACKET, LINE):
        deframer.feed(message)
        assert deframer.completes(message[:-1]) is None
        body = body_of(message)
        assert deframer.completes(message) == (body if isinstance(body, str) else "")
        assert deframer.completes(message + b"\xfa") is None
        deframer.feed(message[:5])
        assert deframer.completes(message[5:]) == (body if isinstance(body, str) else "")
        deframer.feed(message[5:])
    deframer.feed(b"?")
    assert deframer.completes(PACKET) is None
    deframer.drop_pending()
    assert deframer.completes(PACKET) is None


@given(mixtures, noise, st.randoms(use_true_random=False))
@settings(max_examples=300, deadline=None)
def test_messages_do_not_depend_on_the_chunks(
    stream: list[tuple[bytes, bytes]], tail: bytes, rng: random.Random
) -> None:
    data = b"".join(dirt + message for dirt, message in stream) + tail
    whole, cut, bytewise = Deframer(), Deframer(), Deframer()
    frames = whole.feed(data)
    cut_frames, at = [], 0
    while at < len(data):
        size = rng.choice((1, 3, 17, 64, 300))
        cut_frames += cut.feed(data[at : at + size])
        check_sums(cut)
        at += size
    single = [frame for at in range(len(data)) for frame in bytewise.feed(data[at : at + 1])]
    assert frames == cut_frames == single
    frames += finish(whole)
    assert frames == cut_frames + finish(cut) == single + finish(bytewise)
    assert whole.counters == cut.counters == bytewise.counters
    skipped = whole.take_skipped()
    assert skipped == cut.take_skipped() == bytewise.take_skipped()
    check_record(data, frames, skipped)


def check_record(data: bytes, frames: list[Sentence | Packet], skipped: list[Skipped]) -> None:
    """Messages and skipped pieces, put together by offset, are the stream."""
    parts = [(part.offset, part.data) for part in skipped]
    parts += [(frame.offset, data[frame.offset : frame.offset + frame.length]) for frame in frames]
    assert b"".join(part for _, part in sorted(parts)) == data
    assert all(data[offset : offset + len(part)] == part for offset, part in parts)


@given(
    st.lists(messages, min_size=3, max_size=6),
    st.data(),
    st.sampled_from(["drop", "flip", "insert"]),
)
@settings(max_examples=300, deadline=None)
def test_damage_loses_at_most_one_message(
    stream: list[bytes], data: st.DataObject, kind: str
) -> None:
    victim = data.draw(st.integers(0, len(stream) - 1))
    start = data.draw(st.integers(0, len(stream[victim]) - 1))
    length = data.draw(st.integers(1, len(stream[victim]) - start))
    damaged = bytearray(stream[victim])
    if kind == "drop":
        del damaged[start : start + length]
    elif kind == "flip":
        damaged[start] ^= 1 << length % 8
    else:
        damaged[start:start] = data.draw(st.binary(min_size=1, max_size=20))
    deframer = Deframer()
    frames = deframer.feed(b"".join([*stream[:victim], damaged, *stream[victim + 1 :]]))
    check_sums(deframer)
    frames += finish(deframer)
    wanted = [body_of(message) for place, message in enumerate(stream) if place != victim]
    assert contains_in_order(bodies(frames), wanted)


@settings(deadline=None)
@given(st.binary(max_size=3000), st.booleans())
@example(b"\xfa" * 1000, False)
@example(b"$VN" + b"0" * 2000, False)
@example(b"$VN" + b"0" * 2000, True)
@example(b"\xfa\x17\x3d\x3f\x91\x01\xff\x1f\xff\x11" * 200, False)
@example(b"\xfa\x88\x20\x00\x40\x00\x40\xff" * 200, False)
def test_garbage_is_harmless_and_the_buffer_bounded(data: bytes, host_side: bool) -> None:
    deframer = Deframer(host_side=host_side)
    for at in range(0, len(data), 7):
        deframer.feed(data[at : at + 7])
        check_sums(deframer)
    finish(deframer)
    assert deframer.pending == 0
    check_sums(deframer)


# ── single rules ─────────────────────────────────────────────────────────────────────────────────


def test_messages_follow_each_other() -> None:
    deframer = Deframer()
    frames = deframer.feed(LINE + PACKET + PACKET + LINE)
    offsets = [0, len(LINE), len(LINE) + 64, len(LINE) + 128]
    assert [frame.offset for frame in frames] == offsets
    counters = deframer.counters
    assert (counters.sentences, counters.packets, counters.skipped_bytes) == (2, 2, 0)
    assert frames[1] == Packet(CALIBRATION, PACKET, len(LINE))


def test_single_line_feed_ends_a_line() -> None:
    (frame,) = Deframer().feed(LINE.replace(b"\r", b""))
    assert (bodies([frame]), frame.length) == ([body_of(LINE)], len(LINE) - 1)


def test_bypass_is_for_hosts_only() -> None:
    line = b"$VNRRG,8*XX\r\n"
    assert bodies(Deframer(host_side=True).feed(line)) == ["VNRRG,8"]
    device = Deframer()
    assert device.feed(line) == []
    assert device.counters.damage == {Cause.CHECKSUM: 1}


def test_a_host_sends_no_packets() -> None:
    deframer = Deframer(host_side=True)
    assert bodies(deframer.feed(PACKET + b"$VNWNV*57\r\n")) == ["VNWNV"]
    assert deframer.counters.damage == {}


@pytest.mark.parametrize(("host_side", "longest"), [(False, 320), (True, 256)])
def test_the_longest_line(host_side: bool, longest: int) -> None:
    line = encode("VNRRG," + "0" * (longest - 11))
    assert len(line) == longest + 1
    deframer = Deframer(host_side=host_side)
    assert deframer.feed(line) == []
    assert deframer.counters.damage == {Cause.TOO_LONG: 1}
    assert deframer.take_skipped()[0] == Skipped(0, line[:longest], Cause.TOO_LONG)
    (frame,) = deframer.feed(encode("VNRRG," + "0" * (longest - 12)))
    assert frame.length == longest


def test_other_devices_sentences_are_noise() -> None:
    deframer = Deframer()
    foreign = b"$GPVTG,,T,,M,0.02,N*33\r\n"
    assert bodies(deframer.feed(foreign + LINE + foreign)) == [body_of(LINE)]
    assert deframer.counters.rejected == 0
    assert [part.cause for part in deframer.take_skipped()] == [Cause.NOISE, Cause.NOISE]


def test_two_merged_lines_are_one_rejection() -> None:
    deframer = Deframer()
    merged = LINE[:20] + LINE[12:]
    assert bodies(deframer.feed(LINE + merged + LINE)) == [body_of(LINE)] * 2
    assert deframer.counters.rejected == 1
    assert deframer.take_skipped() == [Skipped(len(LINE), merged, Cause.CHECKSUM)]


def test_a_line_broken_off_by_another_is_one_rejection() -> None:
    deframer = Deframer()
    assert bodies(deframer.feed(LINE[:9] + LINE)) == [body_of(LINE)]
    assert deframer.counters.damage == {Cause.BROKEN: 1}
    assert deframer.take_skipped() == [Skipped(0, LINE[:9], Cause.BROKEN)]


def test_false_long_header_does_not_delay_packets() -> None:
    """Each packet comes out with its last byte although the false one still waits."""
    long_header = LAYOUTS[3].header
    deframer = Deframer()
    assert deframer.feed(long_header) == []
    for number in range(4):
        assert deframer.feed(PACKET[:-1]) == []
        (frame,) = deframer.feed(PACKET[-1:])
        assert frame.offset == len(long_header) + 64 * number
    assert deframer.counters.damage == {Cause.OVERTAKEN: 1}
    assert deframer.take_skipped() == [Skipped(0, long_header, Cause.OVERTAKEN)]


SHORT = encode_packet(LAYOUTS[2], (12.5,))
FIRST = encode_packet(LAYOUTS[1], [1] * len(LAYOUTS[1].columns))


def test_packet_with_a_known_header_is_awaited() -> None:
    """Behind a message, a whole packet that another one has as content is not taken for one."""
    assert bodies(Deframer().feed(FIRST + nest(SHORT))) == [FIRST, nest(SHORT)]


@pytest.mark.parametrize("size", [1, 500])
def test_out_of_sync_the_message_that_ends_first_wins(size: int) -> None:
    deframer = Deframer()
    data = nest(SHORT) + FIRST
    frames = [f for at in range(0, len(data), size) for f in deframer.feed(data[at : at + size])]
    assert bodies(frames) == [SHORT, FIRST]
    assert deframer.counters.damage == {Cause.OVERTAKEN: 1}


@pytest.mark.parametrize("size", [1, 500])
def test_a_failed_packet_is_searched_and_counted_once(size: int) -> None:
    """Its CRC was awaited, so the CRC is the cause, although the message inside ended before."""
    deframer = Deframer()
    damaged = nest(SHORT)[:-1] + b"\0"
    data = FIRST + damaged + FIRST
    frames = [f for at in range(0, len(data), size) for f in deframer.feed(data[at : at + size])]
    assert bodies(frames) == [FIRST, SHORT, FIRST]
    assert deframer.counters.damage == {Cause.CRC: 1}
    start = len(FIRST) + damaged.index(SHORT)
    assert deframer.take_skipped() == [
        Skipped(len(FIRST), data[len(FIRST) : start], Cause.CRC),
        Skipped(start + len(SHORT), data[start + len(SHORT) : -len(FIRST)], Cause.NOISE),
    ]


@pytest.mark.parametrize("size", [1, 500])
def test_a_refused_packet_that_ends_in_a_sync_byte_is_one_piece(size: int) -> None:
    deframer = Deframer()
    refused = SHORT[:-2] + b"\0\xfa"
    data = PACKET + refused + LINE
    frames = [f for at in range(0, len(data), size) for f in deframer.feed(data[at : at + size])]
    assert bodies(frames) == [PACKET, body_of(LINE)]
    assert deframer.take_skipped() == [Skipped(len(PACKET), refused, Cause.CRC)]


def test_silence_discards_a_partial_message() -> None:
    deframer = Deframer()
    assert len(deframer.feed(PACKET + PACKET[:40])) == 1
    assert deframer.pending == 40
    assert finish(deframer) == []
    assert deframer.counters.damage == {Cause.CUT: 1}
    assert deframer.counters.rejected == 0
    assert bodies(deframer.feed(PACKET[40:] + PACKET)) == [PACKET]


def test_silence_delivers_messages_hidden_in_a_truncated_packet() -> None:
    deframer = Deframer()
    assert bodies(deframer.feed(PACKET + PACKET[:10] + LINE)) == [PACKET]
    assert bodies(finish(deframer)) == [body_of(LINE)]
    assert deframer.counters.damage == {Cause.OVERTAKEN: 1}


def test_several_packet_layouts_in_turn() -> None:
    made = [encode_packet(layout, [1] * len(layout.columns)) for layout in LAYOUTS]
    deframer = Deframer()
    assert bodies(deframer.feed(b"".join(made * 3))) == made * 3
    assert deframer.counters.skipped_bytes == 0


def test_skipped_bytes_are_kept_within_bounds() -> None:
    deframer = Deframer()
    for _ in range(100):
        deframer.feed(b"\x01" * 4096)
    kept = sum(len(part.data) for part in deframer.take_skipped())
    assert KEPT_SKIPPED_BYTES <= kept <= KEPT_SKIPPED_BYTES + 2 * 4096
    assert deframer.counters.skipped_bytes == 409600
    deframer.feed(b"\x02" * 500_000)
    assert deframer.take_skipped() == [Skipped(409600, b"\x02" * 500_000, Cause.NOISE)]
    assert deframer.take_skipped() == []


def test_longest_line_of_the_manual_is_accepted() -> None:
    body = "VNRRG,23," + ",".join(["-1.234567E-05"] * 12)
    assert len(encode(body)) < LONGEST_LINE
    assert bodies(Deframer().feed(encode(body))) == [body]
