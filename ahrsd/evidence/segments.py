"""History of the evidence: averaged samples in segments, some held out, and their attitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.evidence.values import Bools
from ahrsd.samples import Array, SampleBlock

# -- Samples in segments ---------------------------------------------------------------------------
#
# Samples are averaged to at most 25 Hz. Field, force, time and *accumulated angle* are averaged
# with the same weights, and the angle is differenced afterwards, so all four belong to the same
# instant at any stream rate.
#
# Time is divided into slots of `segment_s`. Every `heldout_every`-th slot is held out: the
# estimator never gets it. A segment is contiguous data inside one slot: a gap, a change of role or
# of the register epoch ends it. The number of segments is bounded; segments at rest are dropped
# before segments with motion.


_CLOCK_S = 1e-6  # a sample this close before a boundary counts as on it
Role = Literal["train", "heldout"]


@dataclass(frozen=True, slots=True)
class HistoryParameters:
    """How the stream is divided and how much of it is kept."""

    segment_s: float = 30.0  # longer: slower vehicles show a full turn in one, later first verdict
    heldout_every: int = 4  # smaller: more proof, less data for the estimate
    rate_hz: float = 25.0  # averaged rate: larger follows faster motion, costs memory
    shortest_s: float = 5.0  # a shorter piece between two gaps is dropped
    segments: int = 120  # one hour
    moving_deg: float = 20.0  # a segment that turned less counts as rest when one is dropped


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Contiguous averaged samples of one role; `number` counts segments since the start.

    time_s (n,); raw_b_gauss (n, 3); angle_b_rad (n, 3): gyro integrated from the previous row to
    this one, bias not removed, first row zero; accel_b_m_s2 (n, 3), nan if the stream has none;
    turned_rad: sum of the angles; averaged: samples of the stream in one row.
    """

    number: int
    heldout: bool
    time_s: Array
    raw_b_gauss: Array
    angle_b_rad: Array
    accel_b_m_s2: Array
    temperature_c: float
    turned_rad: float
    averaged: int

    def __len__(self) -> int:
        return len(self.time_s)


class SegmentHistory:
    """Turns blocks into segments. Deterministic: depends on device time and blocks only."""

    def __init__(self, parameters: HistoryParameters | None = None) -> None:
        self.parameters = parameters or HistoryParameters()
        self.segments: list[Segment] = []
        self._start_s: float | None = None
        self._newest_s = np.inf  # no block yet: the first one begins a segment
        self._closed = 0
        self._open = _Averager(1)
        self._role: Role = "train"
        self._slot = 0
        self._epoch = 0

    def role(self, block: SampleBlock) -> Role:
        """Role of a block that is to be added next: that of its first sample's slot."""
        if len(block) == 0:
            return self._role
        first_s = float(block.time_s[0])
        return self._role_of(self._slot_of(first_s, self._slot_origin_s(first_s)))

    def split(self, block: SampleBlock) -> list[tuple[Role, SampleBlock]]:
        """The block split at slot boundaries; `gap_before` is set where the role changes."""
        if len(block) == 0:
            return []
        start_s = self._slot_origin_s(float(block.time_s[0]))
        first, last = (self._slot_of(float(t), start_s) for t in block.time_s[[0, -1]])
        edges_s = start_s + np.arange(first + 1, last + 1) * self.parameters.segment_s
        cuts = [0, *np.searchsorted(block.time_s, edges_s - _CLOCK_S).tolist(), len(block)]
        parts: list[tuple[Role, SampleBlock]] = []
        before = self._role
        for slot, (a, b) in enumerate(pairwise(cuts), start=first):
            role = self._role_of(slot)
            if b > a:
                gap = (block.gap_before and a == 0) or role != before
                parts.append((role, block.part(slice(a, b), gap_before=gap)))
                before = role
        return parts

    def add(self, block: SampleBlock) -> None:
        """Add a block under its `role`; a row that is not finite ends the segment."""
        if len(block) == 0:
            return
        first_s = float(block.time_s[0])
        self._start_s = self._slot_origin_s(first_s)
        slot = self._slot_of(first_s, self._start_s)
        restarted = first_s <= self._newest_s
        fresh = block.gap_before or slot != self._slot or block.epoch != self._epoch
        if restarted or fresh:
            self.close_segment()
            self._open = _Averager(self._averaging_factor(block))
        self._role, self._slot, self._epoch = self._role_of(slot), slot, block.epoch
        self._newest_s = float(block.time_s[-1])
        if np.isfinite(block.raw_b_gauss).all() and np.isfinite(block.gyro_b_rad_s).all():
            self._open.add(block)
        else:
            self.close_segment()

    def close_segment(self) -> None:
        """Close the open segment."""
        segment = self._open.close(self._closed, self._role == "heldout")
        self._open = _Averager(self._open.factor)
        p = self.parameters
        if segment is None or segment.time_s[-1] - segment.time_s[0] < p.shortest_s:
            return
        self.segments.append(segment)
        self._closed += 1
        if len(self.segments) > p.segments:
            rest = np.radians(p.moving_deg)
            older = self.segments[: -p.segments // 4]
            idle = [k for k, s in enumerate(older) if s.turned_rad < rest]
            del self.segments[idle[0] if idle else 0]

    def _averaging_factor(self, block: SampleBlock) -> int:
        known = block.dt_s[np.isfinite(block.dt_s) & (block.dt_s > 0)]
        if len(known) == 0:
            return self._open.factor
        return max(1, int(np.ceil(1.0 / (float(np.median(known)) * self.parameters.rate_hz) - 0.2)))

    def _slot_origin_s(self, time_s: float) -> float:
        """Start of slot 0: the first sample, and again after a restart of the device's clock."""
        if self._start_s is None or time_s < self._start_s:
            return time_s
        return self._start_s

    def _slot_of(self, time_s: float, start_s: float) -> int:
        return int((time_s - start_s + _CLOCK_S) // self.parameters.segment_s)

    def _role_of(self, slot: int) -> Role:
        every = self.parameters.heldout_every
        return "heldout" if slot % every == every - 1 else "train"


class _Averager:
    """Means of `factor` rows of time, field, accumulated angle, force; bounded by one segment."""

    def __init__(self, factor: int) -> None:
        self.factor = factor
        self._rows: list[Array] = []
        self._incomplete = np.empty((0, 10))
        self._angle = np.zeros(3)
        self._temperatures: list[float] = []

    def add(self, block: SampleBlock) -> None:
        dt_s = np.where(np.isfinite(block.dt_s), block.dt_s, 0.0)
        angle = self._angle + np.cumsum(block.gyro_b_rad_s * dt_s[:, None], axis=0)
        self._angle = angle[-1]
        rows = np.column_stack([block.time_s, block.raw_b_gauss, angle, block.accel_b_m_s2])
        rows = np.vstack([self._incomplete, rows])
        whole = len(rows) // self.factor * self.factor
        self._incomplete = rows[whole:]
        if whole:
            self._rows.append(rows[:whole].reshape(-1, self.factor, 10).mean(axis=1))
        temperature = block.covariates.get("temperature_c")
        if temperature is not None:
            self._temperatures.append(float(np.mean(temperature)))

    def close(self, number: int, heldout: bool) -> Segment | None:
        if not self._rows:
            return None
        rows = np.vstack(self._rows)
        angle = np.diff(rows[:, 4:7], axis=0, prepend=rows[:1, 4:7])
        turned_rad = float(np.sum(np.linalg.norm(_sum_over_seconds(angle), axis=1)))
        rows[:, 4:7] = angle  # one table per segment: most of the memory
        return Segment(
            number=number,
            heldout=heldout,
            time_s=rows[:, 0],
            raw_b_gauss=rows[:, 1:4],
            angle_b_rad=rows[:, 4:7],
            accel_b_m_s2=rows[:, 7:10],
            temperature_c=float(np.mean(self._temperatures)) if self._temperatures else np.nan,
            turned_rad=turned_rad,
            averaged=self.factor,
        )


def _sum_over_seconds(angle: Array) -> Array:
    """Angles summed over about one second, so that noise does not count as turning."""
    whole = max(1, len(angle) // 25 * 25)
    return np.asarray(angle[:whole].reshape(-1, min(25, whole), 3).sum(axis=1))


# -- Attitude inside a segment ---------------------------------------------------------------------
#
# Attitude inside a segment: integrated gyro and fitted gravity only.
#
# For sample k of a segment, R_0k rotates vectors of the sensor frame at k into the sensor frame at
# the segment's first sample. The one unknown is the down direction in frame 0: the mean of the
# specific force in frame 0, in which a vehicle's own accelerations average out and gravity does
# not. With the right calibration R_0k h_k is constant for *any* down direction, so an error of
# gravity never makes a good calibration look bad.
#
# A gyro bias that differs by d from the one used here needs no new integration:
#
#     R_0k(b + d) = Exp(-P_k d) R_0k(b),   P_k = sum_j R_0j dt_j
#
# to first order in |d| t; beyond 0.05 rad the segment is integrated again. Checked by
# tests/evidence/test_evidence_attitude.py.


NODE_RATE_HZ = 5.0
_REINTEGRATE_RAD = 0.05
_GRAVITY_M_S2 = 9.81
_CALM_M_S2 = 0.5  # a force that differs from gravity by this has half the weight


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


def integrate_attitude(segment: Segment, bias_b_rad_s: Array) -> AttitudeTrack:
    """Integrate the gyro over a segment at this bias."""
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
    down_0 (S, 3): unit vector, nan if the stream has no accelerometer; heldout (S,);
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

    def select(self, chosen: Bools) -> Nodes | None:
        """The segments selected in `chosen` (S,); None if there are none."""
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


def join_tracks(tracks: Sequence[AttitudeTrack], bias_b_rad_s: Array) -> Nodes | None:
    """Join the segments at a gyro bias; None without segments."""
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
