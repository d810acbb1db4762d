"""The emulated world against arithmetic that shares nothing with it."""

import math

import numpy as np
import pytest

from drivers.vn100.emulator.physics import (
    BLOCK_TICKS,
    HISTORY_TICKS,
    MOTIONS,
    TICK_HZ,
    TRANSITION_S,
    YAW,
    Dipole,
    EmulatedTruth,
    EmulatedWorld,
    IronStep,
    Stops,
    draw_truth,
    euler_angles,
    field_from,
    make_motion,
    matrices,
    quaternion_of,
    quaternions,
)


def matrix(roll, pitch, yaw):
    """R_nb by multiplying three elementary rotations."""
    c, s = math.cos, math.sin
    about_x = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    about_y = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    about_z = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def exponential(vector):
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def quiet(**changes):
    """A truth without noise."""
    return EmulatedTruth(
        noise_mag_gauss=0, noise_gyro_rad_s=0, noise_accel_m_s2=0, clock_jitter_s=0, **changes
    )


def blocks(truth, motion, count, seed=0, disturbances=()):
    world = EmulatedWorld(truth, motion, seed, disturbances)
    return [world.next_block() for _ in range(count)]


def test_attitude_conventions():
    angles = np.array([[0.3, -0.4, 2.0], [-3.0, 1.5, -3.1], [0, 0, 0]])
    for row, R in zip(angles, matrices(quaternions(angles)), strict=True):
        np.testing.assert_allclose(R, matrix(*row), atol=1e-15)
        np.testing.assert_allclose(np.abs(quaternion_of(R) @ quaternions(row[None])[0]), 1.0)
    np.testing.assert_allclose(euler_angles(matrices(quaternions(angles))), angles, atol=1e-12)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("step", [1, 16, 20])
def test_mean_rates_integrate_to_the_attitude(name, step):
    """Exp(w dt) of every output step, multiplied, is the change of attitude: no coning is lost."""
    made = blocks(quiet(), make_motion(name, 5), 40)
    rates = np.vstack([block.rates(step) for block in made])[step - 1 :: step]
    start = matrices(made[0].q_nb[HISTORY_TICKS - 1 :][:1])[0]  # one tick before the first
    end = matrices(made[-1].q_nb[-1:])[0]
    assert len(rates) == 40 * BLOCK_TICKS // step
    R = start
    for rate in rates:
        R = R @ exponential(rate * step / TICK_HZ)
    np.testing.assert_allclose(R, end, atol=1e-9)


def test_field_reading_is_a_h_plus_b():
    soft = np.array([[1.1, 0.1, 0.04], [-0.02, 0.88, 0.02], [0.03, 0.0, 1.22]])
    hard = np.array([0.02, -0.12, 0.09])
    truth = quiet(soft_iron=soft, hard_iron_gauss=hard, field_n_gauss=np.array([0.2, 0.05, 0.4]))
    motion = make_motion("tumble", 3)
    block = blocks(truth, motion, 3)[2]
    for row in (0, 77, 199):
        R = matrix(*motion.angles(np.array([(400 + row) / 800]))[0])
        expected = soft @ (R.T @ np.array([0.2, 0.05, 0.4])) + hard
        np.testing.assert_allclose(block.field()[row], expected, atol=1e-12)
        np.testing.assert_allclose(block.accel_m_s2[row], R.T @ [0, 0, -9.79375], atol=1e-12)


def test_field_from_inclination():
    np.testing.assert_allclose(field_from(0.5, 60), [0.25, 0, 0.5 * math.sqrt(3) / 2])
    assert math.isclose(np.linalg.norm(field_from(0.49, -35, 12)), 0.49)


def test_noise_has_the_stated_deviation():
    truth = EmulatedTruth()
    made = blocks(truth, make_motion("static", 0), 100)
    field = np.vstack([block.field() for block in made])
    rate = np.vstack([block.rates(16) for block in made])
    accel = np.vstack([block.accel_m_s2 for block in made])
    np.testing.assert_allclose(field.std(axis=0), 2e-3, rtol=0.03)
    np.testing.assert_allclose(rate.std(axis=0), 8e-4, rtol=0.03)
    np.testing.assert_allclose(accel.std(axis=0), 0.015, rtol=0.03)


def test_register_85_mean_is_a_running_mean():
    made = blocks(EmulatedTruth(), make_motion("tumble", 0), 5)
    field = np.vstack([block.field() for block in made])
    smooth = np.vstack([block.field(8) for block in made])
    for row in (8, 199, 200, 733):
        np.testing.assert_allclose(smooth[row], field[row - 7 : row + 1].mean(axis=0), atol=1e-12)


def test_gyro_bias_and_its_walk():
    bias = np.array([4e-3, -5e-3, 2e-3])
    still = blocks(quiet(gyro_bias_rad_s=bias), make_motion("static", 0), 4)
    np.testing.assert_allclose(still[3].rates(8), np.tile(bias, (BLOCK_TICKS, 1)), atol=1e-15)
    walking = quiet(gyro_bias_rad_s=bias, gyro_walk_rad_s_rts=1e-3)
    ends = [
        blocks(walking, make_motion("static", 0), 16, seed)[-1].bias_rad_s[-1] - bias
        for seed in range(100)
    ]
    assert np.std(ends) == pytest.approx(1e-3 * math.sqrt(4.0), rel=0.15)


def test_saturation_clips():
    truth = quiet(hard_iron_gauss=np.array([3.0, 0, 0]))
    assert blocks(truth, make_motion("static", 0), 1)[0].field()[:, 0].max() == 2.5


def test_same_seed_same_world_other_seed_other_world():
    first, again = (
        blocks(EmulatedTruth(), make_motion("survey", 1), 5, seed=7)[4] for _ in range(2)
    )
    other = blocks(EmulatedTruth(), make_motion("survey", 1), 5, seed=8)[4]
    assert np.array_equal(first.mag_gauss, again.mag_gauss)
    assert np.array_equal(first.gyro_extra_rad_s, again.gyro_extra_rad_s)
    assert not np.array_equal(first.mag_gauss, other.mag_gauss)


def test_dipole_acts_while_it_passes_and_by_the_law():
    motion, still = make_motion("static", 0), quiet()
    made = blocks(still, motion, 12, disturbances=(Dipole(1.0, 1.0, 5.0),))
    field = np.vstack([block.field() for block in made])
    change = np.linalg.norm(field - field[0], axis=1)
    assert np.all(change[:800] == 0) and np.all(change[1601:] == 0)
    r, moment = np.array([0, 0.25, 0.166]), np.array([0, 0, 5.0])
    distance = np.linalg.norm(r)
    nearest = 1e-7 * (3 * r * (r @ moment) / distance**5 - moment / distance**3) * 1e4  # tesla to G
    np.testing.assert_allclose(field[1200] - field[0], nearest, rtol=1e-9)


def test_iron_step_stays():
    made = blocks(quiet(), make_motion("static", 0), 8, disturbances=(IronStep(1.0, 0.1),))
    field = np.vstack([block.field() for block in made])
    np.testing.assert_allclose(field[799], field[0])
    np.testing.assert_allclose(field[800] - field[0], [0.1, -0.05, 0], atol=1e-12)


def test_stops_stand_still_regularly_and_move_smoothly():
    stops = Stops(50.0, 7.0, 1.5)
    time_s = np.arange(0, 150, 0.01)
    moving = stops.moving_time(time_s)
    speed = np.diff(moving) / 0.01
    assert np.all(speed > -1e-9) and speed.max() == pytest.approx(1.0, abs=1e-9)
    assert np.abs(np.diff(speed)).max() < 0.02
    still = (time_s[1:] % 50 > 43.01) & (time_s[1:] % 50 < 49.99)
    np.testing.assert_allclose(speed[still], 0.0, atol=1e-9)
    assert moving[-1] == pytest.approx(3 * (50 - 7 - 1.5), abs=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_survey_has_tilt_turns_and_still_periods(seed):
    time_s = np.arange(0, 240, 0.05)
    angles = np.degrees(make_motion("survey", seed).angles(time_s))
    assert 25 < np.abs(angles[:, :2]).max() <= 35.0
    assert np.ptp(angles[:, YAW]) > 360
    turning = np.abs(np.diff(angles, axis=0)).max(axis=1) > 1e-9
    longest = max(len(run) for run in "".join("m" if m else "s" for m in turning).split("m"))
    assert longest * 0.05 >= 5.0
    rates = blocks(quiet(), make_motion("survey", seed), 400)
    assert max(np.abs(block.rates(16)).max() for block in rates) < 1.0


@pytest.mark.parametrize(
    ("name", "half_ranges"), [("wam", (180, 180, 180)), ("mam", (5, 45, 180)), ("lam", (5, 15, 90))]
)
@pytest.mark.parametrize("variant", ["", "-rov"])
def test_half_ranges_of_the_simulated_experiment(name, half_ranges, variant):
    angles = make_motion(name + variant, 2).angles(np.arange(0, 4000, 0.5))
    np.testing.assert_allclose(np.degrees(np.abs(angles).max(axis=0)), half_ranges, rtol=0.01)


def test_phases_join_smoothly():
    motion = make_motion([("tumble", 20.0), ("planar", 30.0), ("static", 1.0)], 4)
    time_s = np.arange(0, 80, 0.01)
    R = matrices(quaternions(motion.angles(time_s)))
    turned = np.einsum("kji,kjl->kil", R[:-1], R[1:])
    angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.degrees(angle.max()) / 0.01 < 180  # degrees per second: no jump anywhere
    end = 20 + 30 + 2 * TRANSITION_S
    np.testing.assert_allclose(np.ptp(R[time_s > end], axis=0), 0, atol=1e-12)


def test_unknown_motion_names_the_known_ones():
    with pytest.raises(ValueError, match=r"no motion 'hover'; there are wam, .*static"):
        make_motion("hover", 0)


@pytest.mark.parametrize("seed", range(20))
def test_drawn_truth_is_worth_finding_and_can_be_undone(seed):
    truth = draw_truth(seed)
    assert np.linalg.det(truth.soft_iron) == pytest.approx(1.0)
    assert np.linalg.eigvalsh(truth.soft_iron)[0] > 0.5
    np.testing.assert_array_equal(truth.soft_iron, truth.soft_iron.T)
    assert truth.heading_error_deg(np.eye(3), np.zeros(3)) > 10
    perfect = truth.heading_error_deg(np.linalg.inv(truth.soft_iron), truth.hard_iron_gauss)
    assert perfect < 1e-9
