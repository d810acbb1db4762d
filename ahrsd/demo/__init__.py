"""The main job with no hardware: an emulated VN-100 with hidden iron, and the real daemon.

The daemon talks to the emulator over a pty (`emulated`), at `speed` times real time on both sides.
The demo plays the people of the scene (`scene`): the vehicle, which says that a write is safe, the
operator, who approves the candidate by its id, and somebody who switches the device off and on
again. It knows the truth and uses it only to judge at the end (`result`).
"""

from __future__ import annotations

import datetime
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from ahrsd.config.config import CONFIG_KEY, Config, check_config, core_settings, print_config
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import JournalKeeper, Shell, close_shell
from ahrsd.daemon.daemon import Daemon
from ahrsd.daemon.host_clock import HostClock
from ahrsd.daemon.journal import Journal
from ahrsd.daemon.vehicle_files import VehicleFiles
from ahrsd.demo.emulated import (
    BAUD,
    UNREAD_BYTES,
    AlwaysSafe,
    WorldClock,
    emulated_device,
    read_back,
    run_watched,
)
from ahrsd.demo.result import GYRO, MAG, DemoResult, conclude, figures, lines, verdict, write_files
from ahrsd.demo.scene import DemoScene
from ahrsd.recording.capture import CaptureWriter
from ahrsd.viewer.sink import RerunSink
from drivers.vn100.emulator.scenarios import Setup, build

__all__ = ["FILES", "SPEED", "DemoResult", "demo_config", "figures", "lines", "run_demo", "verdict"]

SPEED = 20.0
FILES = (
    "report.html",
    "run.rrd",
    "capture.mcap",
    "calibration.json",
    "journal.jsonl",
    "journal.receipt",
)
_RATE_HZ = 50
# Pirouettes until a calibration should be proven; then a minute's rest, in which it can be saved,
# and pirouettes again, so that all headings follow the write.
_MOTION = (("survey", 240.0), ("survey", 160.0), *(("static", 60.0), ("survey", 120.0)) * 10)
# On the Black Sea, where the world model has the emulator's field: 0.49 G, 60 deg down.
_PLACE = {"latitude_deg": 42.0, "longitude_deg": 34.2, "date": datetime.date(2026, 1, 1)}
_REPLY_S = 0.3  # real time that a reply may take; the clock of the demo runs `speed` times faster
_REST_S = 10.0  # longer than the stops between pirouettes, which are too short for a save
_LONGEST_AGE_S = 60.0  # of the vehicle's word, as far as the configuration goes
_CLOSE_S = 60.0  # real time at most for the files to be whole: nobody waits for a demo's end
# Of device time in all. A busy machine makes the demo slow; no such machine makes it longer.
_LONGEST, _SPARE_S = 2.0, 600.0


def demo_config(directory: Path, speed: float = 1.0) -> Config:
    """The configuration of the demo: flash may be written, a person approves.

    What is asked of the host in seconds (how old the vehicle's word and the newest sample may be,
    how long a reply takes) is asked of a clock that runs `speed` times faster here.
    """
    age_s = float(min(max(3.0 * speed, 1.0), _LONGEST_AGE_S))
    body = {
        "mode": "commit",
        "state_directory": str(directory),
        "device": {"baud": BAUD, "reply_timeout_s": max(0.4, _REPLY_S * speed)},
        "location": _PLACE,
        "interlock": {"max_age_s": age_s},
        "still": {"duration_s": _REST_S, "max_age_s": max(2.0, age_s)},
    }
    return check_config(body, "demo")


def run_demo(
    directory: Path,
    *,
    seconds: float = 2400.0,
    seed: int = 0,
    speed: float = SPEED,
    say: Callable[[str], None] = print,
) -> DemoResult:
    """The whole scene; leaves `FILES` in `directory`. Raises AhrsdError, and OSError of the files.

    seconds: of device time, at most
    """
    directory.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        (directory / name).unlink(missing_ok=True)
    setup = Setup("rov", seed=seed, output="binary", rate_hz=_RATE_HZ, baud=BAUD, motion=_MOTION)
    truth = build(setup).truth
    config = demo_config(directory, speed)
    scene = DemoScene(seconds, say)
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "vn100"
        with emulated_device(setup, link, speed) as emulated:
            clock = WorldClock(speed, patient_bytes=UNREAD_BYTES, world_s=emulated.device_s)
            shell = _shell(directory, config, clock, scene)
            files = VehicleFiles(AlwaysSafe(), max_age_s=config.interlock.max_age_s)
            daemon = Daemon(config, shell, link, clock, files)
            scene.stop, scene.operate = daemon.stop, daemon.operate
            scene.candidate = lambda: shell.core.writeback.proposal
            scene.registers = lambda: shell.core.registers
            scene.power_cycle = emulated.power_cycle
            try:
                run_watched(daemon, emulated, _LONGEST * seconds + _SPARE_S)
            finally:
                close_shell(shell, time.monotonic() + _CLOSE_S)
            registers = read_back(link, (MAG, GYRO))
    result = conclude(truth, registers, scene, shell.core)
    write_files(directory, seed, result, scene, shell.core)
    return result


def _shell(directory: Path, config: Config, clock: HostClock, scene: DemoScene) -> Shell:
    header = {"program": "ahrsd demo", CONFIG_KEY: print_config(config)}
    return Shell(
        Core(core_settings(config)),
        CaptureWriter(directory / "capture.mcap", header),
        JournalKeeper(lambda _: Journal.open(directory / "journal.jsonl"), clock.now_ns),
        RerunSink(directory / "run.rrd", wait=True),
        [scene],
    )
