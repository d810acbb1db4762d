"""Present and predicted heading, compared with known attitudes."""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.events import SamplesSeen
from ahrsd.samples import SampleBlock
from ahrsd.telemetry.protocol import plain
from ahrsd.telemetry.status import readings
from ahrsd.telemetry.words import heading_line, reading_lines, turned_deg

NORTH, DOWN = 0.25, 0.43
IRON = np.array([0.05, -0.03, 0.1])


def seen(heading_deg, proposed=None, accel=True, rows=4):
    h = np.radians(heading_deg)
    field = np.array([NORTH * np.cos(h), -NORTH * np.sin(h), DOWN]) + IRON
    force = [0.0, 0.0, -9.81] if accel else [np.nan] * 3
    time_s = np.arange(rows) * 0.025 + 10.0
    block = SampleBlock(
        time_s=time_s,
        dt_s=np.full(rows, 0.025),
        host_s=time_s + 1000.0,
        raw_b_gauss=np.tile(field, (rows, 1)),
        gyro_b_rad_s=np.tile([0.0, 0.0, np.radians(12.0)], (rows, 1)),
        accel_b_m_s2=np.tile(force, (rows, 1)),
    )
    return SamplesSeen(block, Affine.identity(), proposed)


def test_predicted_heading_is_the_true_one():
    found = readings(seen(123.0, Affine(np.eye(3), IRON)), 1010.3)
    assert found["heading_would_be_deg"] == pytest.approx(123.0)
    wrong = np.degrees(np.arctan2(
        NORTH * np.sin(np.radians(123.0)) - IRON[1], NORTH * np.cos(np.radians(123.0)) + IRON[0]
    ))  # fmt: skip
    assert found["heading_deg"] == pytest.approx(wrong)
    assert abs(turned_deg(wrong, 123.0)) > 5.0
    assert (found["roll_deg"], found["pitch_deg"]) == (pytest.approx(0.0), pytest.approx(0.0))
    assert found["age_s"] == pytest.approx(0.225)


def test_lines_contain_known_values():
    status = {
        "readings": plain(readings(seen(350.0, Affine(np.eye(3), IRON)), 1010.1)),
        "estimate": {"heading_sigma_deg": 0.42},
    }
    line = heading_line(status)
    assert "would be 350.0 +- 0.42 deg (1 sigma), " in line
    assert reading_lines(status) == [
        "field: raw +296, +13, +530 mG; corrected 607 mG",
        "turning: +0.0, +0.0, +12.0 deg/s; roll -0.0, pitch +0.0 deg",
    ]


def test_lines_omit_unknown_values():
    early = {"readings": plain(readings(seen(350.0), 1010.1)), "estimate": None}
    assert heading_line(early).endswith("not known before it has converged")
    blind = {"readings": plain(readings(seen(350.0, accel=False), 1010.1)), "estimate": None}
    assert heading_line(blind) == "heading: not known, the stream has no acceleration"
    assert not any("roll" in line for line in reading_lines(blind))
    old = {"readings": plain(readings(seen(350.0), 1027.0)), "estimate": None}
    assert heading_line(old) == "heading: the newest sample is 17 s old"
    assert reading_lines(old) == []
    assert heading_line({"readings": None}) == "heading: no samples yet"


def test_sensor_without_readings_has_no_heading():
    dead = seen(350.0)
    dead.block.accel_b_m_s2[:] = 0.0
    dead.block.raw_b_gauss[:] = np.nan
    found = plain(readings(dead, 1010.1))
    assert (found["heading_deg"], found["roll_deg"]) == (None, None)
    assert found["raw_b_gauss"] == [None, None, None]
    assert reading_lines({"readings": found}) == [
        "readings: of no use, the sensor sends what is no number"
    ]


def test_turn_is_the_shorter_one():
    assert turned_deg(350.0, 10.0) == 20.0
    assert turned_deg(10.0, 350.0) == -20.0
