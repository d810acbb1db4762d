"""Live figures of a trial: the written registers against the old ones, on the same raw samples.

The figure is the spread (std / mean) of the corrected field over the newest minute: both
corrections see the same motion and the same disturbances, so only their quality differs. At rest
both show the sensor's noise, scaled by a matrix each, and are not compared. Whether the new ones
are *right* is not told by the spread, which noise has as well, but by how much of it an error of
the calibration explains (`leftover_error`). That says nothing of the gyroscope, nor of a matrix
that is turned: `field_steadiness` does, with the new registers and with each alternative to them
(either one put back, or both; at rest only the gyroscope's).

The heading's jump is the difference of the two tilt-compensated headings of the same samples,
averaged over the first seconds of samples in which the vehicle is nearly level. It was predicted
for level, on the side it may be twice as much, and at 15 deg a hard iron along the vertical adds
half as much again: so each sample is turned level on its own heading before the two are compared.
Seconds are those that samples cover, taken in pieces of a quarter of one: over a gap, or over the
many seconds that a busy host reads at once, the vehicle turns, and a mean over a turn is no field.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.field_steadiness import CarriedField
from ahrsd.writeback.leftover_error import TURNED, LeftoverError
from ahrsd.writeback.trial import TrialMetrics

_WINDOW_S = 60.0
_JUMP_S = 3.0
_PIECE_S = 0.25  # one heading each; a vehicle turns by little in it
_LEVEL = np.cos(np.radians(15.0))
_OLD_GYRO = 2  # of the pairs that are carried: the new magnetometer's register, the old gyro's
_SPACING_S = 0.1  # samples closer than this add nothing to a spread


class LiveTrial:
    """Collects what `TrialMetrics` needs from the moment the new registers are in force."""

    def __init__(
        self,
        new: Affine,
        old: Affine,
        gyro_bias_rad_s: Array,
        old_gyro_bias_rad_s: Array | None = None,
        *,
        wrong_limit: float = 0.005,
    ) -> None:
        self._wrong_limit = wrong_limit
        self._leftover, self._old_leftover = LeftoverError(), LeftoverError()
        self._new, self._old, self._bias = new, old, gyro_bias_rad_s.copy()
        before = self._bias if old_gyro_bias_rad_s is None else old_gyro_bias_rad_s
        self._carried = CarriedField(
            [(new, self._bias), (old, self._bias), (new, before), (old, before)]
        )
        self._rows: deque[tuple[float, Array]] = deque()
        self._jumps: list[float] = []
        self._jump_covered_s = 0.0  # by the samples of the jumps
        self._start_s: float | None = None
        self._last_s = 0.0
        self._turned_rad = 0.0

    def take(self, block: SampleBlock) -> TrialMetrics:
        """Further samples; the figures so far."""
        if self._start_s is None:
            self._start_s = self._last_s = float(block.time_s[0])
        self._carried.take(block)
        down = _down(block.accel_b_m_s2)
        rate = (block.gyro_b_rad_s - self._bias) @ down if np.isfinite(down).all() else np.zeros(1)
        self._turned_rad += abs(float(np.nansum(rate * np.nan_to_num(block.dt_s))))
        for t, m in zip(block.time_s.tolist(), block.raw_b_gauss, strict=True):
            if not self._rows or t - self._rows[-1][0] >= _SPACING_S:
                self._rows.append((t, m))
                self._leftover.add(t, self._new.apply(m[None])[0])
                self._old_leftover.add(t, self._old.apply(m[None])[0])
        now_s = float(block.time_s[-1])
        while self._rows and now_s - self._rows[0][0] > _WINDOW_S:
            self._rows.popleft()
        self._last_s = now_s
        for piece in _pieces(block.time_s):
            if self._jump_covered_s < _JUMP_S:
                self._see_jump(
                    block.raw_b_gauss[piece], block.accel_b_m_s2[piece], block.dt_s[piece]
                )
        return self._metrics()

    def _see_jump(self, raw: Array, accel: Array, dt_s: Array) -> None:
        """How far the heading of these samples is from what it was with the old registers."""
        down = _down(accel)
        if not down[2] >= _LEVEL:  # nor where it is nan
            return
        field = self._new.apply(raw.mean(axis=0)[None])
        heading = tilt_compensated_heading(field, -down[None])
        level = self._new.undo(_levelled(field[0], heading[0], down)[None])
        before = tilt_compensated_heading(self._old.apply(level), np.array([[0.0, 0.0, -1.0]]))
        self._jumps.append(float((heading - before)[0]))
        self._jump_covered_s += float(np.nansum(np.minimum(dt_s, _PIECE_S)))

    def _metrics(self) -> TrialMetrics:
        field = np.array([m for _, m in self._rows])
        new = np.linalg.norm(self._new.apply(field), axis=1)
        old = np.linalg.norm(self._old.apply(field), axis=1)
        directions = self._new.apply(field) / new[:, None]
        turned = bool(len(field) > 1 and directions.var(axis=0).sum() > TURNED)
        spread = float(new.std() / new.mean()) if len(field) > 1 else float("nan")
        jump = None
        if self._jumps:
            angles = np.array(self._jumps)
            jump = float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))
        left = self._leftover.leftover(self._wrong_limit)
        swing = np.nan_to_num(self._carried.spreads)
        start = self._last_s if self._start_s is None else self._start_s
        return TrialMetrics(
            duration_s=self._last_s - start,
            turns=self._turned_rad / (2 * np.pi),
            new_figure=spread,
            old_figure=float(old.std() / old.mean()) if len(field) > 1 else float("nan"),
            field_spread=spread,
            turned=turned,
            heading_jump_deg=jump,
            new_swing=float(swing[0]),
            old_swing=float(swing[1:].min() if turned else swing[_OLD_GYRO]),
            wrong=left.share,
            old_wrong=self._old_leftover.leftover(self._wrong_limit).share,
            wrong_sigmas=left.sigmas,
        )


def _levelled(field_b: Array, heading_rad: float, down_b: Array) -> Array:
    """The same field as it would be in the sensor's axes were it level, on the same heading."""
    vertical = float(down_b @ field_b)
    horizontal = float(np.linalg.norm(field_b - vertical * down_b))
    north = np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])
    return np.asarray(horizontal * north + np.array([0.0, 0.0, vertical]))


def _pieces(time_s: Array) -> list[slice]:
    """Samples that follow each other within `_PIECE_S` of the first of their piece."""
    starts = [0]
    for k, t in enumerate(time_s.tolist()):
        if not 0.0 <= t - time_s[starts[-1]] < _PIECE_S:
            starts.append(k)
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(time_s)], strict=True)]


def _down(accel: Array) -> Array:
    mean = accel.mean(axis=0)
    return np.asarray(-mean / max(float(np.linalg.norm(mean)), 1e-9))
