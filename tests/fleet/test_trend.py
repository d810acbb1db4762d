"""Drift, temperature dependence and steps are recovered, and none is found without one."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.fleet.drift import Bins, Series, trends

PER_YEAR = np.array([2e-3, -1e-3, 0.0])
PER_DEGREE = np.array([0.0, 1e-4, -2e-4])
STEP = np.array([5e-3, -3e-3, 4e-3])


def series(seed: int, n: int = 120, *, step_at: int | None = None, warm: bool = True) -> Series:
    """Calibrations over two years that scatter by 0.5 mG with a sigma of 0.2 mG."""
    rng = np.random.default_rng(seed)
    day = 20000.0 + np.sort(rng.uniform(0.0, 730.0, n))
    temperature = rng.normal(15.0, 6.0, n)
    values = 0.1 + rng.normal(0.0, 5e-4, (n, 3)) + rng.normal(0.0, 2e-4, (n, 3))
    values += (day - day[0])[:, None] / 365.25 * PER_YEAR
    values += temperature[:, None] * PER_DEGREE
    if step_at is not None:
        values[step_at:] += STEP
    return Series(day, temperature if warm else np.full(n, np.nan), values, np.full((n, 3), 2e-4))


def test_drift_temperature_and_a_step_are_recovered_within_their_sigmas():
    given = [series(seed, step_at=70) for seed in range(40)]
    z = []
    for one, found in zip(given, trends(given), strict=True):
        (change,) = found.changes
        assert change.before_day == one.day[69]
        assert change.after_day == one.day[70]
        z.append([
            (found.per_year - PER_YEAR) / found.per_year_sigma,
            (found.per_degree - PER_DEGREE) / found.per_degree_sigma,
            (change.size - STEP) / change.sigma,
        ])  # fmt: skip
        assert found.scatter == pytest.approx(5e-4, rel=0.6)
    assert np.std(z, axis=(0, 2)) == pytest.approx([1.0, 1.0, 1.0], abs=0.3)
    assert np.abs(z).max() < 5.0


def test_drift_alone_has_no_steps():
    found = trends([series(seed, n) for seed in range(150) for n in (8, 40, 200)])
    assert sum(bool(one.changes) for one in found) <= 5


def test_single_outlying_calibration_is_not_a_step():
    given = []
    for seed in range(20):
        one = series(seed)
        one.values[50] += 0.05
        given.append(one)
    found = trends(given)
    assert [len(one.changes) for one in found] == [0] * 20
    z = [(one.per_year - PER_YEAR) / one.per_year_sigma for one in found]
    assert np.abs(z).max() < 5.0


def test_two_steps_are_reported_in_order():
    one = series(3)
    one.values[30:] += STEP
    one.values[90:] -= 2 * STEP
    (found,) = trends([one])
    assert [change.after_day for change in found.changes] == [one.day[30], one.day[90]]
    assert found.changes[1].size == pytest.approx(-2 * STEP, abs=1e-3)


@pytest.mark.parametrize("n", [8, 12, 60])
def test_step_is_single_without_a_temperature(n):
    one = series(6, n, step_at=n // 2, warm=False)
    one.values[:] = 0.1 + np.arange(n)[:, None] // (n // 2) * STEP  # without any scatter
    (found,) = trends([one])
    (change,) = found.changes
    assert change.after_day == one.day[n // 2]
    assert change.size == pytest.approx(STEP, rel=1e-6)


def test_undetermined_coefficients_are_nan():
    cold, two = series(1, warm=False), series(1, 2)
    found = trends([cold, two])
    assert np.isnan(found[0].per_degree).all()
    assert np.isfinite(found[0].per_year).all()
    assert np.isnan(found[1].per_year).all()
    assert found[1].changes == ()


def test_devices_do_not_influence_each_other():
    alone = trends([series(5, 60, step_at=20)])[0]
    beside = trends([series(9, 150), series(5, 60, step_at=20), series(2, 3)])[1]
    assert beside.per_year == pytest.approx(alone.per_year, rel=1e-6)
    assert beside.changes[0].size == pytest.approx(alone.changes[0].size, rel=1e-6)


def test_step_within_averaged_calibrations_is_one_step():
    one = series(4, 3001, step_at=1507)
    bins = Bins.of(np.zeros(3001, np.int64), np.arange(3001))
    (day,) = bins.means([one.day]).T
    warm = bins.known_means(one.temperature_c)
    small = Series(day, warm, bins.means(one.values.T), bins.sigmas(one.sigmas.T))
    assert len(small.day) == 200
    assert small.values.mean(axis=0) == pytest.approx(one.values.mean(axis=0), abs=1e-5)
    assert small.sigmas[0] == pytest.approx(2e-4 / np.sqrt(15), rel=1e-6)
    (found,) = trends([small])
    (change,) = found.changes
    assert change.before_day < one.day[1507] <= change.after_day + 1.0
    assert change.size == pytest.approx(STEP, abs=3e-4)


def test_no_series_gives_no_trends():
    assert trends([]) == []
