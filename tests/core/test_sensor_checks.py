"""A stuck or saturated sensor, a wrong unit and a wrong sign are reported, a sound sensor is
not.
"""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.core.sensor_checks import SensorChecks, SensorLimits
from ahrsd.events import Noted
from ahrsd.inputs import RegistersKnown, Samples
from ahrsd.recording.capture import to_json
from ahrsd.samples import SampleBlock
from ahrsd.so3 import exp
from ahrsd.telemetry.status import LinkFacts, StatusMaker
from ahrsd.telemetry.words import explain_json, explain_lines, status_lines
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode

RATE_HZ = 40.0
FIELD = np.array([0.22, 0.02, 0.42])
IRON = np.array([[1.15, 0.05, -0.04], [0.05, 0.95, 0.03], [-0.04, 0.03, 0.9]])
OFFSET = np.array([0.21, -0.17, 0.3])
BIAS = np.array([0.01, -0.02, 0.015])


def motion(kind, seconds):
    """Rates (N, 3) of the body, rad/s."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    if kind == "rest":
        return np.zeros((len(t), 3))
    if kind == "planar":
        return np.column_stack([0 * t, 0 * t, 0.25 + 0.1 * np.sin(0.3 * t)])
    return np.column_stack([0.5 * np.sin(0.7 * t), 0.6 * np.cos(0.5 * t), 0.4 + 0 * t])


def stream(kind="3D", seconds=90.0, seed=1, noise=1.0):
    return tuple(part.copy() for part in made(kind, seconds, seed, noise))


@cache
def made(kind, seconds, seed, noise):
    """time_s, raw field, raw rate: a sensor with iron and bias, and with noise."""
    rates = motion(kind, seconds)
    R, fields = np.eye(3), []
    for w in rates:
        R = R @ exp(w / RATE_HZ)
        fields.append(IRON @ (R.T @ FIELD) + OFFSET)
    random = np.random.default_rng(seed)
    field = np.array(fields) + noise * 1.5e-3 * random.standard_normal((len(rates), 3))
    gyro = rates + BIAS + noise * 1e-3 * random.standard_normal((len(rates), 3))
    return np.arange(1, len(rates) + 1) / RATE_HZ, field, gyro


def said(time_s, field, gyro, rows=10):
    checks, told = SensorChecks(), []
    for a in range(0, len(time_s), rows):
        part = slice(a, a + rows)
        dt_s = np.full(len(time_s[part]), 1 / RATE_HZ)
        if a == 0:
            dt_s[0] = np.nan
        block = SampleBlock(
            time_s[part], dt_s, time_s[part], field[part], gyro[part],
            np.full((len(dt_s), 3), np.nan), gap_before=a == 0,
        )  # fmt: skip
        told += checks.take(block)
    return checks, told


@pytest.mark.parametrize("kind", ["rest", "planar", "3D"])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))]
)
def test_nothing_is_reported_for_a_sound_sensor(kind, seed):
    checks, told = said(*stream(kind, seed=seed))
    assert told == []
    assert checks.findings == {}


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param(kind, seed, marks=() if k == seed else pytest.mark.slow)
        for k, kind in enumerate(("xy", "xz", "yz"))
        for seed in range(3)
    ],
)
def test_soft_iron_with_turns_about_one_axis_is_not_a_wrong_sign(kind, seed):
    """Soft iron makes the turn look like a large one about the other axes, in both directions."""
    iron = np.eye(3)
    i, j = ("xyz".index(axis) for axis in kind)
    iron[i, j] = iron[j, i] = 0.1
    rates = motion("planar", 90.0)
    t = np.arange(len(rates)) / RATE_HZ
    rates += 0.008 * np.column_stack([np.sin(1.3 * t), np.cos(1.1 * t), 0 * t])  # it rocks a little
    random = np.random.default_rng(seed)
    for sign in (1.0, -1.0):
        R, fields = np.eye(3), []
        for w in rates:
            R = R @ exp(w / RATE_HZ)
            fields.append((np.eye(3) + sign * (iron - np.eye(3))) @ (R.T @ FIELD) + OFFSET)
        field = np.array(fields) + 1e-3 * random.standard_normal((len(rates), 3))
        gyro = rates + 0.3 * BIAS + 1e-3 * random.standard_normal((len(rates), 3))
        _, told = said(t + 1 / RATE_HZ, field, gyro)
        assert told == []


def test_fitted_gyro_gains_are_the_true_ones():
    checks, _ = said(*stream())
    g, sigma, _ = checks._fit_gyro_gain()
    assert np.allclose(g, 1.0, atol=0.2)
    assert np.all(sigma < 0.2)


def test_stuck_magnetometer_is_reported_when_the_vehicle_turns():
    time_s, field, gyro = stream()
    field[:] = field[0]
    checks, told = said(time_s, field, gyro)
    (text,) = checks.findings.values()
    assert text.startswith("the magnetometer gives the same value on all axes (")
    assert " while the vehicle turned by " in text
    assert "it is stuck" in text
    assert len(told) == 1


@pytest.mark.parametrize("value", [0.0, 0.01])
def test_stuck_gyro_is_reported_when_the_field_turns(value):
    time_s, field, gyro = stream()
    gyro[:] = value
    checks, told = said(time_s, field, gyro)
    (text,) = checks.findings.values()
    assert text.startswith(f"the gyroscope gives the same value on all axes ({value:g}, ")
    assert len(told) == 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_dead_gyro_axis_is_reported(axis):
    time_s, field, gyro = stream()
    gyro[:, axis] = 0.0
    checks, _ = said(time_s, field, gyro)
    assert f"the same value on axis {'xyz'[axis]} (0 rad/s)" in checks.findings["gyroscope still"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_stuck_magnetometer_axis_is_reported(axis):
    time_s, field, gyro = stream()
    field[1000:, axis] = 0.1234
    checks, _ = said(time_s, field, gyro)
    (text,) = checks.findings.values()
    assert f"the magnetometer gives the same value on axis {'xyz'[axis]} (0.1234 gauss)" in text


def test_saturated_axis_is_reported():
    time_s, field, gyro = stream()
    field[:, 2] = 2.5
    checks, _ = said(time_s, field, gyro)
    (text,) = checks.findings.values()
    assert "on axis z (2.5 gauss)" in text
    assert "it is saturated: move it away from the magnet" in text


def test_constant_readings_without_noise_are_reported_at_rest():
    time_s, field, gyro = stream("rest", noise=0.0)
    checks, _ = said(time_s, field, gyro)
    assert set(checks.findings) == {"magnetometer still", "gyroscope still"}
    assert all("it shows not even noise" in text for text in checks.findings.values())
    assert not any("turned" in text for text in checks.findings.values())


@pytest.mark.parametrize("kind", ["planar", "3D"])
@pytest.mark.parametrize("seed", range(3))
def test_gyro_in_degrees_is_reported(kind, seed):
    time_s, field, gyro = stream(kind, seed=seed)
    checks, told = said(time_s, field, np.degrees(gyro))
    (text,) = checks.findings.values()
    assert "deg/s where rad/s are wanted" in text
    assert text.startswith(("the field turns 5", "the field turns 6"))
    assert len(told) == 1


@pytest.mark.parametrize(("kind", "axes"), [("planar", "z"), ("3D", "x, y, z")])
@pytest.mark.parametrize("seed", range(3))
def test_gyro_with_the_wrong_sign_is_reported(kind, axes, seed):
    time_s, field, gyro = stream(kind, seed=seed)
    checks, _ = said(time_s, field, -gyro)
    (text,) = checks.findings.values()
    assert text.startswith(f"the field turns against the gyroscope on axis {axes}:")


def test_axis_with_the_wrong_sign_is_reported():
    time_s, field, gyro = stream()
    checks, _ = said(time_s, field, gyro * [1, -1, 1])
    (text,) = checks.findings.values()
    assert text.startswith("the field turns against the gyroscope on axis y:")


def test_end_of_a_fault_is_reported_once():
    time_s, field, gyro = stream()
    field[400:1200] = field[400]
    checks, told = said(time_s, field, gyro)
    assert checks.findings == {}
    assert len(told) == 2
    assert told[1] == f"over: {told[0]}" or told[1].startswith("over: the magnetometer gives")


def test_findings_do_not_depend_on_the_block_size():
    time_s, field, gyro = stream()
    for rows in (3, 64):
        checks, _ = said(time_s, field, -gyro, rows)
        assert set(checks.findings) == {"gyroscope sign"}


def test_impossible_readings_are_counted():
    checks = SensorChecks()
    assert checks.count(3, 480) == []  # too few to report
    assert checks.count(10, 490) == [checks.findings["readings"]]
    assert checks.findings["readings"].startswith("2 % of the newest 500 readings are of no use")
    assert checks.count(11, 990) == ["over: " + checks_text(2, 500)]


def checks_text(percent, count):
    checks = SensorChecks(SensorLimits())
    checks.count(percent * count // 100, count - percent * count // 100)
    return checks.findings["readings"]


def test_findings_are_cleared_after_a_restart():
    time_s, field, gyro = stream()
    field[:] = field[0]
    checks, _ = said(time_s, field, gyro)
    assert checks.findings
    one = slice(0, 10)
    block = SampleBlock(
        time_s[one],
        np.full(10, 0.025),
        time_s[one],
        field[one],
        gyro[one],
        np.full((10, 3), np.nan),
    )
    (text,) = checks.take(block)
    assert text.startswith("over: ")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.degrees, "deg/s where rad/s are wanted"),
        (np.negative, "the field turns against the gyroscope on axis x, y, z"),
    ],
    ids=["degrees", "negated"],
)
def test_finding_is_in_status_and_explain_and_the_core_continues(change, words):
    core = Core(core_settings(Config(), policy=WriteBackPolicy(mode=Mode.PASSIVE)))
    core.handle(RegistersKnown(0, {}, "test"))
    time_s, field, gyro = stream(seconds=40.0)
    out = []
    for a in range(0, len(time_s), 10):
        part = slice(a, a + 10)
        block = SampleBlock(
            time_s[part], np.full(10, 1 / RATE_HZ), time_s[part], field[part], change(gyro[part]),
            np.full((10, 3), np.nan), gap_before=a == 0,
        )  # fmt: skip
        out += core.handle(Samples(int(time_s[part][-1] * 1e9), block))
    noted = [e.text for e in out if isinstance(e, Noted) and words in e.text]
    assert len(noted) == 1
    status = json.loads(to_json(StatusMaker(0.0).make(core, LinkFacts("x", 115200, True), 1.0)))
    assert words in status["sensors"][0]
    assert any(line.startswith("sensor: ") and words in line for line in status_lines(status))
    explained = explain_json(status)
    assert words in explained["next"]
    assert any(words in line for line in explain_lines(explained))
    assert core.stream.facts.samples == len(time_s)
