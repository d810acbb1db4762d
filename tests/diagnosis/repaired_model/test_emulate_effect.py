"""`ahrsd emulate --effect`: the emulated device's readings contain the effect along its motion."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.diagnosis.repaired_model.injection import PIECE_S, EmulatedEffects
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.emulator.scenarios import Setup, build

SETUP = Setup("wam", seed=5, output="binary", rate_hz=20, motion="wam-rov")


def columns(device, seconds, *names):
    rows = [decode(frame) for frame in Deframer().feed(device.advance(seconds))]
    good = [row for row in rows if isinstance(row, Measurement)]
    index = [good[0].layout.index(name) for name in names]
    return np.array([[row.values[i] for i in index] for row in good])


def sensors(device, seconds):
    names = [f"uncomp_{what}" for what in ("mag_x_gauss", "mag_y_gauss", "mag_z_gauss")]
    names += [f"uncomp_gyro_{axis}_rad_s" for axis in "xyz"]
    values = columns(device, seconds, "time_startup_s", *names)
    return values[:, 0], values[:, 1:4], values[:, 4:]


def test_misaligned_device_reads_the_rotated_field():
    wanted = ["mag_gyro_misalignment=angle_x=0.1,angle_z=-0.05"]
    _, mag, gyro = sensors(build(SETUP, EmulatedEffects(SETUP, wanted)), 20.0)
    plain = build(SETUP)
    _, before, gyro_before = sensors(plain, 20.0)
    truth = plain.truth
    field = np.linalg.solve(truth.soft_iron, (before - truth.hard_iron_gauss).T)
    turned = (truth.soft_iron @ so3.exp(np.array([0.1, 0.0, -0.05])) @ field).T
    # the noise of 2 mG is the same in both; rotated, it differs by a tenth
    assert mag == pytest.approx(turned + truth.hard_iron_gauss, abs=2e-3)
    assert np.abs(mag - before).max() > 0.02
    assert np.array_equal(gyro, gyro_before)


@pytest.mark.slow
def test_gyro_bias_follows_the_temperature_of_the_emulated_device():
    wanted = ["gyro_bias_temperature=bias_per_degree_y=0.001"]
    device = build(SETUP, EmulatedEffects(SETUP, wanted))
    temperature = columns(device, 400.0, "temperature_c")[:, 0]
    _, _, gyro = sensors(build(SETUP, EmulatedEffects(SETUP, wanted)), 400.0)
    _, _, before = sensors(build(SETUP), 400.0)
    added = gyro - before
    assert np.abs(added[:, [0, 2]]).max() < 1e-6
    slope = np.polyfit(temperature - temperature[0], added[:, 1], 1)[0]
    assert slope == pytest.approx(1e-3, rel=0.02)


def test_effect_at_an_instant_does_not_depend_on_how_instants_are_grouped():
    wanted = ["viscous_magnetisation", "hysteresis", "motor_current_field=2"]
    time_s = np.arange(PIECE_S - 5, PIECE_S + 5, 1 / 800)
    at_once = EmulatedEffects(SETUP, wanted).at(time_s)
    bit_by_bit = EmulatedEffects(SETUP, wanted)
    parts = [bit_by_bit.at(part) for part in np.split(time_s, 40)]
    for side in (0, 1):
        assert np.array_equal(at_once[side], np.vstack([part[side] for part in parts]))
    # pieces are continuous: a memory of two minutes is enough for these effects
    step = np.abs(np.diff(at_once[0], axis=0)).max(axis=1)
    border = np.searchsorted(time_s, PIECE_S)
    assert step[border - 2 : border + 2].max() < 3e-4


def test_effect_before_the_start_equals_that_at_the_start():
    effects = EmulatedEffects(SETUP, ["motor_current_field"])
    past, start = effects.at(np.array([-1.0, -0.5])), effects.at(np.zeros(2))
    assert np.array_equal(past[0], start[0])


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("mag_saturation", "mag_saturation cannot be emulated; there are hard_iron_step"),
        ("noise_burst", "noise_burst cannot be emulated"),
        ("magic", "no effect 'magic'"),
    ],
)
def test_effect_that_cannot_be_emulated_is_refused_in_one_line(run, capsys, wanted, message):
    assert run("emulate", "--effect", wanted) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
