"""Epochs of the window and the graph that joins them: growing, linearising, forgetting."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain, noise
from ahrsd.estimator.epoch import LinearisationPlan, WindowEpoch, grown, place_borders, scores_of
from ahrsd.estimator.excitation import turned
from ahrsd.estimator.factors import (
    LinearisationPoint,
    Node,
    Stack,
    bias_prior,
    chain_step,
    epoch_factor,
)
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.grouping import group_size, grouped
from ahrsd.estimator.instrument import FoldedInformation, linearise_instrument
from ahrsd.estimator.lag import delayed, rates
from ahrsd.estimator.misfit import Misfit
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.systematic import Cells
from ahrsd.samples import Array

_WORK, _MOST_WORK = 18, 160  # linearisations that each new epoch allows, and that may be saved up
_GYRO_LEAST = 1 / 3  # of the guess by differences: below it the level runs away towards nothing
_GUESSES = 64  # epochs whose first guess of the noise is remembered
_ANOTHER_REST = 0.02  # rad between two directions at rest


class Linearised:
    """Epochs, each where it was linearised; `graph.c` = [M (6), b (3)] in gauss is the answer."""

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
        self.epochs: list[WindowEpoch] = []
        self.misfit = Misfit()
        self.folded = False
        self.lag_s = 0.0  # of the field against the gyro; it is in the epochs' data
        self.past = FoldedInformation()  # of what was folded since there is a lag
        self._folded_cells = Cells()
        self._rest: Array | None = None
        self._work = 0
        self._waiting: list[
            tuple[chain.EpochData, bool]
        ] = []  # not attached yet; with motion or not
        self._guesses: deque[chain.Noise] = deque([usual], maxlen=_GUESSES)
        self._guess = usual  # the middle of them
        prior = bias_prior(0, c, first, parameters.prior_gyro_bias_rad_s)
        self.graph = Graph(c, belief, first, prior)

    def copy(self) -> Self:
        """A copy that goes its own way."""
        other = copy(self)
        other.graph, other.epochs = self.graph.copy(), list(self.epochs)
        other._guesses, other.misfit = self._guesses.copy(), copy(self.misfit)
        other._waiting = list(self._waiting)
        return other

    # -- growing and forgetting ------------------------------------------------------------------

    def take(self, new: Sequence[chain.EpochData]) -> int:
        """New epochs of single steps, linked to the one before unless `measures_first`.

        They wait to be attached until the answer moves; returns how many have motion.
        """
        size = float(np.cbrt(np.linalg.det(chain.symmetric(self.graph.c[:6]))))
        guesses = [noise.first_guess(data, self.parameters) for data in new]
        bias = self.graph.nodes[self.graph.last].bias
        moving = [turned(data, bias) for data in new]
        for data, moves in zip(new, moving, strict=True):
            if moves:
                self.graph.moments.take(data.field_b_gauss)
        self._guesses.extend(guesses)
        self._guess = noise.median(self._guesses)
        sizes = [group_size(d, guess, size) for d, guess in zip(new, guesses, strict=True)]
        coarse = grouped(new, sizes)
        if self.lag_s != 0.0:
            coarse = [delayed(data, self.lag_s) for data in coarse]
        self._waiting += zip(coarse, moving, strict=True)
        return sum(moving)

    @property
    def data(self) -> list[chain.EpochData]:
        """Of all epochs, those that wait too."""
        return [epoch.data for epoch in self.epochs] + [data for data, _ in self._waiting]

    def join(self) -> None:
        """Attach what waits, at the present values."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self.attach([data for data, _ in waiting], [moving for _, moving in waiting])

    def learn_from(self, other: Linearised) -> None:
        """First guesses of the noise and moments of the field, for a part of the other's data."""
        self._guesses, self._guess = other._guesses.copy(), other._guess
        self.graph.moments = other.graph.moments

    def attach(self, new: Sequence[chain.EpochData], moving: Sequence[bool]) -> None:
        """Epochs whose steps are grouped already, and whether they calibrate."""
        walk = self.parameters.bias_walk_rad_s_sqrt_s
        pieces = [grown(self.graph, d, walk, moving=m) for d, m in zip(new, moving, strict=True)]
        self._work = min(self._work + _WORK * len(new), max(_MOST_WORK, _WORK * len(new)))
        begun = self._linearised([LinearisationPlan(piece, u, self.usual) for piece, u in pieces])
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
            self._remember_lag(old)
            self.misfit.remember(old.factor, scores_of([old])[0], self.graph)
            while self.graph.first < self.epochs[0].a:
                self.graph.fold_oldest()

    def _remember_lag(self, old: WindowEpoch) -> None:
        """Keep what an epoch that leaves the window knows of the lag, where one is taken out."""
        if not old.turned or self.lag_s == 0.0:
            return
        if old.instrument is None:  # the others will be asked soon; together it is cheaper
            linearise_instrument([old, *self.epochs], self.graph)
        if old.instrument is not None:
            sigma_bias = self.parameters.prior_gyro_bias_rad_s
            self.past = self.past.with_epoch(old.instrument, self.lag_s, sigma_bias)

    # -- linearisation ---------------------------------------------------------------------------

    def _linearised(
        self, places: Sequence[LinearisationPlan], outlier_sigma: float | None = None
    ) -> list[WindowEpoch]:
        """Epochs at the present values; with `outlier_sigma` at weights of their own."""
        self._work -= len(places)
        graph, chains = self.graph, []
        for at in places:
            first, last = graph.nodes[at.piece.a], graph.nodes[at.piece.a + 1]
            at.u[0], at.u[-1] = first.direction, last.direction
            chains.append(chain.Chain(at.piece.data, at.u, first.bias, at.used, at.weights))
        found = chain.linearise_all(chains, graph.c, outlier_sigma=outlier_sigma)
        pieces = [e.piece for e in self.epochs] + [at.piece for at in places]
        moving = {j for piece in pieces if piece.turned for j in (piece.a, piece.a + 1)}
        out = []
        for at, q in zip(places, found, strict=True):
            a, rest = at.piece.a, None if at.piece.turned else self._resting(at.u)
            point = LinearisationPoint(graph.c, graph.nodes[a], graph.nodes[a + 1])
            drawn = (a not in moving, a + 1 not in moving)
            factor = epoch_factor(q, a, point, at.piece.walk, rest=rest, drawn=drawn)
            out.append(WindowEpoch(at.piece, at.u, at.used, self.usual, q, factor))
        return out

    def _resting(self, u: Array) -> Array:
        """Direction at rest: that of the last rest unless it is clearly another.

        Differences that are only noise would seem to say something of the bias along the field.
        """
        mean = u.mean(axis=0)
        mean /= np.linalg.norm(mean)
        if self._rest is None or float(np.linalg.norm(mean - self._rest)) > _ANOTHER_REST:
            self._rest = mean
        return self._rest

    def _replace(
        self, which: Sequence[int], places: Sequence[LinearisationPlan], **weighing: float
    ) -> None:
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
            LinearisationPlan(e.piece, u, noise.shrunk(e.residuals, self.usual, p))
            for e, u in zip(epochs, self._moved_directions(which), strict=True)
        ]
        self._replace(which, places, outlier_sigma=p.outlier_sigma)
        found = [e.residuals for e in self.epochs]
        self.usual = noise.at_least(
            noise.pooled(found, self._guess, self.parameters), _GYRO_LEAST * self._guess.gyro_rad_s
        )

    def delay(self, lag_s: float) -> None:
        """Take the field to be `lag_s` late in every epoch of the window, and in those to come.

        The directions turn back by as much, so that they fit the fields as well as before.
        """
        if self.lag_s == 0.0 and self.folded:
            self.past = FoldedInformation.of_iron(self.graph, lag_s)
        graph, more, everyone = self.graph, lag_s - self.lag_s, range(len(self.epochs))
        places = []
        for epoch, u in zip(self.epochs, self._moved_directions(everyone), strict=True):
            back = so3.exp(-more * rates(epoch.data))
            u = (back @ u[:, :, None])[:, :, 0]
            if epoch.a == graph.first:
                graph.turn_first(back[0])
            elif epoch.data.measures_first:
                graph.nodes[epoch.a] = Node.at(graph.nodes[epoch.a].bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(graph.nodes[epoch.a + 1].bias, u[-1])
            data = delayed(epoch.data, more)
            places.append(
                LinearisationPlan(replace(epoch.piece, data=data), u, epoch.used, epoch.weights)
            )
        self._replace(everyone, places)
        self.lag_s = lag_s
