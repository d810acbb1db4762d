"""Attitude inside a segment: gyro integrated, gravity fitted, nothing else believed.

For sample k of a segment, R_0k turns vectors of the sensor frame at k into the sensor frame at the
segment's first sample. The one unknown is where down is in frame 0: the mean of the specific force
seen from frame 0, in which a vehicle's own accelerations average out and gravity does not. With the
right calibration R_0k h_k is constant *whatever* down is, so an error of gravity never turns a good
calibration into a bad one.

A gyro bias that differs by d from the one used here needs no new integration:

    R_0k(b + d) = Exp(-P_k d) R_0k(b),   P_k = sum_j R_0j dt_j

to first order in |d| t; beyond 0.05 rad the segment is integrated again.
Checked by tests/evidence/test_evidence_attitude.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.evidence.history import Segment
from ahrsd.samples import Array

Bools = NDArray[np.bool_]
NODE_RATE_HZ = 5.0
_REINTEGRATE_RAD = 0.05
_GRAVITY_M_S2 = 9.81
_CALM_M_S2 = 0.5  # a force that differs from gravity by this much counts half


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeTrack:
    """One segment's attitude at nodes of about 5 Hz.

    time_s (k,); raw_b_gauss (k, 3); R_0b (k, 3, 3); drift_s (k, 3, 3) is P_k;
    force_0_m_s2 (k, 3): specific force averaged around the node, in frame 0; bias_b_rad_s (3,).
    """

    segment: Segment
    time_s: Array
    raw_b_gauss: Array
    R_0b: Array
    drift_s: Array
    force_0_m_s2: Array
    bias_b_rad_s: Array

    def usable_for(self, bias_b_rad_s: Array) -> bool:
        """Whether the first-order correction to this bias is good enough."""
        turned = np.linalg.norm(bias_b_rad_s - self.bias_b_rad_s) * (
            self.time_s[-1] - self.time_s[0]
        )
        return bool(turned < _REINTEGRATE_RAD)


def track(segment: Segment, bias_b_rad_s: Array) -> AttitudeTrack:
    """Integrate a segment."""
    dt_s = np.diff(segment.time_s, prepend=segment.time_s[:1])
    R = so3.products(so3.exp(segment.angle_b_rad - np.outer(dt_s, bias_b_rad_s)))
    middle = (R + np.concatenate([R[:1], R[:-1]])) / 2
    drift_s = np.cumsum(middle * dt_s[:, None, None], axis=0)
    force_0 = np.einsum("kij,kj->ki", R, segment.accel_b_m_s2)
    step_s = float(np.median(dt_s[1:]))
    stride = max(1, round(1.0 / (NODE_RATE_HZ * step_s)))
    nodes = np.arange(stride // 2, len(segment), stride)
    starts = np.arange(len(nodes)) * stride
    counts = np.diff(np.append(starts, len(segment)))
    return AttitudeTrack(
        segment=segment,
        time_s=segment.time_s[nodes],
        raw_b_gauss=segment.raw_b_gauss[nodes],
        R_0b=R[nodes],
        drift_s=drift_s[nodes],
        force_0_m_s2=np.add.reduceat(force_0, starts) / counts[:, None],
        bias_b_rad_s=np.array(bias_b_rad_s, dtype=float),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """All nodes of all segments, at one gyro bias.

    segment (N,): index of the node's segment; starts (S,): first node of each segment;
    down_0 (S, 3): unit vector, nan where the stream has no accelerometer; heldout (S,);
    rough_m_s2 (S,): rms of |force| - gravity.
    """

    time_s: Array
    raw_b_gauss: Array
    R_0b: Array
    segment: NDArray[np.intp]
    starts: NDArray[np.intp]
    heldout: Bools
    down_0: Array
    rough_m_s2: Array
    tracks: tuple[AttitudeTrack, ...]

    @property
    def has_gravity(self) -> bool:
        """Whether down is known in every segment."""
        return bool(np.isfinite(self.down_0).all())

    @property
    def down_b(self) -> Array:
        """(N, 3) down in the sensor frame at each node."""
        return np.asarray(np.einsum("nji,nj->ni", self.R_0b, self.down_0[self.segment]))

    def only(self, chosen: Bools) -> Nodes | None:
        """The segments marked in `chosen` (S,); None where there are none."""
        if not chosen.any():
            return None
        rows = chosen[self.segment]
        counts = np.diff(np.append(self.starts, len(rows)))[chosen]
        return Nodes(
            time_s=self.time_s[rows],
            raw_b_gauss=self.raw_b_gauss[rows],
            R_0b=self.R_0b[rows],
            segment=np.repeat(np.arange(len(counts)), counts),
            starts=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp),
            heldout=self.heldout[chosen],
            down_0=self.down_0[chosen],
            rough_m_s2=self.rough_m_s2[chosen],
            tracks=tuple(t for t, c in zip(self.tracks, chosen, strict=True) if c),
        )

    def mean(self, values: Array) -> Array:
        """Mean over each segment's nodes: (N, ...) to (S, ...)."""
        counts = np.diff(np.append(self.starts, len(values)))
        shape = (-1,) + (1,) * (values.ndim - 1)
        return np.asarray(np.add.reduceat(values, self.starts) / counts.reshape(shape))


def nodes_at(tracks: Sequence[AttitudeTrack], bias_b_rad_s: Array) -> Nodes | None:
    """Put the segments together at a gyro bias; None without segments."""
    if not tracks:
        return None
    counts = [len(t.time_s) for t in tracks]
    segment = np.repeat(np.arange(len(tracks)), counts)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp)
    offset = np.array([bias_b_rad_s - t.bias_b_rad_s for t in tracks])[segment]
    drift_s = np.concatenate([t.drift_s for t in tracks])
    turn = so3.exp(-(drift_s @ offset[..., None])[..., 0])
    force_0 = (turn @ np.concatenate([t.force_0_m_s2 for t in tracks])[..., None])[..., 0]
    excess = np.linalg.norm(force_0, axis=1) - _GRAVITY_M_S2
    weight = 1.0 / (1.0 + (excess / _CALM_M_S2) ** 2)
    down_0 = -np.add.reduceat(weight[:, None] * force_0, starts)
    down_0 /= np.linalg.norm(down_0, axis=1, keepdims=True)
    return Nodes(
        time_s=np.concatenate([t.time_s for t in tracks]),
        raw_b_gauss=np.concatenate([t.raw_b_gauss for t in tracks]),
        R_0b=turn @ np.concatenate([t.R_0b for t in tracks]),
        segment=segment,
        starts=starts,
        heldout=np.array([t.segment.heldout for t in tracks]),
        down_0=down_0,
        rough_m_s2=np.sqrt(np.add.reduceat(excess**2, starts) / np.array(counts)),
        tracks=tuple(tracks),
    )
