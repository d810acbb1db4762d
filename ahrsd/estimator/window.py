"""The window: epochs that can still be linearised again, and the graph that joins them.

Two ways to move the estimate. `track` is a plain Gauss-Newton step after which only what it pays to
linearise again is (`staleness.py`): the steady state, whose cost does not depend on
how long the run has been. `optimise` linearises everything and takes a step only if the true cost
falls (Levenberg-Marquardt): for searching, and whenever a tracking step would be large. `track`
spends at most _WORK linearisations per epoch on average; what is left over waits.

Directions of the calibration that the data do not determine are held at the prior's mean, so that
noise and model errors cannot make them wander (`Graph.hold_blind`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.change import contradicts
from ahrsd.estimator.epoch import LinearisationPlan, Snapshot, WindowEpoch, place_borders, scores_of
from ahrsd.estimator.factors import Node, Stack
from ahrsd.estimator.graph import SingularError, sigmas
from ahrsd.estimator.instrument import FoldedInformation, Lag, lag_known
from ahrsd.estimator.linearised import Linearised
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.staleness import bends, drifts, outdated
from ahrsd.estimator.systematic import excess
from ahrsd.samples import Array

_SETTLED, _EXACT = 0.05, 0.1  # sigmas of a step after which iterating stops; `exactly`
_LARGE, _CURVED = 1.0, 0.1  # sigmas: a larger tracking step that is so curved is taken with care
_MAX_STEPS = 12
_MAX_TRACKS = 6
BLIND = 0.5  # posterior over prior sigma above which a direction counts as not determined
_FINISH_WORK = 20  # linearisations per epoch at the end of a recording
_WIDER = 2.0  # at most this many times the first guess is the field's noise at a restart
_RESTART_WORK = 5  # linearisations per epoch that a restart is worth
_DAMPING, _DAMPING_FAR = 1e-3, 1e2
_STILL = 1e12  # damping at which the calibration stays where it is
_DAMPING_LIMITS = (1e-9, 1e6)
_SHORT, _STRAIGHT = 5.0, 0.02  # sigmas of a step, and by how much it is curved, to be foreseen
_CHANCE = 2.0  # sigmas of the misfit by chance from which it counts
_GAIN = 0.05  # of log likelihood: less is not worth another step


class Window(Linearised):
    """Epochs and graph, and how the answer moves over them."""

    def __init__(
        self,
        parameters: EstimatorParameters,
        c: Array,
        belief: Array,
        first: Node,
        usual: chain.Noise,
    ) -> None:
        super().__init__(parameters, c, belief, first, usual)
        self.found_misfit = 1.0
        self.step_sigmas = float(np.inf)
        self.loud = 1.0  # what searching found the model to leave over (`search.Found`)
        self._damping = _DAMPING
        self._covariance = belief  # of c, when it was last weighed

    @property
    def untried(self) -> bool:
        """Whether no step was ever possible: the answer is where it began."""
        return not np.isfinite(self.step_sigmas)

    def contradicted(self, k: int) -> bool:
        """Whether epoch k contradicts the calibration; ask before it is tracked."""
        limit = self.parameters.outlier_sigma
        return contradicts(self.epochs[k], self.graph.c, self._covariance, self.usual, limit)

    def anew(self, count: int) -> Window:
        """A window of the last `count` epochs that remembers nothing before but noise and bias."""
        graph = self.graph
        kept = self.epochs[-count:]
        first = replace(kept[0].data, measures_first=True)
        node = Node.at(graph.nodes[graph.last].bias, kept[0].u[0])
        mean, information = graph.anchor
        belief = np.asarray(np.linalg.inv(information), dtype=np.float64)
        other = Window(self.parameters, mean, belief, node, self.usual)
        other._guesses, other._guess = self._guesses.copy(), self._guess
        other.lag_s = self.lag_s
        if self.lag_s != 0.0 and (known := self.lag_known(self.epochs[:-count])):
            other.past = FoldedInformation.of_lag(self.lag_s, known.sigma_s)
        for epoch in kept:
            other.graph.moments.take(epoch.data.field_b_gauss)
        other.attach([first, *(e.data for e in kept[1:])], [e.turned for e in kept])
        return other

    def lag_known(self, epochs: Sequence[WindowEpoch] | None = None) -> Lag | None:
        """How well the lag is known by these epochs, all at present, and the past; None: not."""
        asked = self.epochs if epochs is None else epochs
        try:
            return lag_known(asked, self.graph, self.past, self.parameters.prior_gyro_bias_rad_s)
        except np.linalg.LinAlgError:
            return None

    def restart_at(self, c: Array, bias: Array) -> None:
        """Put the calibration at c, directions from the field alone, noise as first guessed.

        The guess does not depend on c, so costs reached from different starts compare.
        """
        graph = self.graph
        self.usual = self._start_noise()
        self._damping = _DAMPING_FAR
        graph.c = c.copy()
        if not self.epochs:
            graph.nodes[graph.last] = Node.at(bias, graph.nodes[graph.last].direction)
            self.join()
            self._work = max(self._work, _RESTART_WORK * len(self.epochs))
            return
        self.join()
        places = []
        for k, epoch in enumerate(self.epochs):
            u = chain.start_directions(chain.symmetric(c[:6]), c[6:], epoch.data.field_b_gauss)
            if epoch.data.measures_first or k == 0:
                graph.nodes[epoch.a] = Node.at(bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(bias, u[-1])
            places.append(LinearisationPlan(epoch.piece, u, self.usual))
        self._replace(range(len(self.epochs)), places)
        place_borders(graph, [epoch for epoch in self.epochs if not epoch.turned])
        self._work = max(self._work, _RESTART_WORK * len(self.epochs))

    def _start_noise(self) -> chain.Noise:
        guess = self._guess
        return chain.Noise(min(self.usual.mag_gauss, _WIDER * guess.mag_gauss), guess.gyro_rad_s)

    def snapshot(self) -> Snapshot:
        """The whole state; cheap, because epochs, nodes and factors are replaced, never changed."""
        graph = self.graph
        return Snapshot(graph.c, dict(graph.nodes), list(self.epochs), list(graph.factors))

    def restore(self, kept: Snapshot) -> None:
        """Back to a snapshot of the same epochs."""
        self.graph.c, self.graph.nodes = kept.c, dict(kept.nodes)
        self.epochs, self.graph.factors = list(kept.epochs), list(kept.factors)

    def cost(self) -> float:
        """Negative log likelihood of the window plus the prior, up to a constant."""
        graph = self.graph
        rises = Stack([graph.prior, *graph.factors], graph.c, graph.nodes).rises()
        return sum(e.cost for e in self.epochs) + float(rises.sum()) + graph.anchor_cost()

    def optimise(
        self, steps: int = _MAX_STEPS, enough: Callable[[Array], bool] | None = None
    ) -> float:
        """Levenberg-Marquardt over the whole window at fixed noise and weights; returns the cost.

        Stops at the iteration limit, where damping alone finds no lower cost, or where c is
        `enough`; the window is then at the best point found. A last step that is short and straight
        is taken without looking: its cost is that foreseen. Never raises on hopeless data.
        """
        c = self.graph.c
        present = all(np.array_equal(e.factor.point.c, c) for e in self.epochs if e.turned)
        cost = self.cost() if present else self._cost_here()
        for _ in range(steps):
            kept = self.snapshot()
            try:
                if (gain := self._foreseen()) is not None:
                    self.graph.move(*self.graph.step())
                    return cost - gain
                dc, dy = self.graph.step(self._damping)
                self.graph.move(dc, dy)
                new = self._cost_here()
            except SingularError:
                new = np.inf
            if new < cost:
                gain, cost = cost - new, new
                self._damping = max(self._damping / 10, _DAMPING_LIMITS[0])
                if gain < _GAIN * self.graph.temper or (enough and enough(self.graph.c)):
                    break
            else:
                self.restore(kept)
                self._damping *= 30
                if self._damping > _DAMPING_LIMITS[1]:
                    self._damping = _DAMPING
                    break
        return cost

    def _foreseen(self) -> float | None:
        """What an undamped step gains, if it is as short and straight as to be foreseen."""
        graph = self.graph
        dc, information = graph.ahead()
        if not sigmas(dc, information) < _SHORT:
            return None
        bent = bends(self.epochs, graph.c + dc, graph.moments, information)
        return 0.5 * float(dc @ information @ dc) if bent.max() < _STRAIGHT else None

    def _cost_here(self) -> float:
        """Cost after a step, everything linearised there; infinite where M is not positive."""
        if np.linalg.eigvalsh(chain.symmetric(self.graph.c[:6]))[0] <= 0:
            return float(np.inf)
        which = [k for k, e in enumerate(self.epochs) if e.turned]  # others do not depend on c
        epochs = [self.epochs[k] for k in which]
        places = zip(epochs, self._moved_directions(which), strict=True)
        self._replace(which, [LinearisationPlan(e.piece, u, e.used, e.weights) for e, u in places])
        return self.cost()

    def track(
        self, new: int = 1, *, everything: bool = False, exactly: bool = False, here: bool = False
    ) -> None:
        """Follow the newest epochs; with `everything`, all are linearised anew first.

        here: all were linearised here just now, at directions from the field alone.

        Ends where linearising again would hardly move the answer: by what the step was curved, or,
        `exactly`, by what another pass over everything did.
        """
        self.join()
        graph, everyone = self.graph, range(len(self.epochs))
        stale: Sequence[int] = everyone if everything else everyone[-new:]
        if everything:
            self._work = max(self._work, _FINISH_WORK * len(everyone))
        if here:
            self._smooth()
        for _ in range(_MAX_TRACKS):
            self.refresh(stale)
            try:
                information = self._weigh()
                dc, dy = graph.step()
            except (SingularError, np.linalg.LinAlgError):
                self.step_sigmas = float(np.inf)
                return
            step, bent = (
                sigmas(dc, information),
                bends(self.epochs, graph.c + dc, graph.moments, information),
            )
            self.step_sigmas = step if exactly else min(step, float(bent.max()))
            if step > _LARGE and bent.max() > _CURVED:
                self.step_sigmas = step
                if not self._careful():
                    return
                stale = everyone
                continue
            graph.move(dc, dy)
            drifted = drifts(self.epochs, graph.nodes, self.usual)
            stale = outdated(self.epochs, bent, drifted, self.usual, exactly=exactly)
            if not stale and self.step_sigmas < (_EXACT if exactly else _SETTLED):
                return
            stale = everyone if exactly else stale or everyone[-1:]
            if len(stale) > self._work and not everything:
                return

    def _smooth(self) -> None:
        """Put the directions where the chains want them at the present calibration.

        Those of the field alone are so noisy that a step of the calibration from there goes astray.
        """
        try:
            _, dy = self.graph.step(_STILL)
        except SingularError:
            return
        self.graph.move(np.zeros(9), dy)

    def _careful(self) -> bool:
        """A large step with care, as far as the work allowed goes; whether iterating may go on.

        The next epoch goes on from wherever this ends.
        """
        n = max(1, sum(e.turned for e in self.epochs))
        steps = min(_MAX_STEPS, self._work // n - 1)
        if steps < 1:
            return False
        self.optimise(steps)
        return self._work >= 2 * n

    def _weigh(self) -> Array:
        """Prior against data, and what is held; returns the tempered information of c (9, 9).

        What is believed without data keeps its weight against data that disagree among themselves.
        """
        graph, factors, asked = self.graph, [e.factor for e in self.epochs], scores_of(self.epochs)
        graph.temper, graph.hold = 1.0, np.zeros((9, 9))
        self.found_misfit, chance = self.misfit.value(factors, asked, graph, graph.step())
        told = self.found_misfit > 1.0 + _CHANCE * chance  # else sigmas would only ever grow by it
        graph.temper = max(1.0, self.found_misfit if told else 1.0, self._repeating())
        covariance = graph.covariance()[:9, :9] * graph.temper
        distance_from_prior = graph.distance_from_prior(covariance)
        if distance_from_prior > graph.temper:
            graph.temper = distance_from_prior
            covariance = graph.covariance()[:9, :9] * graph.temper
        self._covariance = covariance
        graph.hold_blind(BLIND, covariance)
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def _repeating(self) -> float:
        """By how much errors that repeat with the attitude shrink the information."""
        cells = sum((e.cells for e in self.epochs if e.turned), self._folded_cells)
        return excess(cells, self.usual.mag_gauss, self._guess.mag_gauss)
