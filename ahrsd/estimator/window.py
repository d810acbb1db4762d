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

from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from ahrsd.estimator import chain, noise
from ahrsd.estimator.change import contradicts
from ahrsd.estimator.epoch import Epoch, Place, Snapshot, grown, place_borders, scores_of
from ahrsd.estimator.excitation import turned
from ahrsd.estimator.factors import (
    Node,
    Point,
    Stack,
    bias_prior,
    chain_step,
    epoch_factor,
)
from ahrsd.estimator.graph import Graph, SingularError, sigmas
from ahrsd.estimator.grouping import group_size, grouped
from ahrsd.estimator.lag import delayed
from ahrsd.estimator.misfit import Misfit
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.staleness import bends, outdated
from ahrsd.estimator.systematic import Cells, excess
from ahrsd.samples import Array

_SETTLED, _EXACT = 0.05, 0.1  # sigmas of a step after which iterating stops; `exactly`
_LARGE, _CURVED = 1.0, 0.1  # sigmas: a larger tracking step that is so curved is taken with care
_MAX_STEPS = 12
_MAX_TRACKS = 6
_WORK, _MOST_WORK = 18, 160  # linearisations that each new epoch allows, and that may be saved up
BLIND = 0.5  # posterior over prior sigma above which a direction counts as not determined
_FINISH_WORK = 20  # linearisations per epoch at the end of a recording
_WIDER = 2.0  # at most this many times the first guess is the field's noise at a restart
_RESTART_WORK = 5  # linearisations per epoch that a restart is worth
_DAMPING, _DAMPING_FAR = 1e-3, 1e2
_DAMPING_LIMITS = (1e-9, 1e6)
_GAIN = 0.05  # of log likelihood: less is not worth another step
_GYRO_LEAST = 1 / 3  # of the guess by differences: below it the level runs away towards nothing
_GUESSES = 64  # epochs whose first guess of the noise is remembered
_ANOTHER_REST = 0.02  # rad between two directions at rest


class Window:
    """Epochs and graph. `c` = [M (6), b (3)] in gauss is the calibration as it stands."""

    def __init__(
        self,
        parameters: EstimatorParameters,
        c: Array,
        belief: Array,
        first: Node,
        usual: chain.Noise,
    ) -> None:
        self.parameters = parameters
        self.usual = usual
        self.epochs: list[Epoch] = []
        self.misfit = Misfit()
        self.found_misfit = 1.0
        self.step_sigmas = float(np.inf)
        self.folded = False
        self.lag_s = 0.0  # of the field against the gyro; it is in the epochs' data
        self.loud = 1.0  # what searching found the model to leave over (`search.Found`)
        self._folded_cells = Cells()
        self._damping = _DAMPING
        self._rest: Array | None = None
        self._covariance = belief  # of c, when it was last weighed
        self._work = 0
        self._guesses: deque[chain.Noise] = deque([usual], maxlen=_GUESSES)
        self._guess = usual  # the middle of them
        prior = bias_prior(0, c, first, parameters.prior_gyro_bias_rad_s)
        self.graph = Graph(c, belief, first, prior)

    def twin(self) -> Window:
        """A copy that goes its own way."""
        other = copy(self)
        other.graph, other.epochs = self.graph.twin(), list(self.epochs)
        other._guesses, other.misfit = self._guesses.copy(), copy(self.misfit)
        return other

    # -- growing and forgetting ------------------------------------------------------------------

    def append(self, new: Sequence[chain.Data]) -> None:
        """New epochs of single steps, linked to the one before unless `measures_first`."""
        size = float(np.cbrt(np.linalg.det(chain.symmetric(self.graph.c[:6]))))
        moving, coarse = [], []
        for data in new:
            guess = noise.first_guess(data, self.parameters)
            self._guesses.append(guess)
            moving.append(turned(data))
            if moving[-1]:
                self.graph.moments.take(data.field_b_gauss)
            few = grouped(data, group_size(data, guess, size))
            coarse.append(few if self.lag_s == 0.0 else delayed(few, self.lag_s))
        self._guess = noise.median(self._guesses)
        self.attach(coarse, moving)

    def learn_from(self, other: Window) -> None:
        """First guesses of the noise and moments of the field, for a part of the other's data."""
        self._guesses, self._guess = other._guesses.copy(), other._guess
        self.graph.moments = other.graph.moments

    def attach(self, new: Sequence[chain.Data], moving: Sequence[bool]) -> None:
        """Epochs whose steps are grouped already, and whether they calibrate."""
        walk = self.parameters.bias_walk_rad_s_sqrt_s
        pieces = [grown(self.graph, d, walk, moving=m) for d, m in zip(new, moving, strict=True)]
        self._work = min(self._work + _WORK * len(new), max(_MOST_WORK, _WORK * len(new)))
        begun = self._linearised([Place(piece, u, self.usual) for piece, u in pieces])
        self.epochs += begun
        self.graph.factors += [epoch.factor for epoch in begun]
        place_borders(self.graph, begun)

    def fold(self) -> None:
        """Fold the oldest epochs until the window has its size."""
        while (
            len(self.epochs) > 1
            and sum(e.data.steps for e in self.epochs) > self.parameters.window_steps
        ):
            old = self.epochs.pop(0)
            self.folded |= old.turned
            if old.turned:
                self._folded_cells += old.cells
            self.misfit.remember(old.factor, scores_of([old])[0], self.graph)
            while self.graph.first < self.epochs[0].a:
                self.graph.fold_oldest()

    @property
    def untried(self) -> bool:
        """Whether no step was ever possible: the answer is where it began."""
        return not np.isfinite(self.step_sigmas)

    # -- linearisation ---------------------------------------------------------------------------

    def _linearised(
        self, places: Sequence[Place], outlier_sigma: float | None = None
    ) -> list[Epoch]:
        """Epochs at the present values; with `outlier_sigma` at weights of their own."""
        self._work -= len(places)
        graph, chains = self.graph, []
        for at in places:
            first, last = graph.nodes[at.piece.a], graph.nodes[at.piece.a + 1]
            at.u[0], at.u[-1] = first.direction, last.direction
            chains.append(chain.Chain(at.piece.data, at.u, first.bias, at.used, at.weights))
        found = chain.linearise_all(chains, graph.c, outlier_sigma=outlier_sigma)
        out = []
        for at, q in zip(places, found, strict=True):
            a, rest = at.piece.a, None if at.piece.turned else self._resting(at.u)
            point = Point(graph.c, graph.nodes[a], graph.nodes[a + 1])
            factor = epoch_factor(q, a, point, at.piece.walk, rest=rest)
            out.append(Epoch(at.piece, at.u, at.used, self.usual, q, factor))
        return out

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
        for epoch in kept:
            other.graph.moments.take(epoch.data.field_b_gauss)
        other.attach([first, *(e.data for e in kept[1:])], [e.turned for e in kept])
        return other

    def _resting(self, u: Array) -> Array:
        """Direction at rest: that of the last rest unless it is clearly another.

        Differences that are only noise would seem to say something of the bias along the field.
        """
        mean = u.mean(axis=0)
        mean /= np.linalg.norm(mean)
        if self._rest is None or float(np.linalg.norm(mean - self._rest)) > _ANOTHER_REST:
            self._rest = mean
        return self._rest

    def _replace(self, which: Sequence[int], places: Sequence[Place], **weighing: float) -> None:
        if not which:
            return
        factors = self.graph.factors
        where = {id(factor): i for i, factor in enumerate(factors)}
        for k, new in zip(which, self._linearised(places, **weighing), strict=True):
            factors[where[id(self.epochs[k].factor)]] = new.factor
            self.epochs[k] = new

    def _moved_directions(self, which: Sequence[int]) -> list[Array]:
        """Directions of these epochs where the present values put them."""
        graph, epochs = self.graph, [self.epochs[k] for k in which]
        if not epochs:
            return []
        z = Stack([e.factor for e in epochs], graph.c, graph.nodes).z
        return [
            chain.move(e.u, e.quadratic, chain_step(own, calibrates=e.turned))
            for e, own in zip(epochs, z, strict=True)
        ]

    def refresh(self, which: Sequence[int]) -> None:
        """Linearise epochs again at the present values, with fresh noise and outlier weights."""
        epochs, p = [self.epochs[k] for k in which], self.parameters
        places = [
            Place(e.piece, u, noise.shrunk(e.residuals, self.usual, p))
            for e, u in zip(epochs, self._moved_directions(which), strict=True)
        ]
        self._replace(which, places, outlier_sigma=p.outlier_sigma)
        found = [e.residuals for e in self.epochs]
        self.usual = noise.at_least(
            noise.pooled(found, self._guess, self.parameters), _GYRO_LEAST * self._guess.gyro_rad_s
        )

    def delay(self, lag_s: float) -> None:
        """Take the field to be `lag_s` late in every epoch of the window, and in those to come."""
        everyone = range(len(self.epochs))
        places = []
        for epoch, u in zip(self.epochs, self._moved_directions(everyone), strict=True):
            data = delayed(epoch.data, lag_s - self.lag_s)
            places.append(Place(replace(epoch.piece, data=data), u, epoch.used, epoch.weights))
        self._replace(everyone, places)
        self.lag_s = lag_s

    # -- moving ----------------------------------------------------------------------------------

    def restart_at(self, c: Array, bias: Array) -> None:
        """Put the calibration at c, directions from the field alone, noise as first guessed.

        The guess does not depend on c, so costs reached from different starts compare.
        """
        graph = self.graph
        self.usual = self._start_noise()
        self._damping = _DAMPING_FAR
        graph.c = c.copy()
        places = []
        for k, epoch in enumerate(self.epochs):
            u = chain.start_directions(chain.symmetric(c[:6]), c[6:], epoch.data.field_b_gauss)
            if epoch.data.measures_first or k == 0:
                graph.nodes[epoch.a] = Node.at(bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(bias, u[-1])
            places.append(Place(epoch.piece, u, self.usual))
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
        `enough`; the window is then at the best point found. Never raises on hopeless data.
        """
        c = self.graph.c
        present = all(np.array_equal(e.factor.point.c, c) for e in self.epochs if e.turned)
        cost = self.cost() if present else self._cost_here()
        for _ in range(steps):
            kept = self.snapshot()
            try:
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

    def _cost_here(self) -> float:
        """Cost after a step, everything linearised there; infinite where M is not positive."""
        if np.linalg.eigvalsh(chain.symmetric(self.graph.c[:6]))[0] <= 0:
            return float(np.inf)
        which = [k for k, e in enumerate(self.epochs) if e.turned]  # others do not depend on c
        epochs = [self.epochs[k] for k in which]
        places = zip(epochs, self._moved_directions(which), strict=True)
        self._replace(which, [Place(e.piece, u, e.used, e.weights) for e, u in places])
        return self.cost()

    def track(
        self, new: int = 1, *, everything: bool = False, exactly: bool = False, here: bool = False
    ) -> None:
        """Follow the newest epochs; with `everything`, all are linearised anew first.

        here: all were linearised here just now, which need not be repeated.

        Ends where linearising again would hardly move the answer: by what the step was curved, or,
        `exactly`, by what another pass over everything did.
        """
        graph, everyone = self.graph, range(len(self.epochs))
        stale: Sequence[int] = everyone if everything else everyone[-new:]
        if everything:
            self._work = max(self._work, _FINISH_WORK * len(everyone))
        for k in range(_MAX_TRACKS):
            if k > 0 or not here:
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
            stale = outdated(self.epochs, bent, self.usual, exactly=exactly)
            if not stale and self.step_sigmas < (_EXACT if exactly else _SETTLED):
                return
            stale = everyone if exactly else stale or everyone[-1:]
            if len(stale) > self._work and not everything:
                return

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
        self.found_misfit = self.misfit.value(factors, asked, graph, graph.step())
        graph.temper = max(1.0, self.found_misfit, self._repeating())
        covariance = self._covariance = graph.covariance()[:9, :9] * graph.temper
        graph.hold_blind(BLIND, covariance)
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def _repeating(self) -> float:
        """By how much errors that repeat with the attitude shrink the information."""
        cells = sum((e.cells for e in self.epochs if e.turned), self._folded_cells)
        return excess(cells, self.usual.mag_gauss, self._guess.mag_gauss)
