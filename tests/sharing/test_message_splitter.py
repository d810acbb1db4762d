"""Whole messages for clients: every byte once, in order, without replies, for any chunks."""

from __future__ import annotations

import numpy as np
import pytest
from cabled_units import crc16, sentence

from ahrsd.sharing.share_output import MessageSplitter, is_reply

REPLIES = ["VNRRG,01,VN-100T-CR", "VNWRG,06,0", "VNERR,03", "VNASY,1", "VNWNV", "VNRST", "VNTAR"]
TEXT = sentence("VNYMR,+006.271,+000.031,-002.000,+0.2,-0.1,+0.4,+0.1,-0.2,-9.8,+0.1,+0.2,+0.3")


def packet(values: bytes) -> bytes:
    head = bytes([0xFA, 0x01, 0x01, 0x00]) + values
    return head + crc16(head[1:]).to_bytes(2, "big")


def cut(stream: bytes, rng: np.random.Generator) -> list[bytes]:
    at = np.sort(rng.integers(0, len(stream), size=rng.integers(0, 60)))
    return [stream[a:b] for a, b in zip([0, *at], [*at, len(stream)], strict=True)]


def out(splitter: MessageSplitter, chunk: bytes) -> list[bytes]:
    """As a share does it."""
    ahead = splitter.completed_message(chunk)
    return [*([ahead] if ahead else []), *splitter.feed(chunk)]


def test_completed_message_is_forwarded_early_and_once():
    splitter, one = MessageSplitter(), packet(bytes(range(8)))
    assert splitter.completed_message(TEXT) == b""  # not synchronised yet
    assert splitter.feed(TEXT) == [TEXT]
    for message in (TEXT, one):
        splitter.feed(message)
        assert splitter.completed_message(message) == message
        assert splitter.feed(message) == []
        assert splitter.completed_message(message[:9]) == b""
        assert splitter.feed(message[:9]) == []
        assert splitter.completed_message(message[9:]) == message
        assert splitter.feed(message[9:]) == []
        assert splitter.completed_message(message + message[:1]) == b""  # more than one
        assert splitter.feed(message + message[:1]) == [message]
        splitter.feed(message[1:])


@pytest.mark.parametrize("body", REPLIES)
def test_reply_is_never_forwarded_early(body):
    splitter = MessageSplitter()
    splitter.feed(TEXT)
    assert out(splitter, sentence(body)) == []
    assert out(splitter, TEXT) == [TEXT]
    assert splitter.replies == 1


def test_message_is_forwarded_with_its_last_byte():
    splitter = MessageSplitter()
    assert splitter.feed(TEXT[:-1]) == []
    assert splitter.feed(TEXT[-1:]) == [TEXT]
    one = packet(bytes(range(8)))
    assert splitter.feed(one[:-1]) == []
    assert splitter.feed(one[-1:] + one[:3]) == [one]


@pytest.mark.parametrize("body", REPLIES)
def test_reply_between_messages_is_withheld(body):
    splitter = MessageSplitter()
    assert splitter.feed(TEXT + sentence(body) + TEXT) == [TEXT, TEXT]
    assert splitter.replies == 1
    assert is_reply(body)
    assert not is_reply("VNYMR,1")


def test_damaged_reply_is_forwarded_as_bytes():
    bad = b"$VNRRG,01,VN-100*00\r\n"
    splitter = MessageSplitter()
    assert b"".join(splitter.feed(TEXT + bad + TEXT) + splitter.flush()) == TEXT + bad + TEXT


@pytest.mark.parametrize("seed", range(30))
def test_every_byte_except_replies_is_forwarded_once_in_order(seed):
    rng = np.random.default_rng(seed)
    stream, wanted = b"", b""
    for _ in range(80):
        kind = rng.integers(0, 5)
        if kind == 0:
            stream += sentence(REPLIES[rng.integers(0, len(REPLIES))])
            continue
        noise = rng.integers(0, 256, size=rng.integers(0, 20), dtype=np.uint8).tobytes()
        # a byte that starts a message may absorb the next ones, as on a real line
        harmless = noise.replace(b"\xfa", b"").replace(b"$", b"")
        piece = [TEXT, TEXT, packet(rng.bytes(8)), harmless][kind - 1]
        stream, wanted = stream + piece, wanted + piece
    splitter = MessageSplitter()
    pieces = [piece for chunk in cut(stream, rng) for piece in out(splitter, chunk)]
    assert b"".join(pieces + splitter.flush()) == wanted


@pytest.mark.parametrize("seed", range(10))
def test_messages_do_not_depend_on_the_chunks(seed):
    rng = np.random.default_rng(seed)
    stream = rng.integers(0, 256, size=3000, dtype=np.uint8).tobytes() + TEXT * 3 + rng.bytes(500)
    outs = []
    for _ in range(3):
        splitter = MessageSplitter()
        pieces = [piece for chunk in cut(stream, rng) for piece in out(splitter, chunk)]
        outs.append(b"".join(pieces + splitter.flush()))
    assert outs[0] == outs[1] == outs[2] == stream
