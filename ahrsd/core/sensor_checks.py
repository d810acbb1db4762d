"""What is wrong with the sensors themselves, seen in the raw stream and said in plain words.

Two kinds of statistic, both over the newest samples:

* how long a value has stood still: a real sensor has noise, so one that repeats itself exactly for
  `still_s` is stuck, held, saturated, or simulated without noise;
* how the field turns against what the gyroscope says, per axis. With theta_k the angle between two
  means of the raw field m, G = diag(g) and hard iron o,

      m_k - m_(k-1) = -(G theta_k) x (m - o)

  is linear in g and in the products g_i o_j (9 unknowns). g = 1 is a right gyroscope, 1/57.3 one in
  deg/s, -1 one with the wrong sign. Scale errors move g by percents; soft iron shows a tenth of the
  turn about one axis as one about another, which is much for an axis that hardly turns.

All limits are in `SensorLimits`. Nothing is decided here: a finding is for a person.
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

    still_s, still_samples: exactly the same for so long, and for so many samples, is no noise
    same_gauss, same_rad_s: values this close are the same one, after un-mapping
    turned_deg, turning_rad_s: a vehicle that turned so far is said to have turned; a slower rate
                      may be a bias
    saturated_gauss:  of the sensor's 2.5 gauss
    window_s, step_s: of the comparison of field and gyroscope
    least_steps, least_field_gauss: fewer steps, or a field that moves less (rms), say nothing
    explained:        share of the field's movement that the fit must explain
    sure:             1-sigma of an axis' g over its size below which the axis is spoken of
    degrees:          g of a gyroscope in deg/s, between
    negated:          g below which an axis has the wrong sign
    soft_iron:        share of a turn that may be shown as one about another axis
    readings, share:  of so many readings, more than this share must not be unusable
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
    """Since when one value has stood still, and how far the vehicle turned meanwhile."""

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
    """Takes raw blocks in order, and says what began or ended to be wrong. Deterministic."""

    def __init__(self, limits: SensorLimits | None = None) -> None:
        self.limits = limits or SensorLimits()
        self._by_samples: dict[str, str] = {}
        self._by_count: dict[str, str] = {}
        self._counted = (0, 0)
        self._begin()

    def _begin(self) -> None:
        self._still = [_Still() for _ in range(6)]
        self._now_s = self._looked_s = float("-inf")
        self._step: _Step | None = None
        self._steps: deque[tuple[float, Array, Array] | None] = deque()

    @property
    def findings(self) -> dict[str, str]:
        """What is wrong now, by a name, in words."""
        return {**self._by_samples, **self._by_count}

    def take(self, block: SampleBlock) -> list[str]:
        """Further samples; what began or ended to be wrong, one sentence each."""
        if not len(block):
            return []
        if float(block.time_s[0]) < self._now_s:  # the device restarted
            self._begin()
        self._now_s = float(block.time_s[-1])
        self._stand_still(block)
        self._turn(block)
        if self._now_s - self._looked_s < 1.0:
            return []
        self._looked_s = self._now_s
        before, self._by_samples = (
            self._by_samples,
            {**dict(self._stuck()), **dict(self._turning())},
        )
        return _changed(before, self._by_samples)

    def count(self, unusable: int, usable: int) -> list[str]:
        """Readings since the start that could not be used, and that could; sentences as `take`."""
        before = self._counted
        bad, good = unusable - before[0], usable - before[1]
        if bad + good < self.limits.readings:
            return []
        self._counted = (unusable, usable)
        share, found = bad / (bad + good), {}
        if share > self.limits.share:
            found["readings"] = (
                f"{100 * share:.0f} % of the newest {bad + good} readings are of no use: not a "
                "number, marked as saturated, larger than the sensor can read, or one that came "
                "twice; look for a magnet beside it, a damaged cable, or another program that "
                "changes the stream"
            )
        told, self._by_count = self._by_count, found
        return _changed(told, found)

    # -- values that stand still -------------------------------------------------------------------

    def _stand_still(self, block: SampleBlock) -> None:
        speed = np.linalg.norm(block.gyro_b_rad_s, axis=1)
        turning = speed > self.limits.turning_rad_s
        rates = np.where(turning, speed, 0.0) * np.nan_to_num(block.dt_s)
        values = np.hstack([block.raw_b_gauss, block.gyro_b_rad_s])
        for k, still in enumerate(self._still):
            same = self.limits.same_gauss if k < 3 else self.limits.same_rad_s
            column = values[:, k]
            last = float(column[-1])
            others = np.flatnonzero(np.abs(column - last) > same)
            if len(others) or not abs(still.value - last) <= same:
                start = int(others[-1]) + 1 if len(others) else 0
                self._still[k] = _Still(
                    last,
                    float(block.time_s[start]),
                    len(block) - start,
                    float(rates[start:].sum()),
                )
            else:
                still.samples += len(block)
                still.turned_rad += float(rates.sum())

    def _stuck(self) -> Iterator[tuple[str, str]]:
        p = self.limits
        for sensor, unit, first in (("magnetometer", "gauss", 0), ("gyroscope", "rad/s", 3)):
            group = self._still[first : first + 3]
            stuck = [
                k
                for k, one in enumerate(group)
                if self._now_s - one.since_s >= p.still_s and one.samples >= p.still_samples
            ]
            if not stuck:
                continue
            axes = "all axes" if len(stuck) == 3 else f"axis {', '.join(AXES[k] for k in stuck)}"
            held = ", ".join(f"{group[k].value:.5g}" for k in stuck)
            for_s = self._now_s - max(group[k].since_s for k in stuck)
            turned = float(np.degrees(min(group[k].turned_rad for k in stuck)))
            moves = turned >= p.turned_deg and sensor == "magnetometer"
            moving = f" while the vehicle turned by {turned:.0f} deg" if moves else ""
            full = sensor == "magnetometer" and any(
                abs(group[k].value) >= p.saturated_gauss for k in stuck
            )
            cause = (
                "it is saturated: move it away from the magnet beside it"
                if full
                else "not even noise moves it: it is stuck, held by another program, or simulated "
                "without noise; nothing can be calibrated from it"
            )
            yield (
                f"{sensor} still",
                f"the {sensor} gives the same value on {axes} ({held} {unit}) for {for_s:.0f} s"
                f"{moving}; {cause}",
            )

    # -- field against gyroscope -------------------------------------------------------------------

    def _turn(self, block: SampleBlock) -> None:
        angle = block.gyro_b_rad_s * np.nan_to_num(block.dt_s)[:, None]
        if block.gap_before:
            self._step = None
            self._steps.append(None)
        for a, b in _cuts(block.time_s, self.limits.step_s):
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

    def _turning(self) -> Iterator[tuple[str, str]]:
        p, fit = self.limits, self._fit()
        if fit is None:
            return
        g, sigma, feigned = fit
        # what a scale of 1/57 means is small beside 1 and must be known beside itself
        known = [k for k in range(3) if sigma[k] < p.sure * abs(g[k])]
        degrees = [k for k in known if p.degrees[0] < abs(g[k]) < p.degrees[1]]
        negated = [k for k in known if g[k] + feigned[k] < p.negated]
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

    def _fit(self) -> tuple[Array, Array, Array] | None:
        """g (3,) with its 1-sigma, and how much of it soft iron may feign, per axis; None where the
        field says too little."""
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
        rest = target - scaled @ found
        total = float(target @ target)
        if total <= 0.0 or 1.0 - float(rest @ rest) / total < p.explained:
            return None
        noise = float(rest @ rest) / max(len(target) - len(used), 1)
        spread = noise * np.sum((vt[keep].T / values[keep]) ** 2, axis=1)
        lost = 1.0 - np.sum(vt[keep].T ** 2, axis=1) > 1e-6  # a direction nobody determined
        g, sigma = np.full(3, np.nan), np.full(3, np.inf)
        for row, k in enumerate(used):
            if k < 3 and not lost[row]:
                g[k], sigma[k] = found[row] / size[k], np.sqrt(spread[row]) / size[k]
        turned = np.sqrt(np.mean(angle**2, axis=0))
        shown = np.abs(np.nan_to_num(g)) * turned  # by the field
        others = np.sqrt(np.maximum(shown @ shown - shown**2, 0.0))
        return g, sigma, p.soft_iron * others / np.maximum(turned, 1e-12)


def _changed(before: dict[str, str], now: dict[str, str]) -> list[str]:
    """What began and what ended, in sentences."""
    told = [text for name, text in now.items() if name not in before]
    return told + [f"over: {text}" for name, text in before.items() if name not in now]


def _cuts(time_s: Array, step_s: float) -> Iterator[tuple[int, int]]:
    """Rows of a block in pieces of at most half a step."""
    number = ((time_s - time_s[0]) // (step_s / 2)).astype(np.int64)
    edges = np.flatnonzero(np.diff(number)) + 1
    bounds = [0, *edges.tolist(), len(time_s)]
    yield from pairwise(bounds)
