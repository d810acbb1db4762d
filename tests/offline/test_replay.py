"""Replays of the emulated device's streams: facts, and equal decisions however they are
replayed.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from contract import REPLAY, faults
from streams import content, cut, inputs

from ahrsd.config.config import Config
from ahrsd.core.core import Core
from ahrsd.events import Event, SamplesSeen
from ahrsd.offline.replay import replay
from ahrsd.recording import opening
from ahrsd.report.summary import summary_json

FOLDER = Path(__file__).parents[2] / "fixtures" / "replays"
FACTS = tomllib.loads((FOLDER / "emulated.toml").read_text())
DAMAGED, RESTART, SWITCH = FACTS


def samples_of(seen: list[Event]) -> np.ndarray:
    """(N, 11) everything that the estimator receives."""
    return np.vstack(
        [
            np.column_stack([b.time_s, b.dt_s, b.raw_b_gauss, b.gyro_b_rad_s, b.accel_b_m_s2])
            for b in (event.block for event in seen if isinstance(event, SamplesSeen))
        ]
    )


@pytest.fixture(scope="module")
def whole():
    """`whole(name)`: a stream's core and events, replayed once as the file is."""
    cache: dict[str, tuple[Core, list[Event]]] = {}

    def get(name: str) -> tuple[Core, list[Event]]:
        if name not in cache:
            seen: list[Event] = []
            cache[name] = replay(FOLDER / name, Config(), listeners=[seen.append]).core, seen
        return cache[name]

    return get


@pytest.mark.parametrize("name", FACTS)
def test_emulated_stream_replays_to_its_expected_facts(whole, name):
    facts, summary = FACTS[name], summary_json(whole(name)[0], name)
    assert faults(summary, REPLAY) == []
    assert summary["packets"] == {
        "valid": facts["valid"], "rejected": facts["rejected"], "by_type": facts["by_type"],
    }  # fmt: skip
    for key in ("skipped_bytes", "samples", "device_restarts", "rate_source"):
        assert summary[key] == facts[key], key
    assert summary["duration_s"] == pytest.approx(facts["duration_s"], abs=0.1)
    assert summary["rate_hz"] == pytest.approx(facts["rate_hz"], rel=1e-3)
    assert len(summary["gaps"]) == facts["gaps"]
    calibration = summary["calibration"]
    for key in ("hard_iron_gauss", "gyro_bias_rad_s"):
        if key in facts:
            sigma = np.array(calibration["standard_deviation"][key])
            assert np.abs(np.subtract(calibration[key], facts[key]) / sigma).max() < 4.0, key


@pytest.mark.parametrize("name", FACTS)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_samples_and_decisions_do_not_depend_on_the_chunks_of_bytes(whole, monkeypatch, name, seed):
    core, seen = whole(name)
    pieces = cut(content(FOLDER / name), seed)
    monkeypatch.setattr(opening, "_byte_inputs", lambda _: inputs(pieces))
    again: list[Event] = []
    other = replay(FOLDER / name, Config(), listeners=[again.append]).core
    assert np.array_equal(samples_of(seen), samples_of(again), equal_nan=True)
    assert other.stream.gaps == core.stream.gaps
    assert other.decisions.entries == core.decisions.entries
    assert other.decisions.sha256 == core.decisions.sha256


def test_different_decisions_have_different_hashes(whole):
    hashes = {whole(name)[0].decisions.sha256 for name in FACTS}
    assert len(hashes) == len(FACTS)


def test_paced_replay_takes_real_time_and_decides_the_same(whole, tmp_path):
    import time

    short = tmp_path / "short.vnraw"
    short.write_bytes(content(FOLDER / DAMAGED)[:60_000])  # 12 s
    fast = replay(short, Config()).core
    start = time.monotonic()
    paced = replay(short, Config(), speed=12.0).core
    assert time.monotonic() - start > 0.8
    assert paced.decisions.sha256 == fast.decisions.sha256
    assert fast.decisions.count > 0


def test_table_of_the_samples_gives_the_estimate_of_the_stream(whole, tmp_path):
    core, seen = whole(RESTART)
    columns = "time_s,mag_x_gauss,mag_y_gauss,mag_z_gauss,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,"
    columns += "accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
    rows = samples_of(seen)
    start = (
        int(np.argmin(np.diff(rows[:, 0]))) + 1
    )  # the restart: time must not decrease in a table
    rows[start:, 0] += 100.0
    path = tmp_path / "same.csv"
    rows = np.delete(rows, 1, axis=1)
    np.savetxt(path, rows, delimiter=",", header=columns, comments="", fmt="%.12g")
    table = replay(path, Config(), held_out=False).core  # the stream has none so early
    assert table.stream.facts.samples == core.stream.facts.samples
    assert len(table.stream.gaps) == 2
    one, other = core.calibrator.estimate, table.calibrator.estimate
    assert one is not None
    assert other is not None
    apart = np.abs(one.hard_iron_gauss - other.hard_iron_gauss) / one.sigma[6:9]
    assert apart.max() < 0.5
    assert np.abs(one.soft_iron - other.soft_iron).max() < 2e-3
    assert np.abs(one.gyro_bias_rad_s - other.gyro_bias_rad_s).max() < 3e-4


def test_stdout_is_pure_json_when_json_goes_to_stdout(run, capsys):
    assert run("replay", FOLDER / RESTART, "--json", "-") == 0
    summary = json.loads(capsys.readouterr().out)
    assert faults(summary, REPLAY) == []


def test_stdout_is_text_when_json_goes_to_a_file(run, tmp_path, capsys):
    assert run("replay", FOLDER / DAMAGED, "--json", tmp_path / "s.json") == 0
    lines = capsys.readouterr().out.splitlines()
    assert json.loads((tmp_path / "s.json").read_text())["samples"] == FACTS[DAMAGED]["samples"]
    assert lines[0].endswith(
        "1569 samples in 40.0 s (40 Hz, from the device's attitude against its rate)"
    )
    assert lines[1] == "  messages: 1569 valid, 29 rejected, 3763 bytes skipped"
    assert lines[2].startswith("  27 gaps, ")
    assert lines[-1].startswith("  state ")
    assert list(tmp_path.iterdir()) == [tmp_path / "s.json"]


def test_given_rate_is_used(run, tmp_path, capsys):
    assert run("replay", FOLDER / DAMAGED, "--rate", 50, "--json", "-") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["rate_hz"] == 50.0
    assert summary["rate_source"] == "as given"


def test_truncated_stream_is_reported(tmp_path):
    path = tmp_path / "cut.vnraw"
    path.write_bytes(content(FOLDER / DAMAGED)[:30_000])
    assert replay(path, Config()).warnings == ["the recording ends in the middle of a message"]
