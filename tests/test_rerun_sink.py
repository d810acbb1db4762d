"""The sink: nothing that happens to the viewer, its process or its disk reaches the caller."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.events import (
    Estimated,
    Event,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.samples import SampleBlock

RATE_HZ = 100.0
FIELD_GAUSS = 0.48
A = np.array([[1.16, 0.07, -0.03], [0.07, 0.92, 0.05], [-0.03, 0.05, 0.95]])
A = A / np.cbrt(np.linalg.det(A))
B_GAUSS = np.array([0.21, -0.13, 0.16])
GYRO_BIAS = np.array([0.004, -0.006, 0.003])


def exponential(v: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(v)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    if angle < 1e-12:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)


def simulated(seconds: float, seed: int = 1) -> SampleBlock:
    """A vehicle that turns and rocks, as the sensor with its iron and bias reads it."""
    rng = np.random.default_rng(seed)
    time_s = 12.0 + np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    t = time_s - time_s[0]
    rate = np.stack(
        [0.55 * np.cos(0.9 * t), 0.5 * np.sin(0.63 * t + 1.0), 0.35 + 0.3 * np.sin(0.11 * t)], 1
    )
    R_nb, field = np.eye(3), []
    for w in rate:
        R_nb = R_nb @ exponential(w / RATE_HZ)
        field.append(R_nb.T @ np.array([0.2, 0.02, 0.436]))
    h = np.array(field) / 0.48 * FIELD_GAUSS
    raw = h @ A.T + B_GAUSS + rng.normal(0, 0.0016, h.shape)
    gyro = rate + GYRO_BIAS + rng.normal(0, 0.002, rate.shape)
    nan = np.full_like(h, np.nan)
    return SampleBlock(time_s, np.full(len(t), 1 / RATE_HZ), 5000.0 + t * 1.00002, raw, gyro, nan)


def part(block: SampleBlock, rows: slice) -> SampleBlock:
    return SampleBlock(
        block.time_s[rows],
        block.dt_s[rows],
        block.host_s[rows],
        block.raw_b_gauss[rows],
        block.gyro_b_rad_s[rows],
        block.accel_b_m_s2[rows],
    )


def estimate_after(seconds: float, rng: np.random.Generator) -> Estimate:
    """An estimate whose error and sigma shrink as 1/sqrt(time)."""
    scale = np.r_[np.full(6, 0.35), np.full(3, 0.12), np.full(3, 0.003)] / (0.2 + seconds)
    scale += np.r_[np.full(6, 0.0015), np.full(3, 0.0005), np.full(3, 0.0001)]
    error = scale * rng.normal(0, 1, 12) * 0.7
    soft = np.zeros((3, 3))
    soft[np.triu_indices(3)] = A[np.triu_indices(3)] + error[:6]
    soft = soft + np.triu(soft, 1).T
    heading = 0.25 + 40.0 / (1.0 + seconds)
    return Estimate(
        soft_iron=soft,
        hard_iron_gauss=B_GAUSS + error[6:9],
        gyro_bias_rad_s=GYRO_BIAS + error[9:],
        field_gauss=FIELD_GAUSS,
        field_known=False,
        covariance=np.diag(scale**2),
        noise_mag_gauss=0.0016,
        noise_gyro_rad_s=0.002,
        misfit=1.02,
        heading_sigma_deg=heading,
        observability=Observability(np.linspace(0.01, 0.3, 12), (), seconds / 40.0),
        samples=int(seconds * RATE_HZ),
        duration_s=seconds,
        converged=heading < 1.0,
    )


def judged_after(seconds: float, at_s: float, host_s: float, heading: float) -> Judged:
    def gate(name: str, value: float, limit: float, ok: bool, unit: str, advice: str) -> GateResult:
        return GateResult(name, value, limit, ok, at_s, unit, advice)

    turn = min(360.0, seconds * 9.0)
    return Judged(
        at_s,
        host_s,
        (
            gate("stream health", 2e-4, 1e-3, True, "", "check the cable and the baud rate"),
            gate("input basis", 6, 6, True, "registers", "let the daemon read registers"),
            gate("motion", turn, 280.0, turn >= 280.0, "deg", "drive a full turn"),
            gate(
                "observability", seconds / 40, 1.0, seconds >= 40, "", "roll and pitch by 30 deg"
            ),
            gate("heading sigma", heading, 1.0, heading <= 1.0, "deg", "keep turning"),
            gate("field strength", 1.4, 2.0, True, "%", "move away from steel"),
            gate(
                "held-out heading",
                30 / (5 + seconds),
                0.5,
                seconds > 55,
                "deg",
                "one more turn, in the other direction",
            ),
            gate("second opinion", 0.4, 2.0, seconds > 20, "deg", "wait for the ellipsoid fit"),
            gate("bounds", 1.27, 2.0, True, "", "an operator must approve"),
        ),
    )


STORY = (
    (0.5, "OBSERVING", "CANDIDATE", "first estimate"),
    (56.0, "CANDIDATE", "QUALIFIED", "all gates ok for 1 s"),
    (58.0, "QUALIFIED", "STAGED", "register 23 and 84 written to RAM and read back"),
    (60.0, "STAGED", "TRIAL", "proving it on live data"),
    (80.0, "TRIAL", "PROVEN", "heading error 0.3 deg on 20 s of live data, 23.1 before"),
)


def simulated_events(seconds: float = 90.0, rows: int = 10) -> Iterator[Event]:
    """What the core would say while a calibration converges, is written and is proven."""
    rng = np.random.default_rng(7)
    block = simulated(seconds)
    story = list(STORY)
    present, proposed = Affine.identity(), None
    yield Noted(12.0, 5000.0, "info", "VN-100, firmware 2.1, serial 0100012345")
    for k in range(0, len(block), rows):
        here = part(block, slice(k, k + rows))
        at_s, host_s = float(here.time_s[-1]), float(here.host_s[-1])
        yield SamplesSeen(here, present, proposed)
        if k % 100 == 90:
            estimate = estimate_after((k + rows) / RATE_HZ, rng)
            proposed = estimate.correction
            yield Estimated(at_s, host_s, estimate)
            yield judged_after(k / RATE_HZ, at_s, host_s, estimate.heading_sigma_deg)
        while story and k / RATE_HZ >= story[0][0]:
            _, old, new, reason = story.pop(0)
            yield StateChanged(at_s, host_s, old, new, reason)
            if new == "STAGED" and proposed is not None:
                before = present.to_register()
                present = proposed
                yield RegisterWritten(
                    at_s, host_s, 23, before, present.to_register(), "written and read back equal"
                )
        if k == 3300:
            yield Noted(at_s, host_s, "warning", "gap of 0.31 s in the stream")
