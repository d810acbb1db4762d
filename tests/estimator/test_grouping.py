"""Groups of steps: exact without noise, never across a gap, and no information lost beyond the
stated amount.
"""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.epoch_data import group_size, group_steps
from ahrsd.estimator.noise import DirectionCells, variance_inflation

M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])
B = np.array([0.1, -0.2, 0.05])
X = np.r_[chain.upper_triangle(M), B]
DT = 0.04
NOISE = chain.Noise(2e-3, 5e-3)


def epoch(n=60, *, cut=None, noise=0.0, speed=0.03):
    """A turning chain with its true directions; `cut`: the row to which no step leads."""
    rng = np.random.default_rng(0)
    t = np.arange(n)
    angle = speed * np.column_stack([np.sin(0.05 * t), np.cos(0.07 * t), np.sin(0.03 * t + 1)])
    u = np.empty((n, 3))
    u[0] = [0.36, -0.48, 0.8]
    for k in range(1, n):
        u[k] = [0.8, 0.0, -0.6] if k == cut else so3.exp(-angle[k]) @ u[k - 1]
    linked = np.ones(n)
    if cut is not None:
        linked[cut], angle[cut] = 0.0, 0.0
    field = u @ M + B + noise * rng.normal(size=(n, 3))
    angle = angle + noise * 0.1 * rng.normal(size=(n, 3)) * linked[:, None]
    data = chain.EpochData(
        field, angle, np.full(n, DT), np.full((n, 3), np.nan), t * DT, True,
        linked=None if cut is None else linked,
    )  # fmt: skip
    return data, u


@pytest.mark.parametrize("cut", [None, 1, 2, 23, 58, 59])
@pytest.mark.parametrize("size", [3, 5, 7])
def test_groups_are_exact_without_noise(cut, size):
    """The true directions at the middles of the groups explain mean field and turns exactly."""
    data, u = epoch(cut=cut)
    small = group_steps([data], [size])[0]
    rows = np.searchsorted(data.time_s, small.time_s)
    assert (rows[0], rows[-1]) == (0, len(data) - 1)
    assert small.steps == len(data)
    np.testing.assert_allclose(small.field_error(u[rows], X), 0.0, atol=1e-12)
    q = chain.linearise(small, u[rows], X, np.zeros(3), NOISE)
    assert q.cost < 1e-16
    cuts = 0 if small.linked is None else np.count_nonzero(small.linked[1:] == 0)
    assert cuts == (0 if cut is None else 1)


def test_gradient_and_hessian_of_a_group_agree_with_differences():
    """The gradient of the cost at fixed directions, and H as its slope."""
    data, u = epoch(noise=2e-3)
    small = group_steps([data], [5])[0]
    rows = np.searchsorted(data.time_s, small.time_s)
    q = chain.linearise(small, u[rows], X, np.zeros(3), NOISE)
    step = np.random.default_rng(1).normal(size=12) * 1e-5

    def cost(s):
        return chain.linearise(small, u[rows], X + s * step[:9], s * step[9:], NOISE).cost

    assert cost(1) - cost(-1) == pytest.approx(2 * q.g[:12] @ step, rel=5e-3)
    curved = cost(1) + cost(-1) - 2 * cost(0)
    assert curved == pytest.approx(step @ q.H[:12, :12] @ step, rel=0.05)


def test_information_of_a_group_equals_that_of_its_steps():
    data, u = epoch(n=500)
    small = group_steps([data], [5])[0]
    rows = np.searchsorted(data.time_s, small.time_s)
    quiet = chain.Noise(2e-3, 2e-3)
    found = []
    for d, at in ((data, u), (small, u[rows])):
        H = chain.linearise(d, at, X, np.zeros(3), quiet).H
        found.append(np.sqrt(np.diag(np.linalg.inv(H))))
    np.testing.assert_allclose(found[1], found[0], rtol=0.02)


@pytest.mark.parametrize(
    ("noise", "speed", "expected"),
    [
        (chain.Noise(2e-3, 2e-3), 0.01, 7),
        (chain.Noise(2e-3, 0.02), 0.01, 3),
        (chain.Noise(2e-3, 0.2), 0.01, 1),  # a poor gyro
        (chain.Noise(2e-3, 2e-3), 0.2, 1),  # fast turns
    ],
)
def test_group_size_follows_from_noise_and_speed(noise, speed, expected):
    assert group_size(epoch(speed=speed)[0], noise, 0.5) == expected


def test_errors_that_repeat_with_the_attitude_count_once_per_cell():
    ring = np.linspace(0, 2 * np.pi, 1200, endpoint=False)
    level = np.column_stack([np.cos(ring), np.sin(ring), np.full(1200, 0.05)])
    cells = DirectionCells.of(level, 5.0) + DirectionCells.of(level, 5.0)
    assert cells.visited == 12
    assert cells.steps == 12_000
    assert variance_inflation(cells, 1e-3, 1e-3) == 1.0  # white
    assert variance_inflation(cells, 1e-2, 1e-3) == pytest.approx(1000 * (1 - 1.5e-2))
    assert variance_inflation(DirectionCells(), 1e-2, 1e-3) == 1.0
    assert cells.regions == 6  # smooth errors: fewer unknowns, so more is lost
    smooth = variance_inflation(cells, 1e-2, 1e-3, smooth=True)
    assert smooth == pytest.approx(2000 * (1 - 1.5e-2))


def test_several_epochs_are_grouped_as_each_by_itself():
    epochs = [epoch(n=n, cut=cut, noise=2e-3)[0] for n, cut in ((60, 23), (3, None), (41, None))]
    for few, data in zip(group_steps(epochs, [5, 3, 7]), epochs, strict=True):
        alone = group_steps([data], [5 if len(data) == 60 else 7])[0]
        assert len(few) == len(alone) <= len(data)
        for name in ("field_b_gauss", "angle_b_rad", "dt_s", "time_s"):
            np.testing.assert_allclose(getattr(few, name), getattr(alone, name), atol=1e-15)
        assert (few.linked is None) == (alone.linked is None)
    assert group_steps(epochs, [1, 1, 1]) == epochs
