"""Values that the generator must meet; ``pytest tests/generators``."""

from __future__ import annotations

import csv
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from generators.road_and_air import world
from generators.road_and_air.effects import LIBRARY, OUTSIDE, Scene, attitude_gap, unit
from generators.road_and_air.motion import (
    VEHICLES,
    Array,
    integrate_rate,
    make_motion,
    quat_to_matrix,
)

pytestmark = pytest.mark.slow


def short_scene(vehicle: str, seed: int, rate_hz: float = 25.0) -> Scene:
    """A scene of one vehicle at a low rate."""
    rng = np.random.default_rng(seed)
    return world.make_scene(make_motion(vehicle, rng, rate_hz), rng)


def columns(path: Path) -> dict[str, Array]:
    """The columns of a written recording."""
    with gzip.open(path, "rt") as stream:
        rows = list(csv.reader(stream))
    table = np.array(rows[1:], dtype=float)
    return {name: table[:, i] for i, name in enumerate(rows[0])}


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_step_rates_lead_to_the_true_attitude(vehicle: str) -> None:
    s = short_scene(vehicle, 3)
    assert attitude_gap(s) < 1e-9
    assert np.allclose(s.motion.rotation[-1] @ s.motion.rotation[-1].T, np.eye(3), atol=1e-12)


def test_integration_agrees_with_a_known_turn() -> None:
    q = integrate_rate(np.tile([0.0, 0.0, 0.5], (1000, 1)), 0.001, np.array([1.0, 0, 0, 0]))
    turn = quat_to_matrix(q[-1])
    assert math.atan2(turn[1, 0], turn[0, 0]) == pytest.approx(0.5, abs=1e-12)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_resting_accelerometer_points_up(vehicle: str) -> None:
    s = short_scene(vehicle, 4)
    up = np.einsum("nij,nj->ni", s.motion.rotation, s.motion.force)
    assert up[:, 2].mean() == pytest.approx(-9.80665, abs=0.1)


@pytest.mark.parametrize("law", world.LAWS)
def test_null_readings_are_model_plus_noise(law: str) -> None:
    s = short_scene("copter", 5)
    noise = world.make_noise(s, np.random.default_rng(6), law, False)
    r = world.read(s, [], noise)
    field = np.einsum("nij,i->nj", s.motion.rotation[s.motion.index], s.field_ned)
    mag = (r.mag_k - field @ s.soft_iron - s.hard_iron) / s.sigma_mag
    gyro = (r.gyro_k - s.rate - s.gyro_bias) / s.sigma_gyro
    assert np.mean(mag**2) == pytest.approx(1.0, abs=0.06)
    assert np.mean(gyro**2) == pytest.approx(1.0, abs=0.06)
    assert np.abs(mag.mean(axis=0)).max() < 5 / math.sqrt(len(mag))


def test_written_null_has_white_innovations_of_size_one(tmp_path: Path) -> None:
    counts = {"null": 3, "single": 0, "pair": 0, "withheld": 0, "outside": 0}
    for case in world.make_cases(11, counts):
        s = case.scene
        assert s is not None
        world.write_table(tmp_path / "x.csv.gz", case.table)
        t = columns(tmp_path / "x.csv.gz")
        mag = np.stack([t[f"mag_{a}_gauss"] for a in "xyz"], axis=1)
        gyro = np.stack([t[f"gyro_{a}_rad_s"] for a in "xyz"], axis=1) - s.gyro_bias
        start = s.motion.quaternion[0]
        q = integrate_rate(gyro, s.motion.step_s, start)[1:]
        field = (mag - s.hard_iron) @ np.linalg.inv(s.soft_iron)
        error = np.einsum("nij,nj->ni", quat_to_matrix(q), field) - s.field_ned
        back = np.einsum("nij,ni->nj", s.motion.rotation[s.motion.index], error) @ s.soft_iron
        e = world.whitened(s, back, None)[:, 1:]
        assert np.mean(e**2) == pytest.approx(1.0, abs=0.2)  # soft iron colours the noise a bit
        assert abs(np.mean(e[1:] * e[:-1])) < 0.1


def test_hard_iron_step_has_the_size_it_states() -> None:
    s = short_scene("car", 7)
    effect = LIBRARY["hard_iron_step"](s, np.random.default_rng(1))
    assert effect is not None and effect.onset is not None
    d_mag, d_gyro = world.change_of(s, effect, 0.02)
    stated = np.array([effect.parameters(0.02)[f"step_{a}_gauss"] for a in "xyz"])
    at = int(effect.onset * 25.0)
    assert np.linalg.norm(stated) == pytest.approx(0.02)
    assert np.allclose(d_mag[at + 2 :], stated) and not np.any(d_mag[: at - 2])
    assert not np.any(d_gyro)


def test_world_step_is_constant_in_the_world() -> None:
    s = short_scene("hand", 8)
    effect = LIBRARY["field_step"](s, np.random.default_rng(1))
    assert effect is not None
    d_mag, _ = world.change_of(s, effect, 0.03)
    field = d_mag @ np.linalg.inv(s.soft_iron)
    ned = np.einsum("nij,nj->ni", s.motion.rotation[s.motion.index], field)
    stated = [effect.parameters(0.03)[f"step_{a}_gauss"] for a in "xyz"]
    assert np.allclose(ned[-1], stated) and np.allclose(ned[0], 0.0)


def test_anomaly_peak_lag_and_current_have_their_sizes() -> None:
    s = short_scene("robot", 9)
    anomaly = next(
        e for k in range(20) if (e := LIBRARY["field_anomaly"](s, np.random.default_rng(k)))
    )
    d_mag, _ = world.change_of(s, anomaly, 0.1)
    field = np.linalg.norm(d_mag @ np.linalg.inv(s.soft_iron), axis=1)
    assert field.max() == pytest.approx(0.1, rel=0.02)
    lag = LIBRARY["mag_time_lag"](s, np.random.default_rng(1))
    assert lag is not None
    d_mag, _ = world.change_of(s, lag, 0.002)
    slope = np.cross(s.body[s.motion.index], s.motion.omega[s.motion.index]) @ s.soft_iron
    fit = float(np.sum(slope * d_mag) / np.sum(slope**2))
    assert fit == pytest.approx(-0.002, rel=0.1)
    lead = LIBRARY["motor_current_field"](s, np.random.default_rng(1))
    assert lead is not None
    d_mag, _ = world.change_of(s, lead, 0.001)
    ampere = s.motion.channels["motor_current_a"][s.motion.index]
    assert np.allclose(np.linalg.norm(d_mag, axis=1), np.abs(ampere) * 0.001)


@pytest.mark.slow
def test_every_effect_changes_its_own_sensor_only() -> None:
    seen = set()
    for vehicle in VEHICLES:
        s = short_scene(vehicle, 10)
        for name, maker in {**LIBRARY, **OUTSIDE}.items():
            effect = maker(s, np.random.default_rng(2))
            if effect is None:
                continue
            size = math.sqrt(effect.low * effect.high)
            d_mag, d_gyro = world.change_of(s, effect, size)
            assert np.any(d_mag) or np.any(d_gyro), name
            if effect.frame in ("sensor", "world"):
                assert not np.any(d_gyro), name
            if effect.frame == "gyro":
                assert not np.any(d_mag), name
            assert all(isinstance(v, float) for v in effect.parameters(size).values()), name
            seen.add(name)
    assert seen == set(LIBRARY) | set(OUTSIDE)
    assert len(LIBRARY) >= 25 and len(OUTSIDE) >= 6


def test_absorbed_changes_are_invisible() -> None:
    s = short_scene("hand", 12)
    h = s.body[s.motion.index]
    d_mag = 0.05 * h @ np.diag([1.0, -0.3, 0.2]) + 0.1 * unit(np.random.default_rng(1))
    plain, blind = world.visibility(s, d_mag, np.tile([0.01, 0.02, -0.01], (len(h), 1)))
    assert plain < 1e-3 and blind < 1.0


@pytest.mark.slow
def test_command_is_reproducible_and_hides_the_truth(tmp_path: Path) -> None:
    flags = ["--null", "1", "--single", "1", "--pair", "1", "--withheld", "2", "--outside", "1"]
    for name in ("a", "b"):
        assert world.main([str(tmp_path / name), "--seed", "3", *flags]) == 0
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == sorted(p.name for p in (tmp_path / "b").iterdir())
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert [c["id"] for c in truth["cases"]] == sorted(c["id"] for c in truth["cases"])
    for case in truth["cases"]:
        table = columns(tmp_path / "a" / f"{case['id']}.csv.gz")
        assert np.all(np.diff(table["time_s"]) > 0)
        assert all(np.all(np.isfinite(v)) for v in table.values())
        assert len(case["effects"]) == {"null": 0, "pair": 2}.get(case["kind"], 1)
        assert bool(case["withheld"]) == (case["kind"] == "withheld")
        assert not set(case["withheld"]) & set(table)
        for effect in case["effects"]:
            causes = world.CAUSES.get(effect["effect"], ())
            if case["kind"] == "withheld":
                assert set(case["withheld"]) & set(causes)
            elif causes:
                assert set(table) & set(causes)
