"""The main job with no hardware: an emulated VN-100 with hidden iron, and the real daemon.

The daemon talks to the emulator over a pty, at `speed` times real time on both sides. The demo
plays the people of the scene (`scene`): the vehicle, which says that a write is safe, the operator,
who approves the candidate by its id, and somebody who switches the device off and on again. It
knows the truth and uses it only to judge at the end (`result`).
"""

from __future__ import annotations

import contextlib
import datetime
import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.config.core_settings import core_settings
from ahrsd.config.loading import CONFIG_KEY, Config, check_config
from ahrsd.config.text import print_config
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import JournalKeeper, Shell
from ahrsd.daemon.daemon import Daemon, HostClock
from ahrsd.daemon.journal import Journal
from ahrsd.daemon.service import close_shell
from ahrsd.demo.result import LIMIT_DEG, DemoResult, figures, lines, verdict
from ahrsd.demo.scene import DemoScene, live_samples
from ahrsd.errors import EXIT_BUSY, DeviceError
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.recording.capture import CaptureWriter
from ahrsd.report import EventCollector, HeadingError, write_report
from ahrsd.report.calibration_json import calibration_json
from ahrsd.report.summary import heading_errors, serial_of
from ahrsd.samples import Array
from ahrsd.viewer.sink import RerunSink
from ahrsd.writeback.states import State
from drivers.serial_port import PortError, SerialPort
from drivers.vn100.device import Device
from drivers.vn100.emulator.physics import EmulatedTruth
from drivers.vn100.emulator.process import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.errors import DriverError
from drivers.vn100.procedures import read_registers
from drivers.vn100.registers import same

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
_BAUD = 115200
_RATE_HZ = 50
_MAG, _GYRO = 23, 84
# Pirouettes until a calibration should be proven; then a minute's rest, in which it can be saved,
# and pirouettes again, so that all headings follow the write.
_MOTION = (("survey", 240.0), ("survey", 160.0), *(("static", 60.0), ("survey", 120.0)) * 10)
# On the Black Sea, where the world model has the emulator's field: 0.49 G, 60 deg down.
_PLACE = {"latitude_deg": 42.0, "longitude_deg": 34.2, "date": datetime.date(2026, 1, 1)}
_REPLY_S = 0.1  # real time that a reply may take; the clock of the demo runs `speed` times faster
_REST_S = 10.0  # longer than the stops between pirouettes, which are too short for a save
_LONGEST_AGE_S = 60.0  # of the vehicle's word, as far as the configuration goes
_UNREAD_BYTES = 512  # then the world waits: some messages
_WATCH_S = 0.5
_CLOSE_S = 60.0  # real time at most for the files to be whole: nobody waits for a demo's end
_STUCK_S = 120.0  # real time in which the emulated world goes on by nothing
# Of device time in all. A busy machine makes the demo slow; no such machine makes it longer.
_LONGEST, _SPARE_S = 2.0, 600.0


@dataclass(frozen=True, slots=True)
class WorldClock(HostClock):
    """The emulated world's time: a busy machine slows the world, and the daemon's clock with it."""

    world_s: Callable[[], float] = float

    def now_ns(self) -> int:
        """Nanoseconds, never falling."""
        return self.start_ns + int(self.world_s() * 1e9)

    def boot(self) -> tuple[str, float]:
        """The world's time, whose boot was its beginning."""
        return self._own_boot()


class AlwaysSafe:
    """A vehicle that never objects."""

    def safe(self) -> bool:
        """The vehicle's word."""
        return True


def demo_config(directory: Path, speed: float = 1.0) -> Config:
    """The configuration of the demo: flash may be written, a person approves.

    What is asked of the host in seconds (how old the vehicle's word and the newest sample may be,
    how long a reply takes) is asked of a clock that runs `speed` times faster here.
    """
    age_s = float(min(max(3.0 * speed, 1.0), _LONGEST_AGE_S))
    body = {
        "mode": "commit",
        "state_directory": str(directory),
        "device": {"baud": _BAUD, "reply_timeout_s": max(0.4, _REPLY_S * speed)},
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
    setup = Setup("rov", seed=seed, output="binary", rate_hz=_RATE_HZ, baud=_BAUD, motion=_MOTION)
    truth = build(setup).truth
    config = demo_config(directory, speed)
    scene = DemoScene(seconds, say)
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "vn100"
        with _emulated(setup, link, speed) as emulated:
            clock = WorldClock(speed, patient_bytes=_UNREAD_BYTES, world_s=emulated.device_s)
            shell = _shell(directory, config, clock, scene)
            scene.daemon = Daemon(config, shell, link, clock, AlwaysSafe())
            scene.power_cycle = emulated.power_cycle
            _run(scene.daemon, shell, emulated, _LONGEST * seconds + _SPARE_S)
            registers = _read_back(link)
    result = _conclude(truth, registers, scene, shell.core)
    _leave(directory, seed, result, scene, shell.core)
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


@contextlib.contextmanager
def _emulated(setup: Setup, link: Path, speed: float) -> Iterator[EmulatorProcess]:
    """The emulated device; whatever its port says becomes one line."""
    try:
        with EmulatorProcess(setup, link=link, speed=speed, lossless=True) as emulated:
            yield emulated
    except (PortError, DriverError) as error:
        raise DeviceError(f"the emulated device: {error}", EXIT_BUSY) from error
    except OSError as error:
        if error.filename not in (None, str(link)):
            raise
        raise DeviceError(f"no emulated device: {error}", EXIT_BUSY) from error


def _run(daemon: Daemon, shell: Shell, emulated: EmulatorProcess, longest_s: float) -> None:
    """The daemon until the scene ends it, or the emulated device is gone or stands still.

    longest_s: of device time, in case no samples come that could end the scene
    """
    over = threading.Event()
    trouble: list[str] = []

    def watch() -> None:
        world_s, moved = emulated.device_s(), time.monotonic()
        while not over.wait(_WATCH_S):
            now_s = emulated.device_s()
            if now_s != world_s:
                world_s, moved = now_s, time.monotonic()
            if not emulated.alive:
                trouble.append("the emulated device died")
            elif time.monotonic() - moved > _STUCK_S:
                trouble.append(f"the emulated device stood still for {_STUCK_S:.0f} s")
            elif world_s > longest_s:
                trouble.append(f"no end after {longest_s:.0f} s of device time")
            if trouble:
                daemon.stop(trouble[0])
                return

    watcher = threading.Thread(target=watch, name="demo-watch", daemon=True)
    watcher.start()
    try:
        daemon.run()
    finally:
        over.set()
        watcher.join()
        close_shell(shell, time.monotonic() + _CLOSE_S)
    if trouble:
        raise DeviceError(f"the demo ended early: {trouble[0]}", EXIT_BUSY)


def _read_back(link: Path) -> dict[int, tuple[float, ...]]:
    """What the device holds now, by a connection of its own."""
    with SerialPort(link, _BAUD) as port, Device(port) as device:
        values = device.run(read_registers((_MAG, _GYRO)), 10.0)
    return {number: tuple(map(float, v)) for number, v in values.items()}


def _conclude(
    truth: EmulatedTruth, registers: dict[int, tuple[float, ...]], scene: DemoScene, core: Core
) -> DemoResult:
    """Judge by the truth."""
    sent = scene.proposed
    exact = bool(sent) and all(same(n, sent[n], registers[n]) for n in sent)
    present = Affine.identity()  # the emulated device comes from the factory
    written = Affine.from_register(registers[_MAG])
    true = Affine(np.asarray(np.linalg.inv(truth.soft_iron), float), truth.hard_iron_gauss)
    heading, before, after = _live_headings(scene, true, present, written)
    return DemoResult(
        truth=truth,
        present=present,
        written=written,
        written_gyro=Affine.from_register(registers[_GYRO]),
        read_back_exact=exact,
        estimate=scene.approved or scene.estimate,
        state=scene.state,
        goal=State.CONFIRMED.value,
        decision_sha256=core.decisions.sha256,
        live_heading_deg=heading,
        live_before_deg=before,
        live_after_deg=after,
    )


def _live_headings(
    scene: DemoScene, true: Affine, old: Affine, new: Affine
) -> tuple[Array, Array, Array]:
    """Heading, error before and error after (deg) of the samples since the write.

    All three corrections see the same samples, so sensor noise cancels in the differences.
    """
    raw, accel = live_samples(scene)
    heading = tilt_compensated_heading(true.apply(raw), accel)
    errors = [
        np.degrees(wrapped(tilt_compensated_heading(c.apply(raw), accel) - heading))
        for c in (old, new)
    ]
    return np.degrees(heading), errors[0], errors[1]


def _leave(directory: Path, seed: int, result: DemoResult, scene: DemoScene, core: Core) -> None:
    """calibration.json and report.html; the other files are there already."""
    body = calibration_json(
        "capture.mcap",
        result.estimate,
        scene.in_force or core.registers,
        heading=heading_errors(core),
        warnings=list(core.stream.warnings),
        serial=serial_of(core),
    )
    (directory / "calibration.json").write_text(json.dumps(body, indent=1) + "\n")
    _report(directory / "report.html", seed, result, scene.collector)


def _report(path: Path, seed: int, result: DemoResult, collector: EventCollector) -> None:
    truth = result.truth
    heading = HeadingError(
        result.live_heading_deg,
        result.live_before_deg,
        result.live_after_deg,
        "Live samples after the new registers were written: the approved estimate has not seen "
        "them. The error is against the emulator's hidden truth.",
        LIMIT_DEG,
    )
    report = collector.report(
        "ahrsd demo",
        {
            "hard_iron_gauss": truth.hard_iron_gauss,
            "soft_iron": truth.soft_iron,
            "gyro_bias_rad_s": truth.gyro_bias_rad_s,
        },
        verdict=verdict(result),
        good=result.good,
        summary=figures(result),
        seed=seed,
        command=f"ahrsd demo --output {path.parent.name} --seed {seed}",
        heading=heading if len(result.live_heading_deg) else None,
    )
    write_report(path, report)
