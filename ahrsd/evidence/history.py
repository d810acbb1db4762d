"""What the evidence remembers: averaged samples in segments, some of them held out.

Samples are averaged to at most 25 Hz. Field, force, time and *accumulated angle* are averaged with
the same weights, and the angle is differenced afterwards, so all four belong to the same instant
whatever the stream's rate.

Time is cut in slots of `segment_s`. Every `heldout_every`-th slot is held out: the estimator never
sees it. A segment is what is contiguous inside one slot: a gap, a change of role or of the register
epoch ends it. Memory is bounded by the number of segments; rest is forgotten before motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from ahrsd.samples import Array, SampleBlock

_CLOCK_S = 1e-6  # a sample this close before a boundary is on it
Role = Literal["train", "heldout"]


@dataclass(frozen=True, slots=True)
class HistoryParameters:
    """How the stream is cut and how much of it is kept."""

    segment_s: float = 30.0  # longer: slower vehicles show a full turn in one, later first verdict
    heldout_every: int = 4  # smaller: more proof, less data for the estimate
    rate_hz: float = 25.0  # averaged rate: larger follows faster motion, costs memory
    shortest_s: float = 5.0  # a shorter piece between two gaps is dropped
    segments: int = 120  # one hour
    moving_deg: float = 20.0  # turned by less than this, a segment counts as rest when room is made


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Contiguous averaged samples of one role; `number` counts segments since the start.

    time_s (n,); raw_b_gauss (n, 3); angle_b_rad (n, 3): gyro integrated from the previous row to
    this one, bias not removed, first row zero; accel_b_m_s2 (n, 3), nan where the stream has none;
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
    """Blocks in, segments out.  Deterministic: depends on device time and on what was added."""

    def __init__(self, parameters: HistoryParameters | None = None) -> None:
        self.parameters = parameters or HistoryParameters()
        self.segments: list[Segment] = []
        self._start_s: float | None = None
        self._newest_s = np.inf  # nothing yet: the first block begins a segment
        self._closed = 0
        self._open = _Averager(1)
        self._role: Role = "train"
        self._slot = 0
        self._epoch = 0

    def role(self, block: SampleBlock) -> Role:
        """Role of a block that is about to be added: that of its first sample's slot."""
        if len(block) == 0:
            return self._role
        first_s = float(block.time_s[0])
        return self._role_of(self._slot_of(first_s, self._anchor(first_s)))

    def parts(self, block: SampleBlock) -> list[tuple[Role, SampleBlock]]:
        """The block cut at slot boundaries; a part that follows another role has `gap_before`."""
        if len(block) == 0:
            return []
        start_s = self._anchor(float(block.time_s[0]))
        first, last = (self._slot_of(float(t), start_s) for t in block.time_s[[0, -1]])
        edges_s = start_s + np.arange(first + 1, last + 1) * self.parameters.segment_s
        cuts = [0, *np.searchsorted(block.time_s, edges_s - _CLOCK_S).tolist(), len(block)]
        parts: list[tuple[Role, SampleBlock]] = []
        before = self._role
        for slot, (a, b) in enumerate(pairwise(cuts), start=first):
            role = self._role_of(slot)
            if b > a:
                part = _rows(block, a, b)
                gap = part.gap_before or role != before
                parts.append((role, replace(part, gap_before=gap)))
                before = role
        return parts

    def add(self, block: SampleBlock) -> None:
        """Take a block under its `role`; a row that is not finite ends the segment."""
        if len(block) == 0:
            return
        first_s = float(block.time_s[0])
        self._start_s = self._anchor(first_s)
        slot = self._slot_of(first_s, self._start_s)
        restarted = first_s <= self._newest_s
        fresh = block.gap_before or slot != self._slot or block.epoch != self._epoch
        if restarted or fresh:
            self.interrupt()
            self._open = _Averager(self._factor(block))
        self._role, self._slot, self._epoch = self._role_of(slot), slot, block.epoch
        self._newest_s = float(block.time_s[-1])
        if np.isfinite(block.raw_b_gauss).all() and np.isfinite(block.gyro_b_rad_s).all():
            self._open.add(block)
        else:
            self.interrupt()

    def interrupt(self) -> None:
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

    def _factor(self, block: SampleBlock) -> int:
        known = block.dt_s[np.isfinite(block.dt_s) & (block.dt_s > 0)]
        if len(known) == 0:
            return self._open.factor
        return max(1, int(np.ceil(1.0 / (float(np.median(known)) * self.parameters.rate_hz) - 0.2)))

    def _anchor(self, time_s: float) -> float:
        """Slot 0 begins at the first sample, and again where the device's clock started again."""
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
        self._rest = np.empty((0, 10))
        self._angle = np.zeros(3)
        self._temperatures: list[float] = []

    def add(self, block: SampleBlock) -> None:
        dt_s = np.where(np.isfinite(block.dt_s), block.dt_s, 0.0)
        angle = self._angle + np.cumsum(block.gyro_b_rad_s * dt_s[:, None], axis=0)
        self._angle = angle[-1]
        rows = np.column_stack([block.time_s, block.raw_b_gauss, angle, block.accel_b_m_s2])
        rows = np.vstack([self._rest, rows])
        whole = len(rows) // self.factor * self.factor
        self._rest = rows[whole:]
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
        turned_rad = float(np.sum(np.linalg.norm(_smooth(angle), axis=1)))
        rows[:, 4:7] = angle  # one table per segment: this is most of what is remembered
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


def _smooth(angle: Array) -> Array:
    """Angles summed over about a second, so that noise does not count as turning."""
    whole = max(1, len(angle) // 25 * 25)
    return np.asarray(angle[:whole].reshape(-1, min(25, whole), 3).sum(axis=1))


def _rows(block: SampleBlock, a: int, b: int) -> SampleBlock:
    return replace(
        block,
        time_s=block.time_s[a:b],
        dt_s=block.dt_s[a:b],
        host_s=block.host_s[a:b],
        raw_b_gauss=block.raw_b_gauss[a:b],
        gyro_b_rad_s=block.gyro_b_rad_s[a:b],
        accel_b_m_s2=block.accel_b_m_s2[a:b],
        covariates={name: values[a:b] for name, values in block.covariates.items()},
        gap_before=block.gap_before and a == 0,
    )
