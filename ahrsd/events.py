"""What the pure core answers: bytes to send, and facts for the log, the viewer and the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ahrsd.calibration import Affine, Estimate
from ahrsd.samples import SampleBlock


@dataclass(frozen=True, slots=True)
class Send:
    """Write these bytes to the port."""

    data: bytes


@dataclass(frozen=True, slots=True)
class SendToClient:
    """Write these bytes into the shared port of this name.

    stream: whether its reader wants measurements from now on; None: as before
    """

    client: str
    data: bytes
    stream: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SamplesSeen:
    """New samples, raw, with the correction that the newest estimate would apply to them."""

    block: SampleBlock
    present: Affine
    proposed: Affine | None


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """A new estimate. `at_s` is device time."""

    at_s: float
    host_s: float
    estimate: Estimate


@dataclass(frozen=True, slots=True)
class GateResult:
    """One row of the verdict: what was measured, the limit, and what a person can do about it."""

    gate: str
    value: float
    limit: float
    ok: bool
    since_s: float
    unit: str
    advice: str


@dataclass(frozen=True, slots=True)
class Judged:
    """All gates at one instant."""

    at_s: float
    host_s: float
    gates: tuple[GateResult, ...]


@dataclass(frozen=True, slots=True)
class StateChanged:
    """The write-back state machine moved."""

    at_s: float
    host_s: float
    old: str
    new: str
    reason: str


@dataclass(frozen=True, slots=True)
class RegisterWritten:
    """A register write was sent, verified, refused or undone (`outcome` says which)."""

    at_s: float
    host_s: float
    register: int
    old: tuple[float, ...]
    new: tuple[float, ...]
    outcome: str


@dataclass(frozen=True, slots=True)
class Noted:
    """One line for the log. `level`: "debug", "info", "warning" or "error"."""

    at_s: float
    host_s: float
    level: str
    text: str


@dataclass(frozen=True, slots=True)
class Answered:
    """What became of a person's command, the `word` of `inputs.Operator`; `text` says why."""

    word: str
    accepted: bool
    text: str


@dataclass(frozen=True, slots=True)
class OpenJournal:
    """The device is known: open its journal and answer with `JournalOpened`."""

    serial: int


@dataclass(frozen=True, slots=True)
class JournalAppend:
    """Make this record durable, then answer with `Journalled`; nothing is sent before."""

    kind: str
    facts: dict[str, object]


@dataclass(frozen=True, slots=True)
class Failure:
    """How work beside the core broke off: in a line, and its traceback."""

    reason: str
    trace: str


@dataclass(frozen=True, slots=True, eq=False)
class Examine:
    """Do this beside the core, each after the one before; then answer with `Examined`."""

    work: Callable[[], Failure | None]


@dataclass(frozen=True, slots=True)
class RegistersRead:
    """A full reading of the device's configuration."""

    host_s: float
    values: dict[int, tuple[float | int | str, ...]]


@dataclass(frozen=True, slots=True)
class Finished:
    """Everything that had to be put back is; the shell may close the port."""

    reason: str


Event = (
    Send
    | SendToClient
    | SamplesSeen
    | Estimated
    | Judged
    | StateChanged
    | RegisterWritten
    | Noted
    | Answered
    | OpenJournal
    | JournalAppend
    | Examine
    | RegistersRead
    | Finished
)
