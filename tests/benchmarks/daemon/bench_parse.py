"""How fast bytes become values: `python tests/benchmarks/daemon/bench_parse.py`.

Messages per second of processor time on one core, and the ratio to a bound that is measured in the
same run: the checks and number conversions alone, over the same messages, already cut apart.
"""

from __future__ import annotations

import random
import struct
import time
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass

from drivers.vn100.decode import decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import MESSAGES, binary_layout, encode_packet, encode_sentence

CALIBRATION = binary_layout(0x06, (0x0001, 0x083F))  # 64 bytes
CHUNK_BYTES = 4096
REPEATS = 5


@dataclass(frozen=True)
class Result:
    """Messages per second, and time over the bound's time."""

    name: str
    per_second: float
    ratio: float

    def __str__(self) -> str:
        return f"{self.name:24} {self.per_second:12,.0f} /s    {self.ratio:5.2f} x the bound"


def sentences(count: int) -> list[bytes]:
    rng = random.Random(1)
    width = len(MESSAGES["VNYMR"].columns)
    return [
        encode_sentence("VNYMR", [rng.uniform(-3, 3) for _ in range(width)]) for _ in range(count)
    ]


def packets(count: int) -> list[bytes]:
    rng = random.Random(2)
    made = []
    for number in range(count):
        values = [0.01 * number, 0, *(rng.uniform(-9, 9) for _ in range(11)), 0]
        made.append(encode_packet(CALIBRATION, values))
    return made


def chunks(messages: list[bytes]) -> list[bytes]:
    stream = b"".join(messages)
    return [stream[at : at + CHUNK_BYTES] for at in range(0, len(stream), CHUNK_BYTES)]


def seconds(work: Callable[[], int], count: int) -> float:
    """Least processor time of some runs of `work`, each of which must yield `count` messages."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        assert work() == count
        times.append(time.process_time() - start)
    return min(times)


def parse(pieces: list[bytes]) -> int:
    deframer = Deframer()
    return sum(len([decode(frame) for frame in deframer.feed(piece)]) for piece in pieces)


def bound_sentences(messages: list[bytes]) -> int:
    total = 0
    for message in messages:
        body = message[1:-5]
        total += len(list(map(float, body.split(b",")[1:]))) // 12 * (crc_hqx(body, 0) >= 0)
    return total


def bound_packets(messages: list[bytes]) -> int:
    unpack = struct.Struct("<QH11fH").unpack_from
    return sum(
        crc_hqx(message, 0xFA00) == 0 and len(unpack(message, 6)) > 0 for message in messages
    )


def measure(count: int) -> tuple[Result, Result]:
    """Sentences and packets: bytes in chunks to SI values."""
    results = []
    for name, make, bound in (
        ("VNYMR sentences", sentences, bound_sentences),
        ("64-byte packets", packets, bound_packets),
    ):
        messages = make(count)
        pieces = chunks(messages)
        ours = seconds(lambda pieces=pieces: parse(pieces), count)
        least = seconds(lambda messages=messages, bound=bound: bound(messages), count)
        results.append(Result(name, count / ours, ours / least))
    return results[0], results[1]


if __name__ == "__main__":
    for result in measure(20_000):
        print(result)
