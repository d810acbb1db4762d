"""How far an injected effect stands out of a recording's own remainder, and what is injected."""

from pathlib import Path

import numpy as np
import pytest
from blind_trials.world import (
    bases,
    cases,
    chain,
    ideal,
    injected,
    limits,
    remainder,
    semireal,
    world,
)
from blind_trials.world.rotations import turned
from scipy.spatial.transform import Rotation

RECORDINGS = Path(__file__).parents[3] / "shared" / "recordings"
RATE_HZ, SIGMA_MAG, SIGMA_GYRO = 25.0, 1e-3, 5e-4
KEYS = (
    "mag_time_lag", "mag_gyro_misalignment", "gyro_scale", "hard_iron_step", "gyro_bias_step",
    "motor_current_field", "switched_device", "mag_bias_temperature",
)  # fmt: skip


class Simulated:
    """A recording with white noise, the differences of KEYS, and what `ideal` says of them."""

    def __init__(self, motion):
        scene = world.make_world(motion, np.random.default_rng(3), 240.0)
        self.at, mag, gyro = chain.readings(scene, chain.Stages(), RATE_HZ)
        rng = np.random.default_rng(8)
        self.mag = mag + SIGMA_MAG * rng.normal(size=mag.shape)
        self.gyro = gyro + SIGMA_GYRO * rng.normal(size=mag.shape)
        self.differences = []
        for key in KEYS:
            made = cases._alone(key, scene, limits.EFFECTS[key].limit, [1, 2], RATE_HZ)
            self.differences.append((made[0] - mag, made[1] - gyro))
        index = np.rint(self.at * 1000).astype(int)
        h_b = chain.body_field(scene, chain.Stages())[index]
        R_nb, A = scene.motion.R_nb[index], scene.soft_iron
        column, gram = ideal.observer(R_nb, h_b, A, 1 / RATE_HZ, SIGMA_MAG, SIGMA_GYRO)
        others = ideal.nuisances(column, R_nb, h_b, A)
        self.ideal = ideal.signal_to_noise(gram, [column(*d) for d in self.differences], others)
        self.world = scene


@pytest.fixture(scope="module", params=["drone", pytest.param("wam_rov", marks=pytest.mark.slow)])
def simulated(request):
    return Simulated(request.param)


def test_attitudes_are_the_product_of_the_turns():
    rng = np.random.default_rng(0)
    gyro, steps = rng.normal(size=(20, 3)), rng.uniform(0.01, 0.5, 20)
    reached = Rotation.identity()
    for k, R in enumerate(remainder.attitudes(gyro, steps)):
        if k:
            reached = reached * Rotation.from_rotvec(gyro[k] * steps[k])
        assert np.allclose(R, reached.as_matrix(), atol=1e-12)


def test_the_spectrum_of_a_walk_and_white_noise():
    rng, K = np.random.default_rng(2), 6000
    ratios = []
    for _ in range(6):
        noise = 1e-3 * rng.normal(size=(K, 3)) + 3e-5 * np.cumsum(rng.normal(size=(K, 3)), axis=0)
        true = 1e-6 + 9e-10 / remainder.eigenvalues(K)[:, None]
        inverse = true / remainder.spectrum(remainder._transformed(noise))
        ratios.append([np.mean(inverse[a:b]) for a, b in ((0, 14), (14, 200), (200, K))])
    assert np.allclose(np.mean(ratios, axis=0), 1.0, atol=[0.3, 0.1, 0.03])


def test_bands_cover_everything_once():
    for count in (9, 30, 31, 5000):
        edges = remainder.bands(count)
        assert edges[0] == 0 and edges[-1] == count
        assert np.min(np.diff(edges)) >= min(count, 14)


def test_noise_that_is_turned_does_not_show(simulated):
    """All is turned by half a radian once, before the first reading: nothing tells of it."""
    own = remainder.fit(simulated.at, simulated.mag, simulated.gyro)
    once = np.zeros_like(simulated.gyro)
    once[0] = np.array([0.3, -0.4, 0.0]) / own.steps_s[0]
    assert own.signal_to_noise(np.zeros_like(simulated.mag), once) < 3.0


def test_signal_to_noise_is_the_ideal_observers_where_noise_is_white(simulated):
    own = remainder.fit(simulated.at, simulated.mag, simulated.gyro)
    ratio = np.array([own.signal_to_noise(*d) for d in simulated.differences]) / simulated.ideal
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)
    assert np.all(np.abs(np.log(ratio)) < np.log(1.5))
    size = np.linalg.norm(np.mean(own.world, axis=0)) / np.linalg.norm(simulated.world.field_n)
    shape = own.inverse @ simulated.world.soft_iron * size
    assert np.allclose(shape / np.cbrt(np.linalg.det(shape)), np.eye(3), atol=0.02)
    assert abs(own.own_delay_s) < 1e-3


def test_visibility_ignores_calibration_and_axes(simulated):
    own = remainder.fit(simulated.at, simulated.mag, simulated.gyro)
    none, one = np.zeros_like(simulated.mag), np.ones_like(simulated.mag)
    assert own.signal_to_noise(one * [1e-3, -2e-3, 0], none) < 0.1
    assert own.signal_to_noise(none, 1e-4 * one) < 0.1
    mag, gyro = simulated.differences[0]
    angle = np.array([0.3, -1.0, 2.0])
    other = remainder.fit(simulated.at, turned(simulated.mag, angle), turned(simulated.gyro, angle))
    there = other.signal_to_noise(turned(mag, angle), turned(gyro, angle))
    assert there == pytest.approx(own.signal_to_noise(mag, gyro), rel=0.02)


def test_own_remainder_of_a_recording_is_near_one_for_stationary_noise(simulated):
    own = remainder.fit(simulated.at, simulated.mag, simulated.gyro)
    none = np.zeros_like(simulated.mag)
    late = (simulated.at > np.mean(simulated.at))[:, None]
    steps = [late * step for step in 1e-3 * np.eye(3)]
    assert np.sqrt(np.mean([own.score(step, none) ** 2 for step in steps])) < 2
    moved = remainder.fit(simulated.at, simulated.mag + 20 * steps[2], simulated.gyro)
    assert moved.score(steps[2], none) > 5


def test_own_delay_of_a_recording_is_found_and_not_counted_as_noise(simulated):
    own = remainder.fit(simulated.at, simulated.mag, simulated.gyro)
    late = np.array(
        [np.interp(simulated.at - 0.02, simulated.at, column) for column in simulated.mag.T]
    ).T
    delayed = remainder.fit(simulated.at, late, simulated.gyro)
    assert delayed.own_delay_s - own.own_delay_s == pytest.approx(0.02, abs=1e-3)
    pair = simulated.differences[3]
    assert delayed.signal_to_noise(*pair) > 0.7 * own.signal_to_noise(*pair)


def test_every_variant_has_its_control_and_the_seed_decides():
    plan = semireal.plan(60, 5)
    assert len(plan) == 60
    variants = {variant for variant, _ in plan}
    assert {variant for variant, keys in plan if not keys} == variants
    assert len({variant.name for variant in variants}) == len(variants) == 10
    first = [(variant.name, keys[0]) for variant, keys in plan if keys]
    assert {key for _, key in first} == set(injected.INJECTED)
    assert len(set(first)) == len(first) == 50  # none twice in a variant
    counts = [[key for _, key in first].count(key) for key in injected.INJECTED]
    assert max(counts) - min(counts) <= 2
    assert semireal.plan(60, 5) == plan != semireal.plan(60, 6)


_CIRCLES = next(base for base in bases.BASES if "circles_2022" in base.file)


@pytest.fixture
def variant(recordings):
    return bases.Variant(_CIRCLES, 1, 77)


@pytest.mark.slow
def test_injections_on_real_recordings_are_exact(variant):
    plain, spec, truth = semireal.make_semireal(RECORDINGS, variant, (), [1])
    assert (truth["kind"], truth["effects"]) == ("control", [])
    assert spec == {"rate_hz": pytest.approx(40, abs=0.1)}
    rows, _, truth = semireal.make_semireal(RECORDINGS, variant, ("motor_current_field",), [1])
    effect = truth["effects"][0]
    per_ampere = [p["value"] for p in effect["parameters"]]
    added = np.outer(rows.columns["motor_current_a"], per_ampere)
    assert np.allclose(rows.mag - plain.mag, added, atol=1e-12)
    assert np.array_equal(rows.gyro, plain.gyro)
    own = remainder.fit(plain.time_s, plain.mag, plain.gyro)
    seen = own.signal_to_noise(rows.mag - plain.mag, rows.gyro - plain.gyro)
    assert 0.4 * seen < effect["snr"] <= seen * (1 + 1e-9)
    at_limit = effect["snr"] / effect["multiple"]
    assert at_limit == pytest.approx(cases.SEEN) or effect["limit"] == 4e-3
    assert 0.5 <= effect["multiple"] <= 8


def test_an_effect_that_cannot_be_seen_is_replaced(variant):
    # the car's donuts turn about one axis: no two of the other axes can be told apart
    keys = ("frame_error", "gyro_g_sensitivity", "hard_iron_step")
    _, _, truth = semireal.make_semireal(RECORDINGS, variant, keys, [2])
    effect = truth["effects"][0]
    assert effect["source"] == "hard_iron_step"
    assert effect["strength"] <= injected.INJECTED["hard_iron_step"].most
