"""Columns next to each other, so that many pass the filter at once; zeros on no side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.values import Columns


def batches(columns: Sequence[Columns], most: int) -> list[list[int]]:
    """Numbers of the columns, those of one side together, no more than `most` wide if possible."""
    out: list[list[int]] = []
    sides = [(part.mag is None, part.gyro is None) for part in columns]
    for side in dict.fromkeys(sides):
        room = 0
        for number in (k for k, one in enumerate(sides) if one == side):
            width = columns[number].width
            if room == 0 or width > room:
                out.append([])
                room = most
            out[-1].append(number)
            room = max(0, room - width)
    return out


def joined(parts: Sequence[Columns]) -> Columns:
    """Columns of one batch next to each other."""
    if len(parts) == 1:
        return parts[0]
    mag = [part.mag for part in parts if part.mag is not None]
    gyro = [part.gyro for part in parts if part.gyro is not None]
    return Columns(
        np.concatenate(mag, axis=2) if mag else None,
        np.concatenate(gyro, axis=2) if gyro else None,
    )
