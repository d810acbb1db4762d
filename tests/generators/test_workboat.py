"""Tests of the generator: every one asserts values against the true motion and parameters."""

from __future__ import annotations

import gzip
import json
import math
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from generators.workboat.effects import RECIPES, World, dipole
from generators.workboat.motion import VEHICLES, Array, integrate_attitude, quaternion_of
from generators.workboat.world import (
    NOISE_LAWS,
    VISIBLE,
    Active,
    Case,
    calibration_basis,
    draw_case,
    draw_world,
    generate,
    render,
    visibility,
    visibility_without_attitude,
)

pytestmark = pytest.mark.slow

COUNTS = {"null": 1, "single": 1, "pair": 1, "withheld": 2, "outside": 1}


@lru_cache
def case(kind: str, *names: str, seed: int = 3) -> Case:
    return draw_case(np.random.default_rng(seed), kind, names)


@lru_cache
def world(vehicle: str, law: str = "white", seed: int = 5) -> World:
    return draw_world(np.random.default_rng(seed), vehicle, law, "north_sea")


def model(w: World) -> Array:
    return np.asarray(w.h[w.motion.index] @ w.soft_iron.T + w.hard_iron)


def columns(c: Case, stem: str, unit: str) -> Array:
    return np.stack([c.table[f"{stem}_{a}_{unit}"] for a in "xyz"], axis=1)


@pytest.mark.parametrize("law", NOISE_LAWS)
def test_null_residual_is_the_noise(law: str) -> None:
    w = draw_world(np.random.default_rng(11), VEHICLES[len(law) % 4], law, "gulf_of_mexico")
    r = render(w, [])
    a = ((r.mag - model(w)) / w.sigma_mag)[r.keep]
    b = ((r.gyro - w.motion.step_rate - w.gyro_bias) / w.sigma_gyro)[r.keep]
    assert np.allclose(a, w.noise_mag[r.keep], atol=1e-9)
    assert np.allclose(b, w.noise_gyro[r.keep], atol=1e-9)
    slack = 0.12 if "red" in law else 0.05
    assert abs(np.mean(a**2) - 1.0) < slack
    assert abs(np.mean(b**2) - 1.0) < slack
    assert ("gaps" in law) == bool((~r.keep).any())


def test_null_table_holds_the_readings() -> None:
    c = case("null")
    keep = c.readings.keep
    a = (columns(c, "mag", "gauss") - model(c.world)[keep]) / c.world.sigma_mag
    assert 0.85 < np.mean(a**2) < 1.15
    assert np.linalg.det(c.world.soft_iron) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(c.world.hard_iron) < 0.3
    assert np.abs(np.linalg.eigvalsh(c.world.soft_iron) - 1.0).max() < 0.151


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_gyro_integrates_to_the_attitude(vehicle: str) -> None:
    w = world(vehicle)
    m = w.motion
    assert np.abs(m.step_rate - m.step_mean(m.w)).max() < 2e-4
    q = integrate_attitude(m.q[m.index[0]], m.step_rate[1:] / m.rate_hz)
    assert np.abs(q - m.q[m.index] * np.sign(np.sum(q * m.q[m.index], 1))[:, None]).max() < 1e-9
    read = render(w, []).gyro - w.gyro_bias
    q = integrate_attitude(m.q[m.index[0]], read[1:] / m.rate_hz)
    angle = 2.0 * math.acos(min(1.0, abs(float(q[-1] @ m.q[m.index[-1]]))))
    one_axis = w.sigma_gyro / m.rate_hz * math.sqrt(len(q))
    assert 0.0 < angle < 4.5 * one_axis
    back = m.r_nb[::997] @ np.swapaxes(m.r_nb[::997], 1, 2)
    assert np.abs(back - np.eye(3)).max() < 1e-9
    assert np.linalg.norm(m.force, axis=1).mean() == pytest.approx(9.81, abs=0.4)


def test_body_rate_is_the_derivative_of_attitude() -> None:
    m = world("rov").motion
    k = 5000
    d = (m.r_nb[k + 1] - m.r_nb[k - 1]) / (2.0 * m.dt_fine)
    skew = m.r_nb[k].T @ d
    rate = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    assert np.allclose(rate, m.w[k], atol=2e-5)
    assert np.allclose(integrate_attitude(quaternion_of(np.zeros(3)), np.zeros((7, 3)))[:, 0], 1.0)


def change(name: str, size: float, vehicle: str = "rov") -> tuple[World, Active, Array, Array]:
    w = world(vehicle)
    e = Active(RECIPES[name], RECIPES[name].draw(w, np.random.default_rng(2)), size)
    a, b = render(w, []), render(w, [e])
    return w, e, b.mag - a.mag, b.gyro - a.gyro


def test_step_and_current_have_the_stated_size() -> None:
    w, e, dm, _ = change("hard_iron_step", 0.004)
    assert e.built.onset is not None
    late = w.ts >= e.built.onset
    assert np.abs(dm[~late]).max() == 0.0
    assert np.allclose(np.linalg.norm(dm[late], axis=1), 0.004)
    for name, column in (("motor_current_field", None), ("speed_field", "speed_m_s")):
        w, e, dm, _ = change(name, 0.001, "towed_body")
        x = w.motion.signals[column or e.built.needs[0]][w.motion.index]
        assert np.allclose(np.linalg.norm(dm, axis=1), 0.001 * np.abs(x), rtol=1e-9)


def test_lags_have_the_stated_size_and_sign() -> None:
    w, _, dm, _ = change("mag_time_lag", 0.01)
    hdot = np.cross(w.h, w.motion.w)[w.motion.index] @ w.soft_iron.T
    assert -np.sum(dm * hdot) / np.sum(hdot**2) == pytest.approx(0.01, rel=0.02)
    w, _, _, dw = change("gyro_time_lag", 0.01)
    wdot = w.motion.step_mean(np.gradient(w.motion.w, w.motion.dt_fine, axis=0))
    assert -np.sum(dw * wdot) / np.sum(wdot**2) == pytest.approx(0.01, rel=0.05)


def test_world_effects_turn_with_the_vehicle() -> None:
    w, _, dm, _ = change("field_step", 0.01)
    back = np.linalg.solve(w.soft_iron, dm.T).T
    in_world = np.einsum("kij,kj->ki", w.motion.r_nb[w.motion.index], back)
    late = np.linalg.norm(dm, axis=1) > 0
    assert np.ptp(in_world[late], axis=0).max() < 1e-12
    assert np.linalg.norm(in_world[-1]) == pytest.approx(0.01)
    w, _, dm, _ = change("field_anomaly", 0.02)
    peak = np.linalg.norm(np.linalg.solve(w.soft_iron, dm.T), axis=0).max()
    assert 0.019 < peak <= 0.02 + 1e-9
    on_axis = dipole(np.array([[0.0, 0.0, 2.0]]), np.array([0.0, 0.0, 50.0]))
    assert on_axis[0, 2] == pytest.approx(1e4 * 2e-7 * 50.0 / 8.0)


def test_gyro_effects_have_the_stated_size() -> None:
    w, e, _, dw = change("gyro_scale", 0.005)
    want = 0.005 * np.array([e.built.scaled[f"scale_{a}_share"] for a in "xyz"])
    mean = w.motion.step_mean(w.motion.w)
    assert np.allclose(np.sum(dw * mean, 0) / np.sum(mean**2, 0), want, rtol=1e-3, atol=1e-7)
    w, _, _, dw = change("earth_rotation", 1.0)
    assert np.allclose(np.linalg.norm(dw, axis=1), 7.292115e-5, rtol=1e-3)


@pytest.mark.parametrize("name", [n for n, r in RECIPES.items() if r.stage != "rows"])
def test_each_effect_touches_its_own_sensor_only(name: str) -> None:
    r = RECIPES[name]
    size = math.sqrt(r.low * r.high)
    _, _, dm, dw = change(name, size, "rov" if "rov" in r.vehicles else r.vehicles[0])
    touched, other = (dw, dm) if r.stage in ("rate", "gyro") else (dm, dw)
    assert np.abs(other).max() == 0.0
    assert np.isfinite(touched).all()
    assert np.abs(touched).max() > 0.0


def test_visibility_forgets_the_calibration() -> None:
    w = world("rov")
    basis, base = calibration_basis(w), render(w, [])
    other = render(w, [])
    soft = np.array([[1.01, 0.02, 0.0], [0.02, 0.97, 0.01], [0.0, 0.01, 1.0]])
    other.mag = other.mag + w.h[w.motion.index] @ (soft - np.eye(3)) + 0.01
    other.gyro = other.gyro + np.array([1e-3, -2e-3, 3e-3])
    assert visibility(w, basis, base, other) < 1e-6
    r = RECIPES["noise_level"]
    e = Active(r, r.draw(w, np.random.default_rng(1)), 1.0)
    assert e.built.onset is not None
    want = math.sqrt(3.0 * np.sum(w.ts >= e.built.onset))
    assert visibility(w, basis, base, render(w, [e])) == pytest.approx(want, rel=0.03)
    visibility_without_attitude(w, [e])
    assert e.without_attitude == pytest.approx(want, rel=0.03)


@pytest.mark.slow
def test_same_seed_same_files_and_the_contract(tmp_path: Path) -> None:
    cases = generate(tmp_path / "a", 7, COUNTS)
    generate(tmp_path / "b", 7, COUNTS)
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == sorted(p.name for p in (tmp_path / "b").iterdir())
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert truth["seed"] == 7
    assert len(truth["cases"]) == len(cases) == 6
    assert sum(n.endswith("spec.json") for n in names) == 3
    for entry in truth["cases"]:
        with gzip.open(tmp_path / "a" / f"{entry['id']}.csv.gz", "rt") as f:
            head = f.readline().strip().split(",")
            first = np.array(f.readline().split(","), dtype=float)
        assert head[:4] == ["time_s", "mag_x_gauss", "mag_y_gauss", "mag_z_gauss"]
        assert len(first) == len(head)
        assert not set(entry["withheld"]) & set(head)
        assert bool(entry["withheld"]) == (entry["kind"] == "withheld")
        wanted = {"null": 0, "pair": 2}.get(entry["kind"], 1)
        assert len(entry["effects"]) == wanted
        for e in entry["effects"]:
            if RECIPES[e["effect"]].family != "gross":
                assert VISIBLE[0] <= e["visibility"] <= VISIBLE[1]
                assert e["visibility_without_attitude"] >= 4.99


def test_needed_columns_exist_unless_withheld() -> None:
    single = case("single", "mag_bias_temperature")
    assert "temperature_c" in single.table
    hidden = case("withheld", "mag_bias_temperature")
    assert hidden.withheld == ["temperature_c"]
    assert "temperature_c" not in hidden.table


def test_link_faults_have_their_stated_effect() -> None:
    w = world("auv")
    for seed in range(12):
        built = RECIPES["frame_error"].draw(w, np.random.default_rng(seed))
        m = np.array(list(built.fixed.values())).reshape(3, 3)
        assert not np.allclose(m, np.eye(3))
        assert np.allclose(m @ m.T, np.eye(3))
    r = RECIPES["dropped_samples"]
    got = render(w, [Active(r, r.draw(w, np.random.default_rng(1)), 0.01)])
    lost = int((~got.keep).sum())
    assert lost == pytest.approx(0.01 * len(w.ts), rel=0.35)
    assert np.allclose(np.diff(got.time[got.keep]), w.dt)
    r = RECIPES["clock_rate"]
    e = Active(r, r.draw(w, np.random.default_rng(1)), 0.002)
    ratio = render(w, [e]).time[-1] / w.ts[-1] - 1.0
    assert ratio == pytest.approx(0.002 * e.built.scaled["stamp_rate_error_share"])
    r = RECIPES["timestamp_jitter"]
    e = Active(r, r.draw(w, np.random.default_rng(1)), 0.004)
    got = render(w, [e])
    assert np.std(got.time - w.ts) == pytest.approx(0.004, rel=0.1)
    assert np.diff(got.time).min() > 0.0
