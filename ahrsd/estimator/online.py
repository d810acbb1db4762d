"""The estimator: samples in, estimates out, at a cost that does not grow.

Samples become steps, steps become epochs of constant size, each epoch becomes one factor of the
graph. While the window of epochs holds everything, the answer is that of the batch smoother; what
falls out of it is folded into the prior.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.estimator import chain, noise, start, summary
from ahrsd.estimator.factors import Node
from ahrsd.estimator.graph import SingularError
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.steps import StepAverager, Steps, join, samples_per_step, split
from ahrsd.estimator.window import Window
from ahrsd.samples import Array, SampleBlock

_MIN_EPOCH = 64  # a shorter piece before a gap is not worth a factor
_SEARCH_AT = (1, 2, 3, 4, 6, 8, 12, 16)  # epochs after which new starts may compete
_AGREEMENT = 1.0  # of log likelihood: starts that end this close count as one answer
_HOPELESS_DEG = 5.0  # worst heading sigma beyond which nobody may call the estimate converged
_TYPICAL_DIP_RAD = np.radians(65.0)  # without gravity: pessimistic for most of the inhabited earth


class Estimator:
    """Streaming MAGYC.  Not thread-safe; deterministic: the same samples give the same numbers."""

    def __init__(
        self,
        parameters: EstimatorParameters | None = None,
        present: Affine | None = None,
        present_gyro_bias_rad_s: Array | None = None,
    ) -> None:
        """`present` is the device's calibration (registers 23 and 84): the prior's centre."""
        self.parameters = parameters or EstimatorParameters()
        self._present = present or Affine.identity()
        self._present_bias = (
            np.zeros(3) if present_gyro_bias_rad_s is None else present_gyro_bias_rad_s.copy()
        )
        self._averager: StepAverager | None = None
        self._pending: list[Steps] = []
        self._pending_count = 0
        self._fresh = True
        self._window: Window | None = None
        self._prior_sigma = np.ones(12)
        self._down: deque[Array] = deque(maxlen=64)
        self._searching = True
        self._epochs = 0
        self._samples = 0
        self._duration_s = 0.0

    def add(self, block: SampleBlock) -> bool:
        """Take samples; true where they completed an epoch, so that `estimate` says something new.

        Samples must be finite; a block must not span a gap (`SampleBlock`).
        """
        if len(block) == 0:
            return False
        closed = False
        if block.gap_before:
            closed = self.interrupt()
        if self._averager is None:
            rate = 1.0 / float(np.nanmedian(block.dt_s))
            self._averager = StepAverager(samples_per_step(rate, self.parameters.step_rate_hz))
        steps = self._averager.add(
            block.time_s, block.dt_s, block.raw_b_gauss, block.gyro_b_rad_s, block.accel_b_m_s2
        )
        self._samples += len(block)
        self._duration_s += float(np.nansum(block.dt_s))
        if len(steps):
            self._pending.append(steps)
            self._pending_count += len(steps)
        while self._pending_count >= self._wanted():
            self._close(self._wanted())
            closed = True
        return closed

    def interrupt(self) -> bool:
        """A gap follows: finish what is pending; nothing is bridged but the gyro bias's walk."""
        closed = self._pending_count >= _MIN_EPOCH
        if closed:
            self._close(self._pending_count)
        self._pending.clear()
        self._pending_count = 0
        self._fresh = True
        if self._averager is not None:
            self._averager.restart()
        return closed

    def finish(self) -> Estimate | None:
        """End of the recording: use what is pending and iterate to the end."""
        self.interrupt()
        if self._window is not None:
            if self._searching:
                self._search(self._window)
            self._window.track(everything=True)
        return self.estimate()

    def _wanted(self) -> int:
        return self.parameters.epoch_steps + int(self._fresh)

    def _close(self, count: int) -> None:
        steps, rest = split(join(self._pending), count)
        self._pending = [rest] if len(rest) else []
        self._pending_count = len(rest)
        data = _epoch_data(steps, self._fresh)
        if self._window is None:
            self._window = self._begin(data)
        elif not self._fresh:
            data = _with_border(data, self._window.epochs[-1].data)
        self._fresh = False
        self._down.append(data.down_b[len(data) // 2])
        self._window.append(data)
        self._epochs += 1
        if self._searching and self._epochs in _SEARCH_AT:
            self._search(self._window)
        else:
            self._window.track()
        self._window.fold()

    def _begin(self, data: chain.Data) -> Window:
        A0 = np.linalg.inv(self._present.matrix)
        A0 = (A0 + A0.T) / 2  # what is not symmetric in the device's register cannot be held here
        size = float(np.median(np.linalg.norm(self._present.apply(data.field_b_gauss), axis=1)))
        c = np.r_[chain.upper_triangle(A0 * max(size, 1e-3)), self._present.offset]
        p = self.parameters
        scale = float(np.cbrt(np.linalg.det(chain.symmetric(c[:6]))))
        sigma_c = np.r_[np.full(6, p.prior_soft_iron * scale), np.full(3, p.prior_hard_iron_gauss)]
        self._prior_sigma = np.r_[sigma_c, np.full(3, p.prior_gyro_bias_rad_s)]
        direction = chain.start_directions(chain.symmetric(c[:6]), c[6:], data.field_b_gauss[:1])[0]
        first = Node.at(self._present_bias, direction)
        return Window(p, c, sigma_c, first, noise.first_guess(data, p))

    def _search(self, window: Window) -> None:
        """The present answer and fresh starts compete by cost, until they agree on good data."""
        window.graph.temper = 1.0  # a poor answer must not strengthen the prior that holds it
        data = [e.data for e in window.epochs]
        starts = [window.graph.c, start.linear_start(data), start.sphere_start(_fields(data))]
        reached = []
        for c in starts:
            if c is not None:
                window.restart_at(c)
                reached.append((window.optimise(), window.snapshot()))
        costs = [cost for cost, _ in reached]
        window.restore(reached[int(np.argmin(costs))][1])
        window.track(everything=True)
        if max(costs) - min(costs) < _AGREEMENT and self._sure(window):
            self._searching = False

    @staticmethod
    def _sure(window: Window) -> bool:
        try:
            sigma = np.sqrt(np.diag(window.graph.covariance())[6:9])
        except SingularError:
            return False
        size = np.cbrt(np.linalg.det(chain.symmetric(window.graph.c[:6])))
        return bool(np.all(sigma < 0.05 * size))

    def estimate(self) -> Estimate | None:
        """The present answer, None before the first epoch or where nothing at all is determined."""
        window = self._window
        if window is None or not window.epochs:
            return None
        graph = window.graph
        try:
            covariance = graph.covariance()
        except SingularError:
            return None
        misfit = window.misfit.value([e.factor for e in window.epochs], graph)
        covariance = covariance * graph.temper
        observed = summary.observability(covariance, self._prior_sigma)
        A, b, size, J = summary.unit_volume(graph.c)
        K = np.eye(12)
        K[:9, :9] = J
        down, dip = self._attitude(window)
        heading = summary.heading_sigma_deg(graph.c, covariance, down, dip)
        averaged = self._averager.averaged if self._averager else 1
        return Estimate(
            soft_iron=A,
            hard_iron_gauss=b,
            gyro_bias_rad_s=graph.nodes[graph.last].bias.copy(),
            field_gauss=size,
            field_known=False,
            covariance=K @ covariance @ K.T,
            noise_mag_gauss=window.usual.mag_gauss * float(np.sqrt(averaged)),
            noise_gyro_rad_s=window.usual.gyro_rad_s * float(np.sqrt(averaged)),
            misfit=misfit,
            heading_sigma_deg=heading,
            observability=observed,
            samples=self._samples,
            duration_s=self._duration_s,
            converged=bool(
                window.step_sigmas < 0.5 and not observed.unobservable and heading < _HOPELESS_DEG
            ),
        )

    def _attitude(self, window: Window) -> tuple[Array, float]:
        """Tilts seen so far and the field's dip, both from gravity; level and steep without it."""
        down = np.array([d for d in self._down if np.isfinite(d).all()])
        if len(down) == 0:
            return np.array([[0.0, 0.0, 1.0]]), float(_TYPICAL_DIP_RAD)
        middle = [
            (e.u[len(e.u) // 2], e.data.down_b[len(e.u) // 2])
            for e in window.epochs
            if np.isfinite(e.data.down_b).all()
        ]
        if not middle:
            return down, float(_TYPICAL_DIP_RAD)
        along = np.array([u @ d for u, d in middle])
        limit = np.radians(80.0)
        return down, float(np.clip(np.median(np.arcsin(np.clip(along, -1, 1))), -limit, limit))


def _fields(data: list[chain.Data]) -> Array:
    return np.vstack([d.field_b_gauss for d in data])


def _epoch_data(steps: Steps, fresh: bool) -> chain.Data:
    return chain.Data(
        steps.field_b_gauss,
        steps.angle_b_rad,
        steps.dt_s,
        _down(steps.accel_b_m_s2),
        steps.time_s,
        measures_first=fresh,
    )


def _down(accel: Array) -> Array:
    """Unit vectors towards the earth from specific force (it points up at rest), smoothed."""
    if not np.isfinite(accel).all():
        return np.full_like(accel, np.nan)
    kernel = np.ones(min(len(accel), 33))
    smooth = np.column_stack([np.convolve(accel[:, i], kernel, "same") for i in range(3)])
    return np.asarray(-smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-9))


def _with_border(data: chain.Data, before: chain.Data) -> chain.Data:
    """Put the previous epoch's last step in front, as the shared border."""
    return chain.Data(
        np.vstack([before.field_b_gauss[-1:], data.field_b_gauss]),
        np.vstack([np.zeros((1, 3)), data.angle_b_rad]),
        np.r_[data.dt_s[0], data.dt_s],
        np.vstack([before.down_b[-1:], data.down_b]),
        np.r_[before.time_s[-1], data.time_s],
        measures_first=False,
    )
