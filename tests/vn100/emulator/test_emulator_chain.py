"""Each stage of the compensation chain against arithmetic written out here."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.vn100.emulator.chain import (
    BIAS_S,
    ChainSettings,
    FilterState,
    OnBoardHsi,
    SensorOutputs,
)
from drivers.vn100.emulator.physics import (
    BLOCK_TICKS,
    EmulatedTruth,
    EmulatedWorld,
    SensorBlock,
    make_motion,
)

EYE = (np.eye(3), np.zeros(3))
PLAIN = ChainSettings(EYE, EYE, EYE, np.eye(3), None, np.array([0.245, 0, 0.424]))
SKEWED = (np.array([[1.02, 0.01, 0], [0.01, 0.98, 0], [0, 0, 1.01]]), np.array([0.05, -0.03, 0.1]))
TURNED = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x of the output is y of the sensor


def block(motion="tumble", number=1, **truth):
    world = EmulatedWorld(EmulatedTruth(**truth), make_motion(motion, 1), 1)
    return [world.next_block() for _ in range(number)][-1]


def with_field(made: SensorBlock, field) -> SensorBlock:
    return replace(made, mag_gauss=np.tile(field, (len(made.mag_gauss), 1)))


def test_worked_example_of_5_2():
    made = with_field(block(), [0.25, 0.10, 0.50])
    out = SensorOutputs(made, replace(PLAIN, mag=SKEWED), FilterState())
    for name in ("uncomp_mag", "mag"):
        np.testing.assert_allclose(out.quantity(name)[7], [0.2053, 0.1294, 0.4040], atol=1e-12)


def test_rotation_acts_behind_the_calibration():
    """With R = diag(-1,1,-1) a bias in register 23 moves the output by -R C b (5.3, measured)."""
    R = np.diag([-1.0, 1, -1])
    made = with_field(block(), [0.25, 0.10, 0.50])
    without = SensorOutputs(
        made, replace(PLAIN, mag=(SKEWED[0], np.zeros(3)), rotation=R), FilterState()
    )
    moved = SensorOutputs(made, replace(PLAIN, mag=SKEWED, rotation=R), FilterState())
    shift = moved.quantity("uncomp_mag")[0] - without.quantity("uncomp_mag")[0]
    np.testing.assert_allclose(shift, [0.0507, 0.0289, 0.1010], atol=1e-12)


def test_hsi_acts_on_the_compensated_field_only_and_last():
    hsi = (np.diag([2.0, 1.0, 0.5]), np.array([0.1, 0.0, 0.0]))
    made = with_field(block(), [0.25, 0.10, 0.50])
    out = SensorOutputs(made, replace(PLAIN, mag=SKEWED, rotation=TURNED, hsi=hsi), FilterState())
    np.testing.assert_allclose(out.quantity("uncomp_mag")[0], [0.1294, -0.2053, 0.4040], atol=1e-12)
    expected = [2 * (0.1294 - 0.1), -0.2053, 0.5 * 0.4040]
    np.testing.assert_allclose(out.quantity("mag")[0], expected, atol=1e-12)


def test_gyro_and_accel_registers_and_rotation():
    made = block()
    out = SensorOutputs(
        made, replace(PLAIN, gyro=SKEWED, accel=SKEWED, rotation=TURNED), FilterState()
    )
    read, accel = made.rates(16)[50], made.accel_m_s2[50]
    C, B = SKEWED
    for seen, raw in ((out.rates(16)[50], read), (out.quantity("uncomp_accel")[50], accel)):
        y, x, z = C @ (raw - B) * [-1, 1, 1]
        np.testing.assert_allclose(seen, [x, y, z], atol=1e-12)
    np.testing.assert_array_equal(out.quantity("accel"), out.quantity("uncomp_accel"))


def test_filter_bias_converges_and_is_subtracted_from_angular_rate_only():
    bias = np.array([0.004, -0.005, 0.002])
    world = EmulatedWorld(EmulatedTruth(gyro_bias_rad_s=bias), make_motion("static", 1), 1)
    state = FilterState()
    for number in range(1, 121):  # thirty seconds
        out = SensorOutputs(world.next_block(), PLAIN, state)
        difference = out.rates(16)[-1] - out.compensated_rates(16)[-1]
        expected = bias * (1 - math.exp(-number * 0.25 / BIAS_S))
        np.testing.assert_allclose(difference, expected, atol=1e-12)
        state = out.end_state()


def test_register_85_window_smooths_the_selected_quantities():
    made = block(number=5)
    out = SensorOutputs(made, replace(PLAIN, windows=(0, 8)), FilterState())
    field = made.field()
    np.testing.assert_array_equal(out.quantity("uncomp_mag"), field)
    np.testing.assert_allclose(out.quantity("mag")[60], field[53:61].mean(axis=0), atol=1e-12)


def test_heading_shows_the_iron_and_recovers_with_the_registers():
    """Level and at rest the yaw is off by what the uncorrected field's direction says."""
    hard = np.array([0.03, -0.12, 0.05])
    truth = EmulatedTruth(hard_iron_gauss=hard, noise_mag_gauss=0.0)
    motion = make_motion("static", 1)
    yaw = motion.angles(np.zeros(1))[0, 2]
    made = EmulatedWorld(truth, motion, 1).next_block()
    off = SensorOutputs(made, PLAIN, FilterState())
    right = SensorOutputs(made, replace(PLAIN, mag=(np.eye(3), hard)), FilterState())
    assert right.quantity("ypr")[-1, 0] == pytest.approx(yaw, abs=1e-9)
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = 0.245 * c + 0.03, -0.245 * s - 0.12  # tilt of this static attitude is below 3 degrees
    assert off.quantity("ypr")[-1, 0] == pytest.approx(math.atan2(-y, x), abs=math.radians(4))
    assert abs(off.quantity("ypr")[-1, 0] - yaw) > math.radians(10)


def test_attitude_quantities_belong_together():
    out = SensorOutputs(block("tumble", 3), replace(PLAIN, rotation=TURNED), FilterState())
    mag, R = out.quantity("mag")[9], out.R_nu[9]
    np.testing.assert_allclose(R @ mag, out.quantity("mag_ned")[9], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    still = out.quantity("linear_accel_ned").mean(axis=0)
    np.testing.assert_allclose(still, [0, 0, 0], atol=0.005)
    np.testing.assert_allclose(out.quantity("accel_ned").mean(axis=0)[2], -9.79375, atol=0.005)
    x, y, z, w = out.q_nu[9]
    np.testing.assert_allclose(
        R[0], [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], atol=1e-12
    )


def test_saturation_flags():
    out = SensorOutputs(block(hard_iron_gauss=np.array([0.0, 4.0, 0])), PLAIN, FilterState())
    assert set(out.saturation().tolist()) == {2.0}


def test_on_board_hsi_finds_the_iron():
    soft = np.array([[1.05, 0.05, 0], [0.05, 0.97, 0.02], [0, 0.02, 1.0]])
    hard = np.array([0.1, -0.08, 0.05])
    world = EmulatedWorld(
        EmulatedTruth(soft_iron=soft, hard_iron_gauss=hard), make_motion("tumble", 1), 1
    )
    hsi = OnBoardHsi()
    spread = []
    for _ in range(160):
        field = world.next_block().field()[::40]
        hsi.add(field, 5, 0.05)
        length = np.linalg.norm((field - hsi.offset) @ hsi.matrix.T, axis=1)
        spread.extend(length - 0.49)
    np.testing.assert_allclose(hsi.offset, hard, atol=0.005)
    assert np.std(spread[-100:]) < 0.005
    assert np.std(spread[:10]) > 0.01
    hsi.reset()
    np.testing.assert_array_equal(hsi.matrix, np.eye(3))


def test_on_board_hsi_does_not_change_at_rest():
    world = EmulatedWorld(
        EmulatedTruth(hard_iron_gauss=np.array([0.1, 0, 0])), make_motion("static", 1), 1
    )
    hsi = OnBoardHsi()
    for _ in range(80):
        hsi.add(world.next_block().field()[::40], 5, 0.05)
    assert np.linalg.norm(hsi.offset) < 0.01
    np.testing.assert_allclose(hsi.matrix, np.eye(3), atol=0.01)


def test_outputs_have_a_row_per_tick():
    out = SensorOutputs(block(), PLAIN, FilterState())
    for name in ("uncomp_mag", "ypr", "linear_accel_body", "mag_ned"):
        assert out.quantity(name).shape == (BLOCK_TICKS, 3)
    with pytest.raises(KeyError):
        out.quantity("flux")
