"""Kalman filter of the field: whitened innovations and their derivatives by any parameter.

State: the field in body axes h and, where the null model has a gyro-bias random walk, that bias.

    predict  h- = Exp(-(w_k - w_b) dt) h+,   process noise (sigma_gyro dt)^2 (|n|^2 I - n n^T)
                                             + q q^T,  q = n x (w_k - w_b) dt s
    update   e = m - A h- - b,  S = A P- A^T + sigma_mag^2 I,  K = P- A^T S^-1,  h+ = h- + K e

s is the standard deviation of a step's turn, as a fraction of that turn, due to `Track.lost_turns`
(a Poisson number).

A gyro error turns the field and does not stretch it, so the process noise is tangential to the
sphere |h| = r.  If it were tangential at the filter's own h, each additive update would lengthen h
by |step|^2 / 2 r, which looks like an external field trend on every recording.  Therefore n is a
nominal field instead: the readings, smoothed forwards and backwards in the frame that the
integrated gyro defines (the carried frame), scaled to constant size, at the middle of the step.
The filter is then linear, its gains depend on no single innovation, and with the gains fixed the
sensitivities are exact:

    T = F H+ - dt [h-]x Jl W_k,   X_k = A T + D_k,   H+ = T - K X_k

Whitening uses S = L L^T: under the null model L^-1 e = L^-1 X dtheta + white noise of variance 1.

These are the derivatives of the innovations, as a descent needs them.  They are not suitable as
regressors: turns and predicted fields contain the same gyro noise as the innovations (errors in
variables).  With a gyro noise of 5 mrad/s and a magnetometer noise of 0.1 mG, a spurious field by
heading gained 440 nats.  `filtered_for_regression` therefore computes F, and h- in the
calibration's columns, from the smoothed rate.

The first row of a run initialises the field from its reading (`used` is false there):
h+ = A^-1 (m - b).  If that row has no reading, the field starts from the nominal field with a
standard deviation of half its size, so that the first reading decides.

Columns pass the filter in batches (`batch_columns`, `join_columns`); a batch holds only columns
that act on the same sensors, so that no zeros are filtered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.diagnosis import priors
from ahrsd.diagnosis.innovation_filter.parallel_scan import (
    Gains,
    Layout,
    LinearModel,
    Recursion,
    kalman_gains,
    layout_of,
    products_before,
)
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.time_series import two_sided_sums
from ahrsd.diagnosis.track import Track
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: gauss; below this the nearest reading, many hundred rows away, has no weight left: squares of
#: smaller numbers underflow
_NEGLIGIBLE_GAUSS = 1e-100


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """Result of one filter run over a track; rows as in the track.

    innovation:   (N, 3) gauss, 0 where not `used`;  whitened: (N, 3), variance 1 under the null
    predicted_b:  (N, 3) gauss, the field before each reading;  field_b: after it
    nominal_b:    (N, 3) gauss, smoothed forwards and backwards, of constant size
    orientation:  (N, 3, 3) body to the carried frame (integrated gyro), I at each run's first row
    used:         (N,) false in each run's first row and where there is no reading
    log_likelihood: (N,) of each innovation
    """

    track: Track
    model: NullModel
    innovation: Array
    whitened: Array
    predicted_b: Array
    field_b: Array
    nominal_b: Array
    orientation: Array
    used: NDArray[np.bool]
    log_likelihood: Array
    gains: Gains
    recursion: Recursion | None

    @property
    def normalised_innovation(self) -> float:
        """Mean square of the whitened innovations: 1 where noise and model are right."""
        return float(np.mean(self.whitened[self.used] ** 2)) if np.any(self.used) else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class NominalMotion:
    """Nominal field and integrated orientation, which need no gains; fields as in `Filtered`."""

    model: NullModel
    nominal_b: Array
    orientation: Array


def nominal_motion(
    track: Track,
    model: NullModel,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
) -> NominalMotion:
    """What `run_filter` computes of the motion from the same arguments, in a tenth of the time."""
    motion = _gyro_motion(track, model, terms_gyro)
    layout, opens = _layout_and_run_starts(track)
    orientation = _integrate_turns(layout, motion.turn, opens)
    field = _calibrated_readings(track, model, terms_mag)
    return NominalMotion(
        model, _nominal_field(field, orientation, layout, model, motion.dt_s), orientation
    )


def run_filter(
    track: Track,
    model: NullModel,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
    *,
    gains_from: Filtered | None = None,
    with_sensitivities: bool = True,
) -> Filtered:
    """Run the filter over a track.  terms_*: (N, 3) contributions of effects, subtracted first.

    gains_from: use gains and nominal field of this earlier run over the same track
    with_sensitivities: false where only innovations are needed, and no `sensitivities`
    Rows whose reading is not finite have no update.
    Raises ValueError where a run has no rows, LinAlgError where the model is so far off that its
    innovations are not finite.
    """
    field, motion = (
        _calibrated_readings(track, model, terms_mag),
        _gyro_motion(track, model, terms_gyro),
    )
    layout, opens = _layout_and_run_starts(track)
    blind, orientation = ~_has_reading(field), _integrate_turns(layout, motion.turn, opens)
    if gains_from is None:
        nominal = _nominal_field(field, orientation, layout, model, motion.dt_s)
        linear = _linear_model(model, motion, nominal, opens, blind)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            filter_gains = kalman_gains(linear, _runs(track))
    else:
        nominal, filter_gains = gains_from.nominal_b, gains_from.gains
    from_nominal = opens & blind
    filter_gains.gain[from_nominal] = 0.0
    field = np.where(from_nominal[:, None], nominal, field)
    state, used = _transition(motion, nominal, opens, model), ~(opens | blind)
    readings = np.where((blind & ~from_nominal)[:, None], 0, field)
    predicted = _predicted_fields(layout, state, filter_gains, model.soft_iron, readings)
    innovation = np.where(used[:, None], (field - predicted) @ model.soft_iron, 0.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        root = _inverse_root(filter_gains.innovation_covariance)
    if not np.isfinite(root).all():
        raise np.linalg.LinAlgError("the innovations are not finite: the model is far off")
    root = root * used[:, None, None]
    whitened = np.einsum("nij,nj->ni", root, innovation)
    recursion_inputs = (layout, state, filter_gains, model.soft_iron, root, motion, predicted)
    return Filtered(
        track=track,
        model=model,
        innovation=innovation,
        whitened=whitened,
        predicted_b=predicted,
        field_b=predicted + np.einsum("nij,nj->ni", filter_gains.gain[:, :3], innovation),
        nominal_b=nominal,
        orientation=orientation,
        used=used,
        log_likelihood=np.where(used, _log_likelihood(whitened, root), 0.0),
        gains=filter_gains,
        recursion=_sensitivity_recursion(*recursion_inputs) if with_sensitivities else None,
    )


def _layout_and_run_starts(track: Track) -> tuple[Layout, NDArray[np.bool]]:
    """Block layout of the track's runs, and (N,) whether a row is the first of its run."""
    layout = layout_of(_runs(track))
    opens = np.zeros(len(track), dtype=bool)
    opens[layout.starts[layout.opens]] = True
    return layout, opens


def _runs(track: Track) -> tuple[slice, ...]:
    return track.runs or (slice(0, len(track)),)


def _log_likelihood(whitened: Array, root: Array) -> Array:
    """(N,) log likelihood of each innovation; undefined where root (N, 3, 3) is zero."""
    likelihood = -0.5 * np.sum(whitened**2, axis=1) - 1.5 * np.log(2 * np.pi)
    with np.errstate(divide="ignore"):
        likelihood += np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)), axis=1)
    return np.asarray(likelihood)


def sensitivities(filtered: Filtered, columns: Columns) -> Array:
    """Whitened regressors (N, 3, p): e~(theta) = e~ - X dtheta to first order, gains fixed.

    ValueError where the columns are empty for both sensors, or the run has no sensitivities.
    """
    if filtered.recursion is None:
        raise ValueError("this run of the filter was made without sensitivities")
    return filtered.recursion.run(columns.gyro, columns.mag)


def filtered_for_regression(filtered: Filtered, rate_b_rad_s: Array) -> Filtered:
    """The run with sensitivities and predicted fields that contain no gyro noise.

    rate_b_rad_s: (N, 3) without bias and without that noise
    ValueError where the run has no sensitivities.
    """
    if filtered.recursion is None:
        raise ValueError("this run of the filter was made without sensitivities")
    turn = _turn_matrices(filtered.track, rate_b_rad_s)
    observed = filtered.model.soft_iron @ turn
    size, matrix = filtered.recursion.states, filtered.recursion.matrix.copy()
    root = matrix[:, :3, size + 3 :]  # the whitening matrix
    matrix[:, :3, :3] = root @ observed
    matrix[:, 3:, :3] = -filtered.gains.gain @ observed
    matrix[:, 3:6, :3] += turn
    return replace(
        filtered,
        predicted_b=predicted_field(filtered, rate_b_rad_s),
        recursion=Recursion(filtered.recursion.layout, matrix),
    )


def predicted_field(filtered: Filtered, rate_b_rad_s: Array) -> Array:
    """(N, 3) gauss, the previous row's updated field, turned by these rates (N, 3)."""
    before = np.roll(filtered.field_b, 1, axis=0)
    turned = np.einsum("nij,nj->ni", _turn_matrices(filtered.track, rate_b_rad_s), before)
    return np.where(filtered.used[:, None], turned, filtered.predicted_b)


def _turn_matrices(track: Track, rate_b_rad_s: Array) -> Array:
    """(N, 3, 3) Exp(-w dt), 0 in the first row of each run."""
    turn = so3.exp(-rate_b_rad_s * np.nan_to_num(track.dt_s, nan=0.0)[:, None])
    turn[_layout_and_run_starts(track)[1]] = 0.0
    return turn


def nuisance_columns(filtered: Filtered) -> Columns:
    """The 11 columns of the calibration: soft iron (TRACELESS), hard iron, gyro bias."""
    count = len(filtered.track)
    mag, gyro = np.zeros((count, 3, 11)), np.zeros((count, 3, 11))
    mag[:, :, :5] = np.einsum("aij,nj->nia", TRACELESS, filtered.predicted_b)
    mag[:, :, 5:8] = np.eye(3)
    gyro[:, :, 8:] = np.eye(3)
    return Columns(mag, gyro)


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """dt_s (N,), 0 where unknown; turn Exp(-w dt) and lever Jl(-w dt) dt, (N, 3, 3).

    off_rad (N, 3): standard deviation of the turn, along the turn itself, where turns were lost;
    None where none were
    """

    dt_s: Array
    turn: Array
    lever: Array
    off_rad: Array | None = None


def _calibrated_readings(track: Track, model: NullModel, terms: Array | None) -> Array:
    """C (m - b - terms), (N, 3), with C = A^-1."""
    mag = track.mag_b_gauss if terms is None else track.mag_b_gauss - terms
    return np.asarray((mag - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron))


def _gyro_motion(track: Track, model: NullModel, terms: Array | None) -> _Motion:
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    if terms is not None:
        rate = rate - terms
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    turn, left = so3.exp_and_left_jacobian(-rate * dt[:, None])
    lost = track.lost_turns
    off = None if lost is None else rate * (track.step_share * dt * np.sqrt(lost))[:, None]
    return _Motion(dt, turn, left * dt[:, None, None], off)


def carried_orientation(track: Track, rate_b_rad_s: Array) -> Array:
    """(N, 3, 3) body to the frame carried along by these rates, I at each run's first row."""
    turn = so3.exp(-rate_b_rad_s * np.nan_to_num(track.dt_s, nan=0.0)[:, None])
    layout, opens = _layout_and_run_starts(track)
    return _integrate_turns(layout, turn, opens)


def _integrate_turns(layout: Layout, turn: Array, opens: NDArray[np.bool]) -> Array:
    """(N, 3, 3) body to carried frame: the product of all turns since the run began."""
    turned = np.where(opens[:, None, None], np.eye(3), turn)
    before, total = products_before(layout, turned)
    start = np.empty_like(total)
    R = np.eye(3)
    for b, first in enumerate(layout.opens):
        start[b] = R = np.eye(3) if first else R
        R = total[b] @ R
    lengths = layout.ends - layout.starts
    return np.swapaxes(turned @ before @ np.repeat(start, lengths, axis=0), 1, 2)


def _nominal_field(
    field: Array, orientation: Array, layout: Layout, model: NullModel, dt_s: Array
) -> Array:
    """Readings smoothed by exp(-|k| / memory) in the carried frame, scaled to their median size.

    Rows too far from any reading for that take a straight line between the nearest readings.
    """
    seen = _has_reading(field)
    carried = np.einsum("nij,nj->ni", orientation, np.where(seen[:, None], field, 0.0))
    size = float(np.median(np.linalg.norm(field[seen], axis=1))) if np.any(seen) else 1.0
    step = model.sigma_gyro_rad_s * float(np.median(dt_s)) * size / model.sigma_mag_gauss
    forget = np.clip(step * (np.sqrt(step**2 + 4) - step) / 2, 1e-4, 0.9)
    out = np.empty_like(carried)
    firsts = layout.starts[layout.opens]
    for first, last in zip(firsts, [*firsts[1:], len(field)], strict=True):
        out[first:last] = two_sided_sums(carried[first:last], 1.0 - forget)
        near = np.flatnonzero(seen[first:last])
        far = np.flatnonzero(np.max(np.abs(out[first:last]), axis=1) < _NEGLIGIBLE_GAUSS)
        if len(near) and len(far):
            between = [np.interp(far, near, axis) for axis in carried[first + near].T]
            out[first + far] = np.column_stack(between)
    out *= size / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)
    return np.asarray(np.einsum("nji,nj->ni", orientation, out))


def _has_reading(field: Array) -> NDArray[np.bool]:
    return np.asarray(np.isfinite(field).all(axis=1), dtype=np.bool)


def _field_per_rate_error(motion: _Motion, field_b: Array) -> Array:
    """-[h]x Jl dt, (N, 3, 3): derivative of the predicted field by the gyro's error."""
    return np.asarray(-so3.skew(field_b) @ motion.lever)


def _transition(
    motion: _Motion, nominal: Array, opens: NDArray[np.bool], model: NullModel
) -> Array:
    """(N, s, s): s is 6 with a random walk of the gyro bias, else 3."""
    turn = np.where(opens[:, None, None], 0.0, motion.turn)
    if model.gyro_walk_rad_s_sqrt_s == 0.0:
        return turn
    out = np.tile(np.eye(6), (len(turn), 1, 1))
    out[:, :3, :3] = turn
    out[:, :3, 3:] = _field_per_rate_error(motion, nominal)
    return out


def _linear_model(
    model: NullModel,
    motion: _Motion,
    nominal: Array,
    opens: NDArray[np.bool],
    blind: NDArray[np.bool],
) -> LinearModel:
    transition = _transition(motion, nominal, opens, model)
    before = np.einsum("nij,nj->ni", motion.turn, np.roll(nominal, 1, axis=0))
    middle = nominal + np.where(opens[:, None], nominal, before)
    size = np.linalg.norm(nominal, axis=1, keepdims=True)
    middle *= size / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    tangent = np.eye(3) * (size**2)[:, :, None] - middle[:, :, None] * middle[:, None, :]
    process = np.zeros_like(transition)
    process[:, :3, :3] = tangent * np.square(model.sigma_gyro_rad_s * motion.dt_s)[:, None, None]
    if motion.off_rad is not None:
        off = np.cross(middle, motion.off_rad)
        process[:, :3, :3] += off[:, :, None] * off[:, None, :]
    if transition.shape[-1] == 6:
        process[:, [3, 4, 5], [3, 4, 5]] = model.gyro_walk_rad_s_sqrt_s**2 * motion.dt_s[:, None]
    C = np.linalg.inv(model.soft_iron)
    process[opens, :3, :3] = model.sigma_mag_gauss**2 * C @ C.T
    unread_start = opens & blind
    process[unread_start, :3, :3] = (
        np.eye(3) * (priors.UNSEEN_FIELD * size[unread_start, :, None]) ** 2
    )
    return LinearModel(transition, process, model.soft_iron, model.sigma_mag_gauss**2, opens, blind)


def _predicted_fields(
    layout: Layout, state: Array, filter_gains: Gains, A: Array, field: Array
) -> Array:
    """Predicted fields (N, 3); in a run's first row the reading itself."""
    size = state.shape[-1]
    opens = layout.starts[layout.opens]
    gain = (filter_gains.gain.reshape(-1, 3) @ A).reshape(filter_gains.gain.shape)
    gain[opens, :3] = np.eye(3)  # independent of the soft iron that the gains were made for
    matrix = np.zeros((len(state), 3 + size, size + 6))
    matrix[:, :3, :size] = state[:, :3]
    matrix[:, 3:, :size] = state - gain @ state[:, :3]
    matrix[:, 3:, size + 3 :] = gain
    predicted = Recursion(layout, matrix).run(None, field[:, :, None])[:, :, 0]
    predicted[opens] = field[opens]
    return predicted


def _sensitivity_recursion(
    layout: Layout,
    state: Array,
    filter_gains: Gains,
    A: Array,
    root: Array,
    motion: _Motion,
    predicted: Array,
) -> Recursion:
    """The recursion of T, X and H+, whitened."""
    size = state.shape[-1]
    driven = np.zeros((len(state), size, size + 6))
    driven[:, :, :size] = state
    driven[:, :3, size : size + 3] = _field_per_rate_error(motion, predicted)
    observed = A @ driven[:, :3]
    observed[:, :, size + 3 :] += np.eye(3)
    matrix = np.concatenate([root @ observed, driven - filter_gains.gain @ observed], axis=1)
    return Recursion(layout, matrix)


def _inverse_root(S: Array) -> Array:
    """L^-1 of S = L L^T, (N, 3, 3), in closed form."""
    a = np.sqrt(S[:, 0, 0])
    b, c = S[:, 1, 0] / a, S[:, 2, 0] / a
    d = np.sqrt(S[:, 1, 1] - b * b)
    e = (S[:, 2, 1] - b * c) / d
    f = np.sqrt(S[:, 2, 2] - c * c - e * e)
    out = np.zeros_like(S)
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = 1 / a, 1 / d, 1 / f
    out[:, 1, 0] = -b / (a * d)
    out[:, 2, 1] = -e / (d * f)
    out[:, 2, 0] = (b * e - c * d) / (a * d * f)
    return out


def batch_columns(columns: Sequence[Columns], most: int) -> list[list[int]]:
    """Indices of the columns, batched by sensor, at most `most` wide where possible."""
    out: list[list[int]] = []
    sides = [(part.mag is None, part.gyro is None) for part in columns]
    for side in dict.fromkeys(sides):
        room = 0
        for number in (k for k, one in enumerate(sides) if one == side):
            width = columns[number].width
            if room == 0 or width > room:
                out.append([])
                room = most
            out[-1].append(number)
            room = max(0, room - width)
    return out


def join_columns(parts: Sequence[Columns]) -> Columns:
    """The columns of one batch side by side."""
    if len(parts) == 1:
        return parts[0]
    mag = [part.mag for part in parts if part.mag is not None]
    gyro = [part.gyro for part in parts if part.gyro is not None]
    return Columns(
        np.concatenate(mag, axis=2) if mag else None,
        np.concatenate(gyro, axis=2) if gyro else None,
    )
