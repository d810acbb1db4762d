"""What the write-back asks of the core, to be carried out in the order in which it is given.

JournalAppend is carried out with fsync *before* the next action runs, and its end is told with
`on_journal_ok` or `on_journal_failed`, whose own actions come before the rest of the list.
RunProcedure waits until the session is idle; CancelProcedure throws Cancelled into the running one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ahrsd.events import Event
from ahrsd.writeback.permissions import Purpose
from ahrsd.writeback.reconcile import RecordKind
from drivers.vn100.commands import Command, Procedure
from drivers.vn100.procedures import Unit
from drivers.vn100.registers import Values


@dataclass(frozen=True, slots=True)
class RunProcedure:
    """Have the session carry out `make()`. `gate` is asked for each command, just before it goes.

    `name` is unique; the end is told with `on_procedure_finished` or `on_procedure_failed`.
    """

    name: str
    purpose: Purpose
    make: Callable[[], Procedure[object]]
    gate: Callable[[Command], bool]


@dataclass(frozen=True, slots=True)
class CancelProcedure:
    """End the procedure of this name, if it runs or waits; its end need not be told."""

    name: str


@dataclass(frozen=True, slots=True)
class AppendToJournal:
    """Make this record durable."""

    kind: RecordKind
    facts: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Emit:
    """A fact for the log, the viewer and the report."""

    event: Event


@dataclass(frozen=True, slots=True)
class InForce:
    """From now on the device applies these registers; None: nobody knows, samples are unusable."""

    registers: Mapping[int, Values] | None


@dataclass(frozen=True, slots=True)
class SetUpStream:
    """The user's own outputs were put back for a save: set the session's up again."""


@dataclass(frozen=True, slots=True)
class IdentifyAgain:
    """Identify the device, read its registers and tell `on_device`."""


@dataclass(frozen=True, slots=True)
class Look:
    """Ask who answers and what it holds, when nothing else runs, and tell `on_looked`."""

    unit: Unit
    expected: Mapping[int, Values]


@dataclass(frozen=True, slots=True)
class CalibrateAnew:
    """What was un-mapped until now may have been so through registers that were not in force."""

    reason: str


Action = (
    RunProcedure
    | CancelProcedure
    | AppendToJournal
    | Emit
    | InForce
    | SetUpStream
    | IdentifyAgain
    | Look
    | CalibrateAnew
)
