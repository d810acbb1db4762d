"""What a person wants to hear of a running daemon: how it stands, and when something is amiss.

`look` is called about once a second. Every minute it says how things stand; what is amiss it says
once when it has lasted, and once when it is over. It decides nothing that the core depends on.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from ahrsd.calibration_json import UNKNOWN_HEADING_DEG
from ahrsd.core.core import Core
from ahrsd.printable import counted

STATUS_S = 60.0  # interval of the status line
_AMISS_S = 5.0  # a fault is reported when it has lasted this long
_SILENT = "nothing comes from the device: check its power and cable"
_OFF = (
    "the device answers and sends nothing by itself: its outputs are off (registers 6 and 75 to "
    "77), or paused by a program that was killed (then switch the device off and on); "
    "device.configure_stream = true lets the daemon switch one on"
)
_DEAF = "bytes arrive but no message: not a VN-100, or not the rate of its port"


@dataclass(frozen=True, slots=True)
class Remark:
    """One line for the log; `level` is one of logging's."""

    level: int
    text: str


@dataclass(slots=True)
class _Count:
    """A number that should grow, and since when it has not."""

    value: float = 0.0
    since_s: float = 0.0

    def stuck_s(self, value: float, now_s: float) -> float:
        """For how long it has stood still."""
        if value != self.value:
            self.value, self.since_s = value, now_s
        return now_s - self.since_s


@dataclass(slots=True)
class Watch:
    """See the module. Times are of the host's clock, in s."""

    started_s: float
    silent: bool = False  # no byte for some time
    garbage: bool = False  # bytes, and no message for some time
    _said: str = ""
    _status_s: float = field(init=False)
    _samples: tuple[float, int] = field(init=False)
    _bytes: _Count = field(init=False)
    _messages: _Count = field(init=False)
    _taken: _Count = field(init=False)
    _streamed: _Count = field(init=False)

    def __post_init__(self) -> None:
        self._status_s = self.started_s
        self._samples = (self.started_s, 0)
        self.link_opened(self.started_s)

    def link_opened(self, now_s: float) -> None:
        """Begin to wait for bytes, messages and samples."""
        self._bytes = _Count(-1.0, now_s)
        self._messages = _Count(-1.0, now_s)
        self._taken = _Count(-1.0, now_s)
        self._streamed = _Count(-1.0, now_s)
        self.silent = self.garbage = False

    def look(self, core: Core, now_s: float, capture_error: str, is_open: bool) -> list[Remark]:
        """What is to be said now."""
        reason = self._reason(core, now_s, is_open)
        remarks = self._amiss(reason, capture_error, self._taken.since_s == now_s)
        if now_s - self._status_s >= STATUS_S:
            self._status_s = now_s
            remarks.append(Remark(logging.INFO, self._status(core, now_s)))
        return remarks

    def _reason(self, core: Core, now_s: float, is_open: bool) -> str:
        """What is amiss with the stream; empty where nothing is."""
        counters = core.device_session.session.deframer.counters
        silent_s = self._bytes.stuck_s(counters.fed_bytes, now_s)
        deaf_s = self._messages.stuck_s(counters.valid, now_s)
        idle_s = self._taken.stuck_s(core.stream.facts.samples, now_s)
        self.silent = is_open and silent_s >= _AMISS_S
        self.garbage = is_open and deaf_s >= _AMISS_S and not self.silent
        if not is_open:
            return ""  # that the port is gone is said elsewhere
        if self._outputs_off(core, now_s, deaf_s):
            return _OFF
        if self.silent:
            return _SILENT
        if self.garbage:
            return _DEAF
        if idle_s >= _AMISS_S:
            return _no_samples(core)
        return ""

    def _outputs_off(self, core: Core, now_s: float, deaf_s: float) -> bool:
        """Whether an identified device only answers, and has sent nothing by itself for longer."""
        streamed = sum(core.stream.by_layout.values())
        unsent_s = self._streamed.stuck_s(streamed, now_s)
        answers = deaf_s < core.writeback.policy.recheck_s + _AMISS_S
        only_answers = not streamed or unsent_s - deaf_s >= _AMISS_S
        known = core.device_session.identity is not None
        return known and answers and only_answers and unsent_s >= _AMISS_S

    def _amiss(self, stream: str, capture_error: str, flowing: bool) -> list[Remark]:
        capture = f"capture: {capture_error}, records are being lost" if capture_error else ""
        now = "; ".join(text for text in (stream, capture) if text)
        if now == self._said or not (now or flowing):  # after reopening nothing is known yet
            return []
        self._said = now
        return [Remark(logging.WARNING, now) if now else Remark(logging.INFO, "all is well again")]

    def _status(self, core: Core, now_s: float) -> str:
        """One line: samples, rate, state, heading sigma, what holds a write back."""
        facts, (before_s, before) = core.stream.facts, self._samples
        self._samples = (now_s, facts.samples)
        rate = (facts.samples - before) / max(now_s - before_s, 1e-9)
        estimate = core.calibrator.estimate
        sigma = "no estimate" if estimate is None else _sigma(estimate.heading_sigma_deg)
        holds = core.writeback.obstacles() if core.calibrator.gates else []
        gates = [text.removeprefix("gate ") for text in holds if text.startswith("gate ")]
        waits = f", waits for {gates[0]}" if gates else "".join(f"; {text}" for text in holds[:1])
        return (
            f"{counted(facts.samples, 'sample')}, {rate:.1f} Hz, "
            f"{counted(core.stream.all_gaps.count, 'gap')}, "
            f"{core.writeback.state.value}, heading sigma {sigma}{waits}"
        )


def _no_samples(core: Core) -> str:
    reasons = "; ".join(str(error) for error in core.stream.refused.values())
    if not reasons:
        return "messages arrive, but no samples"
    return f"{reasons}; or let the daemon do it: device.configure_stream = true"


def _sigma(heading_sigma_deg: float) -> str:
    known = heading_sigma_deg < UNKNOWN_HEADING_DEG
    return f"{heading_sigma_deg:.2f} deg" if known else "not known"
