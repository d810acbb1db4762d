"""The drift of all devices at once equals a plain computation for each."""

from __future__ import annotations

import datetime
import itertools
from collections import defaultdict

import numpy as np
import pytest
from fleet_rows import BEGIN, row, store_of

from ahrsd.fleet.questions import FleetRows

pytest.importorskip("duckdb", reason="duckdb (the extra fleet) is not installed")

IRON = [f"hard_iron_{axis}_gauss" for axis in "xyz"]
BIAS = [f"gyro_bias_{axis}_rad_s" for axis in "xyz"]
DEVICES = (
    ("1", 1, "rov1", 260), ("rov9", None, "rov9", 60), ("2", 2, "rov2", 8), ("3", 3, None, 3),
    ("4", 4, "rov4", 2), ("5", 5, "rov5", 1),
)  # fmt: skip


def sigma_of(name: str) -> str:
    return name.replace("iron_", "iron_sigma_").replace("bias_", "bias_sigma_")


def made_up(seed: int, *, tied: bool = True) -> list[dict[str, object]]:
    """Rows in no order: some at the same time, some without a temperature, some without parts."""
    rng = np.random.default_rng(seed)
    rows = []
    for _, serial, vehicle, n in DEVICES:
        steps = 0.01 * (np.arange(n) >= n // 2)
        days = rng.choice(max(2 * n // 3, 2), n) if tied else rng.choice(3 * n, n, replace=False)
        for day, step in zip(np.sort(days), steps, strict=True):
            number = int(rng.integers(2**62))
            values = {name: float(rng.normal(0.1, 5e-4) + step) for name in IRON}
            values |= {name: float(rng.normal(1e-3, 1e-4)) for name in BIAS}
            values |= {sigma_of(name): float(rng.uniform(1e-5, 2e-4)) for name in IRON + BIAS}
            values["temperature_c"] = float(rng.normal(15, 5)) if rng.random() < 0.9 else None
            values["heading_sigma_deg"] = float(rng.uniform(0.1, 1.0))
            values["recorded_by"] = str(rng.choice(["its name", "the file's date"]))
            values["converged"] = n < 10 or bool(rng.random() < 0.9)
            rows.append(
                row(number, day=float(day), serial_number=serial, vehicle=vehicle, **values)
            )
    rows.append(row(5, day=1.0, serial_number=None, vehicle=None))
    rows.append(row(6, serial_number=1))
    rows.append(row(7, day=0.0, serial_number=2, vehicle="a"))  # the last by name is rov2
    return [rows[i] for i in rng.permutation(len(rows))]


def day_of(one: dict[str, object]) -> float:
    at = datetime.datetime.fromisoformat(str(one["recorded_utc"]))
    return (at - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)).total_seconds() / 86400


def plain_points(rows: list[dict[str, object]]) -> list[list[dict[str, object]]]:
    """At most 200 groups of neighbours in time, by an index of each."""
    rows = sorted(rows, key=lambda one: (one["recorded_utc"], one["key"]))
    most = min(len(rows), 200)
    starts = [k * len(rows) // most for k in range(most)] + [len(rows)]
    return [rows[a:b] for a, b in itertools.pairwise(starts)]


def plain_series(points, names) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    day, warm, values, sigmas = [], [], [], []
    for point in points:
        day.append(sum(map(day_of, point)) / len(point))
        known = [one["temperature_c"] for one in point if one["temperature_c"] is not None]
        warm.append(sum(known) / len(known) if known else np.nan)
        values.append([sum(one[name] for one in point) / len(point) for name in names])
        squares = [sum(one[sigma_of(name)] ** 2 for one in point) for name in names]
        sigmas.append([np.sqrt(square) / len(point) for square in squares])
    return tuple(map(np.array, (day, warm, values, sigmas)))


def plain_line(day, warm, values, sigmas, step_after):
    """Slopes with sigmas of one weighted fit of lines in time and temperature with one step."""
    n = len(day)
    columns = {"constant": np.ones(n), "year": (day - day.mean()) / 365.25}
    known = np.isfinite(warm)
    degrees = np.where(known, warm - warm[known].mean(), 0.0)
    columns["degree"] = degrees
    if step_after is not None:
        columns["step"] = (day > step_after).astype(float)
    step, warmer = np.diff(values, axis=0), np.diff(degrees)
    step = step - np.outer(warmer, warmer @ step / (warmer @ warmer))
    scatter2 = np.median(np.abs(step), axis=0) ** 2 * 1.4826**2 / 2 - np.median(sigmas**2, axis=0)
    variance = sigmas**2 + np.maximum(scatter2, 0.0)
    scale = np.sqrt(variance.mean(axis=0))
    root = 1.0 / np.sqrt((variance / scale**2).mean(axis=1))
    X = np.column_stack(list(columns.values())) * root[:, None]
    Y = values / scale * root[:, None]
    beta = np.linalg.lstsq(X, Y, rcond=None)[0]
    misfit = np.maximum(((Y - X @ beta) ** 2).sum(axis=0) / (n - X.shape[1]), 1.0)
    own = np.diag(np.linalg.inv(X.T @ X))[:, None]
    sigma = np.sqrt(own * misfit) * scale
    return dict(zip(columns, zip(beta * scale, sigma, strict=True), strict=True))


@pytest.mark.parametrize("seed", [0, 1])
def test_all_devices_at_once_equal_each_alone(tmp_path, seed):
    rows = made_up(seed)
    store = store_of(tmp_path / "out", rows[:200])
    store_of(tmp_path / "out", rows[200:], compacted=False)
    with FleetRows(store) as asked:
        found = {one.device: one for one in asked.drift()}
    groups = defaultdict(list)
    for one in rows:
        device = one["serial_number"] if one["serial_number"] is not None else one["vehicle"]
        if one["converged"] and one["recorded_utc"] is not None and device is not None:
            groups[str(device)].append(one)
    assert found.keys() == {"1", "rov9", "2", "3", "4"}
    assert len(groups["1"]) > 200
    for device, own in found.items():
        expected = groups[device]
        points = plain_points(expected)
        day, warm, values, sigmas = plain_series(points, IRON + BIAS)
        assert own.recordings == len(expected)
        assert own.vehicle == max((e["vehicle"] for e in expected if e["vehicle"]), default=None)
        assert own.by_file_date == sum(e["recorded_by"] == "the file's date" for e in expected)
        assert own.series.day == pytest.approx(day, rel=1e-12)
        assert own.series.temperature_c == pytest.approx(warm, rel=1e-12, nan_ok=True)
        assert own.series.values == pytest.approx(values, rel=1e-12)
        assert own.series.sigmas == pytest.approx(sigmas, rel=1e-12)
        assert own.first_day == min(map(day_of, expected))
        assert own.last_day == max(map(day_of, expected))
        assert own.heading_sigma_deg == points[-1][-1]["heading_sigma_deg"]
        moved = np.sqrt(sum((values[-1, k] - values[0, k]) ** 2 for k in range(3)))
        assert own.heading_kept_deg == pytest.approx(np.degrees(np.arctan2(moved, 0.25)))


@pytest.mark.parametrize("seed", [0, 2])  # a draw without a chance step of the bias
def test_slopes_and_steps_equal_those_of_a_plain_fit(tmp_path, seed):
    rows = [one for one in made_up(seed, tied=False) if one["vehicle"] == "rov9"]
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        (found,) = asked.drift()
    (change,) = found.iron.changes
    assert found.bias.changes == ()
    series = found.series
    for trend, k, step in (
        (found.iron, slice(0, 3), change.before_day),
        (found.bias, slice(3, 6), None),
    ):
        fit = plain_line(
            series.day, series.temperature_c, series.values[:, k], series.sigmas[:, k], step
        )
        assert trend.per_year == pytest.approx(fit["year"][0], rel=1e-6)
        assert trend.per_year_sigma == pytest.approx(fit["year"][1], rel=1e-6)
        assert trend.per_degree == pytest.approx(fit["degree"][0], rel=1e-6)
        assert trend.per_degree_sigma == pytest.approx(fit["degree"][1], rel=1e-6)
        if step is not None:
            assert change.size == pytest.approx(fit["step"][0], rel=1e-6)
            assert change.sigma == pytest.approx(fit["step"][1], rel=1e-6)


def test_extreme_times_are_ordered(tmp_path):
    """A clock that was never set and one that is far ahead, for many devices or few."""
    from ahrsd.fleet.drift import Bins

    rows = [row(1, day=-700000.0), row(2, day=2900000.0), row(3, day=1.0)]
    rows[2]["hard_iron_x_gauss"] = 0.2
    with FleetRows(store_of(tmp_path / "out", rows)) as asked:
        (found,) = asked.drift()
    assert found.series.values[:, 0] == pytest.approx([0.1, 0.2, 0.1])
    assert found.first_day == pytest.approx((BEGIN.timestamp() / 86400) - 700000.0)
    one = Bins.of(np.zeros(3, np.int64), np.array([2, 0, 1]), 2)
    assert one.of_row.tolist() == [1, 1, 0]
