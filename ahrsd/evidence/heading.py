"""Compares magnetic heading with gyro heading on held-out data.

Within a segment (at most one slot long) the corrected field, rotated into the segment's first frame
by the gyro, must be constant. Its rotation about down is tilt-compensated magnetic heading minus
gyro heading, up to one unknown constant that is removed: the heading error. Both calibrations use
the candidate's gyro bias, so that only the magnetometer is judged. Errors are averaged over one
second, because the noise of single samples is no calibration error.
"""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.evidence.segments import NODE_RATE_HZ, Nodes
from ahrsd.evidence.values import NO_PROOF, SECTOR_DEG, SECTORS, Bools, HeadingProof
from ahrsd.samples import Array

_PER_MEAN = round(NODE_RATE_HZ)
_BLOCK = 10  # one-second means in one block of the bootstrap
_DRAWS = 500
_SEED = 23
_LEVEL_ENOUGH = 0.3  # horizontal part of the x axis below which there is no heading
_TYPICAL_DIP_RAD = np.radians(65.0)  # if gravity is not known


def compare_heading_errors(
    everything: Nodes, heading_rad: Array, after: Affine, before: Affine, least_turn_deg: float
) -> HeadingProof:
    """Heading errors of `after` and `before` on held-out segments with enough turning.

    `heading_rad` (N,) is `gyro_heading_rad` of all nodes; `least_turn_deg`: per segment.
    """
    chosen = everything.heldout & (heading_range_deg(everything, heading_rad) >= least_turn_deg)
    nodes = everything.select(chosen)
    if nodes is None:
        return NO_PROOF
    heading_rad = heading_rad[chosen[everything.segment]]
    errors = np.column_stack([heading_errors_deg(nodes, c) for c in (after, before)])
    windows = [_one_second_means(errors[a:b]) for a, b in _ranges(nodes)]
    turns = [_one_second_means(np.degrees(heading_rad[a:b, None]))[:, 0] for a, b in _ranges(nodes)]
    if nodes.has_gravity:
        windows = [w - np.mean(w, axis=0) for w in windows]
    pooled = np.concatenate(windows)
    rms_deg = np.sqrt(np.mean(pooled**2, axis=0))
    return HeadingProof(
        windows=len(windows),
        sectors=visited_sectors(heading_rad),
        rms_before_deg=float(rms_deg[1]),
        rms_after_deg=float(rms_deg[0]),
        max_after_deg=float(np.max(np.abs(pooled[:, 0]))),
        closure_deg=_closure_deg(turns, [w[:, 0] for w in windows]),
        gain_lower_deg=_gain_lower_deg(windows),
    )


def mean_field_0(nodes: Nodes, correction: Affine) -> Array:
    """(S, 3) mean corrected field of each segment, in its first frame."""
    return nodes.mean(_field_in_first_frame(nodes, correction))


def gyro_heading_rad(nodes: Nodes, field_0: Array) -> Array:
    """(N,) heading of the x axis from each segment's mean field direction (S, 3).

    Unwrapped within each segment; whole turns between segments are arbitrary. nan if the x axis
    is within 17 degrees of vertical, or if gravity is not known.
    """
    north, east = _level_axes(nodes.down_0, field_0)
    x_0 = nodes.R_0b[:, :, 0]
    n = np.sum(x_0 * north[nodes.segment], axis=1)
    e = np.sum(x_0 * east[nodes.segment], axis=1)
    heading = np.where(np.hypot(n, e) > _LEVEL_ENOUGH, np.arctan2(e, n), np.nan)
    known = np.isfinite(heading)
    heading[known] = np.unwrap(heading[known])
    return heading


def heading_range_deg(nodes: Nodes, heading_rad: Array) -> Array:
    """(S,) range of heading within each segment; without gravity, the total turn of the gyro."""
    if not nodes.has_gravity:
        return np.degrees([t.segment.turned_rad for t in nodes.tracks])
    high = np.fmax.reduceat(heading_rad, nodes.starts)
    low = np.fmin.reduceat(heading_rad, nodes.starts)
    return np.asarray(np.degrees(np.nan_to_num(high - low)))


def heading_errors_deg(nodes: Nodes, correction: Affine) -> Array:
    """(N,) heading error of a calibration; without gravity an unsigned upper estimate."""
    h_0 = _field_in_first_frame(nodes, correction)
    mean_0 = nodes.mean(h_0)
    if nodes.has_gravity:
        north, east = _level_axes(nodes.down_0, mean_0)
        n = np.sum(h_0 * north[nodes.segment], axis=1)
        e = np.sum(h_0 * east[nodes.segment], axis=1)
        return np.asarray(
            -np.degrees(np.arctan2(e, n))
        )  # north too far right: heading reads too far left
    mean_0 = mean_0 / np.linalg.norm(mean_0, axis=1, keepdims=True)
    off = np.cross(mean_0[nodes.segment], h_0 / np.linalg.norm(h_0, axis=1, keepdims=True))
    return np.asarray(np.degrees(np.linalg.norm(off, axis=1) / np.cos(_TYPICAL_DIP_RAD)))


def visited_sectors(heading_rad: Array) -> Bools:
    """(36,) which ten-degree sectors the headings visited; nan is ignored."""
    known = heading_rad[np.isfinite(heading_rad)]
    seen = np.zeros(SECTORS, dtype=bool)
    seen[(np.degrees(known) // SECTOR_DEG).astype(int) % SECTORS] = True
    return seen


def _field_in_first_frame(nodes: Nodes, correction: Affine) -> Array:
    return np.asarray((nodes.R_0b @ correction.apply(nodes.raw_b_gauss)[..., None])[..., 0])


def _level_axes(down_0: Array, along_0: Array) -> tuple[Array, Array]:
    """Unit vectors normal to down: along the horizontal part of `along_0`, and to its right."""
    forward = along_0 - np.sum(along_0 * down_0, axis=-1, keepdims=True) * down_0
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    return forward, np.cross(down_0, forward)


def _ranges(nodes: Nodes) -> list[tuple[int, int]]:
    return list(zip(nodes.starts, [*nodes.starts[1:], len(nodes.time_s)], strict=True))


def _one_second_means(values: Array) -> Array:
    """Means of (n, c) over one second of nodes; an incomplete last second is left out."""
    whole = len(values) // _PER_MEAN * _PER_MEAN
    return np.asarray(values[:whole].reshape(-1, _PER_MEAN, values.shape[1]).mean(axis=1))


def _closure_deg(turns_deg: list[Array], errors_deg: list[Array]) -> float:
    """How much the heading error changes over 360 degrees.

    If a window holds a full turn: mean change between its pairs one turn apart, worst window.
    Otherwise 360 times the slope of error over turn in all windows, if they turned 360 in total.
    """
    changes = [
        change
        for turn, error in zip(turns_deg, errors_deg, strict=True)
        if np.isfinite(change := _full_turn_change_deg(turn, error))
    ]
    if changes:
        return float(np.max(np.abs(changes)))
    known = [np.isfinite(t) for t in turns_deg]
    parts = [(t[k], e[k]) for t, e, k in zip(turns_deg, errors_deg, known, strict=True) if k.any()]
    if sum(float(np.ptp(t)) for t, _ in parts) < 360.0:
        return float("nan")
    turn = np.concatenate([t - np.mean(t) for t, _ in parts])
    error = np.concatenate([e - np.mean(e) for _, e in parts])
    return float(abs(turn @ error / (turn @ turn) * 360.0))


def _full_turn_change_deg(turn_deg: Array, error_deg: Array) -> float:
    apart = turn_deg[None, :] - turn_deg[:, None]
    i, j = np.nonzero(np.abs(apart - 360.0) < SECTOR_DEG)
    return float(np.mean(error_deg[j] - error_deg[i])) if len(i) else float("nan")


def _gain_lower_deg(windows: list[Array]) -> float:
    """Lower 95 % bound of rms before - rms after, by resampling ten-second blocks (seeded)."""
    blocks = [w[k : k + _BLOCK] for w in windows for k in range(0, len(w), _BLOCK)]
    if len(blocks) < 4:
        return float("nan")
    sums = np.array([np.sum(b**2, axis=0) for b in blocks])
    counts = np.array([len(b) for b in blocks])
    draws = np.random.default_rng(_SEED).integers(len(blocks), size=(_DRAWS, len(blocks)))
    rms = np.sqrt(sums[draws].sum(axis=1) / counts[draws].sum(axis=1)[:, None])
    return float(np.quantile(rms[:, 1] - rms[:, 0], 0.025))
