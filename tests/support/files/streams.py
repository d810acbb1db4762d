"""Byte streams of the emulated device, made without a port; bytes cut at random."""

from __future__ import annotations

import gzip
import random
from collections.abc import Iterator, Sequence
from pathlib import Path

from ahrsd.inputs import Input, Received, Stop
from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import TICK_HZ, draw_truth, make_motion
from drivers.vn100.emulator.scenarios import CALIBRATION_SET
from drivers.vn100.messages import encode


def emitted(device: Emulator, seconds: float, commands: Sequence[tuple[float, str]] = ()) -> bytes:
    """What the device sends within `seconds`; commands are (when, body)."""
    sent, todo = bytearray(), list(commands)
    for step in range(round(seconds * 20)):
        now_s = (step + 1) / 20
        if todo and todo[0][0] <= now_s:
            device.receive(encode(todo.pop(0)[1]), now_s)
        sent += device.advance(now_s)
    return bytes(sent)


def content(path: Path) -> bytes:
    """A recording's bytes, unzipped where it is gzip."""
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        return file.read()


def cut(
    data: bytes, seed: int, sizes: Sequence[int] = (1, 2, 7, 61, 122, 999, 20000)
) -> list[bytes]:
    """The same bytes in chunks of random sizes."""
    dice, pieces, at = random.Random(seed), [], 0
    while at < len(data):
        size = dice.choice(sizes)
        pieces.append(data[at : at + size])
        at += size
    return pieces


def inputs(pieces: Sequence[bytes]) -> Iterator[Input]:
    """What the core is given for them."""
    for piece in pieces:
        yield Received(0, piece)
    yield Stop(0, "end of recording")


def binary_device(
    seed: int, registers: dict[int, tuple[float, ...]], motion: str = "tumble"
) -> Emulator:
    """A device with these registers in flash that sends the calibration set at 40 Hz."""
    output = {5: (115200,), 6: (0,), 75: (1, TICK_HZ // 40, *CALIBRATION_SET)}
    motions = make_motion(motion, seed)
    return Emulator(draw_truth(seed), motions, seed=seed, presets={**output, **registers})
