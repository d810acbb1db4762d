"""Recovery after an interruption, by the journal's last record and the device's registers.

A transaction can be interrupted at any point by loss of power, link or program. Values in RAM that
were not saved are lost if the device loses power, and remain if only the program ends. So "the
device holds the old values" is always a safe end. The one dangerous phase is VNWNV itself, between
FLASH_SENT and the next reading after a reset.

The table is total over (last record, contents of the device, whether a restart of the device since
that record is proven). If they contradict each other, it raises an alarm; it never writes flash.
After a proven restart the device holds what is in its flash, so values that are neither the old
ones nor saved by ahrsd were saved by another program: they are never overwritten without an
operator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from ahrsd.writeback.journal_history import RecordKind
from ahrsd.writeback.states import Signal
from drivers.vn100.registers import Values, same


class DeviceContents(Enum):
    """Contents of the registers of a transaction; only a proven restart counts as one."""

    OLD = "the old values"
    OLD_AFTER_RESTART = "the old values after a restart"
    NEW = "the new values"
    NEW_AFTER_RESTART = "the new values after a restart"
    MIXED = "some old and some new values"
    MIXED_AFTER_RESTART = "some old and some new values after a restart"
    NEITHER = "neither the old nor the new values"


@dataclass(frozen=True, slots=True)
class Resolution:
    """The resulting signal, journal record (None: none), and level and text of the note."""

    signal: Signal
    record: RecordKind | None
    level: str
    text: str


def compare_contents(
    old: Mapping[int, Values],
    new: Mapping[int, Values],
    device: Mapping[int, Values],
    restarted: bool,
) -> DeviceContents:
    """Compare the registers as the device prints them. An unread register is neither."""
    is_old = {n: n in device and same(n, old[n], device[n]) for n in new}
    is_new = {n: n in device and same(n, new[n], device[n]) for n in new}
    if all(is_old.values()):
        return DeviceContents.OLD_AFTER_RESTART if restarted else DeviceContents.OLD
    if all(is_new.values()):
        return DeviceContents.NEW_AFTER_RESTART if restarted else DeviceContents.NEW
    if all(is_old[n] or is_new[n] for n in new):
        return DeviceContents.MIXED_AFTER_RESTART if restarted else DeviceContents.MIXED
    return DeviceContents.NEITHER


def _report_foreign(what: str) -> Resolution:
    return Resolution(
        Signal.FOREIGN,
        RecordKind.FOREIGN,
        "error",
        f"{what}, and the device holds values that nobody here wrote; compare it with the journal, "
        "then unlock",
    )


def _undo(level: str, text: str) -> Resolution:
    return Resolution(Signal.UNDO, RecordKind.ROLLBACK, level, text)


def _close(record: RecordKind, level: str, text: str) -> Resolution:
    return Resolution(Signal.NOTHING_OPEN, record, level, text)


def _saved_by_others(what: str) -> Resolution:
    return Resolution(
        Signal.FOREIGN,
        RecordKind.FOREIGN,
        "error",
        f"{what}, and somebody else saved registers: the device holds new values after a restart; "
        "compare it with the journal, then unlock",
    )


_TORN: Final = Resolution(
    Signal.TORN,
    RecordKind.FLASH_TORN,
    "error",
    "FLASH TORN: saving was interrupted and the device holds neither the old nor the new values; "
    "write the journal's old values by hand, check the heading, then unlock",
)
_CONFIRMED: Final = Resolution(
    Signal.READ_CONFIRMED, RecordKind.CONFIRMED, "info", "the new values survived a restart"
)
_BACK: Final = (
    "the device has its old values, and nobody knows why: a rollback that could not be journaled, "
    "a restart that nobody saw, or a person"
)

TABLE: Final[dict[RecordKind, dict[DeviceContents, Resolution]]] = {
    RecordKind.PREPARED: {
        DeviceContents.OLD: _close(
            RecordKind.ABORTED, "info", "a write was prepared and never made"
        ),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.ABORTED,
            "info",
            "a write was prepared; the device restarted with its old values",
        ),
        DeviceContents.NEW: Resolution(
            Signal.RESUME_TRIAL,
            RecordKind.RAM_VERIFIED,
            "warning",
            "the device holds the new values of an interrupted write; the trial begins",
        ),
        DeviceContents.NEW_AFTER_RESTART: _saved_by_others("a write was prepared"),
        DeviceContents.MIXED: _undo("warning", "a write was interrupted between its registers"),
        DeviceContents.MIXED_AFTER_RESTART: _saved_by_others("a write was prepared"),
        DeviceContents.NEITHER: _report_foreign("a write was prepared"),
    },
    RecordKind.RAM_FAILED: {
        DeviceContents.OLD: _close(RecordKind.ROLLED_BACK, "info", "a failed write is undone"),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.ROLLED_BACK, "info", "a failed write is undone"
        ),
        DeviceContents.NEW: _undo("warning", "a failed write was not undone"),
        DeviceContents.NEW_AFTER_RESTART: _saved_by_others("a write failed"),
        DeviceContents.MIXED: _undo("warning", "a failed write was not undone"),
        DeviceContents.MIXED_AFTER_RESTART: _saved_by_others("a write failed"),
        DeviceContents.NEITHER: _report_foreign("a write failed"),
    },
    RecordKind.RAM_VERIFIED: {
        DeviceContents.OLD: _close(
            RecordKind.REVERTED, "warning", f"a trial was under way; {_BACK}"
        ),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.LOST,
            "warning",
            "the device restarted during the trial and has its old values: safe",
        ),
        DeviceContents.NEW: Resolution(
            Signal.RESUME_TRIAL, None, "info", "the device kept the new values; the trial restarts"
        ),
        DeviceContents.NEW_AFTER_RESTART: _saved_by_others("a trial was under way"),
        DeviceContents.MIXED: _undo("warning", "one of two registers went back by itself"),
        DeviceContents.MIXED_AFTER_RESTART: _saved_by_others("a trial was under way"),
        DeviceContents.NEITHER: _report_foreign("a trial was under way"),
    },
    RecordKind.PROVEN: {
        DeviceContents.OLD: _close(
            RecordKind.REVERTED, "warning", f"proven values waited to be saved; {_BACK}"
        ),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.LOST,
            "warning",
            "the device restarted before the proven values were saved and has its old ones: safe",
        ),
        DeviceContents.NEW: Resolution(
            Signal.RESUME_PROVEN, None, "info", "the device kept the proven values"
        ),
        DeviceContents.NEW_AFTER_RESTART: Resolution(
            Signal.READ_CONFIRMED,
            RecordKind.CONFIRMED,
            "warning",
            "somebody else saved the device's registers: the proven values survived a restart",
        ),
        DeviceContents.MIXED: _undo("warning", "one of two registers went back by itself"),
        DeviceContents.MIXED_AFTER_RESTART: _saved_by_others("proven values waited to be saved"),
        DeviceContents.NEITHER: _report_foreign("proven values waited to be saved"),
    },
    RecordKind.ROLLBACK: {
        DeviceContents.OLD: _close(RecordKind.ROLLED_BACK, "info", "a rollback is complete"),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.ROLLED_BACK, "info", "a rollback is complete"
        ),
        DeviceContents.NEW: _undo("warning", "a rollback was interrupted"),
        DeviceContents.NEW_AFTER_RESTART: _saved_by_others("a rollback was interrupted"),
        DeviceContents.MIXED: _undo("warning", "a rollback was interrupted"),
        DeviceContents.MIXED_AFTER_RESTART: _saved_by_others("a rollback was interrupted"),
        DeviceContents.NEITHER: _report_foreign("a rollback was interrupted"),
    },
    RecordKind.FLASH_SENT: {
        DeviceContents.OLD: _close(
            RecordKind.REVERTED,
            "warning",
            f"saving was interrupted; {_BACK}; its flash may hold either, the next restart tells",
        ),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.NOT_SAVED,
            "warning",
            "saving was interrupted and the device has its old values: not saved, safe",
        ),
        DeviceContents.NEW: Resolution(
            Signal.UNRESOLVED,
            None,
            "error",
            "nobody knows whether the registers were saved: switch the device off and on while "
            "this runs, then they are read again",
        ),
        DeviceContents.NEW_AFTER_RESTART: _CONFIRMED,
        DeviceContents.MIXED: _TORN,
        DeviceContents.MIXED_AFTER_RESTART: _TORN,
        DeviceContents.NEITHER: _TORN,
    },
    RecordKind.FLASH_ACKED: {
        DeviceContents.OLD: _close(
            RecordKind.REVERTED,
            "warning",
            f"the new values were saved; {_BACK}; the next restart tells what its flash holds",
        ),
        DeviceContents.OLD_AFTER_RESTART: _close(
            RecordKind.NOT_SAVED,
            "error",
            "the device acknowledged the save and still has its old values",
        ),
        DeviceContents.NEW: Resolution(
            Signal.RESUME_COMMITTED, None, "info", "saved; the next restart confirms it"
        ),
        DeviceContents.NEW_AFTER_RESTART: _CONFIRMED,
        DeviceContents.MIXED: _TORN,
        DeviceContents.MIXED_AFTER_RESTART: _TORN,
        DeviceContents.NEITHER: _TORN,
    },
}
