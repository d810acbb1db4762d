"""Reloading the configuration: permitted changes apply, others are reported, a wrong file is
rejected.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict

import pytest
from patience import PATIENCE_S
from planted_operator import estimate

from ahrsd.config.config import (
    Config,
    Reloader,
    check_config,
    core_settings,
    load_config,
    may_change,
    merged,
)
from ahrsd.core.core import Core
from ahrsd.events import GateResult
from ahrsd.inputs import LimitsChanged, Samples
from ahrsd.offline.replay import replay
from ahrsd.recording import capture
from ahrsd.recording.capture import CaptureReader


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)
    return found


def test_permitted_changes_apply_and_others_wait_for_a_restart():
    new = check_config(
        {
            "mode": "commit",
            "gates": {"max_heading_sigma_deg": 0.5, "max_step_auto_deg": 1.0},
            "interlock": {"file": "/run/safe", "max_age_s": 0.5},
            "capture": {"keep_megabytes": 100, "enabled": False},
        },
        "test",
    )
    change = merged(Config(), new)
    assert change.changed == (
        "capture.keep_megabytes = 100",
        "gates.max_heading_sigma_deg = 0.5",
        'interlock.file = "/run/safe"',
    )
    assert change.waits == (
        "mode", "capture.enabled", "gates.max_step_auto_deg", "interlock.max_age_s"
    )  # fmt: skip
    assert change.config.mode == "observe"
    assert change.config.gates.max_heading_sigma_deg == 0.5
    assert change.config.gates.max_step_auto_deg == Config().gates.max_step_auto_deg
    assert change.config.interlock.max_age_s == Config().interlock.max_age_s


def test_no_setting_that_permits_a_write_changes_during_a_run():
    for table in ("write_back", "trial", "still", "budget", "device", "location", "estimator"):
        assert not any(
            may_change(table, key) for key in type(getattr(Config(), table)).model_fields
        )
    assert not may_change("interlock", "max_age_s")
    assert not may_change("gates", "max_step_auto_deg")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("")
    return path


def taken(reloader, applied):
    said = []
    reloader.ask()
    until(lambda: said.extend(reloader.take(applied.append)) or said)
    return said


def test_wrong_file_changes_nothing_and_is_reported(file):
    reloader, applied = Reloader(lambda: load_config(file), Config()), []
    file.write_text("[gates]\nmax_heading_sigma_deg = 0.5\nmisspelt = 1\n[device]\nbaud = 1\n")
    said = taken(reloader, applied)
    assert len(said) == 2
    assert all(not well and text.startswith("the old configuration stays: ") for well, text in said)
    assert applied == []
    assert reloader.config == Config()
    file.unlink()
    os.mkfifo(file)
    assert "is a FIFO, not a regular file" in taken(reloader, applied)[0][1]


def test_correct_file_is_applied_once(file):
    reloader, applied = Reloader(lambda: load_config(file), Config()), []
    file.write_text('mode = "stage"\n[gates]\nmax_heading_sigma_deg = 0.5\n')
    assert taken(reloader, applied) == [
        (True, "configuration read again: gates.max_heading_sigma_deg = 0.5"),
        (False, "these settings change at the next start only: mode"),
    ]
    assert len(applied) == 1
    assert taken(reloader, applied)[0] == (
        True, "configuration read again: no setting that may change during a run has changed"
    )  # fmt: skip
    assert len(applied) == 1


def test_missing_file_is_reported():
    assert taken(Reloader(None, Config()), []) == [
        (False, "the old configuration stays: there is no file to read again: give --config")
    ]


def limits(**changes):
    return asdict(check_config({"gates": changes}, "test").gates.limits())


def test_limits_are_a_recorded_input():
    item = LimitsChanged(5, limits(max_heading_sigma_deg=0.5))
    assert capture.input_from_json(capture.input_to_json(item)) == item


def test_verdict_with_other_limits_permits_nothing():
    core = Core(core_settings(Config()))
    back = core.writeback
    back.on_no_device(None, 1.0)
    green = (GateResult("observability", 3.0, 1.0, True, 0.0, "", ""),)
    back.on_verdict(estimate(), green, 1.0, 1.0)
    assert back.state.value == "QUALIFIED"
    era = core._era()
    core.handle(LimitsChanged(2 * 10**9, limits(max_heading_sigma_deg=0.25)))
    assert back.state.value == "OBSERVING"
    assert back.proposal is None
    assert "no gate has judged yet" in back.obstacles()
    assert core._era() != era  # nor does one that is still being worked on
    assert core.settings.calibrator.limits.max_heading_sigma_deg == 0.25
    assert core.calibrator.settings.limits.max_heading_sigma_deg == 0.25
    assert core.calibrator.make_fresh().settings.limits.max_heading_sigma_deg == 0.25


def test_a_running_daemon_takes_it_on_sighup(emulated, tmp_path):
    config, log = tmp_path / "a.toml", tmp_path / "log"
    with emulated(output="imu") as (_, port), log.open("wb") as stream:
        base = f'state_directory = "{tmp_path}"\n[device]\nbaud = 115200\n'
        config.write_text(base)
        inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
        process = subprocess.Popen(
            [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config), "--port", port],
            stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
        )  # fmt: skip
        signal.signal(signal.SIGHUP, inherited)
        try:
            until(lambda: "OBSERVING" in log.read_text())
            config.write_text(base + "[gates]\nmax_heading_sigma_deg = nan\n")
            process.send_signal(signal.SIGHUP)
            until(lambda: "the old configuration stays: " in log.read_text())
            word = tmp_path / "safe"
            config.write_text(
                base + f'[gates]\nmax_heading_sigma_deg = 0.5\n[interlock]\nfile = "{word}"\n'
            )
            process.send_signal(signal.SIGHUP)
            line = (
                "configuration read again: gates.max_heading_sigma_deg = 0.5, "
                f'interlock.file = "{word}"'
            )
            until(lambda: line in log.read_text())
            until(lambda: f"interlock.file = {word}: cannot be read" in log.read_text())
            time.sleep(1.0)
            assert process.poll() is None
        finally:
            process.terminate()
            assert process.wait(PATIENCE_S) == 0, log.read_text()
    assert "change at the next start only" not in log.read_text()
    (capture,) = (tmp_path / "captures").glob("*.mcap")
    (item,) = [i for i in CaptureReader(capture) if isinstance(i, LimitsChanged)]
    assert item.limits["max_heading_sigma_deg"] == 0.5
    again = replay(capture, Config())
    assert again.core.settings.calibrator.limits.max_heading_sigma_deg == 0.5
    assert not any(isinstance(i, Samples) for i in CaptureReader(capture))
