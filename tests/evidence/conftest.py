"""A small world for the tests of the evidence: attitude, field, iron and gravity, without the
emulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.evidence import BasisFacts, Evidence, EvidenceCollector, HealthFacts
from ahrsd.samples import SampleBlock

GRAVITY = 9.81
DIP = np.radians(60.0)
FIELD_N = 0.5 * np.array([np.cos(DIP), 0.0, np.sin(DIP)])
SOFT = np.array([[1.08, 0.05, 0.02], [0.05, 0.95, -0.03], [0.02, -0.03, 1.0]])
SOFT = SOFT / np.cbrt(np.linalg.det(SOFT))
HARD = np.array([0.08, -0.05, 0.12])
BIAS = np.array([0.004, -0.005, 0.002])
HEALTHY = HealthFacts(0.0, 0.0, 0, 0, 40.0)
SOUND = BasisFacts(True, False, False, False, True)


@dataclass
class Scene:
    """Degrees and seconds. Rest at both ends; between them turns of `turn_s` and oscillating
    tilt.
    """

    duration_s: float = 330.0
    rest_s: float = 12.0
    rate_hz: float = 40.0
    turn_s: float = 20.0
    heading_span_deg: float = 360.0  # less than 360: back and forth within it
    roll_deg: float = 35.0
    pitch_deg: float = 35.0
    noise_gauss: float = 0.0005
    noise_rad_s: float = 0.0005
    accel: bool = True
    temperature_c: float | None = 25.0
    forward_m_s2: float = 0.0  # amplitude of the vehicle's own acceleration
    hard: np.ndarray = field(default_factory=HARD.copy)
    magnet: Callable[[np.ndarray], np.ndarray] | None = None  # (N,) times to (N, 3) extra gauss
    seed: int = 1

    def times(self) -> np.ndarray:
        return np.arange(round(self.duration_s * self.rate_hz)) / self.rate_hz

    def attitude(self, t: np.ndarray) -> Rotation:
        u = np.clip(t - self.rest_s, 0.0, self.duration_s - 2 * self.rest_s)
        if self.heading_span_deg >= 360.0:
            heading = 360.0 * u / self.turn_s
        else:
            heading = 0.5 * self.heading_span_deg * np.sin(2 * np.pi * u / self.turn_s)
        roll = self.roll_deg * np.sin(2 * np.pi * u / 7.3)
        pitch = self.pitch_deg * np.sin(2 * np.pi * u / 11.9)
        return Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]), degrees=True)

    def block(self) -> SampleBlock:
        """The whole drive as one block."""
        rng = np.random.default_rng(self.seed)
        t = self.times()
        R = self.attitude(t)
        n, dt = len(t), 1.0 / self.rate_hz
        turn = (R[:-1].inv() * R[1:]).as_rotvec() / dt
        gyro = np.vstack([turn[:1], turn]) + BIAS + self.noise_rad_s * rng.standard_normal((n, 3))
        h_b = R.inv().apply(FIELD_N)
        mag = h_b @ SOFT.T + self.hard + self.noise_gauss * rng.standard_normal((n, 3))
        if self.magnet is not None:
            mag = mag + self.magnet(t)
        own = self.forward_m_s2 * np.sin(2 * np.pi * t / 5.0)[:, None] * np.array([1.0, 0.3, 0.0])
        own[t < self.rest_s] = own[t > t[-1] - self.rest_s] = 0.0
        force = R.inv().apply(own - np.array([0.0, 0.0, GRAVITY]))
        force = force + 0.005 * rng.standard_normal((n, 3))
        dt_s = np.full(n, dt)
        dt_s[0] = np.nan
        extra = {} if self.temperature_c is None else {"temperature_c": 0 * t + self.temperature_c}
        accel = force if self.accel else np.full((n, 3), np.nan)
        return SampleBlock(t, dt_s, t + 100.0, mag, gyro, accel, extra, 0, True)


def truth() -> Affine:
    return Affine(np.linalg.inv(SOFT), HARD)


def estimate(correction: Affine | None = None, **changes: Any) -> Estimate:
    """The estimate of a well-calibrated estimator for `correction` (default: the truth)."""
    correction = correction or truth()
    sigma = np.r_[np.full(6, 0.002), np.full(3, 0.001), np.full(3, 1e-4)]
    value = Estimate(
        soft_iron=np.linalg.inv(correction.matrix),
        hard_iron_gauss=correction.offset,
        gyro_bias_rad_s=BIAS,
        field_gauss=0.5,
        field_known=False,
        covariance=np.diag(sigma**2),
        noise_mag_gauss=0.0005,
        noise_gyro_rad_s=0.0005,
        misfit=1.0,
        heading_sigma_deg=0.2,
        observability=Observability(np.full(12, 0.01), (), 20.0),
        samples=10000,
        duration_s=300.0,
        converged=True,
        place_deg=0.01,
    )
    return replace(value, **changes)


def old() -> Affine:
    """A calibration in force with 2 to 5 degrees of error."""
    return Affine(
        np.linalg.inv(SOFT) + 0.01 * np.diag([1.0, -1.0, 0.0]), HARD + np.array([0.006, 0.004, 0])
    )


def collect(scene: Scene) -> EvidenceCollector:
    collector = EvidenceCollector()
    for _, part in collector.split(scene.block()):
        collector.add(part)
    collector.finish()
    return collector


def evidence(scene: Scene, correction: Affine | None = None, **given: Any) -> Evidence:
    facts: dict[str, Any] = {
        "present": old(),
        "present_gyro_bias_rad_s": np.zeros(3),
        "world": None,
        "health": HEALTHY,
        "basis": SOUND,
    }
    ours = {*facts, "halves", "proposed"}
    changes = {k: given.pop(k) for k in list(given) if k not in ours}
    return collect(scene).evaluate(estimate(correction, **changes), **(facts | given))


class World:
    """The functions and constants that the tests use."""

    Scene, EvidenceCollector = Scene, EvidenceCollector
    truth, old = staticmethod(truth), staticmethod(old)
    estimate = staticmethod(estimate)
    collect, evidence = staticmethod(collect), staticmethod(evidence)
    SOFT, HARD, BIAS, FIELD_N, DIP = SOFT, HARD, BIAS, FIELD_N, DIP
    HEALTHY, SOUND = HEALTHY, SOUND


@pytest.fixture(scope="session")
def world() -> type[World]:
    return World
