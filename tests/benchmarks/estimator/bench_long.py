"""What a sample costs, and what memory is held, after 10^4 and after 10^7 samples.

    nice -n 19 python tests/benchmarks/estimator/bench_long.py        # 10^7 samples: 111 h at 25 Hz
    python tests/benchmarks/estimator/bench_long.py --samples 300000

The stream is made as it goes, in blocks of 1000; making it is not counted. Cost is processor time
per sample: of the first 10,000, then of every tenth of the run. Memory is the resident set.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_estimator import FIELD_N_GAUSS, GYRO_BIAS_RAD_S, SOFT_IRON, _rotation_vectors, rotation

from ahrsd.estimator.online import Estimator
from ahrsd.samples import Array, SampleBlock

RATE_HZ = 25.0
BLOCK = 1000
PARTS = 2  # of a step, between which the rotation is exact
HALF_RANGE_RAD = np.radians([5.0, 45.0, 180.0])
FREQUENCY_HZ = np.array([0.11, 0.04, 0.015])
FIRST = 10_000


@dataclass(frozen=True)
class Point:
    """State after so many samples: cost of the samples since the last point, and memory."""

    samples: int
    cost_us: float
    resident_mb: float

    def __str__(self) -> str:
        return (
            f"{self.samples:>10,d} samples  {self.cost_us:6.1f} us each  {self.resident_mb:7.2f} MB"
        )


def block(start: int, rng: np.random.Generator) -> SampleBlock:
    """Samples start .. start + BLOCK of an endless motion."""
    fine = (np.arange(BLOCK * PARTS + 1) / PARTS + start) / RATE_HZ
    angles = HALF_RANGE_RAD * np.sin(2 * np.pi * FREQUENCY_HZ * fine[:, None])
    R = rotation(angles)
    turn = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    rate = _rotation_vectors(turn).reshape(BLOCK, PARTS, 3).sum(axis=1) * RATE_HZ
    R = R[PARTS::PARTS]
    field = np.einsum("nji,j->ni", R, FIELD_N_GAUSS) @ SOFT_IRON
    time_s = fine[PARTS::PARTS]
    dt_s = np.full(BLOCK, 1 / RATE_HZ)
    if start == 0:
        dt_s[0] = np.nan
    return SampleBlock(
        time_s=time_s,
        dt_s=dt_s,
        host_s=time_s,
        raw_b_gauss=field + [0.04, 0.11, 0.11] + rng.normal(size=(BLOCK, 3)) * 1e-3,
        gyro_b_rad_s=rate + GYRO_BIAS_RAD_S + rng.normal(size=(BLOCK, 3)) * 5e-3,
        accel_b_m_s2=np.einsum("nji,j->ni", R, np.array([0.0, 0.0, -9.8])),
        gap_before=start == 0,
    )


def resident_mb() -> float:
    """Resident memory now."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


def measure(
    samples: int, seen: Callable[[Point], None] = lambda _: None
) -> tuple[list[Point], Array]:
    """Points at 10^4 and at every tenth of `samples`, given to `seen` as they come; error of the
    hard iron at the end, gauss.
    """
    rng = np.random.default_rng(0)
    estimator = Estimator()
    points: list[Point] = []
    spent = since = 0.0
    last = 0
    tenths = {FIRST, *(samples * k // 10 // BLOCK * BLOCK for k in range(1, 11))}
    for start in range(0, samples, BLOCK):
        made = block(start, rng)
        began = time.process_time()
        for k in range(0, BLOCK, 50):
            estimator.add(_part(made, k))
        spent += time.process_time() - began
        if start + BLOCK in tenths:
            cost = (spent - since) / (start + BLOCK - last) * 1e6
            points.append(Point(start + BLOCK, cost, resident_mb()))
            seen(points[-1])
            last, since = start + BLOCK, spent
    estimate = estimator.estimate()
    assert estimate is not None
    return points, estimate.hard_iron_gauss - [0.04, 0.11, 0.11]


def _part(made: SampleBlock, k: int) -> SampleBlock:
    rows = slice(k, k + 50)
    return SampleBlock(
        made.time_s[rows],
        made.dt_s[rows],
        made.host_s[rows],
        made.raw_b_gauss[rows],
        made.gyro_b_rad_s[rows],
        made.accel_b_m_s2[rows],
        gap_before=made.gap_before and k == 0,
    )


def _say(point: Point) -> None:
    sys.stdout.write(f"{point}\n")
    sys.stdout.flush()


def main() -> None:
    """Print the points, the ratio and the growth."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    points, error = measure(parser.parse_args().samples, _say)
    sys.stdout.write(
        f"cost at the end over that of the first {FIRST:,d}: "
        f"{points[-1].cost_us / points[0].cost_us:.2f}; memory since {points[1].samples:,d}: "
        f"{points[-1].resident_mb - points[1].resident_mb:+.2f} MB; "
        f"hard iron error {1e3 * float(np.linalg.norm(error)):.3f} mG\n"
    )


if __name__ == "__main__":
    main()
