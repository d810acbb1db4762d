"""MAGICAL ([R]), MAGYC ([M]) and MagFactor3: the methods that solve a factor graph on GTSAM.

MAGICAL's four are linear and nonlinear least squares, batch and incremental graph; MAGYC's two have
the same residual with C = L L^T of unit volume by construction. They find soft iron, hard iron and,
but for MAGICAL-LS, the gyro bias from the magnetometer and the gyroscope.

A field fixed in the world turns against the sensor: h' = -w x h. With h = C m - b', b' = C b,

    r = [w - w_b]x (C m - b') + C m'        ([R], [M])
    dr/dc = [w - w_b]x S(m) + S(m'),   dr/db' = -[w - w_b]x,   dr/dw_b = [C m - b']x

S(v) c = symmetric(c) v. Checked numerically in tests/baselines/test_methods_jacobians.py.

Field, rate and the field's derivative are found segment by segment. "median" is the seeds' way:
first differences (m_k - m_(k-1)) / dt_k beside m_k and w_k; over a window of theta samples the
median of each. The difference belongs to the middle of the step and m_k to its end: half a sample
apart, as published. "savgol" smooths readings and rates with a Savitzky-Golay filter of order 2
(the authors' notebooks do so), then takes difference, mid-step field and rate, which all belong to
the middle of the step; per window their mean.

A CustomFactor with a Jacobian of the wrong shape kills the process in GTSAM, a vector in its place
is read from memory that nobody wrote, and a residual that is not a number ends the optimiser
without a word. So `custom_factor` checks shapes and values before every return.

Batch: all windows in one vectorised factor, which is the same sum as one factor each, by dogleg.
Incremental: a factor of every Gamma windows as they come, into iSAM2 with dogleg (RISE); the answer
is the mean of the last fifth of the estimates. With one set of variables each update of iSAM2
evaluates every factor again, so the whole is quadratic in time, as published.

MagFactor3 is GTSAM's magnetometer factor, m = alpha R_bw M + b, attitude R_bw and field M known.
One uniform scale alpha and b; soft iron proper is not in the model. One vectorised factor

    r_k = alpha R_bw M + b - m_k,   dr/dalpha = R_bw M,   dr/db = I

A soft iron is written in numbers in three ways, each with its derivative; all give C = A^-1 as
c = [00 01 02 11 12 22]:

    unit volume   6 terms of A, rescaled A (l0 l1 l2)^(-1/3) each time  ([R] appendix A)
    triangle      the 6 terms of C themselves                           (magical-bfg, -ifg)
    Cholesky      C = L L^T, L = [[e^p0 0 0] [p1 e^p2 0] [p3 p4 e^-(p0+p2)]]: positive definite
                  and of det 1 whatever p is                            ([M], magyc-bfg, -ifg)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from ahrsd import so3
from ahrsd.baselines.data import (
    MethodData,
    MethodError,
    MethodFit,
    MethodSettings,
    answer,
    rescaled,
)
from ahrsd.estimator.chain import symmetric, symmetric_columns, upper_triangle
from ahrsd.samples import Array

# -- Three ways to write a soft iron ---------------------------------------------------------------


def _symmetric_basis() -> Array:
    return np.stack([symmetric(row) for row in np.eye(6)])


BASIS = _symmetric_basis()  # (6, 3, 3): E_j = d(symmetric(x)) / d x_j


def positive(a6: Array) -> bool:
    """Whether symmetric(a6) is positive definite."""
    return bool(np.isfinite(a6).all() and np.linalg.eigvalsh(symmetric(a6))[0] > 0)


def unit_volume(a6: Array) -> tuple[Array, Array]:
    """c (6,) of A = symmetric(a6) rescaled to det 1, and dc/da6 (6, 6), singular along A.

    With s = det^(-1/3):  C = A^-1 / s,  dC = -C dA C s + C tr(A^-1 dA) / 3.
    MethodError where A is not positive definite.
    """
    A = symmetric(a6)
    if not positive(a6):
        raise MethodError("diverged: the soft iron is no longer positive definite")
    s = float(np.linalg.det(A)) ** (-1 / 3)
    inverse = np.linalg.inv(A)
    C = inverse / s
    J = np.empty((6, 6))
    for j, E in enumerate(BASIS):
        J[:, j] = upper_triangle(-C @ E @ C * s + C * np.trace(inverse @ E) / 3)
    return upper_triangle(C), J


def triangle(c6: Array) -> tuple[Array, Array]:
    """c itself and the identity."""
    return c6.copy(), np.eye(6)


def cholesky(p: Array) -> tuple[Array, Array]:
    """c (6,) of C = L L^T and dc/dp (6, 5):  dC = dL L^T + L dL^T."""
    with np.errstate(over="ignore"):  # infinite where a search diverges; the factor says so
        x, y, z = np.exp(p[0]), np.exp(p[2]), np.exp(-(p[0] + p[2]))
    L = np.array([[x, 0, 0], [p[1], y, 0], [p[3], p[4], z]])
    dL = np.zeros((5, 3, 3))
    dL[0, 0, 0], dL[0, 2, 2] = x, -z
    dL[1, 1, 0] = 1.0
    dL[2, 1, 1], dL[2, 2, 2] = y, -z
    dL[3, 2, 0] = 1.0
    dL[4, 2, 1] = 1.0
    J = np.stack([upper_triangle(d @ L.T + L @ d.T) for d in dL], axis=1)
    return upper_triangle(L @ L.T), J


# -- The methods -----------------------------------------------------------------------------------


# -- The kinematic residual ------------------------------------------------------------------------


MINIMUM_WINDOWS = 12  # three equations each, twelve unknowns, and something left to judge by


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """Rows of field (n, 3) gauss, its derivative in the body (n, 3) gauss/s, rate (n, 3) rad/s."""

    field: Array
    derivative: Array
    rate: Array

    def __len__(self) -> int:
        return len(self.field)

    def __getitem__(self, rows: slice) -> Kinematics:
        return Kinematics(self.field[rows], self.derivative[rows], self.rate[rows])


def _join(parts: list[Kinematics]) -> Kinematics:
    return Kinematics(
        np.vstack([p.field for p in parts]),
        np.vstack([p.derivative for p in parts]),
        np.vstack([p.rate for p in parts]),
    )


def _segment(data: MethodData, rows: slice, settings: MethodSettings) -> Kinematics | None:
    m, w, dt = data.raw_b_gauss[rows], data.gyro_b_rad_s[rows], data.dt_s[rows][1:, None]
    if settings.derivative == "savgol":
        from scipy.signal import savgol_filter  # a second that most commands need not wait

        length = settings.savgol_window
        if len(m) < length:
            return None
        m, w = savgol_filter(m, length, 2, axis=0), savgol_filter(w, length, 2, axis=0)
        return Kinematics((m[1:] + m[:-1]) / 2, np.diff(m, axis=0) / dt, w[1:])
    if len(m) < 2:
        return None
    return Kinematics(m[1:], np.diff(m, axis=0) / dt, w[1:])


def _segments(data: MethodData, settings: MethodSettings) -> list[Kinematics]:
    found = [_segment(data, rows, settings) for rows in data.segments()]
    return [part for part in found if part is not None]


def per_sample(data: MethodData, settings: MethodSettings) -> Kinematics:
    """One row a step.  MethodError where no segment is long enough."""
    parts = _segments(data, settings)
    if sum(len(part) for part in parts) < MINIMUM_WINDOWS:
        raise MethodError("no stretch without a gap is long enough to differentiate the field")
    return _join(parts)


def windowed(data: MethodData, settings: MethodSettings) -> Kinematics:
    """One row a window of `settings.window` steps; what is left of a segment is not used."""
    average = np.median if settings.derivative == "median" else np.mean
    theta = settings.window
    parts = []
    for part in _segments(data, settings):
        whole = len(part) // theta * theta
        if whole:
            shape = (-1, theta, 3)
            parts.append(
                Kinematics(
                    *(
                        np.asarray(average(values[:whole].reshape(shape), axis=1))
                        for values in (part.field, part.derivative, part.rate)
                    )
                )
            )
    count = sum(len(part) for part in parts)
    if count < MINIMUM_WINDOWS:
        raise MethodError(
            f"{count} whole windows of {theta} samples without a gap: "
            f"at least {MINIMUM_WINDOWS} are needed"
        )
    return _join(parts)


Shape = Callable[[Array], tuple[Array, Array]]


def residual(kin: Kinematics, c6: Array, pseudo: Array, bias: Array) -> tuple[Array, Array]:
    """r (3n,) in gauss/s and its derivative (3n, 12) by [c (6), b' (3), w_b (3)]."""
    K = so3.skew(kin.rate - bias)
    C = symmetric(c6)
    h = kin.field @ C - pseudo
    r = np.einsum("nij,nj->ni", K, h) + kin.derivative @ C
    J = np.empty((len(kin), 3, 12))
    J[:, :, :6] = K @ symmetric_columns(kin.field) + symmetric_columns(kin.derivative)
    J[:, :, 6:9] = -K
    J[:, :, 9:] = so3.skew(h)
    return r.ravel(), J.reshape(-1, 12)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Numbers x = [p of the soft iron, b' (3), w_b (3)] and how p becomes C.

    nodes: lengths of the graph's variables, which together are x
    norm:  whether a factor |C|_F - 1 fixes the scale
    """

    shape: Shape
    start: Array
    nodes: tuple[int, ...]
    norm: bool

    def residual(self, kin: Kinematics, x: Array) -> tuple[Array, Array]:
        """r (3n,) and dr/dx (3n, len(x))."""
        c6, J6 = self.shape(x[:-6])
        r, J = residual(kin, c6, x[-6:-3], x[-3:])
        return r, np.hstack([J[:, :6] @ J6, J[:, 6:]])

    def norm_residual(self, x: Array) -> tuple[Array, Array]:
        """|C|_F - 1 (1,) and its derivative (1, len(x))."""
        c6, J6 = self.shape(x[:-6])
        twice = c6 * _COUNTED
        size = float(np.sqrt(c6 @ twice))
        J = np.zeros((1, len(x)))
        J[0, :-6] = twice @ J6 / size
        return np.array([size - 1.0]), J

    def fit(self, x: Array, iterations: int, note: str = "") -> MethodFit:
        """The answer at x.  MethodError where it is not one."""
        A, b = answer(self.shape(x[:-6])[0], x[-6:-3])
        return MethodFit(A, b, x[-3:].copy(), iterations, note)


_COUNTED = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])  # how often each term stands in the matrix


# -- Factor graphs on GTSAM ------------------------------------------------------------------------


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


# -- MAGICAL-LS ------------------------------------------------------------------------------------
#
# MAGICAL-LS: iterative least squares for soft and hard iron, gyro bias known ([R]).
#
#     minimise sum |[w]x (C m - b') + C m'|^2
#
# over the six terms of the symmetric A (C = A^-1) and b', by Gauss-Newton from A = I and b' = 0; A
# is rescaled to unit volume after each step, A (l0 l1 l2)^(-1/3). The sum alone is least at C = 0,
# so a step is the shortest that solves the linear problem: none along A itself, where nothing
# changes.
#
# With the bias known the residual is Phi [c, b'], linear, and Phi = Q R: all steps need is R (9,
# 9). They are many where the derivative is noise, because the residual that stays is large.


_LS_MAX_STEPS = 20_000
_LS_MAX_HALVINGS = 30
_LS_TOLERANCE = 1e-7  # of a step, in units of A and gauss


def estimate_magical_ls(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A and b; the note says which gyro bias was taken as known."""
    known = settings.known_gyro_bias_rad_s
    _, phi = residual(per_sample(data, settings), np.zeros(6), np.zeros(3), known)
    R = np.asarray(np.linalg.qr(phi[:, :9]).R)
    x = np.concatenate([upper_triangle(np.eye(3)), np.zeros(3)])
    for count in range(1, _LS_MAX_STEPS + 1):
        r, J = _rows(R, x)
        # rcond drops the direction along A, whose singular value is rounding only
        step = np.asarray(np.linalg.lstsq(J, -r, rcond=1e-10)[0])
        x, moved = _taken(R, x, step, float(r @ r))
        if moved < _LS_TOLERANCE:
            A, b = answer(unit_volume(x[:6])[0], x[6:])
            note = "gyro bias taken as given" if np.any(known) else "gyro bias taken as zero"
            return MethodFit(A, b, None, count, note)
    raise MethodError(f"no end after {_LS_MAX_STEPS} steps")


def _rows(R: Array, x: Array) -> tuple[Array, Array]:
    """Residual (9,) of x = [A (6), b' (3)] and its derivative (9, 9)."""
    c6, J6 = unit_volume(x[:6])
    return R @ np.concatenate([c6, x[6:]]), np.hstack([R[:, :6] @ J6, R[:, 6:]])


def _taken(R: Array, x: Array, step: Array, cost: float) -> tuple[Array, float]:
    """x after the longest halving of the step that does not raise the cost, and how far it went."""
    for halving in range(_LS_MAX_HALVINGS):
        part = step / 2**halving
        new = x + part
        if positive(new[:6]):
            new[:6] = upper_triangle(rescaled(symmetric(new[:6])))
            r, _ = _rows(R, new)
            if r @ r <= cost:
                return new, float(np.linalg.norm(part))
    return x, 0.0


# -- MAGICAL-NLS -----------------------------------------------------------------------------------
#
# MAGICAL-NLS: nonlinear least squares for soft iron, hard iron and gyro bias.
#
#     minimise sum |[w - w_b]x (C m - b') + C m'|^2
#
# over 12 unknowns, the terms of A (C = A^-1, rescaled to unit volume each time), b' and w_b. Start
# A = I, b' = 0, w_b = 0; trust region reflective, tolerance 1e-6.


NLS_TOLERANCE = 1e-6
_NLS_MAX_EVALUATIONS = 1000


def unit_volume_model() -> Model:
    """Terms of A, b' and w_b in one node."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(unit_volume, start, (12,), norm=False)


def estimate_magical_nls(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError where the search diverges or does not end."""
    from scipy.optimize import least_squares  # dear to import, and only this method needs it

    kin, m = per_sample(data, settings), unit_volume_model()
    # the solver asks for the two at the same point one after the other
    kept: dict[bytes, tuple[Array, Array]] = {}
    # trf shrinks its region where a step leads to what is not finite
    outside = np.full(3 * len(kin), np.nan), np.full((3 * len(kin), 12), np.nan)

    def both(x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in kept:
            kept.clear()
            kept[key] = m.residual(kin, x) if positive(x[:6]) else outside
        return kept[key]

    def value(x: Array) -> Array:
        return both(x)[0]

    def derivative(x: Array) -> Array:
        return both(x)[1]

    found = least_squares(
        value,
        m.start,
        jac=derivative,
        method="trf",
        ftol=NLS_TOLERANCE,
        xtol=NLS_TOLERANCE,
        gtol=NLS_TOLERANCE,
        max_nfev=_NLS_MAX_EVALUATIONS,
    )
    if not found.success:
        raise MethodError(f"no end after {found.nfev} evaluations")
    return m.fit(np.asarray(found.x), int(found.nfev))


# -- MAGICAL-BFG -----------------------------------------------------------------------------------
#
# MAGICAL-BFG: batch factor graph ([R]).
#
# One node x = (C's upper triangle, b', w_b). Per averaged window of theta samples one residual
# factor
#
#     [w - w_b]x (C m - b') + C m'
#
# and one norm factor |C|_F - 1 that keeps C from vanishing; relative and absolute tolerance 1e-7. A
# = C^-1 is rescaled to unit volume and b = A b' at the end.


def triangle_model() -> Model:
    """C's triangle, b' and w_b in one node, with the norm factor; start C = I."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(triangle, start, (12,), norm=True)


def estimate_magical_bfg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `batch`."""
    return batch(triangle_model(), windowed(data, settings))


# -- MAGICAL-IFG -----------------------------------------------------------------------------------
#
# MAGICAL-IFG: incremental factor graph ([R]).
#
# MAGICAL-BFG's factors as they arrive, averaged over a window of theta samples, optimised every
# Gamma factors (iSAM2 with dogleg); the answer is the mean of the last 20 % of the estimates.
#
# The seed's figures come out only where iSAM2 never linearises again, which is the default here:
# the derivative by the gyro bias, [C m - b']x, then stays that of C = I while the norm factor takes
# |C|_F from sqrt 3 to 1, and the gyro bias comes out at about half of the truth, as in [R] Table
# 5.1. `MethodSettings.relinearize` mends it.


NEVER = 0.0


def estimate_magical_ifg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `incremental`."""
    threshold = NEVER if settings.relinearize is None else settings.relinearize
    return incremental(triangle_model(), windowed(data, settings), settings, threshold)


# -- MAGYC-BFG -------------------------------------------------------------------------------------
#
# MAGYC-BFG: batch factor graph with C = L L^T of unit volume by construction ([M]).
#
# Three nodes: the five numbers of L (e^p0, p1, e^p2, p3, p4 and e^-(p0 + p2) last), b' and w_b. Per
# window one residual factor [w - w_b]x (C m - b') + C m'; no norm factor. Dogleg, tolerance 1e-7.


def cholesky_model() -> Model:
    """L's numbers, b' and w_b as three nodes; start C = I."""
    return Model(cholesky, np.zeros(11), (5, 3, 3), norm=False)


def estimate_magyc_bfg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `batch`."""
    return batch(cholesky_model(), windowed(data, settings))


# -- MAGYC-IFG -------------------------------------------------------------------------------------
#
# MAGYC-IFG: MAGYC-BFG's factors as they arrive ([M]).
#
# A factor per window of theta samples, iSAM2 with dogleg every Gamma factors, the answer the mean
# of the last 20 % of the estimates. iSAM2 keeps GTSAM's threshold of 0.1 for linearising again, as
# the seed does: a gyro bias in rad/s never crosses it, and moves in the linear part only.


GTSAM_THRESHOLD = 0.1


def estimate_magyc_ifg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `incremental`."""
    threshold = GTSAM_THRESHOLD if settings.relinearize is None else settings.relinearize
    return incremental(cholesky_model(), windowed(data, settings), settings, threshold)


# -- MagFactor3 ------------------------------------------------------------------------------------


MAGFACTOR3_NODES = (1, 3)
_MAGFACTOR3_SIGMA_GAUSS = 1e-3
_MAGFACTOR3_MAX_ITERATIONS = 100


def magfactor3_residual(x: Array, body: Array, raw: Array) -> tuple[Array, Array]:
    """r (3N,) and its derivative (3N, 4) by [alpha, b]; body (N, 3) is R_bw M."""
    r = x[0] * body + x[1:] - raw
    J = np.empty((len(raw), 3, 4))
    J[:, :, 0] = body
    J[:, :, 1:] = np.eye(3)
    return r.ravel(), J.reshape(-1, 4)


def estimate_magfactor3(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A = alpha I and b.  MethodError where attitude or field are missing, or alpha <= 0."""
    del settings
    if data.R_nb is None or data.field_n_gauss is None:
        raise MethodError("needs the attitude of every sample and the local field")
    body = np.einsum("nji,j->ni", data.R_nb, data.field_n_gauss)
    if body.shape != data.raw_b_gauss.shape or not np.isfinite(body).all():
        raise MethodError("attitude or field are not finite, or not one per sample")
    graph = gtsam.NonlinearFactorGraph()
    rows = body.size
    graph.add(
        custom_factor(
            lambda x: magfactor3_residual(x, body, data.raw_b_gauss),
            rows,
            MAGFACTOR3_NODES,
            _MAGFACTOR3_SIGMA_GAUSS,
        )
    )
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAGFACTOR3_MAX_ITERATIONS)
    start = values_of(np.array([1.0, 0.0, 0.0, 0.0]), MAGFACTOR3_NODES)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    x = vector_of(optimizer.optimize(), len(MAGFACTOR3_NODES))
    if not x[0] > 0:
        raise MethodError(f"the scale that fits best is {x[0]:.3g}: attitude or field are wrong")
    return MethodFit(float(x[0]) * np.eye(3), x[1:], None, int(optimizer.iterations()))
