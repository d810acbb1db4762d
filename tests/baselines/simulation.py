"""The thesis' experiment, written again here so that the methods are judged independently."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ahrsd.baselines import MethodData
from ahrsd.samples import Array, SampleBlock

SOFT_IRON = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
UNIT_SOFT_IRON = SOFT_IRON / np.cbrt(np.linalg.det(SOFT_IRON))
HARD_IRON = SOFT_IRON @ np.array([0.020, 0.120, 0.090])  # b = A m_b
GYRO_BIAS = np.array([4e-3, -5e-3, 2e-3])
FIELD = np.array([0.227, 0.052, 0.412])
HALF_RANGE_DEG = {"wam": (180, 180, 180), "mam": (5, 45, 180), "lam": (5, 15, 90)}


@dataclass(frozen=True)
class Run:
    """Samples and the true field in the sensor frame (N, 3)."""

    data: MethodData
    field_b: Array


def simulate(
    kind: str = "wam",
    seed: int = 0,
    *,
    n: int = 10_000,
    rate_hz: float = 25.0,
    sigma_mag: float = 1e-3,
    sigma_gyro: float = 5e-3,
    soft_iron: Array = UNIT_SOFT_IRON,
    hard_iron: Array = HARD_IRON,
    gyro_bias: Array = GYRO_BIAS,
    faster: float = 1.0,
) -> Run:
    """Slow motion (5-10, 5-8, 4-8 mHz times `faster`), or kind "planar" or "static"."""
    rng = np.random.default_rng(seed)
    t = np.arange(n + 1) / rate_hz
    if kind in HALF_RANGE_DEG:
        f = rng.uniform([5e-3, 5e-3, 4e-3], [10e-3, 8e-3, 8e-3]) * faster
        phase = rng.uniform(0, 2 * np.pi, 3)
        angles = np.radians(HALF_RANGE_DEG[kind]) * np.sin(2 * np.pi * f * t[:, None] + phase)
    else:
        angles = np.tile([0.01, -0.02, 1.0], (n + 1, 1))
        angles[:, 2] += 0.3 * t if kind == "planar" else 0.0
    R = Rotation.from_euler("ZYX", angles[:, ::-1])  # R_nb
    rate = (R[:-1].inv() * R[1:]).as_rotvec() * rate_hz
    field = R[1:].inv().apply(FIELD)
    data = MethodData(
        time_s=t[1:],
        dt_s=np.full(n, 1 / rate_hz),
        raw_b_gauss=field @ soft_iron.T + hard_iron + sigma_mag * rng.normal(size=(n, 3)),
        gyro_b_rad_s=rate + gyro_bias + sigma_gyro * rng.normal(size=(n, 3)),
        R_nb=R[1:].as_matrix(),
        field_n_gauss=FIELD,
        field_norm_gauss=float(np.linalg.norm(FIELD)),
    )
    return Run(data, field)


def clean(kind: str = "wam", seed: int = 0, **changes: object) -> Run:
    """Without noise, and sampled so densely that a difference quotient is the derivative."""
    settings: dict[str, object] = {
        "n": 8000, "rate_hz": 100.0, "sigma_mag": 0.0, "sigma_gyro": 0.0, "faster": 5.0
    }  # fmt: skip
    return simulate(kind, seed, **(settings | changes))  # type: ignore[arg-type]


def blocks(
    data: MethodData, sizes: tuple[int, ...], gaps: tuple[int, ...] = ()
) -> list[SampleBlock]:
    """The samples cut into blocks of these sizes; those of index in `gaps` come after a gap."""
    edges = np.cumsum([0, *sizes])
    assert edges[-1] == len(data)
    cut = []
    for i, (a, b) in enumerate(pairwise(edges)):
        cut.append(
            SampleBlock(
                time_s=data.time_s[a:b],
                dt_s=data.dt_s[a:b],
                host_s=data.time_s[a:b],
                raw_b_gauss=data.raw_b_gauss[a:b],
                gyro_b_rad_s=data.gyro_b_rad_s[a:b],
                accel_b_m_s2=np.full((b - a, 3), np.nan),
                gap_before=i in gaps or i == 0,
            )
        )
    return cut
