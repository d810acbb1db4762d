"""What the rivals regress: one-step residuals on the textbook column of every effect.

    r_k = m_k - b - A E_k A^-1 (m_(k-1) - b),   E_k = Exp(-(w_k - w_b) dt)

A column D on the reading enters as D_k - A E_k A^-1 D_(k-1), a column W on the gyro as
-A [h]x W dt. Calibration (A, b, w_b) is projected out of residual and columns alike, so that no
rival fails for the sake of the calibration. h is smoothed along the gyro: a column made of a
reading would hold the reading's noise, which is in the residual, and be chosen for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.recording.table import Table
from ahrsd.samples import Array
from ahrsd.so3 import exp, skew

_STEPS = 9  # onsets that are tried for everything that may jump
_RELAXATION_S = 30.0
_PLAY_GAUSS = 0.03
_SETTLING_S = 60.0
_SMOOTH_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Least squares in small: the same problem as `matrix @ theta = residual` with unit columns.

    residual: (n,) calibration projected out
    root:     (p, p) triangular, root^T root = matrix^T matrix
    target:   (p,) root^T target = matrix^T residual / s, s the residual's standard deviation
    names:    whose each of the p columns is
    """

    residual: Array
    root: Array
    target: Array
    names: tuple[str, ...]
    time_s: Array  # (n / 3,)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    time_s: Array
    field_b: Array
    rate_b: Array
    slope_b: Array
    force_b: Array
    R_nb: Array
    columns: dict[str, Array]


def regression(table: Table, estimate: Estimate) -> Regression:
    """Residual and columns of a recording around a calibration."""
    rows = table.rows
    A, b = estimate.soft_iron, estimate.hard_iron_gauss
    step = np.where(np.isfinite(rows.dt_s), rows.dt_s, 0.0)[1:]
    rate = rows.gyro_b_rad_s - estimate.gyro_bias_rad_s
    turn = exp(-rate[1:] * step[:, None])
    gain = min(float(np.median(step)) / _SMOOTH_S, 1.0)
    h = _smoothed((rows.raw_b_gauss - b) @ np.linalg.inv(A).T, turn, gain)
    follow = A @ turn @ np.linalg.inv(A)
    use = step > 0

    def on_reading(D: Array) -> Array:
        return np.asarray((D[1:] - np.einsum("kij,kj...->ki...", follow, D[:-1]))[use])

    def on_gyro(W: Array) -> Array:
        lever = -(A @ skew(h[:-1])) * step[:, None, None]
        return np.asarray(np.einsum("kij,kj...->ki...", lever, W[1:])[use])

    scene = _scene(table, h, rate)
    names: list[str] = []
    columns: list[Array] = []
    for name, kind, block in _effects(scene):
        pushed = on_reading(block) if kind == "D" else on_gyro(block)
        columns += list(np.moveaxis(pushed, 2, 0))
        names += [name] * block.shape[2]
    eye = np.broadcast_to(np.eye(3), (len(h), 3, 3))
    # of A in r_k itself: on readings instead, dA = A would be the residual, noise and all
    turned = np.einsum("kij,kj->ki", turn, h[:-1])
    of_iron = _iron(turned) - np.einsum("kij,kjn->kin", follow, _iron(h[:-1]))
    nuisance = np.concatenate([of_iron[use], on_reading(eye), on_gyro(eye)], axis=2).reshape(-1, 12)
    residual = on_reading(rows.raw_b_gauss - b).reshape(-1)
    matrix = np.stack([column.reshape(-1) for column in columns], axis=1)
    basis, values, _ = np.linalg.svd(nuisance, full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    residual = residual - basis @ (basis.T @ residual)
    size = np.linalg.norm(matrix, axis=0)
    matrix = matrix - basis @ (basis.T @ matrix)
    left = np.linalg.norm(matrix, axis=0)
    seen = left > 1e-4 * np.maximum(size, 1e-300)
    kept = tuple(name for name, keep in zip(names, seen, strict=True) if keep)
    unit, root = np.linalg.qr(matrix[:, seen] / left[seen])
    target = unit.T @ residual / np.std(residual)
    return Regression(residual, root, target, kept, rows.time_s[1:][use])


def _smoothed(h: Array, turn: Array, gain: float) -> Array:
    """(N, 3) with a reading's own noise nearly gone: else it is in residual and columns alike.

    Carried along by the gyro forwards and backwards, each time with a little of the reading.
    """
    found = np.zeros_like(h)
    for values, turns in ((h, turn), (h[::-1], np.swapaxes(turn, 1, 2)[::-1])):
        way = values.copy()
        for k, E in enumerate(turns, start=1):
            carried = E @ way[k - 1]
            way[k] = carried + gain * (values[k] - carried)
        found += way / 2 if turns is turn else way[::-1] / 2
    return found


def _iron(h: Array) -> Array:
    """dA h for the six symmetric dA, (N, 3, 6)."""
    out = np.zeros((len(h), 3, 6))
    for n, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        out[:, i, n] = h[:, j]
        out[:, j, n] = h[:, i]
    return out


def _scene(table: Table, h: Array, rate: Array) -> _Scene:
    rows = table.rows
    down = -np.where(np.isfinite(rows.accel_b_m_s2), rows.accel_b_m_s2, [0.0, 0.0, -9.81])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    east = np.cross(down, h)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-9)
    columns = {name: np.nan_to_num(values) for name, values in rows.covariates.items()}
    return _Scene(
        rows.time_s - rows.time_s[0],
        h,
        rate,
        np.cross(h, rate),
        -9.81 * down,
        np.stack([np.cross(east, down), east, down], axis=1),
        columns,
    )


def _three(signal: Array) -> Array:
    """e_i s(t): (N, 3, 3)."""
    return signal[:, None, None] * np.eye(3)


def _jumps(time_s: Array) -> list[Array]:
    return [(time_s > time_s[-1] * n / (_STEPS + 1)).astype(float) for n in range(1, _STEPS + 1)]


def _outer(v: Array) -> Array:
    """e_i v_j, (N, 3, 9)."""
    return np.asarray(np.einsum("il,kj->kilj", np.eye(3), v).reshape(len(v), 3, 9))


def _effects(scene: _Scene) -> Iterator[tuple[str, str, Array]]:
    """(effect, D or W, columns (N, 3, p))."""
    yield from _in_time(scene)
    yield from _of_the_field(scene)
    yield from _of_the_gyro(scene)
    for name, values in scene.columns.items():
        yield from _of_a_covariate(scene, name, values - values.mean())
    where = [c for n, c in sorted(scene.columns.items()) if n.startswith("position_")]
    if len(where) == 3:
        place = np.stack([c - c.mean() for c in where], axis=1)
        world = _outer(place)
        yield "field_gradient", "D", np.einsum("kji,kjp->kip", scene.R_nb, world)
        height = scene.columns["position_down_m"]
        turned = np.swapaxes(scene.R_nb, 1, 2)
        yield "altitude_field", "D", turned * (height - height.mean())[:, None, None]


def _in_time(scene: _Scene) -> Iterator[tuple[str, str, Array]]:
    t, to_body = scene.time_s, np.swapaxes(scene.R_nb, 1, 2)
    slope = t / t[-1]
    yield "hard_iron_drift", "D", _three(slope)
    yield "geomagnetic_drift", "D", to_body * slope[:, None, None]
    yield "gyro_bias_drift", "W", _three(slope)
    yield "gyro_startup", "W", _three(np.exp(-t / _SETTLING_S))
    for jump in _jumps(t):
        yield "hard_iron_step", "D", _three(jump)
        yield "field_step", "D", to_body * jump[:, None, None]
        yield "soft_iron_step", "D", _iron(scene.field_b) * jump[:, None, None]
        yield "gyro_bias_step", "W", _three(jump)


def _of_the_field(scene: _Scene) -> Iterator[tuple[str, str, Array]]:
    h = scene.field_b
    yield "mag_time_lag", "D", scene.slope_b[:, :, None]
    yield "eddy_current", "D", _outer(scene.slope_b)
    yield "mag_cross_axis", "D", _three(np.ones(len(h))) * (h * np.roll(h, 1, axis=1))[:, :, None]
    yield "mag_nonlinearity", "D", _three(np.ones(len(h))) * (h**3)[:, :, None]
    flex = np.einsum("kij,kjp->kip", -skew(h), _outer(scene.force_b))
    yield "flexible_mount", "D", flex
    memory, play = h.copy(), h.copy()
    step = np.diff(scene.time_s, prepend=0.0) / _RELAXATION_S
    for k in range(1, len(h)):
        memory[k] = memory[k - 1] + step[k] * (h[k] - memory[k - 1])
        play[k] = np.clip(play[k - 1], h[k] - _PLAY_GAUSS, h[k] + _PLAY_GAUSS)
    yield "viscous_magnetisation", "D", _iron(memory - h)
    yield "hysteresis", "D", _three(np.ones(len(h))) * (play - h)[:, :, None]


def _of_the_gyro(scene: _Scene) -> Iterator[tuple[str, str, Array]]:
    w = scene.rate_b
    one = _three(np.ones(len(w)))
    yield "gyro_scale", "W", one * w[:, :, None]
    yield "clock_rate", "W", w[:, :, None]
    yield "gyro_nonorthogonality", "W", _iron(w)[:, :, 3:]
    yield "mag_gyro_misalignment", "W", -skew(w)
    yield "gyro_nonlinearity", "W", one * (np.abs(w) * w)[:, :, None]
    yield "gyro_g_sensitivity", "W", _outer(scene.force_b)
    yield "earth_rotation", "W", np.swapaxes(scene.R_nb, 1, 2)


def _of_a_covariate(scene: _Scene, name: str, c: Array) -> Iterator[tuple[str, str, Array]]:
    if name.endswith("current_a"):
        yield "motor_current_field", "D", _three(c)
        slope = np.gradient(c, np.maximum(scene.time_s, np.arange(len(c)) * 1e-9))
        yield "current_derivative_field", "D", _three(slope)
        yield "vibration_rectification", "W", _three(c**2)
    elif name.startswith("temperature"):
        yield "mag_bias_temperature", "D", _three(c)
        scaled = scene.field_b * c[:, None]
        yield "mag_scale_temperature", "D", _three(np.ones(len(c))) * scaled[:, :, None]
        yield "gyro_bias_temperature", "W", _three(c)
    elif name.startswith("speed"):
        yield "speed_field", "D", _three(c)
    elif name.endswith("angle_rad"):
        yield "moving_iron", "D", np.concatenate([_three(np.cos(c)), _three(np.sin(c))], axis=2)
    elif name.endswith("_on"):
        yield "switched_device", "D", _three(c)
