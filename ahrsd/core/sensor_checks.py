"""Detects faults of the sensors themselves in the raw stream, and reports them in plain words.

Two kinds of statistic, both over the newest samples:

* how long a value has not changed: a real sensor has noise, so a value that repeats exactly for
  `still_s` is stuck, held, saturated, or simulated without noise;
* how the field turns compared with the gyroscope, per axis. With theta_k the angle between two
  means of the raw field m, G = diag(g) and hard iron o,

      m_k - m_(k-1) = -(G theta_k) x (m - o)

  is linear in g and in the products g_i o_j (9 unknowns). g = 1 is a correct gyroscope, 1/57.3 one
  in deg/s, -1 one with the wrong sign. Scale errors change g by percents. Soft iron makes a tenth
  of a turn about one axis appear as a turn about another, much for an axis that hardly turns.

All thresholds are in `SensorLimits`. The module decides nothing: a finding is for a person.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ahrsd.samples import Array, SampleBlock

AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class SensorLimits:
    """Every threshold of this module.

    still_s, still_samples: a value is stuck if it is the same for this time and number of samples
    same_gauss, same_rad_s: values this close count as the same, after decompensation
    turned_deg, turning_rad_s: turn above which it is mentioned; a slower rate may be a bias
    saturated_gauss:  of the sensor's range of 2.5 gauss
    window_s, step_s: of the comparison of field and gyroscope
    least_steps, least_field_gauss: minimum steps and field variation (rms) for a conclusion
    explained:        share of the field's changes that the fit must explain
    sure:             largest relative 1-sigma of an axis' g for a finding on that axis
    degrees:          range of g of a gyroscope in deg/s
    negated:          g below which an axis has the wrong sign
    soft_iron:        share of a turn that may appear as a turn about another axis
    readings, share:  of this many readings, at most this share may be unusable
    """

    still_s: float = 10.0
    still_samples: int = 50
    same_gauss: float = 1e-5
    same_rad_s: float = 1e-6
    turned_deg: float = 30.0
    turning_rad_s: float = 0.0625
    saturated_gauss: float = 2.4
    window_s: float = 60.0
    step_s: float = 0.2
    least_steps: int = 60
    least_field_gauss: float = 0.04
    explained: float = 0.5
    sure: float = 0.2
    degrees: tuple[float, float] = (0.012, 0.025)
    negated: float = -0.4
    soft_iron: float = 0.1
    readings: int = 500
    share: float = 0.01


@dataclass(slots=True)
class _Still:
    """Since when a value has not changed, and how far the vehicle turned meanwhile."""

    value: float = float("nan")
    since_s: float = 0.0
    samples: int = 0
    turned_rad: float = 0.0


@dataclass(slots=True)
class _Step:
    """Sums over one step of the comparison."""

    began_s: float
    field_gauss: Array
    angle_rad: Array
    samples: int = 0


class SensorChecks:
    """Takes raw blocks in order; reports faults that began or ended. Deterministic."""

    def __init__(self, limits: SensorLimits | None = None) -> None:
        self.limits = limits or SensorLimits()
        self._by_samples: dict[str, str] = {}
        self._by_count: dict[str, str] = {}
        self._counts_before = (0, 0)
        self._reset()

    def _reset(self) -> None:
        self._still_values = [_Still() for _ in range(6)]
        self._now_s = self._checked_s = float("-inf")
        self._step: _Step | None = None
        self._steps: deque[tuple[float, Array, Array] | None] = deque()

    @property
    def findings(self) -> dict[str, str]:
        """Present faults: description by short identifier."""
        return {**self._by_samples, **self._by_count}

    def take(self, block: SampleBlock) -> list[str]:
        """Take samples; returns one sentence for each fault that began or ended."""
        if not len(block):
            return []
        if float(block.time_s[0]) < self._now_s:  # the device restarted
            self._reset()
        self._now_s = float(block.time_s[-1])
        self._update_still_values(block)
        self._update_steps(block)
        if self._now_s - self._checked_s < 1.0:
            return []
        self._checked_s = self._now_s
        before, self._by_samples = (
            self._by_samples,
            {**dict(self._find_stuck_axes()), **dict(self._find_gyro_faults())},
        )
        return _describe_changes(before, self._by_samples)

    def count(self, unusable: int, usable: int) -> list[str]:
        """Numbers of unusable and usable readings since the start; returns sentences as `take`."""
        before = self._counts_before
        bad, good = unusable - before[0], usable - before[1]
        if bad + good < self.limits.readings:
            return []
        self._counts_before = (unusable, usable)
        share, found = bad / (bad + good), {}
        if share > self.limits.share:
            found["readings"] = (
                f"{100 * share:.0f} % of the newest {bad + good} readings are of no use: not a "
                "number, marked as saturated, larger than the sensor can measure, or received "
                "twice; look for a magnet near it, a damaged cable, or another program that "
                "changes the stream"
            )
        before_findings, self._by_count = self._by_count, found
        return _describe_changes(before_findings, found)

    # -- values that do not change -----------------------------------------------------------------

    def _update_still_values(self, block: SampleBlock) -> None:
        speed = np.linalg.norm(block.gyro_b_rad_s, axis=1)
        turning = speed > self.limits.turning_rad_s
        rates = np.where(turning, speed, 0.0) * np.nan_to_num(block.dt_s)
        values = np.hstack([block.raw_b_gauss, block.gyro_b_rad_s])
        for k, still in enumerate(self._still_values):
            same = self.limits.same_gauss if k < 3 else self.limits.same_rad_s
            column = values[:, k]
            last = float(column[-1])
            others = np.flatnonzero(np.abs(column - last) > same)
            if len(others) or not abs(still.value - last) <= same:
                start = int(others[-1]) + 1 if len(others) else 0
                self._still_values[k] = _Still(
                    last,
                    float(block.time_s[start]),
                    len(block) - start,
                    float(rates[start:].sum()),
                )
            else:
                still.samples += len(block)
                still.turned_rad += float(rates.sum())

    def _find_stuck_axes(self) -> Iterator[tuple[str, str]]:
        p = self.limits
        for sensor, unit, first in (("magnetometer", "gauss", 0), ("gyroscope", "rad/s", 3)):
            group = self._still_values[first : first + 3]
            stuck = [
                k
                for k, one in enumerate(group)
                if self._now_s - one.since_s >= p.still_s and one.samples >= p.still_samples
            ]
            if not stuck:
                continue
            axes = "all axes" if len(stuck) == 3 else f"axis {', '.join(AXES[k] for k in stuck)}"
            values = ", ".join(f"{group[k].value:.5g}" for k in stuck)
            for_s = self._now_s - max(group[k].since_s for k in stuck)
            turned = float(np.degrees(min(group[k].turned_rad for k in stuck)))
            turned_enough = turned >= p.turned_deg and sensor == "magnetometer"
            moving = f" while the vehicle turned by {turned:.0f} deg" if turned_enough else ""
            saturated = sensor == "magnetometer" and any(
                abs(group[k].value) >= p.saturated_gauss for k in stuck
            )
            cause = (
                "it is saturated: move it away from the magnet near it"
                if saturated
                else "it shows not even noise: it is stuck, held by another program, or simulated "
                "without noise; nothing can be calibrated from it"
            )
            yield (
                f"{sensor} still",
                f"the {sensor} gives the same value on {axes} ({values} {unit}) for {for_s:.0f} s"
                f"{moving}; {cause}",
            )

    # -- field and gyroscope -----------------------------------------------------------------------

    def _update_steps(self, block: SampleBlock) -> None:
        angle = block.gyro_b_rad_s * np.nan_to_num(block.dt_s)[:, None]
        if block.gap_before:
            self._step = None
            self._steps.append(None)
        for a, b in _split_half_steps(block.time_s, self.limits.step_s):
            if self._step is None:
                self._step = _Step(float(block.time_s[a]), np.zeros(3), np.zeros(3))
            step = self._step
            step.field_gauss += block.raw_b_gauss[a:b].sum(axis=0)
            step.angle_rad += angle[a:b].sum(axis=0)
            step.samples += b - a
            if block.time_s[b - 1] - step.began_s >= 0.8 * self.limits.step_s:
                self._steps.append(
                    (float(block.time_s[b - 1]), step.field_gauss / step.samples, step.angle_rad)
                )
                self._step = None
        while self._steps and (
            self._steps[0] is None or self._now_s - self._steps[0][0] > self.limits.window_s
        ):
            self._steps.popleft()

    def _find_gyro_faults(self) -> Iterator[tuple[str, str]]:
        p, fit = self.limits, self._fit_gyro_gain()
        if fit is None:
            return
        g, sigma, soft_iron_share = fit
        # relative uncertainty: a gain of 1/57 is small compared with 1
        known = [k for k in range(3) if sigma[k] < p.sure * abs(g[k])]
        degrees = [k for k in known if p.degrees[0] < abs(g[k]) < p.degrees[1]]
        negated = [k for k in known if g[k] + soft_iron_share[k] < p.negated]
        if degrees and len(degrees) == len(known):
            yield (
                "gyroscope unit",
                f"the field turns {1 / abs(float(np.mean(g[degrees]))):.0f} times less than the "
                f"gyroscope says (axis {', '.join(AXES[k] for k in degrees)}): its rates are in "
                "deg/s where rad/s are wanted; nothing calibrated from them is right",
            )
        if negated:
            yield (
                "gyroscope sign",
                f"the field turns against the gyroscope on axis "
                f"{', '.join(AXES[k] for k in negated)}: the sign of these rates is wrong, or the "
                "two sensors do not share one frame; nothing that is calibrated from them is right",
            )

    def _fit_gyro_gain(self) -> tuple[Array, Array, Array] | None:
        """Per axis the gain g (3,), its 1-sigma, and the part that soft iron may cause; None if
        the data are insufficient."""
        p = self.limits
        pairs = [
            (one, two)
            for one, two in zip(self._steps, list(self._steps)[1:], strict=False)
            if one is not None and two is not None
        ]
        if len(pairs) < p.least_steps:
            return None
        fields = np.array([[one[1], two[1]] for one, two in pairs])
        angle = np.array([(one[2] + two[2]) / 2 for one, two in pairs])
        moved, mean = fields[:, 1] - fields[:, 0], fields.mean(axis=1)
        if np.sqrt(mean.var(axis=0).sum()) < p.least_field_gauss:
            return None
        unit = np.eye(3)
        columns = [-angle[:, k, None] * np.cross(unit[k], mean) for k in range(3)]
        columns += [
            angle[:, k, None] * np.cross(unit[k], unit[j])
            for k in range(3)
            for j in range(3)
            if j != k
        ]
        design = np.stack([column.ravel() for column in columns], axis=1)
        size = np.linalg.norm(design, axis=0)
        used = np.flatnonzero(size > 1e-9 * max(float(size.max()), 1e-300))
        if not len(used):  # a gyroscope that reads exactly zero
            return None
        scaled = design[:, used] / size[used]
        target = moved.ravel()
        u, values, vt = np.linalg.svd(scaled, full_matrices=False)
        keep = values > 1e-6 * values[0]
        found = vt[keep].T @ ((u[:, keep].T @ target) / values[keep])
        residual = target - scaled @ found
        total = float(target @ target)
        if total <= 0.0 or 1.0 - float(residual @ residual) / total < p.explained:
            return None
        noise = float(residual @ residual) / max(len(target) - len(used), 1)
        spread = noise * np.sum((vt[keep].T / values[keep]) ** 2, axis=1)
        undetermined = 1.0 - np.sum(vt[keep].T ** 2, axis=1) > 1e-6  # not in the data
        g, sigma = np.full(3, np.nan), np.full(3, np.inf)
        for row, k in enumerate(used):
            if k < 3 and not undetermined[row]:
                g[k], sigma[k] = found[row] / size[k], np.sqrt(spread[row]) / size[k]
        turned = np.sqrt(np.mean(angle**2, axis=0))
        apparent = np.abs(np.nan_to_num(g)) * turned  # turn as the field shows it
        others = np.sqrt(np.maximum(apparent @ apparent - apparent**2, 0.0))
        return g, sigma, p.soft_iron * others / np.maximum(turned, 1e-12)


def _describe_changes(before: dict[str, str], now: dict[str, str]) -> list[str]:
    """One sentence for each fault that began or ended."""
    began = [text for name, text in now.items() if name not in before]
    return began + [f"over: {text}" for name, text in before.items() if name not in now]


def _split_half_steps(time_s: Array, step_s: float) -> Iterator[tuple[int, int]]:
    """Row ranges of a block, each at most half a step long."""
    number = ((time_s - time_s[0]) // (step_s / 2)).astype(np.int64)
    edges = np.flatnonzero(np.diff(number)) + 1
    bounds = [0, *edges.tolist(), len(time_s)]
    yield from pairwise(bounds)
