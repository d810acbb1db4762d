"""The demo does the whole job: every figure that the README promises, one seed or five."""

import json
import math
import os
import signal
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
import rerun_cli

from ahrsd.config.config import Config
from ahrsd.demo import FILES, demo_config, emulated, lines, run_demo
from ahrsd.errors import DeviceError
from ahrsd.offline.replay import replay
from drivers.vn100.emulator.pty import EmulatorProcess

SEEDS = range(5)
# Half a minute where nothing else runs; a busy machine makes it slow, and is no reason to fail.
pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """One demo for all tests of the short form: (directory, result, what it said)."""
    directory = tmp_path_factory.mktemp("demo")
    said: list[str] = []
    result = run_demo(directory, seed=1, say=said.append)
    return directory, result, said


def assert_kept(result, said=()):
    assert result.state == "CONFIRMED", "\n".join(said)  # in flash, read after a restart
    assert result.worst_before_deg > 10.0
    assert result.worst_after_deg <= 0.5
    assert np.max(np.abs(result.bias_error_rad_s)) <= 3e-4
    assert np.max(np.abs(result.bias_sigmas)) <= 3.0
    assert result.read_back_exact
    assert result.good, result.failures()


def test_demo_keeps_the_figures_of_the_readme(done):
    _, result, said = done
    assert_kept(result, said)
    assert sum("operator approves" in line for line in said) == 1


def test_before_and_after_on_every_heading_of_unseen_data(done):
    result = done[1]
    sectors = np.unique(np.mod(result.live_heading_deg, 360.0) // 10.0)
    assert len(sectors) >= 34
    assert np.max(np.abs(result.live_before_deg)) > 10.0
    assert np.max(np.abs(result.live_after_deg)) <= 0.5


def test_it_leaves_exactly_these_files(done):
    directory = done[0]
    assert sorted(p.name for p in directory.iterdir()) == sorted(FILES)
    large = set(FILES) - {"journal.receipt"}
    assert all((directory / name).stat().st_size > 1000 for name in large)
    body = json.loads((directory / "calibration.json").read_text())
    assert body["schema"] == "ahrsd.calibration/1"
    assert body["converged"] is True
    assert sorted(body["registers"]) == ["23", "84"]
    factory = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    assert body["registers_in_force"] == {"23": factory, "84": factory}
    assert body["device"] == {"serial": 100130608}  # so `registers write --from` knows which
    page = (directory / "report.html").read_text()
    assert page.index("before and after") < page.index("Field strength")  # the picture comes first


def test_journal_has_the_whole_write(done):
    records = [json.loads(r) for r in (done[0] / "journal.jsonl").read_text().splitlines()]
    assert [r["kind"] for r in records] == [
        "PREPARED", "RAM_VERIFIED", "PROVEN", "FLASH_SENT", "FLASH_ACKED", "CONFIRMED",
    ]  # fmt: skip
    assert records[0]["approver"] == "operator"
    assert {*records[0]["new"]} == {"23", "84"}


def test_replay_decides_the_same(done):
    directory, result, *_ = done
    replayed = replay(directory / "capture.mcap", Config())
    assert replayed.core.decisions.sha256 == result.decision_sha256
    assert replayed.core.writeback.state.value == "CONFIRMED"


def test_result_has_truth_and_estimate(done):
    result = done[1]
    text = "\n".join(lines(result))
    for axis in range(3):
        assert f"{result.truth.hard_iron_gauss[axis] * 1e3:.4f}" in text
        assert f"{result.truth.gyro_bias_rad_s[axis] * 1e3:.4f}" in text
    assert result.decision_sha256 in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_five_seeds_in_a_row(tmp_path, seed):
    assert_kept(run_demo(tmp_path, seed=seed, say=lambda _: None))


def test_demo_ends_when_the_device_dies(tmp_path, monkeypatch):
    processes = []

    class Mortal(EmulatorProcess):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            processes.append(self._process)

    monkeypatch.setattr(emulated, "EmulatorProcess", Mortal)
    said = threading.Event()

    def kill():
        assert said.wait(600.0)
        os.kill(processes[0].pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(DeviceError, match="the emulated device died") as caught:
        run_demo(tmp_path, say=lambda _: said.set())
    killer.join()
    assert caught.value.exit_code == 75
    assert "\n" not in str(caught.value)


def test_demo_ends_without_progress(monkeypatch):
    """Neither a long duration nor a busy machine ends a demo; missing progress does."""

    class Frozen:
        alive = True

        def device_s(self):
            return 12.0

    class Waiting:
        def __init__(self):
            self.stopped = threading.Event()

        def run(self):
            assert self.stopped.wait(600.0)

        def stop(self, _reason):
            self.stopped.set()

    monkeypatch.setattr(emulated, "_STUCK_S", 0.0)
    monkeypatch.setattr(emulated, "_WATCH_S", 0.01)
    with pytest.raises(DeviceError, match="the emulated device stood still"):
        emulated.run_watched(Waiting(), Frozen(), 100.0)
    monkeypatch.setattr(emulated, "_STUCK_S", 1e9)
    with pytest.raises(DeviceError, match="no end after 11 s of device time"):
        emulated.run_watched(Waiting(), Frozen(), 11.0)


def test_report_promises_only_what_the_seed_achieves(done):
    page = (done[0] / "report.html").read_text()
    assert "the same seed gives the same hidden truth, motion and noise" in page
    assert "the same run" not in page


def test_the_recording_for_the_viewer_is_whole(done):
    tool = Path(rerun_cli.__file__).with_name("rerun")
    checked = subprocess.run(
        [tool, "rrd", "verify", done[0] / "run.rrd"], check=False, capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stderr


def test_no_device_is_one_line(tmp_path, monkeypatch, run, capsys):
    def refuse(*_args, **_options):
        raise OSError(2, "out of pty devices")

    monkeypatch.setattr(emulated, "EmulatorProcess", refuse)
    assert run("demo", "--output", tmp_path / "d") == 75
    assert capsys.readouterr().err == ("ahrsd: no emulated device: [Errno 2] out of pty devices\n")


def test_an_output_that_is_a_file_is_refused(tmp_path, run, capsys):
    (tmp_path / "d").write_text("mine")
    assert run("demo", "--output", tmp_path / "d") == 2
    assert (tmp_path / "d").read_text() == "mine"


def test_an_output_below_a_file_is_one_line(tmp_path, run, capsys):
    (tmp_path / "d").write_text("mine")
    assert run("demo", "--output", tmp_path / "d" / "e") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"ahrsd: {tmp_path / 'd' / 'e'}: ")
    assert error.count("\n") == 1


@pytest.mark.slow
def test_demo_without_enough_time_fails(tmp_path, run, capsys):
    assert run("demo", "--output", tmp_path, "--seconds", "60", "--seed", "3") == 1
    out = capsys.readouterr().out
    assert "The demo did not reach its goal: it ended in " in out
    assert "NOT what was approved" in out


def test_the_configuration_allows_for_the_speed(tmp_path):
    slow, fast = demo_config(tmp_path, 1.0), demo_config(tmp_path, 10.0)
    assert slow.mode == fast.mode == "commit"
    assert slow.interlock.max_age_s == 3.0
    assert fast.interlock.max_age_s == 30.0
    assert math.isclose(fast.device.reply_timeout_s, 3.0)
