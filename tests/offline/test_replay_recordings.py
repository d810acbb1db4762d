"""Real recordings replay to the facts in fixtures/replays/recordings.toml.

The recordings are not part of the project; without them these tests are skipped.
"""

from __future__ import annotations

import gzip
import tomllib
from pathlib import Path

import numpy as np
import pytest
from contract import REPLAY, faults
from counted_calls import counted_calls

from ahrsd.config.config import Config
from ahrsd.events import Event, SamplesSeen
from ahrsd.offline.replay import Replayed, replay
from ahrsd.recording.bytestream import read_chunks
from ahrsd.report.summary import summary_json, summary_lines, warnings_of
from drivers.vn100.decode import decode
from drivers.vn100.deframer import Deframer

FACTS = tomllib.loads(
    (Path(__file__).parents[2] / "fixtures" / "replays" / "recordings.toml").read_text()
)


MIXED = "F00379.logger_mixed_stream.gz"
#: long ones, in the slow form
LONG = (
    "drive_2022_rahul.vnraw.gz", "hand_2023_thumatti.vnraw.gz", "static_2025_kiran_5min.vnraw.gz",
    "F00379.vnbin.gz", MIXED,
)  # fmt: skip
EACH = [pytest.param(one, marks=pytest.mark.slow if one in LONG else ()) for one in FACTS]


class Found:
    """A replay and the samples that it processed."""

    def __init__(self, path: Path) -> None:
        self.blocks: list[SamplesSeen] = []
        self.done: Replayed = replay(path, Config(), listeners=[self._keep])
        self.summary = summary_json(self.done.core, path.name, self.done.warnings)

    def _keep(self, event: Event) -> None:
        if isinstance(event, SamplesSeen):
            self.blocks.append(event)

    def table(self) -> np.ndarray:
        """(N, 11) time, step, field, rate, specific force of every sample."""
        return np.vstack(
            [
                np.column_stack([b.time_s, b.dt_s, b.raw_b_gauss, b.gyro_b_rad_s, b.accel_b_m_s2])
                for b in (event.block for event in self.blocks)
            ]
        )


@pytest.fixture(scope="module")
def replayed(recordings):
    """`replayed(name)`: each recording is replayed once."""
    cache: dict[str, Found] = {}

    def get(name: str) -> Found:
        if name not in cache:
            cache[name] = Found(recordings / "vn100" / name)
        return cache[name]

    return get


@pytest.mark.parametrize("name", EACH)
def test_recording_replays_to_its_expected_facts(replayed, name):
    facts, summary = FACTS[name], replayed(name).summary
    assert summary["packets"]["valid"] == facts["valid"]
    if "rejected" in facts:
        assert summary["packets"]["rejected"] == facts["rejected"]
    assert summary["samples"] == facts["samples"]
    assert summary["rate_hz"] == facts["rate_hz"]
    assert summary["device_restarts"] == 0
    gaps = len(summary["gaps"])
    assert gaps == 0 if facts["gaps_at_least"] == 0 else gaps >= facts["gaps_at_least"]
    for words in facts["warns"]:
        assert any(words in text for text in summary["calibration"]["warnings"]), words
    if "hard_iron_gauss" in facts:
        found = np.array(summary["calibration"]["hard_iron_gauss"])
        assert np.abs(found - facts["hard_iron_gauss"]).max() < facts["within_gauss"]


@pytest.mark.parametrize("name", EACH)
def test_summary_has_the_documented_form(replayed, name):
    found = replayed(name)
    assert faults(found.summary, REPLAY) == []
    assert len(found.summary["decisions"]) == found.done.core.decisions.count > 0
    lines = summary_lines(found.done.core, name, found.done.warnings)
    assert not [line for line in lines if "nan" in line or " -0.00 " in line or "-0 %" in line]


def test_text_and_nmea_between_packets_change_no_sample(replayed, recordings, tmp_path):
    """Over half of the recording; the whole of it is in the slow test below."""
    whole = gzip.decompress((recordings / "vn100" / MIXED).read_bytes())
    part = tmp_path / MIXED
    part.write_bytes(gzip.compress(whole[: len(whole) // 2], 1))
    found = Found(part)
    mixed = found.table()
    assert len(mixed) > 4000
    assert np.array_equal(replayed("F00379.vnbin.gz").table()[: len(mixed)], mixed, equal_nan=True)
    assert found.summary["skipped_bytes"] > 100_000


@pytest.mark.slow
def test_text_and_nmea_between_packets_change_no_sample_of_the_whole_recording(replayed):
    pure = replayed("F00379.vnbin.gz").table()
    assert np.array_equal(pure, replayed(MIXED).table(), equal_nan=True)
    assert replayed(MIXED).summary["skipped_bytes"] == 334515


def test_sensor_at_rest_proposes_nothing_and_lists_unobservable_directions(replayed):
    found = replayed("static_2025_kiran_5min.vnraw.gz")
    calibration = found.summary["calibration"]
    assert calibration["converged"] is False
    assert calibration["registers"] == {}
    blind = " ".join(calibration["observability"]["unobservable"])
    for axis in "xyz":
        assert f"hard iron {axis}" in blind
    for pair in ("xx", "xy", "xz", "yy", "yz", "zz"):
        assert f"soft iron {pair}" in blind
    assert found.summary["state"] == "OBSERVING"


def test_two_people_with_one_sensor_find_the_same_hard_iron(replayed):
    one, other = (
        replayed(f"punch_2024_{who}.vnraw.gz").summary["calibration"]
        for who in ("satish", "shaked")
    )
    apart = np.subtract(one["hard_iron_gauss"], other["hard_iron_gauss"])
    sigmas = [c["standard_deviation"]["hard_iron_gauss"] for c in (one, other)]
    assert np.abs(apart / np.hypot(*sigmas)).max() < 3.0
    assert np.abs(apart).max() < 0.03  # x, the axis a fist turns about, is held


def test_two_walks_with_one_sensor_agree_on_the_horizontal_hard_iron(replayed):
    """They agree because samples lost by their logger without a trace are not bridged
    (stream_rate).
    """
    one, other = (
        replayed(f"walk_{way}_2024_sazgar.vnraw.gz").summary["calibration"]
        for way in ("square", "circle")
    )
    apart = np.subtract(one["hard_iron_gauss"], other["hard_iron_gauss"])
    sigmas = [c["standard_deviation"]["hard_iron_gauss"] for c in (one, other)]
    assert np.abs(apart / np.hypot(*sigmas)).max() < 3.0
    assert np.abs(one["gyro_bias_rad_s"]).max() < 0.04
    assert np.abs(other["gyro_bias_rad_s"]).max() < 0.04


def test_each_warning_is_reported_once(replayed):
    found = replayed("walk_square_2024_sazgar.vnraw.gz")
    said = warnings_of(found.done.core, found.done.warnings)
    assert len(said) == len(set(said))
    assert sum("missing although the bytes show no gap" in text for text in said) == 1


def test_message_without_a_magnetometer_is_refused_in_one_line(run, recordings, capsys):
    path = recordings / "vn100" / "wrongtype_VNYIA_2023_gopi.vnraw.gz"
    for command in ("replay", "calibrate"):
        assert run(command, path) == 2
        out, error = capsys.readouterr()
        assert out == ""
        assert len(error.splitlines()) == 1
        assert "VNYIA carries no magnetometer" in error
        assert "configure VNYMR or VNIMU" in error


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("vn100/walk_circle_2024_sazgar.csv.gz", marks=pytest.mark.slow),
        pytest.param("vn100/punch_2024_satish.csv.gz", marks=pytest.mark.slow),
        "vn100/circles_2024_liu.csv.gz",
        "vn100_distorters/clearIMU.csv.gz",
        pytest.param("arducopter/log171_MAG_10hz.csv.gz", marks=pytest.mark.slow),
        pytest.param("repoimu/TStick_Test11_Trial1.csv.gz", marks=pytest.mark.slow),
        "simulated/wam_0.csv.gz",
    ],
)
def test_table_replays_without_registers(recordings, name):
    summary = Found(recordings / name).summary
    assert faults(summary, REPLAY) == []
    assert summary["samples"] > 500
    assert summary["bytes"] == 0
    assert summary["rate_source"] == "time_s"
    assert any(
        "a table does not say what the registers held" in w
        for w in summary["calibration"]["warnings"]
    )


@pytest.mark.slow
def test_cost_of_a_replay_is_bounded_by_that_of_parsing(recordings):
    """Measured: 12 times the calls of parsing alone, 300 per message. In seconds:
    `benchmarks/daemon/bench_replay.py`.
    """
    path = recordings / "vn100" / "punch_2024_satish.vnraw.gz"
    replay(path, Config())  # modules that are loaded on first use
    parsing, messages = counted_calls(lambda: parse_alone(path))
    whole, done = counted_calls(lambda: replay(path, Config()))
    print(f"{parsing} calls to parse {messages} messages, {whole} to replay them")
    assert messages == done.core.stream.facts.samples
    assert whole < 20 * parsing


def parse_alone(path: Path) -> int:
    """Unpack, deframe and decode every message; returns their number."""
    deframer = Deframer()
    return sum(
        decode(frame) is not None for chunk in read_chunks(path) for frame in deframer.feed(chunk)
    )
