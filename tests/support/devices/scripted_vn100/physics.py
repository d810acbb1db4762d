"""What the sensor of a scripted unit reads: motion, field, iron, bias, noise. numpy only.

reading:  m = A h + b + noise      h: true field in the sensor frame, gauss
          w_read = w + w_b + noise, rad/s
frames:   b: x forward, y right, z down; n: north-east-down; accel is the specific force
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

FIELD_N_GAUSS = np.array([0.2105, 0.0165, 0.4365])  # about as at 48 N 11 E
GRAVITY_M_S2 = 9.81
MAG_NOISE_GAUSS, GYRO_NOISE_RAD_S, ACCEL_NOISE_M_S2 = 1.0e-3, 4.0e-4, 0.01


@dataclass(frozen=True)
class Iron:
    """Soft iron A (3,3), hard iron b (3,) in gauss, gyro bias (3,) in rad/s."""

    soft: np.ndarray = field(default_factory=lambda: np.eye(3))
    hard_gauss: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gyro_bias_rad_s: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def moved(self, by_gauss: np.ndarray) -> Iron:
        """With other hard iron."""
        return Iron(self.soft, self.hard_gauss + by_gauss, self.gyro_bias_rad_s)

    def correction(self) -> np.ndarray:
        """Register 23 that is right: C = A^-1 with det C = 1, B = b; (12,)."""
        inverse = np.linalg.inv(self.soft)
        return np.r_[(inverse / np.cbrt(np.linalg.det(inverse))).ravel(), self.hard_gauss]


def _turn(rotation: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = rotation / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


@dataclass(frozen=True)
class Motion:
    """Rest and turning in all directions by turns; time is the vehicle's, from 0 on.

    rest_s, turn_s: lengths of the two; the vehicle begins at rest. `rate_rad_s`: how fast it turns.
    """

    rest_s: float = 5.0
    turn_s: float = 7.0
    rate_rad_s: float = 1.4
    level: bool = False

    def rate_b(self, time_s: float) -> np.ndarray:
        """Angular rate, rad/s."""
        phase_s = time_s % (self.rest_s + self.turn_s)
        if phase_s < self.rest_s:
            return np.zeros(3)
        u = 2.0 * np.pi * (phase_s - self.rest_s) / self.turn_s
        if self.level:
            return self.rate_rad_s * np.array([0.0, 0.0, 1.0])
        # whole periods of each: after `turn_s` it is near to where it was, and has seen all ways
        return self.rate_rad_s * np.array(
            [1.2 * np.sin(u), 1.2 * np.sin(2.0 * u), 0.9 + 0.3 * np.cos(u)]
        )


@lru_cache(maxsize=8)
def table(motion: Motion, period_s: float, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Field, rate and specific force in the sensor frame at steps of `period_s`, (N, 3) each.

    The rate of a step is the mean over the step that ends there.
    """
    fine = max(1, round(period_s / 0.01))
    R_nb, h, w, f = np.eye(3), [], [], []
    for step in range(steps):
        mean = np.zeros(3)
        if step:
            for part in range(fine):
                at_s = (step - 1 + (part + 0.5) / fine) * period_s
                rate = motion.rate_b(at_s)
                mean += rate / fine
                R_nb = R_nb @ _turn(rate * period_s / fine)
        h.append(R_nb.T @ FIELD_N_GAUSS)
        w.append(mean)
        f.append(R_nb.T @ np.array([0.0, 0.0, -GRAVITY_M_S2]))
    return np.array(h), np.array(w), np.array(f)


@lru_cache(maxsize=4)
def noise(seed: int) -> np.ndarray:
    """(4096, 9) standard normal numbers."""
    return np.random.default_rng(seed).standard_normal((4096, 9))


class Vehicle:
    """Where the unit sits: one motion and the iron of the vehicle, which whoever measures feels.

    `moved` has every change of the vehicle's own hard iron: (time_s, gauss (3,)).
    """

    LENGTH_S = 450.0  # of the motion's table; then it begins anew

    def __init__(self, motion: Motion | None = None, *, seed: int = 1) -> None:
        self.motion = motion or Motion()
        self.noise = noise(seed)
        self.moved: list[tuple[float, np.ndarray]] = []
        self.hard_gauss = np.zeros(3)
        self.loud = 1.0

    def move_iron(self, by_gauss: np.ndarray, at_s: float) -> None:
        """Iron is put on or taken off."""
        self.hard_gauss = self.hard_gauss + by_gauss
        self.moved.append((at_s, self.hard_gauss))

    def hard_at(self, at_s: float) -> np.ndarray:
        """The vehicle's hard iron at a time, gauss."""
        found = np.zeros(3)
        for since_s, value in self.moved:
            if since_s <= at_s:
                found = value
        return found

    def reading(
        self, iron: Iron, at_s: float, period_s: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Raw field, rate and specific force that a unit with this iron reads at a time."""
        index, steps = round(at_s / period_s), round(self.LENGTH_S / period_s)
        h, w, f = table(self.motion, period_s, steps)
        k, n = index % steps, self.noise[index % len(self.noise)] * self.loud
        mag = iron.soft @ h[k] + iron.hard_gauss + self.hard_gauss + MAG_NOISE_GAUSS * n[:3]
        gyro = w[k] + iron.gyro_bias_rad_s + GYRO_NOISE_RAD_S * n[3:6]
        return mag, gyro, f[k] + ACCEL_NOISE_M_S2 * n[6:]

    def field_b(self, at_s: float, period_s: float) -> np.ndarray:
        """The field without iron in the sensor frame, gauss, of the step at a time."""
        steps = round(self.LENGTH_S / period_s)
        return table(self.motion, period_s, steps)[0][round(at_s / period_s) % steps]

    def resting(self, at_s: float) -> bool:
        """Whether the vehicle stands still."""
        return not self.motion.rate_b(at_s).any()
