"""The rate of a byte stream that carries no time, from the physics in it.

The device's own attitude turns between two messages by the angle |log(R_k^T R_(k+1))|, and the gyro
says the mean rate; their ratio is the time between them. The median over the messages that turned
enough is robust against the filter's corrections, against lost messages and against noise.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer

_LEAST_RATE_RAD_S = 0.1
_LEAST_MESSAGES = 200
_WANTED_MESSAGES = 20000
_SPAN = 8  # messages per pair: quantisation of the printed angles matters less over several
_USUAL_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 80, 100, 200, 400, 800)
_SNAP = 0.04
_ATTITUDE = ("yaw_rad", "pitch_rad", "roll_rad")
_GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")


def rate_from_attitude(ypr_rad: Array, gyro_rad_s: Array) -> float | None:
    """Hz of a stream of (N, 3) yaw, pitch, roll and (N, 3) rates; None where nothing turned.

    A rate within 4 % of one that the device offers is that rate.
    """
    R = _rotations(ypr_rad)
    turned = np.linalg.norm(so3.log(np.swapaxes(R[:-_SPAN], 1, 2) @ R[_SPAN:]), axis=1)
    window = np.lib.stride_tricks.sliding_window_view(gyro_rad_s[1:], _SPAN, axis=0)
    speed = np.linalg.norm(window.mean(axis=2), axis=1)[: len(turned)]
    good = (speed > _LEAST_RATE_RAD_S) & (turned < 2.0)
    if np.count_nonzero(good) < _LEAST_MESSAGES:
        return None
    dt_s = float(np.median(turned[good] / speed[good])) / _SPAN
    rate = 1.0 / dt_s
    nearest = min(_USUAL_HZ, key=lambda hz: abs(np.log(hz / rate)))
    return float(nearest) if abs(nearest / rate - 1) < _SNAP else rate


def rate_of(chunks: Iterable[bytes]) -> tuple[float, str] | None:
    """Rate and how it was found, for bytes whose messages carry attitude, rate and no time.

    None where the messages carry time, or nothing turned enough.
    """
    deframer = Deframer()
    rows: list[tuple[float, ...]] = []
    columns: list[int] | None = None
    for chunk in chunks:
        for frame in deframer.feed(chunk):
            event = decode(frame)
            if not isinstance(event, Measurement):
                continue
            if columns is None:
                names = [column.name for column in event.layout.columns]
                if "time_startup_s" in names:
                    return None
                if not all(name in names for name in (*_ATTITUDE, *_GYRO)):
                    continue
                columns = [names.index(name) for name in (*_ATTITUDE, *_GYRO)]
                layout = event.layout
            if event.layout is layout:
                rows.append(tuple(event.values[k] for k in columns))
        if len(rows) >= _WANTED_MESSAGES:
            break
    if len(rows) < _LEAST_MESSAGES + _SPAN:
        return None
    table = np.array(rows)
    rate = rate_from_attitude(table[:, :3], table[:, 3:])
    return None if rate is None else (rate, "from the device's attitude against its rate")


def _rotations(ypr_rad: Array) -> Array:
    """R_nb of yaw, pitch, roll (3-2-1)."""
    y, p, r = ypr_rad.T
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
