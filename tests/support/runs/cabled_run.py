"""A core on a cable (`cabled_units`), in virtual time, with a journal per serial number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from cabled_units import Cable, Unit, sentence
from planted_calibrator import PlantedCalibrator

from ahrsd import events, inputs
from ahrsd.calibration import Estimate, Observability
from ahrsd.config.config import Config, core_settings
from ahrsd.config.sections import GatesSection
from ahrsd.core.core import Core
from ahrsd.writeback.policy import StillPolicy, WriteBackPolicy
from ahrsd.writeback.states import Mode
from ahrsd.writeback.trial import TrialPolicy

IRON, BIAS = np.array([0.05, -0.03, 0.04]), np.array([0.01, -0.02, 0.005])
FIRST, SPARE = 100130608, 555
TRIAL = TrialPolicy(duration_s=25.0, turns=100.0, interlock=False)


def estimate(**changes: Any) -> Estimate:
    """The truth of the first unit."""
    values: dict[str, Any] = {
        "soft_iron": np.eye(3), "hard_iron_gauss": IRON, "gyro_bias_rad_s": BIAS,
        "field_gauss": 0.4837, "field_known": False, "covariance": np.eye(12) * 1e-8,
        "noise_mag_gauss": 1e-3, "noise_gyro_rad_s": 1e-3, "misfit": 1.0,
        "heading_sigma_deg": 0.05,
        "observability": Observability(np.full(12, 0.01), (), 10.0),
        "samples": 10_000, "duration_s": 300.0, "converged": True,
    }  # fmt: skip
    return Estimate(**{**values, **changes})


def lenient_gates() -> dict[str, float]:
    """Limits that a minute of motion passes."""
    easy: dict[str, float] = {}
    for name, info in GatesSection.model_fields.items():
        bounds: dict[str, Any] = {type(one).__name__: one for one in info.metadata}
        if name.startswith(("max_", "holdout_rms", "holdout_max", "repeat", "field_", "closure")):
            easy[name] = float(bounds["Le"].le)
        elif name.startswith(("min_", "holdout_segments")):
            easy[name] = float(bounds["Ge"].ge)
    return {**easy, "second_opinion_deg": 180.0, "field_min_gauss": 0.0}


def two_units(rate_hz: float = 20.0, **options: Any) -> Cable:
    """The unit that is judged, and a spare one with another iron."""
    first = Unit(FIRST, IRON, BIAS, **options)
    spare = Unit(SPARE, np.array([-0.1, 0.08, 0.02]), -BIAS, uptime_s=1e5, **options)
    return Cable(first, spare, rate_hz=rate_hz)


class CabledRun:
    """See the module."""

    def __init__(
        self, cable: Cable, *, planted: bool = True, shares: tuple[Any, ...] = (),
        journal: dict[int, list[dict[str, Any]]] | None = None, journal_error: str = "",
        **policy: Any,
    ) -> None:  # fmt: skip
        given: dict[str, Any] = {
            "mode": Mode.COMMIT, "trial": TRIAL, "still": StillPolicy(gyro_rad_s=0.02),
            **policy,
        }  # fmt: skip
        self.cable = cable
        settings = core_settings(Config(), policy=WriteBackPolicy(**given))
        self.core = Core(replace(settings, shares=shares))
        self.heard: dict[str, bytes] = {share.name: b"" for share in shares}
        self.safe, self.journal_error = True, journal_error
        self.journal = {} if journal is None else journal  # of a run before, by serial number
        self.notes: list[tuple[str, str]] = []
        self.states: list[str] = []
        self.taken: list[inputs.Input] = []
        self.listeners: list[Callable[[events.Event], None]] = []
        self.now_s, self._serial = 1.0, 0
        self.feed(inputs.WallClock(self.now_ns, 8e8))
        self.feed(inputs.LinkOpened(self.now_ns, "cable", 115200))
        assert self.until("OBSERVING"), self.notes
        if planted:
            self.run(3.0)
            self.planted_at = len(self.taken)
            self.core.calibrator = PlantedCalibrator(self.core.calibrator, estimate())

    @property
    def now_ns(self) -> int:
        return round(self.now_s * 1e9)

    @property
    def state(self) -> str:
        return self.core.writeback.state.value

    def feed(self, item: inputs.Input) -> None:
        waiting = [item]
        while waiting:
            one = waiting.pop(0)
            self.taken.append(one)
            for event in self.core.handle(one):
                for listener in self.listeners:
                    listener(event)
                match event:
                    case events.Send(data):
                        self.cable.receive(data)
                    case events.SendToClient(client, data):
                        self.heard[client] += data
                    case events.OpenJournal(serial):
                        self._serial = serial
                        records: list[Any] = list(self.journal.setdefault(serial, []))
                        error = self.journal_error
                        opened = inputs.JournalOpened(
                            self.now_ns, serial, [] if error else records, error
                        )
                        waiting.append(opened)
                    case events.JournalAppend(kind, facts):
                        record = {"kind": kind, "facts": dict(facts)}
                        self.journal[self._serial].append(record)
                        waiting.append(inputs.Journalled(self.now_ns, kind))
                    case events.Noted(level=level, text=text):
                        self.notes.append((level, text))
                    case events.StateChanged(new=new):
                        self.states.append(new)

    def say(self, client: str, *bodies: str) -> None:
        """A program on a shared port writes these lines."""
        text = "".join(sentence(body).decode() for body in bodies)
        self.feed(inputs.ClientSent(self.now_ns, client, text))

    def answers(self, client: str) -> list[str]:
        """What it was answered since the last call, between $ and *."""
        heard, self.heard[client] = self.heard[client], b""
        return [line[1:].split("*")[0] for line in heard.decode().split("\r\n")[:-1]]

    def step(self) -> None:
        self.now_s += self.cable.step_s
        data = self.cable.advance()
        if round(self.now_s / self.cable.step_s) % 5 == 0:
            self.feed(inputs.Interlock(self.now_ns, self.safe))
        if data:
            self.feed(inputs.Received(self.now_ns, data))
        due = self.core.deadline_ns
        if due is not None and due <= self.now_ns:
            self.feed(inputs.Tick(self.now_ns))

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.step()

    def until(self, what: str | Callable[[], object], seconds: float = 120.0) -> bool:
        end_s = self.now_s + seconds
        while not (self.state == what if isinstance(what, str) else what()):
            if self.now_s >= end_s:
                return False
            self.step()
        return True

    def approve(self) -> None:
        assert self.until("QUALIFIED"), self.notes
        proposal = self.core.writeback.proposal
        assert proposal is not None
        self.feed(inputs.Operator(self.now_ns, "approve", proposal.id))

    def proven(self) -> None:
        """As far as PROVEN, the vehicle not safe."""
        self.approve()
        assert self.until("TRIAL", 30.0), self.notes
        self.safe = False
        assert self.until("PROVEN"), self.notes

    def park(self, seconds: float = 20.0) -> None:
        """Safe and still: what is proven is saved now or never."""
        self.cable.moving, self.safe = False, True
        self.run(seconds)

    def kinds(self, serial: int = FIRST) -> list[str]:
        return [record["kind"] for record in self.journal.get(serial, [])]

    def told(self, *words: str) -> bool:
        """Whether one line has all these words."""
        return any(all(word in text for word in words) for _, text in self.notes)
