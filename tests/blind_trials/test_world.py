"""The generator obeys physics, says nothing in its files, and is the same for the same seed."""

import ast
import gzip
import io
import json
from pathlib import Path

import grimp
import numpy as np
import pytest
from blind_trials.world import cases, chain, curves, ideal, limits, motion, rings, world
from blind_trials.world.__main__ import csv_bytes, make_ring
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).parents[2]
RATE_HZ = 25.0


@pytest.fixture(scope="module")
def rov():
    return world.make_world("wam_rov", np.random.default_rng(5), 60.0)


def sensed(scene, key=None, strength=0.0, seed=3):
    stages = chain.Stages()
    if key is not None:
        limits.EFFECTS[key].make(scene, stages, strength, np.random.default_rng(seed))
    return chain.readings(scene, stages, RATE_HZ)


def test_generator_and_tool_import_nothing_of_each_other():
    for path in (PROJECT / "tests" / "tools" / "blind_trials" / "world").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module]
            others = {name for name in names if not f"{name}.".startswith("blind_trials.world.")}
            assert {name.split(".")[0] for name in others} <= {
                "__future__", "argparse", "collections",
                "dataclasses", "gzip", "itertools", "json", "numpy", "pathlib", "scipy",
            }, path.name  # fmt: skip
    graph = grimp.build_graph("ahrsd", "drivers", "blind_trials", cache_dir=None)
    world = {"blind_trials.world"} | graph.find_descendants("blind_trials.world")
    assert len(world) > 20
    assert {up for name in world for up in graph.find_modules_that_directly_import(name)} <= world
    others = graph.find_descendants("blind_trials") - world
    assert "ahrsd.diagnosis" not in {
        ".".join(up.split(".")[:2])
        for module in others
        for up in graph.find_modules_directly_imported_by(module)
    }


@pytest.mark.parametrize("name", motion.MOTIONS)
def test_rates_are_the_derivative_of_the_attitude(name):
    made = motion.make_motion(name, np.random.default_rng(1), 30.0)
    turns = Rotation.from_matrix(made.R_nb)
    step = (turns[:-2].inv() * turns[2:]).as_rotvec() / (2 * motion.STEP_S)
    assert np.max(np.abs(step - made.rate_b[1:-1])) < 1e-5


def test_curves_have_exact_derivatives():
    curve = curves.Curve(
        (curves.Sine(0.7, 0.3, 1.0), curves.Rise(2.0, 1.0, 3.0), curves.Line(1, 2))
    )
    t = np.arange(0, 6, 1e-3)
    value, first, second = curve.at(t)
    assert np.allclose(np.gradient(value, t)[1:-1], first[1:-1], atol=1e-5)
    assert np.allclose(np.gradient(first, t)[1:-1], second[1:-1], atol=1e-5)
    assert value[-1] - value[0] == pytest.approx(2 + 2 * t[-1] + 0.7 * (
        np.sin(0.6 * np.pi * t[-1] + 1) - np.sin(1)
    ))  # fmt: skip


@pytest.mark.parametrize("name", ["wam", "wam_rov", "lawn_mower", "car", "drone", "spin"])
def test_a_null_keeps_the_size_of_the_field(name):
    scene = world.make_world(name, np.random.default_rng(2), 30.0)
    _, mag, _ = sensed(scene)
    h = (mag - scene.hard_iron) @ np.linalg.inv(scene.soft_iron).T
    size = np.linalg.norm(h, axis=1)
    assert np.max(np.abs(size - np.linalg.norm(scene.field_n))) < 1e-9
    assert np.linalg.det(scene.soft_iron) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["wam_rov", "lawn_mower", "car", "drone"])
def test_the_gyro_integrates_to_the_attitude(name):
    scene = world.make_world(name, np.random.default_rng(4), 60.0)
    at, _, gyro = sensed(scene)
    index = np.rint(at / motion.STEP_S).astype(int)
    turns = Rotation.from_matrix(scene.motion.R_nb[index])
    steps = Rotation.from_rotvec((gyro[1:] - scene.gyro_bias) / RATE_HZ)
    reached = turns[0]
    for step in steps:
        reached = reached * step
    assert (reached.inv() * turns[-1]).magnitude() < 2e-5
    one = (turns[:-1].inv() * turns[1:]).as_rotvec() * RATE_HZ + scene.gyro_bias
    assert np.max(np.abs(one - gyro[1:])) < 1e-5


def test_specific_force_at_rest_is_minus_gravity_down():
    made = motion.make_motion("spin", np.random.default_rng(3), 5.0)
    assert np.allclose(np.linalg.norm(made.force_b, axis=1), 9.81, atol=1e-3)
    assert np.all(made.force_b[:, 2] < -9.7)


_AT_ZERO = [
    key
    for key, effect in limits.EFFECTS.items()
    if key not in ("mag_quantisation", "mag_low_pass", "gyro_integration", "earth_rotation")
    and effect.scaled
]


@pytest.mark.parametrize("key", _AT_ZERO)
def test_effect_of_zero_strength_changes_nothing(rov, key):
    _, mag, gyro = sensed(rov)
    _, mag_0, gyro_0 = sensed(rov, key, 0.0)
    assert np.max(np.abs(mag_0 - mag)) < 1e-12
    assert np.max(np.abs(gyro_0 - gyro)) < 1e-12


@pytest.mark.parametrize("key", [k for k, e in limits.EFFECTS.items() if e.scaled])
def test_an_effect_at_its_limit_shows_and_grows_in_proportion(rov, key):
    limit = limits.EFFECTS[key].limit
    none = np.concatenate(sensed(rov)[1:])

    def shown(times):
        stages = chain.Stages()
        limits.EFFECTS[key].make(rov, stages, times * limit, np.random.default_rng(3))
        _, mag, gyro = chain.readings(rov, stages, RATE_HZ)
        return np.linalg.norm(np.concatenate([mag, gyro * (1 + stages.clock_error)]) - none)

    assert shown(1.0) > 0
    if key != "gyro_integration":
        assert shown(2.0) / shown(1.0) == pytest.approx(2.0, rel=0.15)


def test_delay_gives_the_earlier_field(rov):
    at, mag, _ = sensed(rov, "mag_time_lag", 0.040)
    _, now, _ = sensed(rov)
    assert np.allclose(mag[1:], now[:-1], atol=1e-12)  # 25 Hz: 40 ms is one sample
    assert at[1] - at[0] == pytest.approx(0.04)


def test_parameters_in_the_key_are_those_of_the_rows(rov):
    stages = chain.Stages()
    planted = limits.EFFECTS["motor_current_field"].make(
        rov, stages, 2e-3, np.random.default_rng(8)
    )
    at, mag, _ = chain.readings(rov, stages, RATE_HZ)
    field = mag - sensed(rov)[1]
    current = rov.current[np.rint(at / motion.STEP_S).astype(int)]
    per_ampere = np.linalg.lstsq(current[:, None], field, rcond=None)[0][0]
    assert np.allclose(per_ampere, [value for _, value, _ in planted.parameters], rtol=1e-9)
    assert np.linalg.norm(per_ampere) * rov.current.max() == pytest.approx(2e-3)


def test_the_ideal_observer_agrees_with_a_dense_solution():
    rng = np.random.default_rng(0)
    K, step, sigma_m, sigma_g = 40, 0.04, 1e-3, 2e-3
    R = Rotation.from_rotvec(rng.normal(size=(K, 3))).as_matrix()
    h = np.einsum("kji,j->ki", R, [0.2, 0.0, 0.4])
    A = np.diag([1.1, 0.95, 1.0])
    column, gram = ideal.observer(R, h, A, step, sigma_m, sigma_g)
    Z = [column(rng.normal(size=(K, 3)), 0.1 * rng.normal(size=(K, 3))) for _ in range(3)]
    H = np.zeros((3 * K, 3 * K))
    walk = np.kron(np.tril(np.ones((K, K))), np.eye(3)) * sigma_g * step
    for k in range(K):
        cross = np.cross(np.eye(3), h[k]).T  # columns e_j x h
        H[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = A @ -cross @ R[k].T
    noise = sigma_m**2 * np.eye(3 * K) + H @ walk @ walk.T @ H.T
    flat = np.stack([z.ravel() for z in Z], axis=1)
    assert np.allclose(gram(Z), flat.T @ np.linalg.solve(noise, flat), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("most", [1, 3])
def test_unidentifiable_cases_cannot_be_seen_and_others_can(most):
    for n, (key, name, warm) in enumerate(rings.UNIDENTIFIABLE[1 : 1 + most]):
        order = cases.Order("unidentifiable", ((key, 2.0),), motion=name, warm_up_c=warm)
        assert cases.make_case(order, [9, n]).truth["effects"][0]["snr"] < 2
    seen = cases.make_case(cases.Order("single", (("gyro_scale", 2.0),)), [9, 99]).truth
    assert seen["effects"][0]["snr"] >= 2 * cases.SEEN * 0.999
    assert seen["effects"][0]["multiple"] == pytest.approx(2.0)
    # on a part that the calibration has not seen, an effect can only cost more
    samples = seen["duration_s"] * seen["rate_hz"] + 1
    assert seen["oracle_gain_nats_per_sample"] > seen["effects"][0]["snr"] ** 2 / 2 / samples


def test_ring_of_600_has_the_documented_composition():
    orders = rings.orders("full", 600, seed=1)
    counts = {kind: sum(o.kind == kind for o in orders) for kind in rings.FULL}
    assert counts == rings.FULL
    laws = [o.law for o in orders if o.kind == "null"]
    assert {law: laws.count(law) for law in set(laws)} == dict.fromkeys(laws, 30)
    singles = [key for o in orders if o.kind == "single" for key, _ in o.effects]
    assert set(singles) == set(rings.SINGLES)
    assert all(0.5 <= m <= 5 for o in orders for _, m in o.effects)
    assert rings.orders("full", 600, seed=1) == orders != rings.orders("full", 600, seed=2)


def test_every_effect_of_the_contract_is_in_the_ring():
    reference = PROJECT.parent / "shared" / "reference" / "contract.md"
    if not reference.exists():
        pytest.skip("the contract is not beside the project")
    text = reference.read_text().split("Effect identifiers")[1].split("\n## ")[0]
    listed = {w for w in text.split("`")[1::2] if w.isidentifier() and "_" in w} | {"hysteresis"}
    named = {limits.EFFECTS[key].identifier for key in rings.SINGLES}
    assert listed == named


@pytest.mark.slow
def test_same_seed_same_bytes_and_no_label(tmp_path):
    """Once as a whole, once in parts, as `challenge make` has it made by several processes."""
    for folder, parts in (("a", (None,)), ("b", ((1, 2), (0, 1)))):
        keys = [make_ring("singles", 2, 7, tmp_path / folder, None, part) for part in parts]
        key = sorted((one for key in keys for one in key), key=lambda one: one["id"])
        (tmp_path / f"{folder}.json").write_text(json.dumps(key))
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 4
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert (tmp_path / "a.json").read_text() == (tmp_path / "b.json").read_text()
    known = {"time_s", *(c for group in limits.GROUPS.values() for c in group)}
    known |= {
        v.format(a) for v in ("mag_{}_gauss", "gyro_{}_rad_s", "accel_{}_m_s2") for a in "xyz"
    }
    for file in files:
        if file.suffix == ".gz":
            data = (tmp_path / "a" / file).read_bytes()
            assert data[3] == 0 and data[4:8] == b"\0\0\0\0"  # no name, no time
            assert set(gzip.decompress(data).split(b"\n", 1)[0].decode().split(",")) <= known
        else:
            spec = json.loads((tmp_path / "a" / file).read_text())
            assert set(spec) <= {"rate_hz", "sigma_mag_gauss", "sigma_gyro_rad_s", "field_gauss"}


@pytest.mark.slow
def test_withheld_column_is_missing():
    order = cases.Order("withheld", (("motor_current_field", 2.0),), withheld="motor")
    made = cases.make_case(order, [4, 4])
    assert not set(limits.GROUPS["motor"]) & set(made.rows.columns)
    table = np.genfromtxt(
        io.BytesIO(gzip.decompress(csv_bytes(made.rows))), delimiter=",", names=True
    )
    assert np.allclose(table["mag_x_gauss"], made.rows.mag[:, 0], atol=1e-7)
    assert len(table) == made.truth["duration_s"] * made.truth["rate_hz"] + 1
