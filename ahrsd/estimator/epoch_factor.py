"""An epoch of readings as one factor, for any GTSAM graph.

    epoch = Epoch.of(field_b_gauss, gyro_b_rad_s, dt_s, Noise(1e-3, 5e-3))
    graph.add(epoch_factor(epoch, EpochKeys(C(0), B(k))))

Variables, by the keys that the caller chooses (frame b is the sensor's):

    calibration  Vector (9): M's upper triangle by rows and b, gauss, of m = M u + b; M = A |h|
    gyro bias    Vector (3): rad/s, one per epoch or one for all
    first, last  Unit3, optional: the field's direction at the epoch's first and last reading

Whatever the number of readings, the factor has all their information on these variables: it is the
negative log likelihood (docs/design/estimator.md, "Model"), up to a constant, minimised over all
other directions. The noise must be white and the field's magnitude constant.

`first` and `last` join an epoch to the next one (whose first reading is this one's last: `follows`)
and to other factors on directions, such as u = R_nb^T n of an attitude node. An epoch without them
is independent. The factor uses the gyroscope's readings: another factor with the same ones, such as
a preintegrated rotation, would count them twice.

There are two forms. `epoch_factor` keeps the readings and is exact at any values; one linearisation
costs a few milliseconds for 512 readings. `EpochSummary.factor` is a quadratic in 12 to 16 numbers
around one point, for epochs whose variables hardly move any more, and costs nothing.

docs/guide/examples/smoothing_with_epochs.py smooths attitude and maps the local field with both.
"""

from __future__ import annotations

from collections.abc import MutableSequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.chain import Noise
from ahrsd.printable import counted
from ahrsd.samples import Array

__all__ = ["Epoch", "EpochKeys", "EpochSummary", "Noise", "Point", "epoch_factor", "summarise"]

_LEAST_ROWS = 4
_CONVERGED_RAD = 1e-9
_MOST_STEPS, _MOST_HALVINGS = 60, 20
_ROUNDING = 1e-12  # relative increase of a cost that is rounding
_SHARED = 12  # calibration and gyro bias
_BORDERS = slice(12, 16)
_UNDETERMINED = 1e-14  # of the largest scaled eigenvalue: undetermined


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """Consecutive readings without a gap, ready to be linearised at any point. Make it by `of`."""

    data: chain.EpochData
    noise: Noise

    @staticmethod
    def of(
        field_b_gauss: Array,
        gyro_b_rad_s: Array,
        dt_s: Array,
        noise: Noise,
        *,
        follows: bool = False,
    ) -> Epoch:
        """Readings (n, 3) gauss, (n, 3) rad/s and the step (n,) in s that ends at each; n >= 4.

        The gyro's value is the mean rate over its step; row 0's step and rate are not used. noise:
        standard deviations per reading and axis; follows: row 0 is the last row of the epoch
        before, which counts its field. ValueError names the invalid argument and row.
        """
        count = len(dt_s)
        if count < _LEAST_ROWS:
            raise ValueError(f"{counted(count, 'reading')}: an epoch has at least {_LEAST_ROWS}")
        for name, values, used in (
            ("field_b_gauss", field_b_gauss, 0),
            ("gyro_b_rad_s", gyro_b_rad_s, 1),
        ):
            if values.shape != (count, 3):
                raise ValueError(f"{name} has shape {values.shape}, not ({count}, 3)")
            _require_rows(name, np.isfinite(values[used:].sum(axis=1)), used)
        _require_rows("dt_s", (dt_s[1:] > 0) & (dt_s[1:] < np.inf), 1)
        if not (0 < noise.mag_gauss < np.inf and 0 < noise.gyro_rad_s < np.inf):
            raise ValueError(f"{noise}: noise must be a positive number")
        steps = np.r_[dt_s[1], dt_s[1:]]
        angle = np.vstack([np.zeros((1, 3)), gyro_b_rad_s[1:] * steps[1:, None]])
        data = chain.EpochData(
            field_b_gauss=np.array(field_b_gauss, dtype=np.float64),
            angle_b_rad=angle,
            dt_s=steps,
            down_b=np.full((count, 3), np.nan),
            time_s=np.cumsum(steps),
            measures_first=not follows,
        )
        return Epoch(data, noise)


def _require_rows(name: str, good: NDArray[np.bool], first: int) -> None:
    if not good.all():
        raise ValueError(f"{name} of row {first + int(np.argmin(good))} cannot be used")


@dataclass(frozen=True, slots=True)
class EpochKeys:
    """GTSAM keys of the variables; both directions or neither."""

    calibration: int
    gyro_bias: int
    first: int | None = None
    last: int | None = None

    def __post_init__(self) -> None:
        if (self.first is None) != (self.last is None):
            raise ValueError("an epoch is joined at both ends or at neither")

    @property
    def listed(self) -> list[int]:
        """In the order of the factor's columns."""
        keys = (self.calibration, self.gyro_bias, self.first, self.last)
        return [key for key in keys if key is not None]


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Values of the variables; directions (3,) of unit length, or None where they are free."""

    calibration: Array
    gyro_bias_rad_s: Array
    first: Array | None = None
    last: Array | None = None

    @staticmethod
    def of(values: gtsam.Values, keys: EpochKeys) -> Point:
        """From the values of a graph."""
        return Point(
            np.array(values.atVector(keys.calibration)),
            np.array(values.atVector(keys.gyro_bias)),
            None if keys.first is None else np.array(values.atUnit3(keys.first).point3()),
            None if keys.last is None else np.array(values.atUnit3(keys.last).point3()),
        )

    def values(self, keys: EpochKeys) -> gtsam.Values:
        """The same as GTSAM's values."""
        values = gtsam.Values()
        values.insert(keys.calibration, self.calibration)
        values.insert(keys.gyro_bias, self.gyro_bias_rad_s)
        for key, direction in ((keys.first, self.first), (keys.last, self.last)):
            if key is not None and direction is not None:
                values.insert(key, gtsam.Unit3(direction))
        return values


@dataclass(frozen=True, slots=True, eq=False)
class EpochSummary:
    """cost + gradient^T z + z^T information z / 2, z the moves of the variables from `point`.

    z: calibration (9), gyro bias (3), and, where `point` has directions, 2 each, in GTSAM's own
    basis of the plane normal to the direction.
    """

    point: Point
    cost: float
    gradient: Array
    information: Array

    def factor(self, keys: EpochKeys) -> gtsam.LinearContainerFactor:
        """The summary in a graph.  ValueError where keys and point do not have the same variables.

        Exact in calibration and gyro bias as far as the model is linear there; a direction that
        moves by an angle is off by the angle's square.
        """
        if (keys.first is None) != (self.point.first is None):
            raise ValueError("the keys and the summary differ in whether directions are variables")
        hessian = _hessian(keys.listed, self.information, self.gradient, self.cost)
        return gtsam.LinearContainerFactor(hessian, self.point.values(keys))

    def rows(self) -> tuple[Array, Array]:
        """Residuals (n + 1,) and Jacobian (n + 1, n): half the sum of squared residuals is the
        cost.

        The rows are along the eigenvectors of the scaled information, and a constant one has the
        remaining cost.
        """
        scale = np.sqrt(np.diag(self.information).clip(min=1e-300))
        values, vectors = np.linalg.eigh(self.information / np.outer(scale, scale))
        root = np.sqrt(np.where(values > _UNDETERMINED * values[-1], values, 0.0))
        J = root[:, None] * (vectors.T * scale)
        seen = root > 0
        r = np.zeros(len(root))
        r[seen] = (vectors.T @ (self.gradient / scale))[seen] / root[seen]
        remaining = np.sqrt(max(0.0, 2.0 * self.cost - float(r @ r)))
        return np.r_[r, remaining], np.vstack([J, np.zeros(len(root))])


def summarise(epoch: Epoch, point: Point, start: Array | None = None) -> EpochSummary:
    """The quadratic of an epoch around a point, minimised over all directions that are not in
    `point`.

    start (n, 3): initial directions, otherwise those of the readings. ValueError if M is not
    positive definite or the directions do not converge.
    """
    return _solve_directions(epoch, point, start)[0]


def _solve_directions(
    epoch: Epoch, point: Point, start: Array | None
) -> tuple[EpochSummary, Array]:
    """Gauss-Newton over the directions; a step is halved until the cost falls."""
    c, bias, data = point.calibration, point.gyro_bias_rad_s, epoch.data
    M = chain.symmetric(c[:6])
    if not (np.isfinite(c).all() and np.linalg.eigvalsh(M)[0] > 0):
        raise ValueError("the calibration's M is not positive definite")
    u = chain.start_directions(M, c[6:], data.field_b_gauss) if start is None else start.copy()
    joined = point.first is not None and point.last is not None
    if joined:
        u[0], u[-1] = point.first, point.last
    turns = so3.exp(-(data.angle_b_rad[1:] - bias * data.dt_s[1:, None]))
    cost = _cost(epoch, u, c, turns)
    for _ in range(_MOST_STEPS):
        q = chain.linearise(data, u, c, bias, epoch.noise)
        z = np.zeros(chain.WIDTH)
        if not joined:
            z[_BORDERS] = -np.linalg.solve(q.H[_BORDERS, _BORDERS], q.g[_BORDERS])
        step = chain.move_directions(u, q, z) - u
        if float(np.max(np.abs(step))) < _CONVERGED_RAD:
            return _summary(point, q, u, joined), u
        for _ in range(_MOST_HALVINGS):
            candidate = u + step
            candidate /= np.linalg.norm(candidate, axis=1, keepdims=True)
            new = _cost(epoch, candidate, c, turns)
            if new <= cost * (1.0 + _ROUNDING):
                break
            step = step / 2
        u, cost = candidate, new
    raise ValueError("the directions of an epoch do not settle: far from any solution")


def _cost(epoch: Epoch, u: Array, c: Array, turns: Array) -> float:
    """Half the sum of squared whitened residuals at directions u (n, 3)."""
    data, noise = epoch.data, epoch.noise
    field = (data.field_b_gauss - u @ chain.symmetric(c[:6]) - c[6:]) / noise.mag_gauss
    if not data.measures_first:
        field[0] = 0.0
    turned = np.einsum("nij,nj->ni", turns, u[:-1])
    motion = np.cross(turned, u[1:]) / (noise.gyro_rad_s * data.dt_s[1:, None])
    return float(0.5 * (np.sum(field**2) + np.sum(motion**2)))


def _summary(point: Point, q: chain.Quadratic, u: Array, joined: bool) -> EpochSummary:
    if joined:  # from the chain's bases of the tangent planes to GTSAM's
        J = np.eye(chain.WIDTH)
        for where, direction in ((chain.FIRST, u[0]), (chain.LAST, u[-1])):
            T = so3.tangent_basis(direction[None])[0]
            J[where, where] = T.T @ np.array(gtsam.Unit3(direction).basis())
        return EpochSummary(point, q.cost, J.T @ q.g, J.T @ q.H @ J)
    gain = np.linalg.solve(q.H[_BORDERS, _BORDERS], q.H[_BORDERS, :_SHARED])
    H = q.H[:_SHARED, :_SHARED] - q.H[:_SHARED, _BORDERS] @ gain
    g = q.g[:_SHARED] - gain.T @ q.g[_BORDERS]
    return EpochSummary(point, q.cost, g, (H + H.T) / 2)


def epoch_factor(epoch: Epoch, keys: EpochKeys) -> gtsam.CustomFactor:
    """The likelihood of an epoch as a nonlinear factor, linearised at any values.

    At an invalid calibration (M not positive definite, directions that do not converge), the error
    is infinite, so that a Levenberg-Marquardt search steps back; linearising there raises
    ValueError.
    """
    widths = (9, 3, 2, 2)[: len(keys.listed)]
    cuts = np.cumsum(widths)[:-1]
    last_directions: list[Array] = []  # the last directions found, where the next search starts

    def error(
        _factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: MutableSequence[Array] | None
    ) -> Array:
        try:
            summary, u = _solve_directions(
                epoch, Point.of(values, keys), last_directions[0] if last_directions else None
            )
        except ValueError:
            last_directions.clear()
            if jacobians is not None:
                raise
            return np.full(sum(widths) + 1, np.inf)
        last_directions[:] = [u]
        r, J = summary.rows()
        if jacobians is not None:
            for k, part in enumerate(np.split(J, cuts, axis=1)):
                jacobians[k] = np.asfortranarray(part)
        return r

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(sum(widths) + 1), keys.listed, error)


def _hessian(keys: list[int], H: Array, g: Array, cost: float) -> gtsam.HessianFactor:
    """One HessianFactor of any number of keys; its wrapper takes three, so a graph adds several.

    Its linear term is minus the gradient, its constant twice the cost.
    """
    at = [slice(0, 9), slice(9, 12), slice(12, 14), slice(14, 16)]
    c, b, first, last = at
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(
        gtsam.HessianFactor(keys[0], keys[1], H[c, c], H[c, b], -g[c], H[b, b], -g[b], 2 * cost)
    )
    if len(keys) == 4:
        for key, where in ((keys[2], first), (keys[3], last)):
            graph.push_back(
                gtsam.HessianFactor(
                    keys[0], keys[1], key,
                    np.zeros((9, 9)), np.zeros((9, 3)), H[c, where], np.zeros(9),
                    np.zeros((3, 3)), H[b, where], np.zeros(3),
                    H[where, where], -g[where], 0.0,
                )
            )  # fmt: skip
        graph.push_back(
            gtsam.HessianFactor(
                keys[2], keys[3], np.zeros((2, 2)), H[first, last], np.zeros(2), np.zeros((2, 2)),
                np.zeros(2), 0.0,
            )
        )  # fmt: skip
    return gtsam.HessianFactor(graph)
