"""`ahrsd registers lock|unlock`: nothing is written to a device until somebody has looked at it.

Where a daemon runs it is told, as by `ahrsd operator`; it alone writes into its journal. Where none
does, the record goes into the journal, and the next daemon begins with it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from ahrsd.cli.device.registers.sources import journals
from ahrsd.config.config import default_state_directory
from ahrsd.daemon import host_clock
from ahrsd.daemon.journal import Journal, journal_path
from ahrsd.daemon.operator_inbox import NoAnswerInTime, OperatorBox, OperatorFolderError
from ahrsd.errors import DeviceError, JournalError
from ahrsd.telemetry.unix_socket import DaemonConnection, default_socket_path
from ahrsd.writeback.journal_history import JournalHistory, RecordKind

_WAIT_S = 5.0
_OPTIONS = (
    click.argument("reason"),
    click.option("--serial", type=int, help="The device, where several have a journal."),
    click.option(
        "--state-directory", type=click.Path(path_type=Path), default=None,
        help="Where the journals are; default: that of the daemon.",
    ),
)  # fmt: skip


def _with_options(function: Callable[..., None]) -> Callable[..., Any]:
    for option in reversed(_OPTIONS):
        function = option(function)
    return function


@click.command()
@_with_options
def lock(reason: str, serial: int | None, state_directory: Path | None) -> None:
    """Forbid every write, but for going back to old values; REASON is for those who come later."""
    _say(RecordKind.LOCKED, reason, serial, state_directory or default_state_directory())


@click.command()
@_with_options
def unlock(reason: str, serial: int | None, state_directory: Path | None) -> None:
    """Allow writes again: REASON says what was found. Also ends FAULT and FLASH_TORN."""
    _say(RecordKind.UNLOCKED, reason, serial, state_directory or default_state_directory())


def refuse_locked(journal: Journal) -> None:
    """Raise JournalError where the newest word in the journal is a lock."""
    reason = JournalHistory.of(journal.records()).locked
    if reason is not None:
        raise JournalError(
            f"{journal.path}: locked: {reason}; nothing is written until "
            "`ahrsd registers unlock REASON`"
        )


def _say(kind: RecordKind, reason: str, serial: int | None, state: Path) -> None:
    elsewhere = serial is not None and _daemons_device(state) not in (None, serial)
    if not elsewhere and _daemon_heard(
        "lock" if kind is RecordKind.LOCKED else "unlock", reason, state
    ):
        click.echo(f"the daemon heard it; {state} has its journal")
        return
    journal = Journal.open(_journal_of(kind, serial, state))
    history = JournalHistory.of(journal.records())
    if kind is RecordKind.UNLOCKED and history.locked is None and not history.torn:
        click.echo(f"{journal.path}: it is not locked")
        return
    record = journal.append(kind, reason=reason, by="registers", **host_clock.stamp())
    click.echo(f"{journal.path}: record {record.seq}, {kind}: {reason}")


def _daemon_heard(verb: str, reason: str, state: Path) -> bool:
    """Whether a daemon runs and took the word. A folder that may not be written: JournalError."""
    box = OperatorBox(state)
    try:
        answer = box.say(verb, reason, _WAIT_S) if box.folder.is_dir() else None
    except NoAnswerInTime as error:
        raise JournalError(f"the daemon {error}; see `ahrsd status`") from None
    except OperatorFolderError as error:
        raise JournalError(str(error)) from None
    except OSError as error:
        raise JournalError(f"{box.folder}: {error.strerror}; try as root") from None
    if answer is not None and not answer.accepted:
        raise JournalError(f"the daemon refused: {answer.text}")
    return answer is not None


def _daemons_device(state: Path) -> int | None:
    """Serial number of the device that the daemon of this folder has; None where nobody says."""
    path = default_socket_path(state)
    if not path.exists():
        return None
    try:
        with DaemonConnection(path) as daemon:
            device = daemon.ask("status")["device"]
    except DeviceError:
        return None
    return None if device is None else int(device["serial"])


def _journal_of(kind: RecordKind, serial: int | None, state: Path) -> Path:
    """The one journal that is meant; a device may be locked before it was ever written."""
    if serial is not None and kind is RecordKind.LOCKED:
        return journal_path(state, serial)
    found = journals(state, None, serial)
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise JournalError(f"{state}: several journals ({names}); say which by --serial")
    return found[0]
