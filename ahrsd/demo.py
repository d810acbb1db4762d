"""The main job with no hardware: an emulated VN-100 with hidden iron, and the real daemon.

The daemon talks to the emulator over a pty, at `speed` times real time on both sides. The demo
plays the two people of the scene: the vehicle, which says that a write is safe, and the operator,
who approves the candidate by its id. It knows the truth and uses it only to judge at the end.
"""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.config import CONFIG_KEY, Config, check_config
from ahrsd.config_text import print_config
from ahrsd.core import Core
from ahrsd.daemon import Daemon, HostClock, close_shell
from ahrsd.events import Estimated, Event, GateResult, Judged, SamplesSeen, StateChanged
from ahrsd.headings import tilt_compensated_heading, wrapped
from ahrsd.journal import Journal
from ahrsd.recording.capture import CaptureWriter
from ahrsd.report import EventCollector, HeadingError, KeyFigure, write_report
from ahrsd.rerun_sink import RerunSink
from ahrsd.result import calibration_json
from ahrsd.samples import Array
from ahrsd.settings import core_settings, with_date
from ahrsd.shell import JournalKeeper, Shell
from ahrsd.summary import heading_errors
from ahrsd.writeback.states import State
from drivers.serial_port import SerialPort
from drivers.vn100.device import Device
from drivers.vn100.emulator_physics import Truth
from drivers.vn100.emulator_process import EmulatorProcess
from drivers.vn100.emulator_scenarios import Setup, build
from drivers.vn100.procedures import read_registers
from drivers.vn100.registers import same

SPEED = 40.0
_BAUD = 115200
_RATE_HZ = 50
_MAG, _GYRO = 23, 84
_LIMIT_DEG = 0.5
_LIMIT_BIAS_RAD_S = 3e-4
# Where the emulator's field (0.49 G, 60 deg dip) is that of the world model: San Francisco.
_PLACE = {"latitude_deg": 37.8, "longitude_deg": -122.4}
_REPLY_S = 0.1  # real time that a reply may take; the clock of the demo runs `speed` times faster
_LIVE_S = 120.0  # of device time after the proof, for the picture


class AlwaysSafe:
    """A vehicle that never objects."""

    def safe(self) -> bool:
        """The vehicle's word."""
        return True


@dataclass(slots=True)
class Scene:
    """Plays the operator, and remembers what the report needs."""

    collector: EventCollector = field(default_factory=EventCollector)
    seconds: float = 2400.0
    say: Callable[[str], None] = print
    daemon: Daemon | None = None
    state: str = State.RECONCILING.value
    gates: tuple[GateResult, ...] = ()
    estimate: Estimate | None = None
    written: Estimate | None = None
    live: list[tuple[Array, Array]] = field(default_factory=list)
    proven_at_s: float = float("nan")
    first_s: float = float("nan")
    newest_s: float = 0.0
    said_s: float = -1e9

    def __call__(self, event: Event) -> None:
        """Watch one event."""
        self.collector.add(event)
        match event:
            case SamplesSeen(block):
                self._samples(block.time_s, block.raw_b_gauss, block.accel_b_m_s2)
            case Estimated(estimate=estimate):
                self.estimate = estimate
            case Judged(gates=gates):
                self.gates = gates
                self._progress()
            case StateChanged(at_s=at_s, new=new, reason=reason):
                self.state = new
                self.say(f"{at_s:7.1f} s  {new}: {reason}")
                self._answer(new, at_s)

    def _samples(self, time_s: Array, raw: Array, accel: Array) -> None:
        if np.isnan(self.first_s):
            self.first_s = float(time_s[0])
        self.newest_s = float(time_s[-1])
        if self.newest_s - self.first_s > self.seconds:
            self._end(f"{self.seconds:.0f} s of device time are over")
        if np.isfinite(self.proven_at_s):
            self.live.append((raw, accel))
            if self.newest_s - self.proven_at_s > _LIVE_S:
                self._end("proven and shown on live data")

    def _answer(self, state: str, at_s: float) -> None:
        assert self.daemon is not None
        if state == State.QUALIFIED:
            proposal = self.daemon.shell.core.writeback.proposal
            if proposal is not None:
                self.say(f"{at_s:7.1f} s  operator approves candidate {proposal.id}:")
                for line in proposal.lines:
                    self.say(f"             {line}")
                self.daemon.operate("approve", proposal.id)
        elif state == State.STAGING:
            self.written = self.estimate
        elif state == State.PROVEN:
            self.proven_at_s = self.newest_s
        elif state in (State.ROLLED_BACK, State.FAULT, State.LOCKED, State.FLASH_TORN):
            self._end(f"ended in {state}")

    def _progress(self) -> None:
        if self.newest_s - self.said_s < 60.0 or self.estimate is None:
            return
        self.said_s = self.newest_s
        shut = [g.gate for g in self.gates if not g.ok]
        self.say(
            f"{self.newest_s:7.1f} s  heading sigma {self.estimate.heading_sigma_deg:6.2f} deg, "
            f"{len(self.gates) - len(shut)} of {len(self.gates)} gates open"
            + (f", waiting for {', '.join(shut[:3])}" if shut else "")
        )

    def _end(self, reason: str) -> None:
        assert self.daemon is not None
        self.daemon.stop(reason)


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """Before, after, truth."""

    truth: Truth
    present: Affine
    written: Affine
    written_gyro: Affine
    read_back_exact: bool
    estimate: Estimate | None
    state: str
    live_before_deg: Array
    live_after_deg: Array
    live_heading_deg: Array

    @property
    def worst_before_deg(self) -> float:
        """Worst heading error over all level headings with the registers as found."""
        return self.truth.heading_error_deg(self.present.matrix, self.present.offset)

    @property
    def worst_after_deg(self) -> float:
        """The same with the registers as the device now holds them."""
        return self.truth.heading_error_deg(self.written.matrix, self.written.offset)

    @property
    def bias_error_rad_s(self) -> Array:
        """Gyro bias error (3,) of what register 84 now removes."""
        return np.asarray(self.written_gyro.offset - self.truth.gyro_bias_rad_s)

    @property
    def good(self) -> bool:
        """Whether the demo did what it promises."""
        return (
            self.state == State.PROVEN.value
            and self.read_back_exact
            and self.worst_after_deg <= _LIMIT_DEG
            and bool(np.all(np.abs(self.bias_error_rad_s) <= _LIMIT_BIAS_RAD_S))
        )


def demo_config(directory: Path, speed: float = 1.0) -> Config:
    """The configuration of the demo: RAM may be written, a person approves.

    What is asked of the host in seconds (how old the vehicle's word may be) is asked of a clock
    that runs `speed` times faster here.
    """
    body = {
        "mode": "stage",
        "state_directory": str(directory),
        "device": {"baud": _BAUD, "reply_timeout_s": max(0.4, _REPLY_S * speed)},
        "location": _PLACE,
        "interlock": {"max_age_s": float(min(max(speed / 2, 1.0), 60.0))},
        "write_back": {"keep_on_stop": True},
    }
    return with_date(check_config(body, "demo"))


def run_demo(
    directory: Path,
    *,
    seconds: float = 2400.0,
    seed: int = 0,
    speed: float = SPEED,
    say: Callable[[str], None] = print,
) -> DemoResult:
    """The whole scene; leaves the five files in `directory`. Raises AhrsdError."""
    directory.mkdir(parents=True, exist_ok=True)
    capture = directory / "capture.mcap"
    journal = directory / "journal.jsonl"
    for old in (capture, journal, directory / "run.rrd"):
        old.unlink(missing_ok=True)
    setup = Setup("rov", seed=seed, output="binary", rate_hz=_RATE_HZ, baud=_BAUD)
    truth = build(setup).truth
    config = demo_config(directory, speed)
    clock = HostClock(speed)
    scene = Scene(seconds=seconds, say=say)
    shell = Shell(
        Core(core_settings(config)),
        CaptureWriter(capture, {"program": "ahrsd demo", CONFIG_KEY: print_config(config)}),
        JournalKeeper(lambda _: Journal.open(journal), clock.now_ns),
        RerunSink(directory / "run.rrd", wait=True),
        [scene],
    )
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "vn100"
        with EmulatorProcess(setup, link=link, speed=speed, lossless=True):
            scene.daemon = Daemon(config, shell, link, clock, AlwaysSafe())
            _run(scene.daemon, shell, seconds / speed)
            registers = _read_back(link)
    result = _conclude(truth, registers, scene, shell.core)
    _leave(directory, seed, result, scene, shell.core)
    return result


def _run(daemon: Daemon, shell: Shell, expected_s: float) -> None:
    """The daemon until the scene ends it, or well after it should have."""
    guard = threading.Timer(3.0 * expected_s + 60.0, daemon.stop, ["the demo took too long"])
    guard.daemon = True
    guard.start()
    try:
        daemon.run()
    finally:
        guard.cancel()
        close_shell(shell)


def _read_back(link: Path) -> dict[int, tuple[float, ...]]:
    """What the device holds now, by a connection of its own."""
    with SerialPort(link, _BAUD) as port, Device(port) as device:
        values = device.run(read_registers((_MAG, _GYRO)), 10.0)
    return {number: tuple(map(float, v)) for number, v in values.items()}


def _conclude(
    truth: Truth, registers: dict[int, tuple[float, ...]], scene: Scene, core: Core
) -> DemoResult:
    """Judge by the truth."""
    transaction = core.writeback.history.open
    sent = {} if transaction is None else transaction.new
    exact = bool(sent) and all(same(n, sent[n], registers[n]) for n in sent)
    old = Affine.identity()
    if transaction is not None and _MAG in transaction.old:
        old = Affine.from_register(tuple(map(float, transaction.old[_MAG])))
    written = Affine.from_register(registers[_MAG])
    true = Affine(np.asarray(np.linalg.inv(truth.soft_iron), float), truth.hard_iron_gauss)
    live = _live_headings(scene, true, old, written)
    return DemoResult(
        truth=truth,
        present=old,
        written=written,
        written_gyro=Affine.from_register(registers[_GYRO]),
        read_back_exact=exact,
        estimate=scene.written or scene.estimate,
        state=scene.state,
        live_heading_deg=live[0],
        live_before_deg=live[1],
        live_after_deg=live[2],
    )


def _live_headings(
    scene: Scene, true: Affine, old: Affine, new: Affine
) -> tuple[Array, Array, Array]:
    """Heading, error before and error after (deg) of the samples since the proof.

    All three corrections see the same samples, so sensor noise cancels in the differences.
    """
    if not scene.live:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    raw = np.vstack([r for r, _ in scene.live])[::5]
    accel = np.vstack([a for _, a in scene.live])[::5]
    heading = tilt_compensated_heading(true.apply(raw), accel)
    errors = [
        np.degrees(wrapped(tilt_compensated_heading(c.apply(raw), accel) - heading))
        for c in (old, new)
    ]
    return np.degrees(heading), errors[0], errors[1]


def _leave(directory: Path, seed: int, result: DemoResult, scene: Scene, core: Core) -> None:
    """calibration.json and report.html; the other files are there already."""
    body = calibration_json(
        "capture.mcap",
        result.estimate,
        {_MAG: result.present.to_register()},
        heading=heading_errors(core),
        warnings=list(core.stream.warnings),
    )
    (directory / "calibration.json").write_text(json.dumps(body, indent=1) + "\n")
    truth = result.truth
    parts = {
        "verdict": verdict(result),
        "good": result.good,
        "summary": tuple(figures(result)),
        "seed": seed,
        "command": f"ahrsd demo --output {directory.name} --seed {seed}",
    }
    if len(result.live_heading_deg):
        parts["heading"] = HeadingError(
            result.live_heading_deg,
            result.live_before_deg,
            result.live_after_deg,
            "live samples after the registers were proven, which no estimate has seen; against "
            "the emulator's hidden truth",
            _LIMIT_DEG,
        )
    report = scene.collector.report(
        "ahrsd demo",
        {
            "hard_iron_gauss": truth.hard_iron_gauss,
            "soft_iron": truth.soft_iron,
            "gyro_bias_rad_s": truth.gyro_bias_rad_s,
        },
        **parts,
    )
    write_report(directory / "report.html", report)


def verdict(result: DemoResult) -> str:
    """One sentence."""
    if result.good:
        return (
            f"The worst heading error fell from {result.worst_before_deg:.1f} to "
            f"{result.worst_after_deg:.2f} deg; the registers read back exactly."
        )
    return f"The demo did not reach its goal; it ended in state {result.state}."


def figures(result: DemoResult) -> list[KeyFigure]:
    """Before, after and limit of what matters."""
    bias = result.truth.gyro_bias_rad_s * 1e3
    left = result.bias_error_rad_s * 1e3
    return [
        KeyFigure(
            "Worst heading error, all headings, level",
            "deg",
            result.worst_before_deg,
            result.worst_after_deg,
            _LIMIT_DEG,
        ),
        *(
            KeyFigure(f"Gyro bias {axis}", "mrad/s", float(b), float(e), _LIMIT_BIAS_RAD_S * 1e3)
            for axis, b, e in zip("xyz", bias, left, strict=True)
        ),
    ]
