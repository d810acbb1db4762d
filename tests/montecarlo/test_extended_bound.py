"""The bound with imperfections of instrument and place, compared with independent code: a dense
Fisher matrix from differences of the physical readings, and the scatter of estimates.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from ahrsd.estimator.parameters import AS_SPECIFIED, ASSEMBLED, ORDINARY
from ahrsd.montecarlo import nuisances
from ahrsd.montecarlo.cramer_rao import Trajectory, cramer_rao
from ahrsd.simulation import Iron, ScenarioSettings, simulate
from ahrsd.simulation.scenarios import measured

SM, SG, DT = 1e-3, 5e-3, 0.04
UPPER = np.triu_indices(3)
KNOT_S = 0.8  # of a trajectory of two seconds
AROUND = replace(ORDINARY, knot_s=KNOT_S)


def turning(samples=50):
    """Turns by 0.2 rad per sample, so that little time determines everything."""
    t = np.arange(samples) * DT
    rate = np.column_stack([4 * np.cos(1.1 * t), 3 * np.sin(1.7 * t), 2 + 3 * np.cos(0.7 * t)])
    R = [Rotation.from_rotvec([0.3, -0.2, 0.5])]
    for w in rate[1:]:
        R.append(R[-1] * Rotation.from_rotvec(w * DT))
    rate[0] = np.nan
    rng = np.random.default_rng(0)
    matrices = np.array([r.as_matrix() for r in R])
    return measured("turning", Iron(), matrices, rate, t, (SM, SG), (rng, rng))


class Readings:
    """Everything read, over its noise, from what is asked for, what is besides, and the motion.

    asked (12): M's upper triangle, b, w_b; besides, over their sigmas: turn (3), lag, scale,
    shape (5), drift of the bias (3) and of the iron (3), then values of place and noise at knots;
    motion: direction of the first field (2), rotation vector of every step (3 each).
    """

    def __init__(self, experiment, kind, around):
        self.kind, self.around = kind, around
        self.rate = experiment.rate_b_rad_s
        self.n = len(experiment)
        truth = experiment.truth
        self.size = truth.field_gauss
        self.first = experiment.field_b[0] / truth.field_gauss
        self.side = np.linalg.svd(self.first[None])[2][1:]
        self.M, self.b = truth.soft_iron * truth.field_gauss, truth.hard_iron_gauss
        self.bias, self.iron = truth.gyro_bias_rad_s, truth.soft_iron
        self.time = np.arange(self.n) * DT
        self.knots = np.arange(int(np.ceil(self.time[-1] / KNOT_S)) + 1) * KNOT_S
        self.besides = 16 + (6 * len(self.knots) if around else 0)
        self.unknowns = 12 + self.besides + 2 + 3 * (self.n - 1)

    def course(self, values):
        """Values (K, 3) at the knots, straight in between, of the mean square that is asked for."""
        return np.sqrt(1.5) * np.column_stack(
            [np.interp(self.time, self.knots, values[:, i]) for i in range(3)]
        )

    def __call__(self, x):
        asked, z, tail = np.split(x, [12, 12 + self.besides])
        M = self.M.copy()
        M[UPPER] += asked[:6]
        M.T[UPPER] = M[UPPER]
        b, bias = self.b + asked[6:9], self.bias + asked[9:12]
        k, share = self.kind, self.time / self.time[-1]
        u = self.first + tail[:2] @ self.side
        steps = self.rate[1:] * DT + tail[2:].reshape(-1, 3)
        turns = [Rotation.identity()]
        for step in steps:
            turns.append(turns[-1] * Rotation.from_rotvec(step))
        R = Rotation.concatenate(turns)
        now = R.inv().apply(u / np.linalg.norm(u))
        rate = np.vstack([steps[:1], steps]) / DT
        late = Rotation.from_rotvec(rate * k.lag_s * z[3]).apply(
            now
        )  # the sensor was not there yet
        mag = late @ M + b + k.iron_gauss * (share - 0.5)[:, None] * z[13:16]
        if self.around:
            place, own = z[16:].reshape(2, 3, -1).transpose(0, 2, 1)
            there = R.inv().apply(self.course(place) * self.around.place_gauss)
            mag = mag + there @ self.iron.T + self.around.coloured * SM * self.course(own)
        p, q, r, s, t = k.shape * z[5:10]
        third = q / np.sqrt(3)
        E = np.array([[p + third, t, s], [t, third - p, r], [s, r, -2 * third]])
        E = Rotation.from_rotvec(k.turn_rad * z[:3]).as_matrix() + E + k.scale * z[4] * np.eye(3)
        gyro = steps / DT @ E.T + bias + k.bias_rad_s * (share - 1.0)[1:, None] * z[10:13]
        return np.concatenate([mag.ravel() / SM, gyro.ravel() / SG])


def dense(readings, step=1e-4):
    """J (measurements, unknowns) by differences."""
    columns = []
    for k in range(readings.unknowns):
        d = np.zeros(readings.unknowns)
        d[k] = step
        columns.append((readings(d) - readings(-d)) / (2 * step))
    return np.array(columns).T


def unit_volume(M, C):
    """Covariance (12, 12) of A = M / det(M)^(1/3), b, w_b of that of M, b, w_b, by differences."""

    def shape(m):
        full = np.zeros((3, 3))
        full[UPPER] = m
        full.T[UPPER] = m
        return (full / np.cbrt(np.linalg.det(full)))[UPPER]

    J = np.eye(12)
    for k, e in enumerate(np.eye(6) * 1e-6):
        J[:6, k] = (shape(M[UPPER] + e) - shape(M[UPPER] - e)) / 2e-6
    return J @ C @ J.T


def besides(experiment, kind, around):
    trajectory = Trajectory(experiment.field_b, experiment.rate_b_rad_s, experiment.samples.dt_s)
    A = experiment.truth.soft_iron
    parts = [nuisances.instrument(trajectory, A, kind)]
    if around:
        parts.append(nuisances.surroundings(trajectory, A, SM, around))
    return trajectory, nuisances.together(*parts)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "around"),
    [
        pytest.param(AS_SPECIFIED, None, id="as specified"),
        pytest.param(ASSEMBLED, AROUND, id="assembled, and surroundings"),
        pytest.param(ASSEMBLED, None, id="assembled", marks=pytest.mark.slow),
        pytest.param(AS_SPECIFIED, AROUND, id="specified, and around", marks=pytest.mark.slow),
    ],
)
def test_equals_a_dense_fisher_matrix_with_priors_of_the_imperfections(kind, around):
    experiment = turning()
    readings = Readings(experiment, kind, around)
    J = dense(readings)
    H = J.T @ J
    H[12 : 12 + readings.besides, 12 : 12 + readings.besides] += np.eye(readings.besides)
    expected = unit_volume(readings.M, np.linalg.inv(H)[:12, :12])
    trajectory, extra = besides(experiment, kind, around)
    found = cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG, nuisances=extra).covariance
    scale = np.sqrt(np.diag(expected))
    assert found / np.outer(scale, scale) == pytest.approx(
        expected / np.outer(scale, scale), abs=1e-3
    )


@pytest.mark.slow
def test_estimates_scatter_as_predicted_when_the_imperfections_are_drawn():
    """Most probable estimates from readings with random noise and imperfections. Chord
    iterations with the matrix at the truth; the readings themselves are not linear.
    """
    experiment = turning()
    readings = Readings(experiment, ASSEMBLED, AROUND)
    J = dense(readings)
    prior = np.zeros(readings.unknowns)
    own = slice(12, 12 + readings.besides)
    prior[own] = 1.0
    gain = np.linalg.inv(J.T @ J + np.diag(prior))
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(150):
        truth = np.zeros(readings.unknowns)
        truth[own] = rng.normal(size=readings.besides)
        read = readings(truth) + rng.normal(size=len(J))
        x = np.zeros(readings.unknowns)
        for _ in range(4):
            x = x + gain @ (J.T @ (read - readings(x)) - prior * x)
        errors.append(x[:12])
    trajectory, extra = besides(experiment, ASSEMBLED, AROUND)
    found = cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG, nuisances=extra)
    scatter = np.mean(np.square(errors), axis=0)[6:]
    assert np.sqrt(scatter / np.diag(found.covariance)[6:]) == pytest.approx(np.ones(6), abs=0.2)
    plain = cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG)
    assert np.all(scatter > 2.0 * np.diag(plain.covariance)[6:])


def test_extended_bound_is_never_below_the_plain_one_and_grows_with_the_sizes():
    experiment = simulate(ScenarioSettings("lam", "rov", seed=1, samples=3000))
    small, large = (
        cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG, nuisances=extra).covariance
        for trajectory, extra in (
            besides(experiment, kind, None) for kind in (AS_SPECIFIED, ASSEMBLED)
        )
    )
    trajectory, _ = besides(experiment, ASSEMBLED, None)
    plain = cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG).covariance
    size = np.sqrt(np.diag(large))
    for less, more in ((plain, small), (small, large)):
        values = np.linalg.eigvalsh((more - less) / np.outer(size, size))
        assert values[0] > -1e-7 * values[-1]
    assert np.all(np.diag(large)[6:9] > 2.0 * np.diag(plain)[6:9])


def test_extended_bound_of_a_perfect_instrument_is_the_plain_one():
    experiment = turning()
    nothing = replace(ASSEMBLED, **dict.fromkeys(ASSEMBLED.__slots__, 1e-12))
    assert astuple(nothing) == (1e-12,) * 6
    trajectory, extra = besides(experiment, nothing, None)
    found, plain = (
        cramer_rao(trajectory, experiment.truth.soft_iron, SM, SG, nuisances=each).covariance
        for each in (extra, None)
    )
    assert found[6:, 6:] == pytest.approx(plain[6:, 6:], rel=1e-5)


def test_roll_and_pitch_determine_what_level_circles_leave_open():
    """Misalignment, delay and scale errors leave the iron undetermined without such motion."""
    level = pieces.drive((("circles", 120.0),), 3, rate_hz=10.0)
    rolled = pieces.drive((("circles", 60.0), ("roll", 30.0), ("pitch", 30.0)), 3, rate_hz=10.0)
    worst = []
    for made in (level, rolled):
        plain, wider = pieces.bound_sigmas(made), pieces.bound_sigmas(made, kind=ASSEMBLED)
        assert np.all(wider >= plain * (1 - 1e-6))
        worst.append(np.max(wider[6:9]))
    assert worst[0] > 2.0 * worst[1]
