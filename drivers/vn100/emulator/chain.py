"""The compensation chain of the emulated VN-100: from factory-calibrated sensors to outputs.

    sensor ── 23 | 25 | 84: C (v - B) ── 26: R v ──┬── uncompensated outputs
                                                   │
              mag: 47 if 44 Output = 3;            └── compensated outputs
              gyro: minus the filter's bias

(vn100-protocol 5.1 to 5.3). Register 85 smooths the magnetometer on its way out only; the gyro
needs no such thing, its values are means over the output step.

The filter is a stand-in for the device's own. Its gyro bias approaches the true one with a time
constant of `BIAS_S`. Roll and pitch are true; the yaw follows the magnetic heading of the
compensated field within `HEADING_S`: a magnetometer that is off shows in the yaw, as on a real one.

The device's own real-time hard and soft iron compensation (registers 44 and 47) is `OnBoardHsi`:
a quadric  m' Q m + 2 u' m = 1  fitted to the field as it leaves register 26, with old samples
fading away and a weak pull towards the present solution, so that directions which the motion does
not show stay as they are. Then B = -Q^-1 u and C = Q^(1/2) with det C = 1, as in register 23.
How the real device does it is not public; this one converges in the times that register 44 states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.vn100.emulator.physics import (
    BLOCK_TICKS,
    GRAVITY_M_S2,
    GYRO_RANGE_RAD_S,
    MAG_RANGE_GAUSS,
    TICK_HZ,
    Array,
    SensorBlock,
    conjugate,
    euler_angles,
    matrices,
    product,
    quaternion_of,
    quaternions,
)

# -- Real-time hard and soft iron ------------------------------------------------------------------


FADING_S = {1: 90.0, 2: 70.0, 3: 50.0, 4: 30.0, 5: 18.0}  # by ConvergeRate
SAMPLE_TICKS = 40  # one sample in so many ticks is used
_PULL = 1e-4  # of the weight of the data
_STEP_GAUSS = 0.02
_UNIT_GAUSS = 0.5  # so that the quadric's coefficients are about 1


class OnBoardHsi:
    """Fits (C, B) to the samples it is given; `reset` begins again."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the solution and the samples."""
        self.matrix: Array = np.eye(3)
        self.offset: Array = np.zeros(3)
        self._moments: Array = np.zeros((9, 9))
        self._sums: Array = np.zeros(9)
        self._weight = 0.0
        self._solution: Array | None = None
        self._newest: Array | None = None

    def add(self, field_gauss: Array, converge_rate: int, period_s: float) -> None:
        """Use samples (N, 3), one every `period_s`, as far as the field has moved, and solve."""
        fade = np.exp(-len(field_gauss) * period_s / FADING_S[converge_rate])
        moved = [sample for sample in field_gauss if self._moved(sample)]
        if not moved:
            return
        field_gauss = np.array(moved)
        x, y, z = (field_gauss / _UNIT_GAUSS).T
        rows = np.column_stack((x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z))
        rows = np.hstack((rows, 2 * field_gauss / _UNIT_GAUSS))
        self._moments = fade * self._moments + rows.T @ rows
        self._sums = fade * self._sums + rows.sum(axis=0)
        self._weight = fade * self._weight + len(rows)
        if self._solution is None:
            power = float(np.mean(np.sum(rows[:, :3], axis=1)))
            self._solution = np.concatenate((np.full(3, 1 / power), np.zeros(6)))
        self._solve(self._solution)

    def _moved(self, sample: Array) -> bool:
        """Whether this is a new direction: at rest there is nothing to learn but noise."""
        if not sample.any():  # a matrix of zeros in register 23
            return False
        if self._newest is not None and np.linalg.norm(sample - self._newest) < _STEP_GAUSS:
            return False
        self._newest = sample
        return True

    def _solve(self, present: Array) -> None:
        pull = _PULL * self._weight
        pulled = self._moments + pull * np.eye(9)
        found = np.asarray(np.linalg.solve(pulled, self._sums + pull * present), np.float64)
        a, b, c, d, e, f = found[:6]
        Q = np.array([[a, d, e], [d, b, f], [e, f, c]])
        eigenvalues, axes = np.linalg.eigh(Q)
        if eigenvalues[0] < 0.05 * eigenvalues[2] or eigenvalues[2] <= 0:
            return  # no ellipsoid: the motion was too small
        self._solution = found
        root = (axes * np.sqrt(eigenvalues)) @ axes.T
        self.matrix = np.asarray(root / np.linalg.det(root) ** (1 / 3))
        self.offset = -np.linalg.solve(Q, found[6:]) * _UNIT_GAUSS


# -- The chain -------------------------------------------------------------------------------------


LARGEST = 1e9  # whatever a host writes into a matrix: every value still fits an f32
BIAS_S = 30.0
HEADING_S = 3.0
BLOCK_S = BLOCK_TICKS / TICK_HZ


def affine(values: tuple[float, ...]) -> tuple[Array, Array]:
    """C (3, 3) and B (3,) of a register of 12 numbers."""
    numbers = np.array(values, dtype=np.float64)
    return numbers[:9].reshape(3, 3), numbers[9:]


@dataclass(frozen=True, slots=True, eq=False)
class ChainSettings:
    """What the registers say that matters here.

    mag, accel, gyro: (C, B) of 23, 25, 84;  rotation: R (3, 3) of 26;  hsi: (C, B) of 47 or None
    where it is not applied;  mag_reference: of 21, gauss;  windows: ticks of register 85's mean of
    the magnetometer (uncompensated, compensated);  tare: attitude q_nu (4,) that counts as zero
    """

    mag: tuple[Array, Array]
    accel: tuple[Array, Array]
    gyro: tuple[Array, Array]
    rotation: Array
    hsi: tuple[Array, Array] | None
    mag_reference: Array
    windows: tuple[int, int] = (0, 0)
    heading_frozen: bool = False
    tare: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """What the attitude filter remembers: gyro bias (3,) rad/s in the output frame, error of yaw.

    yaw_error_rad is None until the first sample after the start.
    """

    gyro_bias_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    yaw_error_rad: float | None = None


def _through(vectors: Array, stage: tuple[Array, Array], rotation: Array) -> Array:
    matrix, offset = stage
    passed = (vectors - offset) @ (rotation @ matrix).T
    return np.asarray(np.clip(passed, -LARGEST, LARGEST))


class SensorOutputs:
    """All output quantities of one block under one set of register values, as they are needed.

    Arrays have a row per tick of the block. Vectors are in the output frame u (behind register 26)
    unless their name ends in `ned`.
    """

    def __init__(self, block: SensorBlock, settings: ChainSettings, state: FilterState) -> None:
        self.block = block
        self._settings = settings
        self._state = state
        self._rates: dict[int, Array] = {}
        self._made: dict[str, Array] = {}
        self._mag_u = self._field(0)
        yaw_error = self._yaw_errors()
        self._yaw_error_end = float(yaw_error[-1])
        turned = np.zeros((BLOCK_TICKS, 3))
        turned[:, 2] = yaw_error
        self.q_nu = product(quaternions(turned), self._true_q_nu())
        if settings.tare is not None:
            self.q_nu = product(conjugate(settings.tare[None]), self.q_nu)
        self.R_nu = matrices(self.q_nu)
        self.filter_bias = self._filter_bias()

    def uncompensated_field(self) -> Array:
        """UncompMag before register 85: what the on-board HSI works on."""
        return self._field(0)

    def end_state(self) -> FilterState:
        """The filter at the end of the block."""
        return FilterState(self.filter_bias[-1], self._yaw_error_end)

    def rates(self, step_ticks: int) -> Array:
        """UncompGyro (BLOCK, 3) of an output that comes every `step_ticks`."""
        if step_ticks not in self._rates:
            read = self.block.rates(step_ticks)
            settings = self._settings
            self._rates[step_ticks] = _through(read, settings.gyro, settings.rotation)
        return self._rates[step_ticks]

    def compensated_rates(self, step_ticks: int) -> Array:
        """AngularRate (BLOCK, 3)."""
        return self.rates(step_ticks) - self.filter_bias

    def quantity(self, name: str) -> Array:
        """A quantity that does not depend on the output's step, (BLOCK, n)."""
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name]

    def _make(self, name: str) -> Array:
        if name == "uncomp_mag":
            return self._field(self._settings.windows[0])
        if name == "mag":
            return self._compensate(self._field(self._settings.windows[1]))
        if name in ("accel", "uncomp_accel"):
            return _through(self.block.accel_m_s2, self._settings.accel, self._settings.rotation)
        if name == "ypr":
            return np.asarray(euler_angles(self.R_nu)[:, ::-1])
        if name == "mag_ned":
            return self._to_ned(self.quantity("mag"))
        if name == "accel_ned":
            return self._to_ned(self.quantity("accel"))
        if name == "linear_accel_body":
            return np.asarray(self.quantity("accel") + GRAVITY_M_S2 * self.R_nu[:, 2, :])
        if name == "linear_accel_ned":
            return np.asarray(self.quantity("accel_ned") + np.array([0.0, 0.0, GRAVITY_M_S2]))
        raise KeyError(name)

    def _field(self, window: int) -> Array:
        return _through(self.block.field(window), self._settings.mag, self._settings.rotation)

    def _compensate(self, field_u: Array) -> Array:
        hsi = self._settings.hsi
        return field_u if hsi is None else _through(field_u, hsi, np.eye(3))

    def _to_ned(self, vectors_u: Array) -> Array:
        return np.asarray(np.einsum("kij,kj->ki", self.R_nu, vectors_u))

    def _true_q_nu(self) -> Array:
        """Attitude of the output frame: q_nb and then R of register 26 undone."""
        q_ub = quaternion_of(self._settings.rotation)[None]
        return product(self.block.q_nb[-BLOCK_TICKS:], conjugate(q_ub))

    def _yaw_errors(self) -> Array:
        """Yaw minus true yaw (BLOCK,): it follows reference declination minus seen declination."""
        seen_n = np.einsum("kij,kj->ki", matrices(self._true_q_nu()), self._compensate(self._mag_u))
        reference = self._settings.mag_reference
        wanted = math.atan2(reference[1], reference[0]) - np.arctan2(seen_n[:, 1], seen_n[:, 0])
        start = self._state.yaw_error_rad
        if start is None:
            start = float(wanted[0])
        if self._settings.heading_frozen:
            return np.full(BLOCK_TICKS, start)
        pull = float(np.mean(np.remainder(wanted - start + math.pi, 2 * math.pi) - math.pi))
        end = start + pull * (1 - math.exp(-BLOCK_S / HEADING_S))
        part = np.arange(1, BLOCK_TICKS + 1) / BLOCK_TICKS
        return np.asarray(start + part * (end - start))

    def _filter_bias(self) -> Array:
        settings = self._settings
        true = _through(self.block.bias_rad_s, settings.gyro, settings.rotation)
        left = np.exp(-np.arange(1, BLOCK_TICKS + 1) / TICK_HZ / BIAS_S)[:, None]
        return np.asarray(true + left * (self._state.gyro_bias_rad_s - true))

    def saturation(self) -> Array:
        """SensSat (BLOCK,): bits 0-2 magnetometer, 6-8 gyro, by axis of the sensor."""
        field_full = np.abs(self.block.field()) >= MAG_RANGE_GAUSS
        rate_full = np.abs(self.block.rates(1)) >= GYRO_RANGE_RAD_S
        bits = field_full @ np.array([1, 2, 4]) + rate_full @ np.array([64, 128, 256])
        return np.asarray(bits, dtype=np.float64)
