"""Everything that can reach the pure core, as values: what `run` records and `replay` feeds again.

The core is a function of this list and of nothing else, which is why a replay yields the same
decisions. The shell creates inputs (and stamps them with the host's monotonic clock), writes each
to the capture *before* the core sees it, and sends what the core answers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ahrsd.samples import SampleBlock


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes from the device, as one read returned them."""

    host_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Tick:
    """Time passed: the core asked to be woken at `host_ns` and nothing else had come by then."""

    host_ns: int


@dataclass(frozen=True, slots=True)
class WallClock:
    """The host's other clocks: the wall clock, and the time since its boot, suspends included.

    The wall clock may forbid (budgets per day) and is a label; boottime gives durations within the
    boot of this id. Without them (older recordings) nothing is concluded from durations.
    """

    host_ns: int
    wall_s: float
    boot_id: str = ""
    boot_s: float | None = None


@dataclass(frozen=True, slots=True)
class LinkOpened:
    """A port was opened. `latency_ms` is the USB adapter's latency timer where it has one."""

    host_ns: int
    port: str
    baud: int
    latency_ms: int | None = None


@dataclass(frozen=True, slots=True)
class LinkLost:
    """The port went away (unplugged, error) or was closed."""

    host_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class Interlock:
    """The vehicle's word whether a write is safe now; absent or old counts as no."""

    host_ns: int
    safe: bool


@dataclass(frozen=True, slots=True)
class Columns:
    """What the vehicle measures at this moment, by column name (`motor_current_a`)."""

    host_ns: int
    values: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TermsKnown:
    """The text of a repaired model whose terms are not to be calibrated in."""

    host_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Operator:
    """A person's command, a verb of `operator_inbox`; the argument: a candidate's hash, a reason.

    word: its name, for the answer (`events.Answered`)
    """

    host_ns: int
    verb: str
    argument: str = ""
    word: str = ""


@dataclass(frozen=True, slots=True)
class ClientSent:
    """Bytes that a program wrote into a shared port (`client`: the share's name), cut anywhere.

    text: each byte as the character of its number
    """

    host_ns: int
    client: str
    text: str


@dataclass(frozen=True, slots=True)
class ClientLeft:
    """The program closed the shared port."""

    host_ns: int
    client: str


@dataclass(frozen=True, slots=True)
class RegistersKnown:
    """Registers that were in force, for recordings in which nobody asked the device for them."""

    host_ns: int
    values: dict[int, tuple[float | int | str, ...]] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples from a table recording: there are no bytes behind them."""

    host_ns: int
    block: SampleBlock


@dataclass(frozen=True, slots=True, eq=False)
class EarlierSamples:
    """Samples of an earlier run, averaged to the estimator's steps; `EarlierRun` ends them."""

    host_ns: int
    block: SampleBlock


@dataclass(frozen=True, slots=True)
class EarlierRun:
    """Whose the samples of `EarlierSamples` are and when the newest was taken, or why none come.

    registers:  that their un-mapping depends on, as that capture has them
    compensated: whether field and rate are only known compensated
    boot_id, boot_s, wall_s: the host's clocks at the newest sample, as `WallClock`
    """

    host_ns: int
    why: str = ""
    source: str = ""
    model: str = ""
    serial: int = 0
    firmware: str = ""
    registers: dict[int, tuple[float | int | str, ...]] = field(default_factory=dict)
    compensated: tuple[bool, ...] = (False, False)
    boot_id: str = ""
    boot_s: float | None = None
    wall_s: float = 0.0


@dataclass(frozen=True, slots=True)
class JournalOpened:
    """The journal of the device with this serial number; `error` where it cannot be trusted."""

    host_ns: int
    serial: int
    records: list[dict[str, object]] = field(default_factory=list)
    error: str = ""


@dataclass(frozen=True, slots=True)
class Journalled:
    """The record that the core asked for is on the disk, or `error` says why not."""

    host_ns: int
    kind: str
    error: str = ""


@dataclass(frozen=True, slots=True)
class Examined:
    """So many pieces of the work that is done beside the core are done, oldest first.

    failure: how the last one of them broke off; empty where none did
    """

    host_ns: int
    pieces: int
    failure: str = ""


@dataclass(frozen=True, slots=True)
class LimitsChanged:
    """A person changed the limits of the gates, by name; what was judged by others is void."""

    host_ns: int
    limits: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stop:
    """Shut down: undo what was changed for the session, then finish."""

    host_ns: int
    reason: str


Input = (
    Received
    | Tick
    | WallClock
    | LinkOpened
    | LinkLost
    | Interlock
    | Columns
    | TermsKnown
    | Operator
    | ClientSent
    | ClientLeft
    | RegistersKnown
    | Samples
    | EarlierSamples
    | EarlierRun
    | JournalOpened
    | Journalled
    | Examined
    | LimitsChanged
    | Stop
)
