"""The window: epochs that can still be linearised again, and the graph that joins them.

There are two ways to move the estimate. `track` takes plain Gauss-Newton steps and then linearises
only the epochs for which it pays (`epochs_to_relinearise`): the steady state, whose cost does not
depend on the length of the run. `optimise` linearises everything and accepts a step only if the
true cost falls (Levenberg-Marquardt): for searching, and whenever a tracking step would be large.
`track` spends at most _WORK linearisations per epoch on average; the remaining ones wait. `search`
lets other starts descend on a part of the window.

Directions of the calibration that the data do not determine are held at the prior's mean, so that
noise and model errors cannot make them drift (`Graph.hold_undetermined`).
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
    group_size,
    group_steps,
    has_motion,
    join_epochs,
    principal_deviation,
    row_rates,
    thin_rows,
    with_gyro_matrix,
    with_lag,
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

_WORK, _MOST_WORK = 18, 160  # linearisations that each new epoch allows, and that may accumulate
_GYRO_LEAST = 1 / 3  # of the guess by differences: below it the level runs away to zero
_HIGH_GYRO_NOISE = 1.2  # of the guess: more is not noise of the readings
_GUESSES = 64  # epochs whose first guess of the noise is remembered
_NEW_REST_RAD = 0.02  # between two directions at rest
_SETTLED, _EXACT = 0.05, 0.1  # sigmas of a step after which iterating stops; `exactly`
_LARGE, _CURVED = 1.0, 0.1  # sigmas: a larger and more curved step goes to `optimise`
_MAX_STEPS = 12
_MAX_TRACKS = 6
_FINISH_WORK = 20  # linearisations per epoch at the end of a recording
_WIDER = 2.0  # at most this many times the first guess is the field's noise at a restart
_RESTART_WORK = 5  # linearisations per epoch that a restart is worth
_DAMPING, _DAMPING_FAR = 1e-3, 1e2
_DAMPING_HELD = 1e12  # damping that holds the calibration
_DAMPING_LIMITS = (1e-9, 1e6)
_SHORT, _STRAIGHT = 5.0, 0.02  # sigmas and curvature of a step whose gain can be predicted
_CHANCE = 2.0  # sigmas by which the misfit must exceed 1
_LEAST_GAIN = 0.05  # nats: less is not worth another step


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
        self.correction = InstrumentCorrection.identity()  # applied to the data of all epochs
        self.folded_since_correction = FoldedInformation()  # information folded since then
        self.folded_information = FoldedInformation()  # information folded in all
        self._folded_cells = DirectionCells()
        self._rest: Array | None = None
        self._work = 0
        self._waiting: list[
            tuple[chain.EpochData, bool]
        ] = []  # not attached yet, and whether they have motion
        self._guesses: deque[chain.Noise] = deque([usual], maxlen=_GUESSES)
        self._guess = usual  # their median
        prior = bias_prior(0, c, first, parameters.prior_gyro_bias_rad_s)
        self.graph = Graph(c, belief, first, prior)
        self.found_misfit = 1.0
        self._excess_misfit = 1.0  # the same, less `_CHANCE` sigmas of chance
        self.step_sigmas = float(np.inf)
        self.search_residual_ratio = 1.0  # of `SearchResult`
        self._damping = _DAMPING
        self._covariance = belief  # of c, at the last `_weigh_prior`

    def copy(self) -> Window:
        """An independent copy."""
        other = copy(self)
        other.graph, other.epochs = self.graph.copy(), list(self.epochs)
        other._guesses, other.misfit = self._guesses.copy(), copy(self.misfit)
        other._waiting = list(self._waiting)
        return other

    # -- growing and forgetting ------------------------------------------------------------------

    def queue(self, new: Sequence[chain.EpochData]) -> int:
        """Take new epochs of single steps, linked to the one before unless `measures_first`.

        They are attached to the graph when the estimate moves. Returns how many have motion.
        """
        size = float(np.cbrt(np.linalg.det(chain.symmetric(self.graph.c[:6]))))
        guesses = [noise.first_guess(data, self.parameters) for data in new]
        bias = self.graph.nodes[self.graph.last].bias
        moving = [has_motion(data, bias) for data in new]
        for data, moves in zip(new, moving, strict=True):
            if moves:
                self.graph.moments.add(data.field_b_gauss)
        self._guesses.extend(guesses)
        self._guess = noise.median_noise(self._guesses)
        sizes = [group_size(d, guess, size) for d, guess in zip(new, guesses, strict=True)]
        coarse = group_steps(new, sizes)
        coarse = [self._apply_correction(data) for data in coarse]
        self._waiting += zip(coarse, moving, strict=True)
        return sum(moving)

    def _bias_walk(self) -> float:
        return float(np.hypot(self.parameters.bias_walk_rad_s_sqrt_s, self.correction.walk))

    def _apply_correction(self, data: chain.EpochData) -> chain.EpochData:
        """Correct an epoch as measured."""
        if not np.array_equal(self.correction.gyro, np.eye(3)):
            data = with_gyro_matrix(data, self.correction.gyro, 0.0)
        return data if self.correction.lag_s == 0.0 else with_lag(data, self.correction.lag_s)

    @property
    def data(self) -> list[chain.EpochData]:
        """Data of all epochs, including the queued ones."""
        return [epoch.data for epoch in self.epochs] + [data for data, _ in self._waiting]

    def attach_waiting(self) -> None:
        """Attach the queued epochs at the present values."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self.attach([data for data, _ in waiting], [moving for _, moving in waiting])

    def copy_noise_guesses(self, other: Window) -> None:
        """Take first noise guesses and moments of the field from a window with more of the same
        data.
        """
        self._guesses, self._guess = other._guesses.copy(), other._guess
        self.graph.moments = other.graph.moments

    def attach(self, new: Sequence[chain.EpochData], moving: Sequence[bool]) -> None:
        """Attach epochs whose steps are grouped already; moving: whether they have motion."""
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
        """Keep the information of an epoch on the instrument before it leaves the window."""
        if not old.has_motion:
            return
        if old.instrument is None:  # all together: the others are needed soon
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
        """Linearise epochs at the present values; with `outlier_sigma`, weights follow their
        residuals.
        """
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
        """Direction of the field at rest: the one of the last rest unless it clearly differs.

        Otherwise differences by noise would look like information on the bias along the field.
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
        """Directions of these epochs at the present values."""
        graph, epochs = self.graph, [self.epochs[k] for k in which]
        if not epochs:
            return []
        z = Stack([e.factor for e in epochs], graph.c, graph.nodes).z
        return [
            chain.move_directions(e.u, e.quadratic, chain_step(own, calibrates=e.has_motion))
            for e, own in zip(epochs, z, strict=True)
        ]

    def relinearise(self, which: Sequence[int]) -> None:
        """Linearise epochs at the present values, with new noise levels and outlier weights."""
        epochs, p = [self.epochs[k] for k in which], self.parameters
        places = [
            LinearisationPlan(e.piece, u, noise.shrink_noise(e.residuals, self.usual, p))
            for e, u in zip(epochs, self._moved_directions(which), strict=True)
        ]
        self._replace(which, places, outlier_sigma=p.outlier_sigma)
        found = [e.residuals for e in self.epochs]
        found_noise = noise.pool_noise(
            found, self._guess, self.parameters, self._fitted_gyro_freedom()
        )
        self.usual = noise.with_gyro_floor(found_noise, _GYRO_LEAST * self._guess.gyro_rad_s)

    def _fitted_gyro_freedom(self) -> float:
        """Degrees of freedom of the gyro's residuals that its matrix and its walking bias used."""
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
        """Apply a correction to the epochs of the window, and to all later ones.

        The directions are turned back by the additional lag, so that they fit the fields as before.
        The residuals of a wrong gyro inflated the noise of the field, so that level starts again
        from its guess.
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
            back = so3.exp(-more_lag_s * row_rates(epoch.data))
            u = (back @ u[:, :, None])[:, :, 0]
            if epoch.a == graph.first:
                graph.rotate_first(back[0])
            elif epoch.data.measures_first:
                graph.nodes[epoch.a] = Node.at(graph.nodes[epoch.a].bias, u[0])
            graph.nodes[epoch.a + 1] = Node.at(graph.nodes[epoch.a + 1].bias, u[-1])
            data = epoch.data if lag_only else with_gyro_matrix(epoch.data, gyro, lag_s)
            data = with_lag(data, more_lag_s) if more_lag_s != 0.0 else data
            information = 1.0 / (walk**2 * float(np.sum(data.dt_s[1:])))
            piece = replace(epoch.piece, data=data, walk=information)
            used = epoch.used if lag_only else self.usual
            places.append(LinearisationPlan(piece, u, used, epoch.weights))
        self._replace(everyone, places)

    # -- moving the answer ------------------------------------------------------------------------

    @property
    def never_moved(self) -> bool:
        """Whether no step was possible yet: the answer is the starting point."""
        return not np.isfinite(self.step_sigmas)

    def epoch_contradicts(self, k: int) -> bool:
        """Whether epoch k contradicts the calibration; call it before the epoch is tracked."""
        limit = self.parameters.outlier_sigma
        return contradicts(self.epochs[k], self.graph.c, self._covariance, self.usual, limit)

    def restart_with_last(self, count: int) -> Window:
        """A window of the last `count` epochs; it keeps only noise and bias of what was before."""
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
        """Uncertainty of the lag by these epochs (None: all) and the folded ones; None if
        unobservable.
        """
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
        """Set the calibration to c, directions from the field alone, and noise to its first guess.

        The guess does not depend on c, so the costs reached from different starts can be compared.
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
        """The whole state. It is cheap: epochs, nodes and factors are replaced, never changed."""
        graph = self.graph
        return Snapshot(
            self._damping, graph.c, dict(graph.nodes), list(self.epochs), list(graph.factors)
        )

    def restore(self, kept: Snapshot) -> None:
        """Return to a snapshot of the same epochs."""
        self._damping = kept.damping
        self.graph.c, self.graph.nodes = kept.c, dict(kept.nodes)
        self.epochs, self.graph.factors = list(kept.epochs), list(kept.factors)

    def cost(self) -> float:
        """Negative log posterior of the window, up to a constant."""
        graph = self.graph
        rises = Stack([graph.prior, *graph.factors], graph.c, graph.nodes).cost_increases()
        return sum(e.cost for e in self.epochs) + float(rises.sum()) + graph.anchor_cost()

    def optimise(
        self, steps: int = _MAX_STEPS, enough: Callable[[Array], bool] | None = None
    ) -> float:
        """Levenberg-Marquardt over the whole window at fixed noise and weights; returns the cost.

        Stops at the iteration limit, if no damping lowers the cost, or if c is `enough`; the window
        is then at the best point found. A last step that is short and straight is taken without
        linearising again: its cost is the predicted one. Never raises on hopeless data.
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
        """Gain of an undamped step if it is short and straight enough to predict it, else None."""
        graph = self.graph
        dc, information = graph.predict_step()
        if not sigmas(dc, information) < _SHORT:
            return None
        curvatures = path_curvatures(self.epochs, graph.c + dc, graph.moments, information)
        return 0.5 * float(dc @ information @ dc) if curvatures.max() < _STRAIGHT else None

    def _cost_after_relinearising(self) -> float:
        """Cost after a step, with everything linearised there; infinite if M is not positive
        definite.
        """
        if np.linalg.eigvalsh(chain.symmetric(self.graph.c[:6]))[0] <= 0:
            return float(np.inf)
        # the others do not depend on c
        which = [k for k, e in enumerate(self.epochs) if e.has_motion]
        epochs = [self.epochs[k] for k in which]
        places = zip(epochs, self._moved_directions(which), strict=True)
        self._replace(which, [LinearisationPlan(e.piece, u, e.used, e.weights) for e, u in places])
        return self.cost()

    def track(
        self, new: int = 1, *, everything: bool = False, exactly: bool = False, here: bool = False
    ) -> None:
        """Follow the newest epochs; with `everything`, all are linearised again first.

        here: all epochs were just linearised, at directions from the field alone.

        Stops when another linearisation would hardly move the answer, judged by the curvature of
        the step or, with `exactly`, by the step of another pass over all epochs.
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
        """Move the directions to the optimum of the chains at the present calibration.

        Directions from the field alone are so noisy that a step of the calibration from there goes
        astray.
        """
        try:
            _, dy = self.graph.step(_DAMPING_HELD)
        except SingularError:
            return
        self.graph.move(np.zeros(9), dy)

    def _optimise_within_work(self) -> bool:
        """Take a large step by `optimise`, as far as the allowed work goes; whether to go on
        iterating.

        The next epoch continues from the result.
        """
        n = max(1, sum(e.has_motion for e in self.epochs))
        steps = min(_MAX_STEPS, self._work // n - 1)
        if steps < 1:
            return False
        self.optimise(steps)
        return self._work >= 2 * n

    def _weigh_prior(self) -> Array:
        """Set the weight of the prior and the held directions; returns the tempered information (9,
        9) of c.

        The prior keeps its weight relative to data that disagree among themselves.
        """
        graph, factors, scores = (
            self.graph,
            [e.factor for e in self.epochs],
            epoch_scores(self.epochs),
        )
        graph.temper, graph.hold = 1.0, np.zeros((9, 9))
        self.found_misfit, chance = self.misfit.value(factors, scores, graph, graph.step())
        # below, it could only widen the sigmas
        significant = self.found_misfit > 1.0 + _CHANCE * chance
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
        """Factor by which errors that repeat with the attitude reduce the information."""
        cells = sum((e.cells for e in self.epochs if e.has_motion), self._folded_cells)
        noise = self.usual.mag_gauss, self._guess.mag_gauss
        return variance_inflation(cells, *noise, smooth=smooth)

    @property
    def residual_ratio(self) -> float:
        """Mean square residual over that of noise; 1 if there is no more than chance."""
        return max(self._excess_misfit, self._attitude_inflation())

    @property
    def gyro_freedom(self) -> float:
        """Degrees of freedom of the gyro's residuals."""
        return sum(epoch.residuals.gyro_freedom for epoch in self.epochs)

    @property
    def has_unmodelled_residual(self) -> bool:
        """Whether the residuals exceed noise, or the gyro's noise level is suspiciously high."""
        high_gyro_noise = self.usual.gyro_rad_s > _HIGH_GYRO_NOISE * self._guess.gyro_rad_s
        return high_gyro_noise or self.residual_ratio > 1.0

    def slow_residual(self) -> noise.SlowResidual | None:
        """Slow part of the residual, from the epochs in the window."""
        return noise.slow_residual(self.graph.c, [(e.data, e.has_motion) for e in self.epochs])

    def covariance(self) -> Array:
        """Covariance (12, 12) of c and the newest gyro bias, including all misfit.

        Disagreement among epochs does not average out (`noise.covariance_with_common_errors`).

        Errors that repeat with the attitude are taken to be smooth in it, like the gradient of a
        room. The weights inside the estimate do not assume this, which follows the data more
        closely.
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
        return noise.covariance_with_common_errors(
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
# Which epochs to linearise again after the calibration moved away from their linearisation points.
#
# The factor of an epoch is exact to second order, so a straight move costs nothing, however long.
# What counts is the curvature of the path to the present calibration (`graph.retract`), in sigmas:
# linearising again moves the answer by about that. An epoch at rest has no information on the
# calibration. There the gyro bias counts: at another bias the directions drift, which looks like
# noise of the field.

_LEAST_CURVATURE = 0.02  # sigmas
# relative change of the gyro's noise level since the linearisation
_NOISE_CHANGE, _NOISE_CHANGE_EXACT = 0.1, 0.04

_LEAST_DRIFT = 0.3  # of the field's noise: drift at rest by a changed bias


def path_curvatures(
    epochs: Sequence[WindowEpoch], c: Array, moments: Moments, information: Array
) -> Array:
    """Curvature of the path to c from each linearisation point, in sigmas (E,); 0 at rest.

    Infinite if the valley does not reach c: then the curvature is unknown.
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
    """Drift (E,) of the directions over an epoch at rest by the change of the gyro bias since its
    linearisation.

    In units of the field's noise; 0 for epochs with motion.
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
    """Epochs that are too far from their linearisation point or assumed another gyro noise than
    `usual`.
    """
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
# The likelihood has several optima when motion is poor. So from time to time several starts descend
# on a part of the window: the epochs whose field varied most, joined to one chain with cuts. Of an
# epoch of single steps every k-th field is used, with the rotations between them composed exactly.
# The starts are the device's present calibration, a linear fit, a sphere, and the present answer.
# The lowest cost wins. It counts as sure only if two independent starts arrive there.

_SEARCH_EPOCHS = 6
_SEARCH_ROWS = 128  # rows per epoch, at most twice that
_DESCENT_STEPS = 8  # Levenberg-Marquardt steps per start
_DESCENT_ROUNDS = 4  # rounds in which starts that do not agree go on
_RIVAL_NATS = 8.0  # nats by which any other optimum must be less likely
_NEAR_SIGMAS = 0.1  # from the best so far, at which a descent stops
_SAME_SIGMAS = 1.0  # within which two answers agree
_HIGH_RESIDUAL_RATIO = 2.0  # residual variance over that of the fields' differences


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Best calibration c (9,) and gyro bias (3,).

    away: sigmas between it and the present answer
    gain: in log likelihood over the end of a descent from the present answer
    apart: sigmas from it within which two independent starts ended
    search_residual_ratio: residual variance of the best over that of the fields' differences, for
        the thinned data; 1 if the model explains the data
    """

    c: Array
    bias: Array
    away: float
    gain: float
    apart: float
    search_residual_ratio: float

    @property
    def agreed(self) -> bool:
        """Whether two independent starts arrived at the best."""
        return self.apart < _SAME_SIGMAS


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """State of a descent.

    independent: whether its start does not depend on the other descents; gain: of log likelihood in
    the last steps; mirrored: whether it began at a mirror image; kept: state from which it can go
    on.
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
        """Residual variance ratio if it exceeds chance, else 1."""
        return (
            self.search_residual_ratio if self.search_residual_ratio > _HIGH_RESIDUAL_RATIO else 1.0
        )


def search(
    parameters: EstimatorParameters,
    window: Window,
    present_bias: Array,
    data: Sequence[chain.EpochData],
) -> SearchResult:
    """Descend from every start on a thinned copy of `data`; `window` is not changed."""
    graph = window.graph
    present, information = graph.anchor
    belief = np.asarray(np.linalg.inv(information), dtype=np.float64)
    chosen = sorted(
        sorted(range(len(data)), key=lambda k: -principal_deviation(data[k].field_b_gauss))[
            :_SEARCH_EPOCHS
        ]
    )
    first = Node.at(present_bias, np.array([1.0, 0.0, 0.0]))
    thin = Window(parameters, present, belief, first, window.usual)
    thin.copy_noise_guesses(window)
    thin.graph.temper = graph.temper
    if window.search_residual_ratio > 1.0:
        thin.graph.hold = graph.hold
    thin.attach(
        [join_epochs([thin_rows(data[k], max(1, len(data[k]) // _SEARCH_ROWS)) for k in chosen])],
        [True],
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
    """Sigmas from the best to the second independent descent, or to another optimum that is nearly
    as likely.
    """
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
    """Continue the descents that have not arrived at an optimum or the best; one that ended
    elsewhere starts again from the mirror image behind the plane of the fields.

    Turns about one axis look nearly the same from both sides of the plane that they span.
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
                thin, chain.mirror_hard_iron(one.c, fields), bias, best, independent=one.independent
            )
            out[k] = replace(one, independent=False, mirrored=True)  # it ended there
            out.append(replace(mirrored, mirrored=True))
    return out


def _is_positive_definite(c: Array) -> bool:
    return bool(np.linalg.eigvalsh(chain.symmetric(c[:6]))[0] > 0.0)


def _descend(
    thin: Window, c: Array, bias: Array, best: _Descent | None, *, independent: bool = True
) -> _Descent:
    """Descend from c until it clearly leads to the best so far."""
    thin.restart_at(c, bias)

    def near(at: Array) -> bool:
        return (
            best is not None and _valley_distance(at, best, thin.graph.moments, 1.0) < _NEAR_SIGMAS
        )

    return _record_descent(
        thin, thin.optimise(_DESCENT_STEPS, near), np.inf, independent=independent
    )


def _continue_descent(thin: Window, before: _Descent) -> _Descent:
    """Continue a descent."""
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
    """Sigmas of the best, along the valley: straight across a bend the distance looks large."""
    if best.information is None:
        return float(np.inf)
    return sigmas(valley_step(best.c, c, moments), best.information / temper)
