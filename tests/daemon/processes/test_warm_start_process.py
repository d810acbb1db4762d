"""`ahrsd run` killed after a drive and started again: its candidate comes much sooner.

The device's time runs faster than the host's, so times are those of the device.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest
from cabled_run import lenient_gates
from patience import PATIENCE_S

from ahrsd.config.config import check_config, print_config
from ahrsd.core.warm_start import CONFIRM_S
from ahrsd.offline.replay import replay
from ahrsd.recording.capture import CaptureReader
from drivers.vn100.emulator.pty import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup

SPEED = 8.0
AGAIN_S = 7.0  # within it the device is read once more, which every used sample requires
#: it stands still while a slow machine starts the program, which determines the bias
MOTION = (("static", 60.0), ("tumble", 5000.0))
SCENE = Setup("rov", seed=2, output="binary", rate_hz=50, baud=115200, motion=MOTION)


class Started:
    """`ahrsd run`, and its capture."""

    def __init__(self, folder, port):
        self.config = check_config(
            {
                "state_directory": str(folder),
                "device": {"port": str(port), "baud": 115200, "reply_timeout_s": 2.0},
                "gates": lenient_gates(),
                "write_back": {"recheck_s": 5.0},
            },
            "test",
        )
        self.folder, path = folder / "captures", folder / "ahrsd.toml"
        path.write_text(print_config(self.config), encoding="utf-8")
        before = set(self.folder.glob("*.mcap"))
        self.log = folder / f"log{len(before)}"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(path)],
                stdout=log,
                stderr=log,
            )
        self.until(lambda: set(self.folder.glob("*.mcap")) - before)
        (self.capture,) = set(self.folder.glob("*.mcap")) - before

    @property
    def said(self):
        return self.log.read_text(encoding="utf-8")

    def until(self, condition):
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.process.poll() is None, self.said
            assert time.monotonic() < end, self.said
            time.sleep(0.1)

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(PATIENCE_S)

    def facts(self):
        """Facts of the capture with the device time."""
        return [fact for _, fact in self._events() if "at_s" in fact]

    def _events(self):
        return CaptureReader(self.capture).facts("event")

    def read_s(self):
        """Upper limit of the device time from the opening of the port to the verdict, by the
        host clock.
        """
        events = [*self._events()]
        qualified = next(ns for ns, fact in events if fact.get("state") == "QUALIFIED")
        return SPEED * 1e-9 * (qualified - events[0][0])

    def qualified_s(self):
        return next(f["at_s"] for f in self.facts() if f.get("state") == "QUALIFIED")

    def warm_s(self):
        return next(f["at_s"] for f in self.facts() if f.get("note", "").startswith("warm start"))


@pytest.mark.slow
def test_drive_before_a_kill_is_used(tmp_path):
    port = tmp_path / "vn100"
    with EmulatorProcess(SCENE, link=port, speed=SPEED, lossless=True):
        cold = Started(tmp_path, port)
        try:
            cold.until(lambda: "-> QUALIFIED" in cold.said)
            time.sleep(AGAIN_S)
        finally:
            cold.kill()
        warm = Started(tmp_path, port)
        try:
            warm.until(lambda: "-> QUALIFIED" in warm.said)
            time.sleep(1.0)  # messages are still on their way to the capture
        finally:
            warm.kill()
    assert "no warm start: there is no earlier capture" in cold.said
    assert f"from {cold.capture.name}" in warm.said
    # a verdict is stamped by its samples, on a busy machine older than those that agreed
    assert warm.read_s() >= CONFIRM_S
    assert warm.qualified_s() - warm.warm_s() < 0.8 * cold.qualified_s()
    done = replay(warm.capture, warm.config)  # the samples are inputs: nothing else is needed
    assert done.core.warm.text.endswith("this run agrees")
    states = [entry["state"] for entry in done.core.decisions.entries if "reason" in entry]
    assert states[-2:] == ["CANDIDATE", "QUALIFIED"]
