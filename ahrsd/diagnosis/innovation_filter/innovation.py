"""Innovations of the field's filter, whitened, and how they move with any parameter.

State: the field in body axes h, and where the null says so the gyro's wandering bias.

    predict  h- = Exp(-(w_k - w_b) dt) h+,   process noise (sigma_gyro dt)^2 (|n|^2 I - n n^T)
                                             + q q^T,  q = n x (w_k - w_b) dt s
    update   e = m - A h- - b,  S = A P- A^T + sigma_mag^2 I,  K = P- A^T S^-1,  h+ = h- + K e

A gyro turns the field, it does not stretch it, so its noise is tangential to the sphere |h| = r.
Tangential to the filter's own h, additive updates lengthen h by |step|^2 / 2 r each: an "external
field trend" on every recording.  So n is not the filter's h but a nominal field: the readings,
smoothed both ways in the frame that the gyro carries along, on the sphere, in the middle of the
step.  The filter is then linear with gains that do not depend on a single innovation, and with the
gain held the sensitivities are exact (s: deviation of a turn by those of
`Track.lost_turns`, a Poisson number, in parts of itself):

    T = F H+ - dt [h-]x Jl W_k,   X_k = A T + D_k,   H+ = T - K X_k

Whitened by S = L L^T: under the null L^-1 e = L^-1 X dtheta + white of variance 1.

These are the derivatives of the innovations, which a descent needs.  To regress on (`regressing`)
they will not do: turns and foretold fields hold the noise of the gyro that the innovations are made
of (errors in variables), and of 5 mrad/s beside .1 mG that made a field that turns with the heading
of 440 nats in nothing.  There F, and h- in the calibration's columns, are of the smoothed rate.

A run's first row starts the field from its reading (`used` is false there): h+ = A^-1 (m - b).
Where that row has no reading the field starts from the nominal one, unsure by half of its size: the
first reading decides.

Columns pass the filter next to each other, many at once (`batches`, `joined`), zeros on no side.
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
    Linear,
    Recursion,
    gains,
    layout_of,
    products_before,
)
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.time_series import both_ways
from ahrsd.diagnosis.track import Track
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: gauss; what is left of the nearest reading where it is many hundred rows away: squares of smaller
#: numbers are none
_OUT_OF_REACH = 1e-100


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """A track as the filter saw it; rows as in the track.

    innovation:   (N, 3) gauss, 0 where not `used`;  whitened: (N, 3), variance 1 under the null
    predicted_b:  (N, 3) gauss, the field before each reading;  field_b: after it
    nominal_b:    (N, 3) gauss, smoothed both ways, constant in size
    orientation:  (N, 3, 3) body to a frame that the gyro carries along, I at each run's first row
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
class Bearings:
    """What a run of the filter says of the motion, before any gain; fields as of `Filtered`."""

    model: NullModel
    nominal_b: Array
    orientation: Array


def bearings(
    track: Track,
    model: NullModel,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
) -> Bearings:
    """The same as `run_filter` has with these arguments, for a tenth of the time."""
    motion = _motion(track, model, terms_gyro)
    layout, opens = _laid_out(track)
    orientation = _orientation(layout, motion.turn, opens)
    field = _readings(track, model, terms_mag)
    return Bearings(model, _nominal(field, orientation, layout, model, motion.dt_s), orientation)


def run_filter(
    track: Track,
    model: NullModel,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
    *,
    held: Filtered | None = None,
    sensitive: bool = True,
) -> Filtered:
    """Filter a track.  terms_*: (N, 3) contributions of the named terms, subtracted first.

    held: take gains and nominal field of this earlier run (same track), not the model's own
    sensitive: false where only innovations are wanted, not what `sensitivities` needs
    Rows whose reading is not finite are passed over.  ValueError where a run has no rows,
    LinAlgError where the model is so far off that its innovations have no finite size.
    """
    field, motion = _readings(track, model, terms_mag), _motion(track, model, terms_gyro)
    layout, opens = _laid_out(track)
    blind, orientation = ~_complete(field), _orientation(layout, motion.turn, opens)
    if held is None:
        nominal = _nominal(field, orientation, layout, model, motion.dt_s)
        linear = _linear(model, motion, nominal, opens, blind)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = gains(linear, _runs(track))
    else:
        nominal, found = held.nominal_b, held.gains
    guessed = opens & blind
    found.gain[guessed] = 0.0
    field = np.where(guessed[:, None], nominal, field)
    state, used = _transition(motion, nominal, opens, model), ~(opens | blind)
    readings = np.where((blind & ~guessed)[:, None], 0, field)
    predicted = _predicted(layout, state, found, model.soft_iron, readings)
    innovation = np.where(used[:, None], (field - predicted) @ model.soft_iron, 0.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        root = _inverse_root(found.innovation_covariance)
    if not np.isfinite(root).all():
        raise np.linalg.LinAlgError("innovations of no finite size: the model is far off")
    root = root * used[:, None, None]
    whitened = np.einsum("nij,nj->ni", root, innovation)
    needed = (layout, state, found, model.soft_iron, root, motion, predicted)
    return Filtered(
        track=track,
        model=model,
        innovation=innovation,
        whitened=whitened,
        predicted_b=predicted,
        field_b=predicted + np.einsum("nij,nj->ni", found.gain[:, :3], innovation),
        nominal_b=nominal,
        orientation=orientation,
        used=used,
        log_likelihood=np.where(used, _log_likelihood(whitened, root), 0.0),
        gains=found,
        recursion=_sensitivity(*needed) if sensitive else None,
    )


def _laid_out(track: Track) -> tuple[Layout, NDArray[np.bool]]:
    """The track's runs as the filter passes them, and (N,) the rows with which a run opens."""
    layout = layout_of(_runs(track))
    opens = np.zeros(len(track), dtype=bool)
    opens[layout.starts[layout.opens]] = True
    return layout, opens


def _runs(track: Track) -> tuple[slice, ...]:
    return track.runs or (slice(0, len(track)),)


def _log_likelihood(whitened: Array, root: Array) -> Array:
    """Per row; whatever where root (N, 3, 3) is zero."""
    likelihood = -0.5 * np.sum(whitened**2, axis=1) - 1.5 * np.log(2 * np.pi)
    with np.errstate(divide="ignore"):
        likelihood += np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)), axis=1)
    return np.asarray(likelihood)


def sensitivities(filtered: Filtered, columns: Columns) -> Array:
    """Whitened regressors (N, 3, p): e~(theta) = e~ - X dtheta to first order, gain held.

    ValueError where the columns are empty on both sides, or the run was not `sensitive`.
    """
    if filtered.recursion is None:
        raise ValueError("this run of the filter was made without sensitivities")
    return filtered.recursion.run(columns.gyro, columns.mag)


def regressing(filtered: Filtered, rate_b_rad_s: Array) -> Filtered:
    """The run with sensitivities and foretold fields that hold no noise of the gyro.

    rate_b_rad_s: (N, 3) without bias and without that noise
    ValueError where the run was not `sensitive`.
    """
    if filtered.recursion is None:
        raise ValueError("this run of the filter was made without sensitivities")
    turn = _turn(filtered.track, rate_b_rad_s)
    seen = filtered.model.soft_iron @ turn
    size, matrix = filtered.recursion.states, filtered.recursion.matrix.copy()
    root = matrix[:, :3, size + 3 :]  # what a field on the reading is whitened by
    matrix[:, :3, :3] = root @ seen
    matrix[:, 3:, :3] = -filtered.gains.gain @ seen
    matrix[:, 3:6, :3] += turn
    return replace(
        filtered,
        predicted_b=foretold(filtered, rate_b_rad_s),
        recursion=Recursion(filtered.recursion.layout, matrix),
    )


def foretold(filtered: Filtered, rate_b_rad_s: Array) -> Array:
    """(N, 3) gauss, the field behind the row before, turned on by these rates (N, 3)."""
    before = np.roll(filtered.field_b, 1, axis=0)
    turned = np.einsum("nij,nj->ni", _turn(filtered.track, rate_b_rad_s), before)
    return np.where(filtered.used[:, None], turned, filtered.predicted_b)


def _turn(track: Track, rate_b_rad_s: Array) -> Array:
    """(N, 3, 3) Exp(-w dt), 0 in the rows with which runs open."""
    turn = so3.exp(-rate_b_rad_s * np.nan_to_num(track.dt_s, nan=0.0)[:, None])
    turn[_laid_out(track)[1]] = 0.0
    return turn


def nuisance_columns(filtered: Filtered) -> Columns:
    """The calibration's own 11 columns: soft iron (TRACELESS), hard iron, gyro bias."""
    count = len(filtered.track)
    mag, gyro = np.zeros((count, 3, 11)), np.zeros((count, 3, 11))
    mag[:, :, :5] = np.einsum("aij,nj->nia", TRACELESS, filtered.predicted_b)
    mag[:, :, 5:8] = np.eye(3)
    gyro[:, :, 8:] = np.eye(3)
    return Columns(mag, gyro)


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """dt_s (N,), 0 where unknown; turn Exp(-w dt) and lever Jl(-w dt) dt, (N, 3, 3).

    off_rad (N, 3): deviation of the turn, along itself, where turns were lost; None where none were
    """

    dt_s: Array
    turn: Array
    lever: Array
    off_rad: Array | None = None


def _readings(track: Track, model: NullModel, terms: Array | None) -> Array:
    """C (m - b - terms), (N, 3)."""
    mag = track.mag_b_gauss if terms is None else track.mag_b_gauss - terms
    return np.asarray((mag - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron))


def _motion(track: Track, model: NullModel, terms: Array | None) -> _Motion:
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    if terms is not None:
        rate = rate - terms
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    turn, left = so3.exp_and_left_jacobian(-rate * dt[:, None])
    lost = track.lost_turns
    off = None if lost is None else rate * (track.step_share * dt * np.sqrt(lost))[:, None]
    return _Motion(dt, turn, left * dt[:, None, None], off)


def carried_along(track: Track, rate_b_rad_s: Array) -> Array:
    """(N, 3, 3) body to the frame that these rates carry along, I at each run's first row."""
    turn = so3.exp(-rate_b_rad_s * np.nan_to_num(track.dt_s, nan=0.0)[:, None])
    layout, opens = _laid_out(track)
    return _orientation(layout, turn, opens)


def _orientation(layout: Layout, turn: Array, opens: NDArray[np.bool]) -> Array:
    """(N, 3, 3) body to the frame that the gyro carries along: all turns since a run began."""
    turned = np.where(opens[:, None, None], np.eye(3), turn)
    before, total = products_before(layout, turned)
    start = np.empty_like(total)
    R = np.eye(3)
    for b, first in enumerate(layout.opens):
        start[b] = R = np.eye(3) if first else R
        R = total[b] @ R
    lengths = layout.ends - layout.starts
    return np.swapaxes(turned @ before @ np.repeat(start, lengths, axis=0), 1, 2)


def _nominal(
    field: Array, orientation: Array, layout: Layout, model: NullModel, dt_s: Array
) -> Array:
    """The field smoothed by exp(-|k| / memory) in the carried frame, of the runs' median size.

    Where the nearest reading is too far away for that, a straight line between readings.
    """
    seen = _complete(field)
    carried = np.einsum("nij,nj->ni", orientation, np.where(seen[:, None], field, 0.0))
    size = float(np.median(np.linalg.norm(field[seen], axis=1))) if np.any(seen) else 1.0
    step = model.sigma_gyro_rad_s * float(np.median(dt_s)) * size / model.sigma_mag_gauss
    forget = np.clip(step * (np.sqrt(step**2 + 4) - step) / 2, 1e-4, 0.9)
    out = np.empty_like(carried)
    firsts = layout.starts[layout.opens]
    for first, last in zip(firsts, [*firsts[1:], len(field)], strict=True):
        out[first:last] = both_ways(carried[first:last], 1.0 - forget)
        near = np.flatnonzero(seen[first:last])
        far = np.flatnonzero(np.max(np.abs(out[first:last]), axis=1) < _OUT_OF_REACH)
        if len(near) and len(far):
            between = [np.interp(far, near, axis) for axis in carried[first + near].T]
            out[first + far] = np.column_stack(between)
    out *= size / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)
    return np.asarray(np.einsum("nji,nj->ni", orientation, out))


def _complete(field: Array) -> NDArray[np.bool]:
    return np.asarray(np.isfinite(field).all(axis=1), dtype=np.bool)


def _lever(motion: _Motion, field_b: Array) -> Array:
    """-[h]x Jl dt, (N, 3, 3): how the predicted field moves with the gyro's reading error."""
    return np.asarray(-so3.skew(field_b) @ motion.lever)


def _transition(
    motion: _Motion, nominal: Array, opens: NDArray[np.bool], model: NullModel
) -> Array:
    """(N, s, s): s is 6 with a wandering gyro bias, else 3."""
    turn = np.where(opens[:, None, None], 0.0, motion.turn)
    if model.gyro_walk_rad_s_sqrt_s == 0.0:
        return turn
    out = np.tile(np.eye(6), (len(turn), 1, 1))
    out[:, :3, :3] = turn
    out[:, :3, 3:] = _lever(motion, nominal)
    return out


def _linear(
    model: NullModel,
    motion: _Motion,
    nominal: Array,
    opens: NDArray[np.bool],
    blind: NDArray[np.bool],
) -> Linear:
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
    lost = opens & blind
    process[lost, :3, :3] = np.eye(3) * (priors.UNSEEN_FIELD * size[lost, :, None]) ** 2
    return Linear(transition, process, model.soft_iron, model.sigma_mag_gauss**2, opens, blind)


def _predicted(layout: Layout, state: Array, found: Gains, A: Array, field: Array) -> Array:
    """Predicted fields (N, 3); in a run's first row the reading itself."""
    size = state.shape[-1]
    opens = layout.starts[layout.opens]
    gain = (found.gain.reshape(-1, 3) @ A).reshape(found.gain.shape)
    gain[opens, :3] = np.eye(3)  # whatever soft iron the gains were made for
    matrix = np.zeros((len(state), 3 + size, size + 6))
    matrix[:, :3, :size] = state[:, :3]
    matrix[:, 3:, :size] = state - gain @ state[:, :3]
    matrix[:, 3:, size + 3 :] = gain
    predicted = Recursion(layout, matrix).run(None, field[:, :, None])[:, :, 0]
    predicted[opens] = field[opens]
    return predicted


def _sensitivity(
    layout: Layout,
    state: Array,
    found: Gains,
    A: Array,
    root: Array,
    motion: _Motion,
    predicted: Array,
) -> Recursion:
    """The recursion of T, X and H+, whitened."""
    size = state.shape[-1]
    driven = np.zeros((len(state), size, size + 6))
    driven[:, :, :size] = state
    driven[:, :3, size : size + 3] = _lever(motion, predicted)
    seen = A @ driven[:, :3]
    seen[:, :, size + 3 :] += np.eye(3)
    matrix = np.concatenate([root @ seen, driven - found.gain @ seen], axis=1)
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


def batches(columns: Sequence[Columns], most: int) -> list[list[int]]:
    """Numbers of the columns, those of one side together, no more than `most` wide if possible."""
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


def joined(parts: Sequence[Columns]) -> Columns:
    """Columns of one batch next to each other."""
    if len(parts) == 1:
        return parts[0]
    mag = [part.mag for part in parts if part.mag is not None]
    gyro = [part.gyro for part in parts if part.gyro is not None]
    return Columns(
        np.concatenate(mag, axis=2) if mag else None,
        np.concatenate(gyro, axis=2) if gyro else None,
    )
