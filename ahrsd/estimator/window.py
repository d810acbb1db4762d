"""The window: epochs that can still be linearised again, and the graph that joins them.

Two ways to move the estimate. `track` is a plain Gauss-Newton step after which only what it pays to
linearise again is (`outdated`): the steady state, whose cost does not depend on how long the run
has been. `optimise` linearises everything and takes a step only if the true cost falls
(Levenberg-Marquardt): for searching, and whenever a tracking step would be large. `track` spends at
most _WORK linearisations per epoch on average; what is left over waits. `search` lets other starts
descend on a part of the window.

Directions of the calibration that the data do not determine are held at the prior's mean, so that
noise and model errors cannot make them wander (`Graph.hold_blind`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain, noise
from ahrsd.estimator.epoch import (
    FoldedInformation,
    InstrumentCorrection,
    Lag,
    LinearisationPlan,
    Misfit,
    Snapshot,
    WindowEpoch,
    begin_epoch,
    contradicts,
    epoch_scores,
    lag_uncertainty,
    linearise_instrument,
    place_borders,
    reusable_locked,
)
from ahrsd.estimator.epoch_data import (
    corrected,
    delayed,
    group_size,
    grouped,
    joined,
    rates,
    spread,
    thinned,
    turned,
)
from ahrsd.estimator.graph import (
    UNDETERMINED_RATIO,
    Graph,
    LinearisationPoint,
    Moments,
    Node,
    SingularError,
    Stack,
    bias_prior,
    chain_step,
    epoch_factor,
    retract_in_valley,
    sigmas,
    valley_step,
)
from ahrsd.estimator.noise import DirectionCells, variance_inflation
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.samples import Array

_WORK, _MOST_WORK = 18, 160  # linearisations that each new epoch allows, and that may be saved up
_GYRO_LEAST = 1 / 3  # of the guess by differences: below it the level runs away towards nothing
_HIGH_GYRO_NOISE = 1.2  # of the guess: more is something else than the noise of its differences
_GUESSES = 64  # epochs whose first guess of the noise is remembered
_NEW_REST_RAD = 0.02  # rad between two directions at rest
_SETTLED, _EXACT = 0.05, 0.1  # sigmas of a step after which iterating stops; `exactly`
_LARGE, _CURVED = 1.0, 0.1  # sigmas: a larger tracking step that is so curved is taken with care
_MAX_STEPS = 12
_MAX_TRACKS = 6
_FINISH_WORK = 20  # linearisations per epoch at the end of a recording
_WIDER = 2.0  # at most this many times the first guess is the field's noise at a restart
_RESTART_WORK = 5  # linearisations per epoch that a restart is worth
_DAMPING, _DAMPING_FAR = 1e-3, 1e2
_DAMPING_HELD = 1e12  # damping at which the calibration stays where it is
_DAMPING_LIMITS = (1e-9, 1e6)
_SHORT, _STRAIGHT = 5.0, 0.02  # sigmas of a step, and by how much it is curved, to be foreseen
_CHANCE = 2.0  # sigmas of the misfit by chance from which it counts
_LEAST_GAIN = 0.05  # of log likelihood: less is not worth another step


class Window:
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
        self.correction = (
            InstrumentCorrection.identity()
        )  # of the instrument; it is in the epochs' data
        self.folded_since_correction = (
            FoldedInformation()
        )  # of what was folded since something was taken out
        self.folded_information = FoldedInformation()  # of all that was folded
        self._folded_cells = DirectionCells()
        self._rest: Array | None = None
        self._work = 0
        self._waiting: list[
            tuple[chain.EpochData, bool]
        ] = []  # not attached yet; with motion or not
        self._guesses: deque[chain.Noise] = deque([usual], maxlen=_GUESSES)
        self._guess = usual  # the middle of them
        prior = bias_prior(0, c, first, parameters.prior_gyro_bias_rad_s)
        self.graph = Graph(c, belief, first, prior)
        self.found_misfit = 1.0
        self._excess_misfit = 1.0  # the same, less what chance may make
        self.step_sigmas = float(np.inf)
        self.search_residual_ratio = (
            1.0  # what searching found the model to leave over (`SearchResult.loud`)
        )
        self._damping = _DAMPING
        self._covariance = belief  # of c, when it was last weighed

    def copy(self) -> Window:
        """A copy that goes its own way."""
        other = copy(self)
        other.graph, other.epochs = self.graph.copy(), list(self.epochs)
        other._guesses, other.misfit = self._guesses.copy(), copy(self.misfit)
        other._waiting = list(self._waiting)
        return other

    # -- growing and forgetting ------------------------------------------------------------------

    def queue(self, new: Sequence[chain.EpochData]) -> int:
        """New epochs of single steps, linked to the one before unless `measures_first`.

        They wait to be attached until the answer moves; returns how many have motion.
        """
        size = float(np.cbrt(np.linalg.det(chain.symmetric(self.graph.c[:6]))))
        guesses = [noise.first_guess(data, self.parameters) for data in new]
        bias = self.graph.nodes[self.graph.last].bias
        moving = [turned(data, bias) for data in new]
        for data, moves in zip(new, moving, strict=True):
            if moves:
                self.graph.moments.add(data.field_b_gauss)
        self._guesses.extend(guesses)
        self._guess = noise.median(self._guesses)
        sizes = [group_size(d, guess, size) for d, guess in zip(new, guesses, strict=True)]
        coarse = grouped(new, sizes)
        coarse = [self._apply_correction(data) for data in coarse]
        self._waiting += zip(coarse, moving, strict=True)
        return sum(moving)

    def _bias_walk(self) -> float:
        return float(np.hypot(self.parameters.bias_walk_rad_s_sqrt_s, self.correction.walk))

    def _apply_correction(self, data: chain.EpochData) -> chain.EpochData:
        """Of an epoch as it was measured."""
        if not np.array_equal(self.correction.gyro, np.eye(3)):
            data = corrected(data, self.correction.gyro, 0.0)
        return data if self.correction.lag_s == 0.0 else delayed(data, self.correction.lag_s)

    @property
    def data(self) -> list[chain.EpochData]:
        """Of all epochs, those that wait too."""
        return [epoch.data for epoch in self.epochs] + [data for data, _ in self._waiting]

    def attach_waiting(self) -> None:
        """Attach what waits, at the present values."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self.attach([data for data, _ in waiting], [moving for _, moving in waiting])

    def copy_noise_guesses(self, other: Window) -> None:
        """First guesses of the noise and moments of the field, for a part of the other's data."""
        self._guesses, self._guess = other._guesses.copy(), other._guess
        self.graph.moments = other.graph.moments

    def attach(self, new: Sequence[chain.EpochData], moving: Sequence[bool]) -> None:
        """Epochs whose steps are grouped already, and whether they calibrate."""
        walk = self._bias_walk()
        pieces = [
            begin_epoch(self.graph, d, walk, has_motion=m) for d, m in zip(new, moving, strict=True)
        ]
        self._work = min(self._work + _WORK * len(new), max(_MOST_WORK, _WORK * len(new)))
        new_epochs = self._linearise(
            [LinearisationPlan(piece, u, self.usual) for piece, u in pieces]
        )
        self.epochs += new_epochs
        self.graph.factors += [epoch.factor for epoch in new_epochs]
        place_borders(self.graph, new_epochs)

    def fold(self) -> None:
        """Fold the oldest epochs until the window has its size."""
        while (
            len(self.epochs) > 1
            and sum(e.data.steps for e in self.epochs) > self.parameters.window_steps
        ):
            old = self.epochs.pop(0)
            self.folded |= old.has_motion
            if old.has_motion:
                self._folded_cells += old.cells
            self._fold_instrument(old)
            self.misfit.remember(old.factor, epoch_scores([old])[0], self.graph)
            while self.graph.first < self.epochs[0].a:
                self.graph.fold_oldest()

    def _fold_instrument(self, old: WindowEpoch) -> None:
        """Keep what an epoch that leaves the window knows of the instrument."""
        if not old.has_motion:
            return
        if old.instrument is None:  # the others will be asked soon; together it is cheaper
            linearise_instrument([old, *self.epochs])
        if old.instrument is not None:
            sigma_bias = self.parameters.prior_gyro_bias_rad_s
            arguments = old.instrument, self.correction, sigma_bias
            self.folded_information = self.folded_information.with_epoch(*arguments)
            if self.correction.is_nonzero:
                self.folded_since_correction = self.folded_since_correction.with_epoch(*arguments)

    # -- linearisation ---------------------------------------------------------------------------

    def _linearise(
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
        moving = {j for piece in pieces if piece.has_motion for j in (piece.a, piece.a + 1)}
        out = []
        for at, q in zip(places, found, strict=True):
            a, rest_direction = (
                at.piece.a,
                None if at.piece.has_motion else self._rest_direction(at.u),
            )
            point = LinearisationPoint(graph.c, graph.nodes[a], graph.nodes[a + 1])
            drawn = (a not in moving, a + 1 not in moving)
            factor = epoch_factor(q, a, point, at.piece.walk, rest=rest_direction, drawn=drawn)
            out.append(WindowEpoch(at.piece, at.u, at.used, self.usual, q, factor))
        return out

    def _rest_direction(self, u: Array) -> Array:
        """Direction at rest: that of the last rest unless it is clearly another.

        Differences that are only noise would seem to say something of the bias along the field.
        """
        mean = u.mean(axis=0)
        mean /= np.linalg.norm(mean)
        if self._rest is None or float(np.linalg.norm(mean - self._rest)) > _NEW_REST_RAD:
            self._rest = mean
        return self._rest

    def _replace(
        self, which: Sequence[int], places: Sequence[LinearisationPlan], **weighing: float
    ) -> None:
        if not which:
            return
        factors = self.graph.factors
        where = {id(factor): i for i, factor in enumerate(factors)}
        for k, new in zip(which, self._linearise(places, **weighing), strict=True):
            factors[where[id(self.epochs[k].factor)]] = new.factor
            new.locked = reusable_locked(self.epochs[k], new)
            self.epochs[k] = new

    def _moved_directions(self, which: Sequence[int]) -> list[Array]:
        """Directions of these epochs where the present values put them."""
        graph, epochs = self.graph, [self.epochs[k] for k in which]
        if not epochs:
            return []
        z = Stack([e.factor for e in epochs], graph.c, graph.nodes).z
        return [
            chain.move(e.u, e.quadratic, chain_step(own, calibrates=e.has_motion))
            for e, own in zip(epochs, z, strict=True)
        ]

    def relinearise(self, which: Sequence[int]) -> None:
        """Linearise epochs again at the present values, with fresh noise and outlier weights."""
        epochs, p = [self.epochs[k] for k in which], self.parameters
        places = [
            LinearisationPlan(e.piece, u, noise.shrunk(e.residuals, self.usual, p))
            for e, u in zip(epochs, self._moved_directions(which), strict=True)
        ]
        self._replace(which, places, outlier_sigma=p.outlier_sigma)
        found = [e.residuals for e in self.epochs]
        found_noise = noise.pooled(found, self._guess, self.parameters, self._fitted_gyro_freedom())
        self.usual = noise.at_least(found_noise, _GYRO_LEAST * self._guess.gyro_rad_s)

    def _fitted_gyro_freedom(self) -> float:
        """Degrees of freedom of the gyro's noise that its matrix and its walking bias took away."""
        used = (
            0.0
            if np.array_equal(self.correction.gyro, np.eye(3))
            else float(len(self.correction.gyro_parameters))
        )
        if self.correction.walk > 0.0:
            for epoch, score in zip(self.epochs, epoch_scores(self.epochs), strict=True):
                information = np.linalg.eigvalsh(score.information[9:, 9:]) / epoch.piece.walk
                used += float(np.sum(information / (1.0 + information)))
        return used

    def correct_instrument(self, correction: InstrumentCorrection) -> None:
        """Take this out of every epoch of the window, and of those to come.

        The directions turn back by as much as a lag grows, so that they fit the fields as before.
        What a gyro that is wrong left over passed for noise of the field: that is guessed anew.
        """
        if not self.correction.is_nonzero and self.folded:
            self.folded_since_correction = FoldedInformation.of_iron(self.graph, correction)
        graph, everyone = self.graph, range(len(self.epochs))
        lag_s, more_lag_s = self.correction.lag_s, correction.lag_s - self.correction.lag_s
        gyro = correction.gyro @ np.linalg.inv(self.correction.gyro)
        lag_only = correction.walk == self.correction.walk and np.array_equal(
            correction.gyro, self.correction.gyro
        )
        self.correction = correction
        if not lag_only:
            self.usual = chain.Noise(self._start_noise().mag_gauss, self.usual.gyro_rad_s)
        walk = self._bias_walk()
        places = []
        for epoch, u in zip(self.epochs, self._moved_directions(everyone), strict=True):
            back = so3.exp(-more_lag_s * rates(epoch.data))
            u = (back @ u[:, :, None])[:, :, 0]
            if epoch.a == graph.first:
                graph.rotate_first(back[0])
            elif epoch.data.measures_first:
                graph.nodes[epoch.a] = Node.at(graph.nodes[epoch.a].bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(graph.nodes[epoch.a + 1].bias, u[-1])
            data = epoch.data if lag_only else corrected(epoch.data, gyro, lag_s)
            data = delayed(data, more_lag_s) if more_lag_s != 0.0 else data
            information = 1.0 / (walk**2 * float(np.sum(data.dt_s[1:])))
            piece = replace(epoch.piece, data=data, walk=information)
            used = epoch.used if lag_only else self.usual
            places.append(LinearisationPlan(piece, u, used, epoch.weights))
        self._replace(everyone, places)

    # -- moving the answer ------------------------------------------------------------------------

    @property
    def never_moved(self) -> bool:
        """Whether no step was ever possible: the answer is where it began."""
        return not np.isfinite(self.step_sigmas)

    def epoch_contradicts(self, k: int) -> bool:
        """Whether epoch k contradicts the calibration; ask before it is tracked."""
        limit = self.parameters.outlier_sigma
        return contradicts(self.epochs[k], self.graph.c, self._covariance, self.usual, limit)

    def restart_with_last(self, count: int) -> Window:
        """A window of the last `count` epochs that remembers nothing before but noise and bias."""
        graph = self.graph
        kept = self.epochs[-count:]
        first = replace(kept[0].data, measures_first=True)
        node = Node.at(graph.nodes[graph.last].bias, kept[0].u[0])
        mean, information = graph.anchor
        belief = np.asarray(np.linalg.inv(information), dtype=np.float64)
        other = Window(self.parameters, mean, belief, node, self.usual)
        other._guesses, other._guess = self._guesses.copy(), self._guess
        other.correction = self.correction
        if self.correction.lag_s != 0.0 and (lag := self.lag_uncertainty(self.epochs[:-count])):
            other.folded_since_correction = FoldedInformation.of_lag(
                self.correction.lag_s, lag.sigma_s
            )
        for epoch in kept:
            other.graph.moments.add(epoch.data.field_b_gauss)
        other.attach([first, *(e.data for e in kept[1:])], [e.has_motion for e in kept])
        return other

    def lag_uncertainty(self, epochs: Sequence[WindowEpoch] | None = None) -> Lag | None:
        """How well the lag is known by these epochs, all at present, and the past; None: not."""
        chosen = self.epochs if epochs is None else epochs
        try:
            return lag_uncertainty(
                chosen,
                self.graph,
                self.folded_since_correction,
                self.parameters.prior_gyro_bias_rad_s,
            )
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
            self.attach_waiting()
            self._work = max(self._work, _RESTART_WORK * len(self.epochs))
            return
        self.attach_waiting()
        places = []
        for k, epoch in enumerate(self.epochs):
            u = chain.start_directions(chain.symmetric(c[:6]), c[6:], epoch.data.field_b_gauss)
            if epoch.data.measures_first or k == 0:
                graph.nodes[epoch.a] = Node.at(bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(bias, u[-1])
            places.append(LinearisationPlan(epoch.piece, u, self.usual))
        self._replace(range(len(self.epochs)), places)
        place_borders(graph, [epoch for epoch in self.epochs if not epoch.has_motion])
        self._work = max(self._work, _RESTART_WORK * len(self.epochs))

    def _start_noise(self) -> chain.Noise:
        guess = self._guess
        return chain.Noise(min(self.usual.mag_gauss, _WIDER * guess.mag_gauss), guess.gyro_rad_s)

    def snapshot(self) -> Snapshot:
        """The whole state; cheap, because epochs, nodes and factors are replaced, never changed."""
        graph = self.graph
        return Snapshot(
            self._damping, graph.c, dict(graph.nodes), list(self.epochs), list(graph.factors)
        )

    def restore(self, kept: Snapshot) -> None:
        """Back to a snapshot of the same epochs."""
        self._damping = kept.damping
        self.graph.c, self.graph.nodes = kept.c, dict(kept.nodes)
        self.epochs, self.graph.factors = list(kept.epochs), list(kept.factors)

    def cost(self) -> float:
        """Negative log likelihood of the window plus the prior, up to a constant."""
        graph = self.graph
        rises = Stack([graph.prior, *graph.factors], graph.c, graph.nodes).cost_increases()
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
        present = all(np.array_equal(e.factor.point.c, c) for e in self.epochs if e.has_motion)
        cost = self.cost() if present else self._cost_after_relinearising()
        for _ in range(steps):
            kept = self.snapshot()
            try:
                if (gain := self._predicted_gain()) is not None:
                    self.graph.move(*self.graph.step())
                    return cost - gain
                dc, dy = self.graph.step(self._damping)
                self.graph.move(dc, dy)
                new = self._cost_after_relinearising()
            except SingularError:
                new = np.inf
            if new < cost:
                gain, cost = cost - new, new
                self._damping = max(self._damping / 10, _DAMPING_LIMITS[0])
                if gain < _LEAST_GAIN * self.graph.temper or (enough and enough(self.graph.c)):
                    break
            else:
                self.restore(kept)
                self._damping *= 30
                if self._damping > _DAMPING_LIMITS[1]:
                    self._damping = _DAMPING
                    break
        return cost

    def _predicted_gain(self) -> float | None:
        """What an undamped step gains, if it is as short and straight as to be foreseen."""
        graph = self.graph
        dc, information = graph.predict_step()
        if not sigmas(dc, information) < _SHORT:
            return None
        curvatures = path_curvatures(self.epochs, graph.c + dc, graph.moments, information)
        return 0.5 * float(dc @ information @ dc) if curvatures.max() < _STRAIGHT else None

    def _cost_after_relinearising(self) -> float:
        """Cost after a step, everything linearised there; infinite where M is not positive."""
        if np.linalg.eigvalsh(chain.symmetric(self.graph.c[:6]))[0] <= 0:
            return float(np.inf)
        which = [k for k, e in enumerate(self.epochs) if e.has_motion]  # others do not depend on c
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
        self.attach_waiting()
        graph, everyone = self.graph, range(len(self.epochs))
        stale: Sequence[int] = everyone if everything else everyone[-new:]
        if everything:
            self._work = max(self._work, _FINISH_WORK * len(everyone))
        if here:
            self._smooth_directions()
        for _ in range(_MAX_TRACKS):
            self.relinearise(stale)
            try:
                information = self._weigh_prior()
                dc, dy = graph.step()
            except (SingularError, np.linalg.LinAlgError):
                self.step_sigmas = float(np.inf)
                return
            step, curvatures = (
                sigmas(dc, information),
                path_curvatures(self.epochs, graph.c + dc, graph.moments, information),
            )
            self.step_sigmas = step if exactly else min(step, float(curvatures.max()))
            if step > _LARGE and curvatures.max() > _CURVED:
                self.step_sigmas = step
                if not self._optimise_within_work():
                    return
                stale = everyone
                continue
            graph.move(dc, dy)
            drifts = rest_drifts(self.epochs, graph.nodes, self.usual)
            stale = epochs_to_relinearise(
                self.epochs, curvatures, drifts, self.usual, exactly=exactly
            )
            if not stale and self.step_sigmas < (_EXACT if exactly else _SETTLED):
                return
            stale = everyone if exactly else stale or everyone[-1:]
            if len(stale) > self._work and not everything:
                return

    def _smooth_directions(self) -> None:
        """Put the directions where the chains want them at the present calibration.

        Those of the field alone are so noisy that a step of the calibration from there goes astray.
        """
        try:
            _, dy = self.graph.step(_DAMPING_HELD)
        except SingularError:
            return
        self.graph.move(np.zeros(9), dy)

    def _optimise_within_work(self) -> bool:
        """A large step with care, as far as the work allowed goes; whether iterating may go on.

        The next epoch goes on from wherever this ends.
        """
        n = max(1, sum(e.has_motion for e in self.epochs))
        steps = min(_MAX_STEPS, self._work // n - 1)
        if steps < 1:
            return False
        self.optimise(steps)
        return self._work >= 2 * n

    def _weigh_prior(self) -> Array:
        """Prior against data, and what is held; returns the tempered information of c (9, 9).

        What is believed without data keeps its weight against data that disagree among themselves.
        """
        graph, factors, scores = (
            self.graph,
            [e.factor for e in self.epochs],
            epoch_scores(self.epochs),
        )
        graph.temper, graph.hold = 1.0, np.zeros((9, 9))
        self.found_misfit, chance = self.misfit.value(factors, scores, graph, graph.step())
        significant = (
            self.found_misfit > 1.0 + _CHANCE * chance
        )  # else sigmas would only ever grow by it
        self._excess_misfit = max(1.0, self.found_misfit - _CHANCE * chance)
        graph.temper = max(
            1.0, self.found_misfit if significant else 1.0, self._attitude_inflation()
        )
        covariance = graph.covariance()[:9, :9] * graph.temper
        distance_from_prior = graph.distance_from_prior(covariance)
        if distance_from_prior > graph.temper:
            graph.temper = distance_from_prior
            covariance = graph.covariance()[:9, :9] * graph.temper
        self._covariance = covariance
        graph.hold_undetermined(UNDETERMINED_RATIO, covariance)
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def _attitude_inflation(self, *, smooth: bool = False) -> float:
        """By how much errors that repeat with the attitude shrink the information."""
        cells = sum((e.cells for e in self.epochs if e.has_motion), self._folded_cells)
        noise = self.usual.mag_gauss, self._guess.mag_gauss
        return variance_inflation(cells, *noise, smooth=smooth)

    @property
    def residual_ratio(self) -> float:
        """Mean square of what the model leaves over, over that of noise; 1: no more than chance."""
        return max(self._excess_misfit, self._attitude_inflation())

    @property
    def gyro_freedom(self) -> float:
        """Degrees of freedom of the gyro's noise."""
        return sum(epoch.residuals.gyro_freedom for epoch in self.epochs)

    @property
    def has_unmodelled_residual(self) -> bool:
        """Whether the model leaves over what is not noise, or calls it noise of the gyro."""
        high_gyro_noise = self.usual.gyro_rad_s > _HIGH_GYRO_NOISE * self._guess.gyro_rad_s
        return high_gyro_noise or self.residual_ratio > 1.0

    def slow_residual(self) -> noise.SlowResidual | None:
        """What is left over that lasts, by the epochs that are still here."""
        return noise.slow_residual(self.graph.c, [(e.data, e.has_motion) for e in self.epochs])

    def covariance(self) -> Array:
        """Of c and the newest gyro bias (12, 12), with all that the model leaves over in it.

        What epochs disagree about is taken not to average out (`noise.unaveraged`).

        What repeats with the attitude is taken to be smooth, as a room's gradient is. The answer
        itself is weighed as if it were not, which is nearer to what the data alone say.
        """
        graph = self.graph.copy()
        graph.temper = max(graph.temper, self._attitude_inflation(smooth=True))
        untempered = graph.covariance()
        epochs = np.array([score.information for score in epoch_scores(self.epochs)])
        folded = np.zeros((12, 12)), 0.0
        if self.folded:
            folded_information = np.linalg.inv(untempered) - epochs.sum(axis=0)
            folded_information[:9, :9] -= graph.temper * graph.anchor[1]
            folded = folded_information, self.misfit.epochs
        return noise.unaveraged(
            untempered * graph.temper,
            epochs,
            misfit=self._excess_misfit,
            temper=graph.temper,
            folded=folded,
        )

    def explained_covariance(self) -> Array:
        """The same (12, 12) if the model explained the data."""
        graph = self.graph.copy()
        graph.temper = 1.0
        return graph.covariance()


# -- Which epochs are worth linearising again ------------------------------------------------------
#
# Which epochs are worth linearising again, after the calibration moved away from where they were.
#
# An epoch's factor is exact to second order, so a straight move costs nothing, however many sigmas
# long. What counts is by how much the way there is curved (`graph.retract`), in sigmas: linearising
# again moves the answer by about that. An epoch at rest knows nothing of the calibration. There the
# gyro's bias counts: at another one its directions drift, which seems to be noise of the field.

_LEAST_CURVATURE = 0.02  # sigmas
_NOISE_CHANGE, _NOISE_CHANGE_EXACT = (
    0.1,
    0.04,
)  # of the gyro's level, that an epoch may have assumed else

_LEAST_DRIFT = 0.3  # of the field's noise: what a bias other than assumed makes of a rest


def path_curvatures(
    epochs: Sequence[WindowEpoch], c: Array, moments: Moments, information: Array
) -> Array:
    """How curved the way is to c from where each was linearised, in sigmas (E,); 0 at rest.

    Infinite where no valley leads there: nothing is known of such a way.
    """
    known: dict[int, float] = {}
    for epoch in epochs:
        at = epoch.factor.point.c
        if epoch.has_motion and id(at) not in known:
            there = retract_in_valley(at, c - at, moments)
            known[id(at)] = np.inf if there is None else sigmas(there - c, information)
    return np.array([known[id(e.factor.point.c)] if e.has_motion else 0.0 for e in epochs])


def rest_drifts(
    epochs: Sequence[WindowEpoch], nodes: Mapping[int, Node], usual: chain.Noise
) -> Array:
    """How far directions at rest drift over their epoch by another bias than it assumed, (E,).

    In units of the field's noise; 0 with motion.
    """
    out = np.zeros(len(epochs))
    for k, epoch in enumerate(epochs):
        if not epoch.has_motion:
            at = epoch.factor.point
            length_s = float(epoch.data.time_s[-1] - epoch.data.time_s[0])
            angle = float(np.linalg.norm(nodes[epoch.a].bias - at.a.bias)) * length_s
            size = float(np.cbrt(np.linalg.det(chain.symmetric(at.c[:6]))))
            out[k] = angle * size / usual.mag_gauss
    return out


def epochs_to_relinearise(
    epochs: Sequence[WindowEpoch],
    curvatures: Array,
    drifts: Array,
    usual: chain.Noise,
    *,
    exactly: bool,
) -> list[int]:
    """Epochs that were left too far behind, or assumed another noise of the gyro than `usual`."""
    assumed = np.array([e.usual.gyro_rad_s for e in epochs])
    limit = _NOISE_CHANGE_EXACT if exactly else _NOISE_CHANGE
    other = np.abs(assumed / usual.gyro_rad_s - 1.0) > limit
    return [
        int(k)
        for k in np.flatnonzero((curvatures > _LEAST_CURVATURE) | (drifts > _LEAST_DRIFT) | other)
    ]


# -- Other starts ----------------------------------------------------------------------------------
#
# Other starting points: do they lead to a better answer, and do they agree?
#
# The likelihood has more than one valley when motion is poor. So now and then several starts
# descend on a part of the window (the epochs whose field varied most, all in one chain with cuts in
# it; of an epoch of single steps every k-th field, rotations between them composed exactly): the
# device's present calibration, a linear fit, a sphere, and the answer as it stands. The lowest
# wins; it may be called sure only if two starts that know nothing of each other arrive there.

_SEARCH_EPOCHS = 6
_SEARCH_ROWS = 128  # rows per epoch, at most twice that
_DESCENT_STEPS = 8  # Levenberg-Marquardt steps per start
_DESCENT_ROUNDS = 4  # times that those which do not agree yet go on
_RIVAL_NATS = 8.0  # of log likelihood, by which another valley must be less likely
_NEAR_SIGMAS = 0.1  # sigmas from the best so far at which a descent need not go on
_SAME_SIGMAS = 1.0  # sigmas within which two answers are one
_HIGH_RESIDUAL_RATIO = (
    2.0  # residual variance over that of the fields' differences that the model left over
)


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Best calibration c (9,) and gyro bias (3,).

    away:   sigmas between it and the answer as it stands
    gain:   in log likelihood over where a descent from the answer as it stands leads
    apart:  sigmas from it within which two starts that know nothing of each other ended
    loud:   residual variance that even the best leaves over that of the fields' differences, at
            which the starts descend; 1 where the model explains the data
    """

    c: Array
    bias: Array
    away: float
    gain: float
    apart: float
    search_residual_ratio: float

    @property
    def agreed(self) -> bool:
        """Two starts that know nothing of each other arrived at the best."""
        return self.apart < _SAME_SIGMAS


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """Where a descent is.

    independent: it knows nothing of the others;  gain: of log likelihood in the last steps
    mirrored: it began at a mirror image;  kept: from where it can go on
    """

    cost: float
    c: Array
    bias: Array
    information: Array | None
    search_residual_ratio: float
    independent: bool
    gain: float
    mirrored: bool
    kept: Snapshot

    @property
    def residual_ratio(self) -> float:
        """Residual variance that it leaves, where that is more than chance; else 1."""
        return (
            self.search_residual_ratio if self.search_residual_ratio > _HIGH_RESIDUAL_RATIO else 1.0
        )


def search(
    parameters: EstimatorParameters,
    window: Window,
    present_bias: Array,
    data: Sequence[chain.EpochData],
) -> SearchResult:
    """Descend from every start on a thinned copy of `data`; `window` itself is not touched."""
    graph = window.graph
    present, information = graph.anchor
    belief = np.asarray(np.linalg.inv(information), dtype=np.float64)
    chosen = sorted(
        sorted(range(len(data)), key=lambda k: -spread(data[k].field_b_gauss))[:_SEARCH_EPOCHS]
    )
    first = Node.at(present_bias, np.array([1.0, 0.0, 0.0]))
    thin = Window(parameters, present, belief, first, window.usual)
    thin.copy_noise_guesses(window)
    thin.graph.temper = graph.temper
    if window.search_residual_ratio > 1.0:
        thin.graph.hold = graph.hold
    thin.attach(
        [joined([thinned(data[k], max(1, len(data[k]) // _SEARCH_ROWS)) for k in chosen])], [True]
    )
    whole = [data[k] for k in chosen]
    fields = np.vstack([d.field_b_gauss for d in whole])
    starts = [chain.linear_start(whole), chain.sphere_start(fields)]
    first_look = bool(np.array_equal(graph.c, present))
    if not first_look:
        starts.insert(0, present)
    known = [c for c in starts if c is not None]
    if window.search_residual_ratio > 1.0:
        known = [graph.project_held(c) for c in known]
    bias = graph.nodes[graph.last].bias
    descents = [_descend(thin, graph.c, bias, None, independent=first_look)]
    for c in known:
        if _is_positive_definite(c):
            descents.append(_descend(thin, c, present_bias, _best_descent(descents)))
    for _ in range(_DESCENT_ROUNDS):
        if _agreement_sigmas(descents, graph) < _SAME_SIGMAS:
            break
        descents = _continue_descents(thin, descents, fields, present_bias)
    best = _best_descent(descents)
    temper = graph.temper * best.residual_ratio if best.residual_ratio > 1.0 else 1.0
    away = _valley_distance(graph.c, best, graph.moments, temper)
    gain = (descents[0].cost - best.cost) / best.residual_ratio
    return SearchResult(
        best.c, best.bias, away, gain, _agreement_sigmas(descents, graph), best.residual_ratio
    )


def _best_descent(descents: Sequence[_Descent]) -> _Descent:
    return min(descents, key=lambda r: r.cost)


def _agreement_sigmas(descents: Sequence[_Descent], graph: Graph) -> float:
    """Sigmas from the best within which two independent ones are, or, where another valley is
    nearly as likely, to the end of that."""
    best = _best_descent(descents)
    temper = graph.temper * best.residual_ratio
    distances = [(r, _valley_distance(r.c, best, graph.moments, temper)) for r in descents]
    second = float((*sorted(far for r, far in distances if r.independent), np.inf)[1])
    rivals = [
        far
        for r, far in distances
        if far >= _SAME_SIGMAS
        and r.gain <= _LEAST_GAIN * graph.temper
        and r.cost - best.cost < _RIVAL_NATS * temper
    ]
    return max([second, *rivals])


def _continue_descents(
    thin: Window, descents: Sequence[_Descent], fields: Array, bias: Array
) -> list[_Descent]:
    """Descents that were not at their ends or at the best go on; one that ended elsewhere begins
    anew behind the plane of the fields.

    Turns about one axis look nearly the same from both sides of the plane that they draw.
    """
    out, best = list(descents), _best_descent(descents)
    for k, one in enumerate(descents):
        arrived = (
            one is best or _valley_distance(one.c, best, thin.graph.moments, 1.0) < _NEAR_SIGMAS
        )
        if one.gain > _LEAST_GAIN * thin.graph.temper:
            out[k] = _continue_descent(thin, one)
        elif not arrived and not one.mirrored:
            mirrored = _descend(
                thin, chain.mirrored(one.c, fields), bias, best, independent=one.independent
            )
            out[k] = replace(one, independent=False, mirrored=True)  # an end that stays one
            out.append(replace(mirrored, mirrored=True))
    return out


def _is_positive_definite(c: Array) -> bool:
    return bool(np.linalg.eigvalsh(chain.symmetric(c[:6]))[0] > 0.0)


def _descend(
    thin: Window, c: Array, bias: Array, best: _Descent | None, *, independent: bool = True
) -> _Descent:
    """Downhill from c, until it is clear that this leads to the best so far."""
    thin.restart_at(c, bias)

    def near(at: Array) -> bool:
        return (
            best is not None and _valley_distance(at, best, thin.graph.moments, 1.0) < _NEAR_SIGMAS
        )

    return _record_descent(
        thin, thin.optimise(_DESCENT_STEPS, near), np.inf, independent=independent
    )


def _continue_descent(thin: Window, before: _Descent) -> _Descent:
    """Further downhill from where it was."""
    thin.restore(before.kept)
    cost = thin.optimise(_DESCENT_STEPS)
    found = _record_descent(thin, cost, before.cost - cost, independent=before.independent)
    return replace(found, mirrored=before.mirrored)


def _record_descent(thin: Window, cost: float, gain: float, *, independent: bool) -> _Descent:
    graph = thin.graph
    try:
        information = np.asarray(np.linalg.inv(graph.covariance()[:9, :9]), dtype=np.float64)
    except (SingularError, np.linalg.LinAlgError):
        information = None
    found = thin.epochs[0].residuals
    residual_ratio = found.mag_gauss2 / found.mag_freedom / thin.usual.mag_gauss**2
    bias = graph.nodes[graph.last].bias.copy()
    kept = thin.snapshot()
    return _Descent(
        cost,
        graph.c.copy(),
        bias,
        information,
        residual_ratio,
        independent,
        gain,
        mirrored=False,
        kept=kept,
    )


def _valley_distance(c: Array, best: _Descent, moments: Moments, temper: float) -> float:
    """In sigmas of the best, along the valley: straight across it a bend looks far."""
    if best.information is None:
        return float(np.inf)
    return sigmas(valley_step(best.c, c, moments), best.information / temper)
