"""The rate and missing messages, from the device's attitude."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from streams import content, emitted

from ahrsd import so3
from ahrsd.stream.streams_without_time import (
    TurnWatch,
    attitude_columns,
    rate_from_attitude,
    rate_of,
)
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.messages import MESSAGES, binary_layout

FOLDER = Path(__file__).parents[2] / "fixtures" / "replays"


def motion(rate_hz: float, seconds: float, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Yaw, pitch, roll and the rate over the step that ends there, (N, 3) each, printed."""
    count = round(rate_hz * seconds)
    t = np.arange(count) / rate_hz
    rate = size * np.column_stack([np.sin(0.7 * t), 0.6 * np.cos(0.4 * t), 0.5 + 0.3 * np.sin(t)])
    R = np.eye(3)
    ypr = np.empty((count, 3))
    for k in range(count):
        R = R @ so3.exp(rate[k : k + 1] / rate_hz)[0] if k else R
        ypr[k] = np.arctan2(R[1, 0], R[0, 0]), np.arcsin(-R[2, 0]), np.arctan2(R[2, 1], R[2, 2])
    return np.radians(np.round(np.degrees(ypr), 3)), np.round(rate, 6)


@pytest.mark.parametrize("rate_hz", [20.0, 40.0, 100.0])
def test_rate_is_found(rate_hz):
    assert rate_from_attitude(*motion(rate_hz, 60.0)) == rate_hz


def test_unusual_rate_is_found_and_not_rounded():
    assert rate_from_attitude(*motion(33.0, 60.0)) == pytest.approx(33.0, rel=0.01)


def test_lost_messages_do_not_change_the_rate():
    ypr, rate = motion(40.0, 120.0)
    lost = np.random.default_rng(1).random(len(ypr)) < 0.03
    assert rate_from_attitude(ypr[~lost], rate[~lost]) == 40.0


def test_no_rate_without_turns():
    ypr, rate = motion(40.0, 60.0, size=0.02)
    assert rate_from_attitude(ypr, rate) is None
    assert rate_from_attitude(*(part[:150] for part in motion(40.0, 60.0))) is None


def test_rate_is_found_from_few_turns_with_a_bias():
    still_ypr, still_rate = motion(10.0, 60.0, size=0.0)
    ypr, rate = motion(10.0, 6.0, size=2.0)
    ypr = np.vstack([ypr, np.tile(ypr[-1], (len(still_ypr), 1))])
    rate = np.vstack([rate, still_rate]) + np.array([0.01, -0.005, 0.02])
    assert rate_from_attitude(ypr, rate) == 10.0


def test_no_rate_when_attitude_and_gyro_disagree():
    ypr, rate = motion(40.0, 60.0)
    dice = np.random.default_rng(2)
    assert rate_from_attitude(ypr, rate * dice.uniform(0.3, 3.0, size=(len(rate), 1))) is None


def test_rate_of_bytes():
    found = rate_of([emitted(build(Setup("tumble", seed=2, rate_hz=20)), 60.0)])
    assert found == (20.0, "from the device's attitude against its rate")


def test_bytes_with_device_time_need_no_rate():
    assert rate_of([content(FOLDER / "tumble_binary_restart.vnbin.gz")]) is None


def test_bytes_without_a_message():
    assert rate_of([b"nothing", b"at all"]) is None
    assert rate_of([]) is None


def test_messages_with_attitude_and_rate_are_recognised():
    layout = MESSAGES["VNYMR"]
    assert attitude_columns(layout) == [0, 1, 2, 9, 10, 11]
    assert attitude_columns(MESSAGES["VNIMU"]) is None
    names = [c.name for c in binary_layout(0x14, (0x003E, 0x003A)).columns]
    columns = attitude_columns(binary_layout(0x14, (0x003E, 0x003A)))
    assert [names[k] for k in columns] == [
        "yaw_rad", "pitch_rad", "roll_rad",
        "uncomp_gyro_x_rad_s", "uncomp_gyro_y_rad_s", "uncomp_gyro_z_rad_s",
    ]  # fmt: skip


class TestTurnWatch:
    def test_no_messages_are_missing_in_a_complete_stream(self):
        watch = TurnWatch()
        found = watch.look(*motion(40.0, 60.0), 0.025)
        assert found.sum() == 0
        assert (watch.places, watch.missing) == (0, 0)

    def test_missing_block_is_found_with_its_approximate_length(self):
        ypr, rate = motion(40.0, 60.0)
        keep = np.r_[0:800, 860:2400]
        watch = TurnWatch()
        found = watch.look(ypr[keep], rate[keep], 0.025)
        assert np.flatnonzero(found).tolist() == [800]
        assert 30 <= found[800] <= 90
        assert watch.places == 1

    def test_result_does_not_depend_on_the_block_size(self):
        ypr, rate = motion(40.0, 60.0)
        keep = np.r_[0:500, 530:1300, 1360:2400]
        whole, pieces = TurnWatch(), TurnWatch()
        one = whole.look(ypr[keep], rate[keep], 0.025)
        edges = [0, 1, 7, 500, 501, 900, len(keep)]
        other = [pieces.look(ypr[keep][a:b], rate[keep][a:b], 0.025) for a, b in pairwise(edges)]
        assert np.array_equal(one, np.concatenate(other))
        assert whole.missing == pieces.missing > 0

    def test_samples_before_a_reset_are_not_compared(self):
        ypr, rate = motion(40.0, 60.0)
        watch = TurnWatch()
        watch.look(ypr[:100], rate[:100], 0.025)
        watch.forget()
        assert watch.look(ypr[1000:1100], rate[1000:1100], 0.025).sum() == 0

    @pytest.mark.parametrize(
        ("name", "least", "most"),
        [
            ("walk_square_2024_sazgar.vnraw.gz", 30, 45),
            ("walk_circle_2024_sazgar.vnraw.gz", 25, 40),
            ("hand_2023_thumatti.vnraw.gz", 0, 0),
            ("circles_2022_rahul.vnraw.gz", 0, 0),
            ("punch_2024_satish.vnraw.gz", 0, 0),
        ],
    )
    def test_real_recordings(self, recordings, name, least, most):
        """Two walks whose logger lost lines, and recordings that are whole."""
        rows = []
        for frame in Deframer().feed(content(recordings / "vn100" / name)):
            event = decode(frame)
            if isinstance(event, Measurement):
                rows.append([event.values[k] for k in attitude_columns(event.layout)])
        watch = TurnWatch()
        table = np.array(rows)
        watch.look(table[:, :3], table[:, 3:], 0.025)
        assert least <= watch.places <= most
