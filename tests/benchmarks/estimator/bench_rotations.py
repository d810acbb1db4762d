"""Rotations by ahrsd.so3 beside scipy's: `python tests/benchmarks/estimator/bench_rotations.py`.

For 16, 512 and 20,000 rows, the time of scipy over ours and the largest difference of the results.
"""

from __future__ import annotations

import timeit

import numpy as np
from scipy.spatial.transform import Rotation

from ahrsd import so3

ROWS = (16, 512, 20_000)
CALLS, REPEATS = 20_000, 5


def seconds(function, rows: int) -> float:
    number = max(1, CALLS // rows)
    return min(timeit.repeat(function, number=number, repeat=REPEATS)) / number


def compared(rows: int) -> None:
    rng = np.random.default_rng(0)
    phi, angles = 0.3 * rng.normal(size=(rows, 3)), rng.uniform(-1.5, 1.5, (rows, 3))
    R = so3.exp(phi)
    for name, ours, theirs in (
        ("Exp", lambda: so3.exp(phi), lambda: Rotation.from_rotvec(phi).as_matrix()),
        ("Log", lambda: so3.log(R), lambda: Rotation.from_matrix(R).as_rotvec()),
        (
            "yaw, pitch, roll",
            lambda: so3.from_yaw_pitch_roll(*angles.T),
            lambda: Rotation.from_euler("ZYX", angles).as_matrix(),
        ),
    ):
        ratio = seconds(theirs, rows) / seconds(ours, rows)
        apart = np.max(np.abs(theirs() - ours()))
        print(f"{name:18} {rows:6,} rows   scipy / ours {ratio:6.2f}   apart {apart:.1e}")


if __name__ == "__main__":
    for rows in ROWS:
        compared(rows)
