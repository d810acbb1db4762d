"""Factor graphs on GTSAM: residuals as factors, and the two ways to optimise of MAGICAL and MAGYC.

A CustomFactor with a Jacobian of the wrong shape kills the process in GTSAM, a vector in its place
is read from memory that nobody wrote, and a residual that is not a number ends the optimiser
without a word. So `custom_factor` checks shapes and values before every return.

Batch: all windows in one vectorised factor, which is the same sum as one factor each, by dogleg.
Incremental: a factor of every Gamma windows as they come, into iSAM2 with dogleg (RISE); the answer
is the mean of the last fifth of the estimates. With one set of variables each update of iSAM2
evaluates every factor again, so the whole is quadratic in time, as published.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import gtsam
import numpy as np

from ahrsd.baselines.data import MethodError, MethodFit, MethodSettings
from ahrsd.baselines.kinematic import Kinematics, Model
from ahrsd.samples import Array

Residual = Callable[[Array], tuple[Array, Array]]
"""x, the variables one after the other -> residual (rows,) and its derivative (rows, len(x))."""


def variable(i: int) -> int:
    """Key of a graph's i-th variable."""
    return int(gtsam.symbol("x", i))


def split(x: Array, lengths: Sequence[int]) -> list[Array]:
    """The variables that x consists of."""
    edges = np.cumsum([0, *lengths])
    return [x[a:b] for a, b in pairwise(edges)]


def values_of(x: Array, lengths: Sequence[int]) -> gtsam.Values:
    """x as GTSAM's values."""
    values = gtsam.Values()
    for i, part in enumerate(split(x, lengths)):
        values.insert(variable(i), part)
    return values


def vector_of(values: gtsam.Values, count: int) -> Array:
    """x of the first `count` variables."""
    return np.concatenate([values.atVector(variable(i)) for i in range(count)])


def custom_factor(
    residual: Residual, rows: int, lengths: Sequence[int], sigma: float
) -> gtsam.CustomFactor:
    """A factor of `rows` rows on all the variables, each row with the same sigma.

    MethodError, out of whatever optimises, where the residual is not finite.
    """
    edges = np.cumsum([0, *lengths])

    def evaluate(
        _: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None
    ) -> Array:
        r, J = residual(vector_of(values, len(lengths)))
        if r.shape != (rows,) or J.shape != (rows, int(edges[-1])):
            raise MethodError(f"a factor of {rows} rows returned {r.shape} and {J.shape}")
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            raise MethodError("diverged: a residual is not finite")
        if H is not None:
            for i, (a, b) in enumerate(pairwise(edges)):
                H[i] = np.asfortranarray(J[:, a:b])
        return r

    noise = gtsam.noiseModel.Isotropic.Sigma(rows, sigma)
    return gtsam.CustomFactor(noise, [variable(i) for i in range(len(lengths))], evaluate)


SIGMA = 1e-6  # the seeds', of every row
TOLERANCE = 1e-7
_MAX_ITERATIONS = 1000
_FIRST_RADIUS = 0.5
_AVERAGED = 0.2  # part of the estimates, from the end


def factors(model: Model, kin: Kinematics) -> list[gtsam.CustomFactor]:
    """The residual factor of these windows, and their norm factors as one."""
    found = [custom_factor(lambda x: model.residual(kin, x), 3 * len(kin), model.nodes, SIGMA)]
    if model.norm:
        each = SIGMA / float(np.sqrt(len(kin)))  # n equal factors are one of n times the weight
        found.append(custom_factor(model.norm_residual, 1, model.nodes, each))
    return found


def batch(model: Model, kin: Kinematics) -> MethodFit:
    """All windows at once.  MethodError where it is singular, diverges or does not end."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors(model, kin):
        graph.add(factor)
    parameters = gtsam.DoglegParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(TOLERANCE)
    parameters.setMaxIterations(_MAX_ITERATIONS)
    parameters.setDeltaInitial(_FIRST_RADIUS)
    try:
        optimizer = gtsam.DoglegOptimizer(graph, values_of(model.start, model.nodes), parameters)
        found = optimizer.optimize()
    except RuntimeError as error:
        raise _singular(error) from error
    if optimizer.iterations() >= _MAX_ITERATIONS:
        raise MethodError(f"no end after {_MAX_ITERATIONS} iterations")
    return model.fit(vector_of(found, len(model.nodes)), int(optimizer.iterations()))


def incremental(
    model: Model, kin: Kinematics, settings: MethodSettings, threshold: float
) -> MethodFit:
    """Window after window; `threshold` of iSAM2's relinearisation, 0 for never.

    MethodError where an update is singular, or the data do not fill one update.
    """
    isam = gtsam.ISAM2(_isam_parameters(threshold))
    every = settings.update_every
    history: list[Array] = []
    for end in range(every, len(kin) + 1, every):
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors(model, kin[end - every : end]):
            graph.add(factor)
        initial = values_of(model.start, model.nodes) if not history else gtsam.Values()
        try:
            isam.update(graph, initial)
            current = isam.calculateEstimate()
        except RuntimeError as error:
            raise _singular(error) from error
        history.append(np.concatenate([current.atVector(variable(i)) for i in _nodes(model)]))
    if not history:
        raise MethodError(f"{len(kin)} windows: the first update needs {every}")
    return _mean(model, history)


def _nodes(model: Model) -> range:
    return range(len(model.nodes))


def _isam_parameters(threshold: float) -> gtsam.ISAM2Params:
    dogleg = gtsam.ISAM2DoglegParams()
    dogleg.setInitialDelta(_FIRST_RADIUS)
    dogleg.setAdaptationMode("ONE_STEP_PER_ITERATION")
    parameters = gtsam.ISAM2Params()
    parameters.setOptimizationParams(dogleg)
    parameters.enableRelinearization = threshold > 0
    if threshold > 0:
        parameters.setRelinearizeThreshold(threshold)
    return parameters


def _mean(model: Model, history: list[Array]) -> MethodFit:
    last = max(1, int(_AVERAGED * len(history)))
    fits = [model.fit(x, len(history)) for x in history[-last:]]
    A = np.mean([fit.soft_iron for fit in fits if fit.soft_iron is not None], axis=0)
    b = np.mean([fit.hard_iron_gauss for fit in fits], axis=0)
    bias = np.mean([x[-3:] for x in history[-last:]], axis=0)
    return MethodFit(
        A, b, bias, len(history), f"mean of the last {last} of {len(history)} estimates"
    )


def _singular(error: RuntimeError) -> MethodError:
    first = str(error).strip().split("\n", maxsplit=1)[0]
    return MethodError(f"the motion does not determine the answer (GTSAM: {first})")
