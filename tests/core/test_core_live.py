"""A live run and the replay of its capture decide the same, also through a whole write and after
a kill.

The emulated device (a separate process) and the daemon run faster than real time, as in the demo.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ahrsd.config.config import Config, check_config
from ahrsd.config.sections import GatesSection
from ahrsd.daemon.core_runner import close_shell, open_shell
from ahrsd.daemon.daemon import Daemon
from ahrsd.daemon.host_clock import HostClock
from ahrsd.daemon.vehicle_files import VehicleFiles
from ahrsd.events import SamplesSeen, StateChanged
from ahrsd.offline.replay import replay
from ahrsd.recording.capture import CaptureReader, Sent
from ahrsd.writeback.states import State
from drivers.serial_port import SerialPort
from drivers.vn100.commands import read_registers
from drivers.vn100.device import Device
from drivers.vn100.emulator.pty import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup

SPEED = 15.0  # a disk that takes 0.3 s to sync must not look like one that hangs
BAUD = 115200
#: an idle machine takes half a minute; a busy one that has not proven it by then never will
GIVEN_UP_S = 240.0
pytestmark = pytest.mark.timeout(600)
EASY_TRIAL = {"max_spread_percent": 100.0, "max_jump_deg": 180.0}
MOTION = (("static", 12.0), ("tumble", 1000.0))
SCENE = Setup("rov", seed=2, output="binary", rate_hz=25, baud=BAUD, motion=MOTION)


class AlwaysSafe:
    """A vehicle that always permits a write."""

    def safe(self):
        return True


def easy_gates():
    """Limits that a minute of motion passes; their values are not tested here."""
    easy = {}
    for name, info in GatesSection.model_fields.items():
        bounds = {type(m).__name__: m for m in info.metadata}
        if name.startswith(("max_", "holdout_rms", "holdout_max", "repeat", "field_", "closure")):
            easy[name] = float(bounds["Le"].le)
        elif name.startswith(("min_", "holdout_segments")):
            easy[name] = float(bounds["Ge"].ge)
    return {**easy, "second_opinion_deg": 180.0, "field_min_gauss": 0.0}


def config_for(folder, **tables):
    body = {
        "state_directory": str(folder),
        "device": {"baud": BAUD, "reply_timeout_s": 2.0 * SPEED},  # a busy machine stalls a second
        "interlock": {"max_age_s": 60.0},
        "gates": easy_gates(),
        "trial": {"duration_s": 60.0, "turns": 100.0, "worse_percent": 100.0, **EASY_TRIAL},
        **tables,
    }
    return check_config(body, "test")


class Run:
    """A daemon that a listener stops; the listener also acts as the operator."""

    def __init__(self, config: Config, folder: Path, port: Path, end) -> None:
        self.capture = folder / "capture.mcap"
        clock = HostClock(SPEED)
        self.shell = open_shell(config, clock, self.capture)
        self.states: list[tuple[float, str]] = []
        self.reasons: list[str] = []
        self._end = end
        self.shell.listeners.append(self._listen)
        files = VehicleFiles(AlwaysSafe(), max_age_s=config.interlock.max_age_s)
        self.daemon = Daemon(config, self.shell, port, clock, files)

    def _listen(self, event):
        if isinstance(event, StateChanged):
            self.states.append((event.at_s, event.new))
            self.reasons.append(f"{event.new}: {event.reason}")
            if event.new == State.QUALIFIED:
                self.daemon.operate("approve", self.shell.core.writeback.proposal.id)
        if isinstance(event, SamplesSeen | StateChanged) and self._end(self, event):
            self.daemon.stop("test")

    def __call__(self):
        guard = threading.Timer(GIVEN_UP_S, self.daemon.stop, ["given up"])
        guard.daemon = True
        guard.start()
        try:
            self.daemon.run()
        finally:
            guard.cancel()
            close_shell(self.shell)
        return self


def after(seconds):
    def end(run, event):
        return isinstance(event, SamplesSeen) and event.block.time_s[-1] > seconds

    return end


def reached(state):
    """In this state or past it: a state that a stall of the machine ended is not waited for."""
    return lambda run, _: bool(run.states) and run.states[-1][1] in (state, "ROLLED_BACK")


def replayed_states(path, config):
    states = []

    def listen(event):
        if isinstance(event, StateChanged):
            states.append((event.at_s, event.new))

    return replay(path, config, listeners=[listen]).core, states


def held(port):
    with SerialPort(port, BAUD) as open_port, Device(open_port) as device:
        return device.run(read_registers((23, 84)), 10.0)


def same_decisions(run, config):
    core, states = replayed_states(run.capture, config)
    live = run.shell.core
    assert states == run.states
    assert core.decisions.count == live.decisions.count
    assert core.decisions.entries == live.decisions.entries
    assert core.decisions.sha256 == live.decisions.sha256
    assert core.stream.facts.samples == live.stream.facts.samples
    return live


@pytest.mark.slow
def test_replay_of_a_run_decides_the_same(tmp_path):
    config = config_for(tmp_path, gates={})
    port = tmp_path / "vn100"
    with EmulatorProcess(SCENE, link=port, speed=SPEED, lossless=True):
        run = Run(config, tmp_path, port, after(120.0))()
    live = same_decisions(run, config)
    assert live.decisions.count >= 3
    assert len(live.stream.gaps) == 0


@pytest.mark.slow  # the short one: a demo and its replay, in demo/test_demo.py
def test_replay_decides_the_same_through_an_approved_write(tmp_path):
    config = config_for(tmp_path, mode="stage")
    port = tmp_path / "vn100"
    with EmulatorProcess(SCENE, link=port, speed=SPEED, lossless=True):
        before = held(port)
        run = Run(config, tmp_path, port, reached("PROVEN"))()
        after_stop = held(port)
    names = [name for _, name in run.states]
    assert names[-3:] == ["PROVEN", "ROLLING_BACK", "ROLLED_BACK"], run.reasons
    assert after_stop == before
    live = same_decisions(run, config)
    assert live.writeback.history.open is None
    journal = next(tmp_path.glob("journal-*.jsonl")).read_text()
    kinds = [json.loads(line)["kind"] for line in journal.splitlines()]
    assert kinds == ["PREPARED", "RAM_VERIFIED", "PROVEN", "ROLLBACK", "ROLLED_BACK"]


@pytest.mark.slow
def test_replay_decides_the_same_through_replugs_resets_and_damage(tmp_path):
    faults = ("unplug=0@20+2", "reset@45", "bit_flip=0.0005@60+5", "byte_drop=0.0005@70+5")
    scene = Setup("rov", seed=2, output="binary", rate_hz=50, baud=BAUD, faults=faults)
    config = config_for(tmp_path, mode="stage")
    port = tmp_path / "vn100"
    with EmulatorProcess(scene, link=port, speed=SPEED, lossless=True):
        seen = []

        def end(run, event):
            seen.append(isinstance(event, SamplesSeen) and run.shell.core.stream.restarts)
            return seen.count(1) > 200

        run = Run(config, tmp_path, port, end)()
    live = same_decisions(run, config)
    assert live.stream.restarts >= 1
    assert live.device_session.session.deframer.counters.rejected > 0
    assert [name for _, name in run.states].count("RECONCILING") >= 2


@pytest.mark.slow
def test_capture_and_journal_are_used_after_a_kill_in_a_trial(tmp_path):
    config, port = config_for(tmp_path, mode="stage"), tmp_path / "vn100"
    second = tmp_path / "second"
    second.mkdir()
    with EmulatorProcess(SCENE, link=port, speed=SPEED, lossless=True):
        before = held(port)
        command = [sys.executable, __file__, str(tmp_path), str(port)]
        killed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        said = [line.split()[:2] for line in killed.stdout.splitlines()]
        assert said[-1][1] == "TRIAL"
        assert killed.returncode == -signal.SIGKILL
        assert held(port) != before
        _, states = replayed_states(tmp_path / "capture.mcap", config)
        assert [[f"{at:.6f}", name] for at, name in states][: len(said)] == said
        assert [i for i in CaptureReader(tmp_path / "capture.mcap") if isinstance(i, Sent)]
        run = Run(config, second, port, reached("TRIAL"))()
        assert [name for _, name in run.states] == ["TRIAL", "ROLLING_BACK", "ROLLED_BACK"]
        assert held(port) == before
    same_decisions(run, config)


if __name__ == "__main__":

    def tell(run, event):
        if isinstance(event, StateChanged):
            print(f"{event.at_s:.6f} {event.new} {event.reason}", flush=True)
            if event.new == "TRIAL":  # data that the kernel has by then are not lost
                threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGKILL)).start()

    Run(config_for(sys.argv[1], mode="stage"), Path(sys.argv[1]), Path(sys.argv[2]), tell)()
