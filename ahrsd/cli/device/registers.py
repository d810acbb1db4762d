"""`ahrsd registers`: the device's registers and their journal, and who may write them.

**Lock and unlock**: nothing is written to a device until somebody has looked at it. Where a daemon
runs it is told, as by `ahrsd operator`; it alone writes into its journal. Where none does, the
record goes into the journal, and the next daemon begins with it.

**A register's values for a person**: by the names of the fields, in short numbers, with units.

    23  Magnetometer Calibration
        c [1 0 0; 0 1 0; 0 0 1]  b [0.12 -0.08 0.06] gauss
    75  Binary Output Register 1
        async_mode 3  rate_divisor 40  groups 29  field_word [7FFF 0210 000C]
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

import click

from ahrsd.cli.device.access import PORT, describe, open_device
from ahrsd.cli.device.register_changes import (
    BAUD_RATE,
    Changes,
    Sources,
    apply,
    calibrated,
    find,
    gate,
    journals,
    newest_in_force,
    refuse_unprovable,
    refuse_unproven_save,
    save_to_flash,
    to_write,
    typed,
)
from ahrsd.cli.files import refuse_unwritable, write_text
from ahrsd.config.config import default_state_directory
from ahrsd.daemon import host_clock
from ahrsd.daemon.journal import (
    Journal,
    Record,
    journal_path,
    register_values,
    typed_lines,
    wrg_lines,
)
from ahrsd.daemon.operator_inbox import NoAnswerInTime, OperatorBox, OperatorFolderError
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError, DeviceError, JournalError
from ahrsd.printable import counted
from ahrsd.telemetry.unix_socket import DaemonConnection, default_socket_path
from ahrsd.writeback.journal_history import JournalHistory, RecordKind, find_record_of_other_device
from drivers.vn100.commands import (
    Identity,
    identify,
    identify_surely,
    missing,
    read_configuration,
    read_present,
    read_registers,
)
from drivers.vn100.device import Device
from drivers.vn100.register_codec import Register, RegisterField, Value
from drivers.vn100.registers import (
    REGISTERS,
    ROTATION,
    RegisterValueError,
    Values,
)

# -- Lock and unlock -------------------------------------------------------------------------------


_WAIT_S = 5.0
_OPTIONS = (
    click.argument("reason"),
    click.option(
        "--serial", type=int, help="Serial number of the device, if several have a journal."
    ),
    click.option(
        "--state-directory", type=click.Path(path_type=Path), default=None,
        help="Where the journals are; default: that of the daemon.",
    ),
)  # fmt: skip


def _with_options(function: Callable[..., None]) -> Callable[..., Any]:
    for option in reversed(_OPTIONS):
        function = option(function)
    return function


@click.command(short_help="Forbid every write except a return to old values.")
@_with_options
def lock(reason: str, serial: int | None, state_directory: Path | None) -> None:
    """Forbid every write except a return to old values; REASON is stored in the journal."""
    _say(RecordKind.LOCKED, reason, serial, state_directory or default_state_directory())


@click.command()
@_with_options
def unlock(reason: str, serial: int | None, state_directory: Path | None) -> None:
    """Allow writes again; REASON is stored in the journal. Also ends FAULT and FLASH_TORN."""
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
        click.echo(f"the daemon accepted it; its journal is in {state}")
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


# -- Read, compare, write, go back -----------------------------------------------------------------


_STATE = click.option(
    "--state-directory", type=click.Path(path_type=Path), default=None,
    help="Where the journals are; default: that of the daemon.",
)  # fmt: skip
_JOURNAL = click.option(
    "--journal", "journal_file", type=click.Path(path_type=Path, exists=True), default=None,
    help="A journal file instead of the one of the device's serial number.",
)  # fmt: skip
_BAUD = click.option("--baud", type=int, help="The port's rate; without it, the rate is detected.")
_YES = click.option(
    "--yes", is_flag=True, help="Do it; without this option, only print what would be done."
)
_SAVE = click.option(
    "--save", is_flag=True, help="Also save all of RAM to flash. Keep the vehicle still."
)


Ids = TypeVar("Ids", int, int | None, tuple[int, ...])
_ROTATION_ACTS_LATER = (
    "register 26 acts only once it is saved and the device has restarted: switch it off and on "
    "before ahrsd runs or captures again"
)
_SHOWN = ("txn", "reason", "undoes", "error", "restored")  # facts of a record besides its registers


def _known(_context: click.Context, _option: click.Parameter, numbers: Ids) -> Ids:
    """Refuse numbers that are not in the register map before a port is opened."""
    for number in numbers if isinstance(numbers, tuple) else (numbers,):
        if number is not None and number not in REGISTERS:
            raise click.BadParameter(f"the VN-100 has no register {number}")
    return numbers


@click.group()
def command() -> None:
    """Read, compare, write and roll back the device's registers.

    Every write is journaled with the old values first, verified by a fresh read, and lives in RAM
    until --save.
    """


command.add_command(lock)
command.add_command(unlock)


@command.command(short_help="Print registers of a device.")
@click.argument("port", type=PORT)
@click.argument("ids", nargs=-1, type=int, callback=_known)
@_BAUD
@click.option("--json", "json_path", help="Values as JSON into this file, - for stdout.")
def read(port: Path, ids: tuple[int, ...], baud: int | None, json_path: str | None) -> None:
    """Print registers of the device on PORT: those in IDS, else its whole configuration."""
    refuse_unwritable(json_path)
    with open_device(port, baud) as device:
        identity = device.run(identify())
        procedure = read_present(ids) if ids else read_configuration(identity.profile)
        values = device.run(procedure)
    absent = [n for n in ids if n not in values] if ids else missing(identity.profile, values)
    if json_path != "-":
        click.echo(f"{identity.model}, serial {identity.serial}, firmware {identity.firmware}")
        for number, row in values.items():
            click.echo(f"{number:3}  {REGISTERS[number].name}")
            click.echo(f"     {described(number, row)}")
    if json_path == "-":
        click.echo(_json(values, identity), nl=False)
    elif json_path:
        write_text(Path(json_path), _json(values, identity))
    if absent:
        numbers = ", ".join(map(str, absent))
        click.echo(f"ahrsd: firmware {identity.firmware} has no register {numbers}", err=True)
    if ids and absent:
        raise SystemExit(EXIT_NO)


@command.command()
@click.argument("first")
@click.argument("second")
@_STATE
@_JOURNAL
@_BAUD
def diff(
    *,
    first: str,
    second: str,
    state_directory: Path | None,
    journal_file: Path | None,
    baud: int | None,
) -> None:
    """Compare two sets of registers; exit 1 where they differ.

    FIRST and SECOND are each a port, a JSON file (of `registers read` or a calibration.json), or a
    number of the journal: 12 for the values before record 12, 12:new for those after it.
    """
    sources = Sources(_state(state_directory), journal_file, baud)
    before, after = sources.read_pair(first, second)
    shared = sorted(before.keys() & after.keys())
    if not shared:
        raise AhrsdError(f"{first} and {second} have no register in common")
    different = to_write(
        {number: after[number] for number in shared}, {number: before[number] for number in shared}
    )
    for number in different:
        click.echo(f"{number:3}  {REGISTERS[number].name}")
        click.echo(f"  -  {described(number, before[number])}")
        click.echo(f"  +  {described(number, after[number])}")
    click.echo(f"{counted(len(shared), 'register')} compared, {len(different)} differ")
    raise SystemExit(EXIT_NO if different else EXIT_DONE)


@command.command(
    context_settings={"ignore_unknown_options": True},
    short_help="Write a register: journaled, read back, RAM until --save.",
)
@click.argument("port", type=PORT)
@click.argument("number", metavar="[ID]", type=int, required=False, callback=_known)
@click.argument("values", nargs=-1)
@click.option(
    "--from",
    "file",
    type=click.Path(path_type=Path),
    help="Registers 23 and 84 of a calibration.json instead of ID and VALUES.",
)
@click.option("--serial", type=int, help="Serial number for --from, if the file does not state it.")
@_YES
@_SAVE
@_STATE
@_BAUD
def write(
    *,
    port: Path,
    number: int | None,
    values: tuple[str, ...],
    file: Path | None,
    serial: int | None,
    yes: bool,
    save: bool,
    state_directory: Path | None,
    baud: int | None,
) -> None:
    """Write register ID of the device on PORT; VALUES in the manual's order, blanks or commas.

    Of registers 23, 25 and 84, values that no sensor can need are refused.

    With --from the registers of a calibration: it must have converged, its numbers must be within
    the daemon's limits, and the device must be the one that was recorded and still hold the values
    that were in force then.
    """
    if file is not None:
        if number is not None:
            raise click.UsageError("give either ID and VALUES, or --from FILE")
        wanted_of = calibrated(file, serial)
        _change(port, baud, wanted_of, _state(state_directory), None, yes=yes, save=save)
        return
    if number is None or not values:
        raise click.UsageError("give ID and VALUES, or --from FILE")
    tokens = [token for value in values for token in value.split(",") if token]
    try:
        wanted = typed(number, tokens)
    except RegisterValueError as error:
        raise click.BadParameter(str(error), param_hint="VALUES") from error
    state = _state(state_directory)
    _change(port, baud, lambda *_: (wanted, {"reason": "write"}), state, None, yes=yes, save=save)


@command.command(short_help="Print the journal, and the lines that undo each write.")
@_STATE
@_JOURNAL
@click.option("--serial", type=int, help="Only the device with this serial number.")
def history(state_directory: Path | None, journal_file: Path | None, serial: int | None) -> None:
    """Print the journal: what was written, when, and the lines that put the old values back."""
    for path in journals(_state(state_directory), journal_file, serial):
        journal = Journal.open(path)
        click.echo(f"{path}: {counted(len(journal.records()), 'record')}")
        if journal.torn:
            click.echo(f"  a torn last line of {len(journal.torn)} bytes was never acknowledged")
        for record in journal.records():
            _print_record(record)


@command.command(short_help="Print registers as $VNWRG lines, to type or send by hand.")
@click.argument("source")
@click.argument("ids", nargs=-1, type=int, callback=_known)
@click.option(
    "--json", "as_json", is_flag=True, help="Print JSON, which `diff` reads, instead of lines."
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Write to this file instead of stdout."
)
@_STATE
@_JOURNAL
@_BAUD
def export(
    *,
    source: str,
    ids: tuple[int, ...],
    as_json: bool,
    output: Path | None,
    state_directory: Path | None,
    journal_file: Path | None,
    baud: int | None,
) -> None:
    """Print registers as $VNWRG lines, which a person can type or send without ahrsd.

    SOURCE is what `diff` takes: a port, a JSON file, or a number of the journal. Without IDS all
    that it has and that can be written, save the baud rate. In RAM until $VNWNV*57 is sent.
    """
    refuse_unwritable(output)
    identity, values = Sources(_state(state_directory), journal_file, baud).read(source)
    if missing := [number for number in ids if number not in values]:
        raise AhrsdError(f"{source} has no register {missing[0]}")
    chosen = {n: row for n, row in values.items() if (n in ids if ids else n != BAUD_RATE)}
    text = _json(chosen, identity) if as_json else "\n".join(typed_lines(chosen)) + "\n"
    if output is None:
        click.echo(text, nl=False)
    else:
        write_text(output, text)


@command.command(short_help="Write back the values from before a record of the journal.")
@click.argument("port", type=PORT)
@click.argument("number", metavar="[ID]", type=int, required=False)
@_YES
@_SAVE
@_STATE
@_JOURNAL
@_BAUD
def rollback(
    *,
    port: Path,
    number: int | None,
    yes: bool,
    save: bool,
    state_directory: Path | None,
    journal_file: Path | None,
    baud: int | None,
) -> None:
    """Write back the values that the registers had before record ID of the journal.

    Without ID: before the newest change of which the device holds a value now.
    """

    def wanted(device: Device, journal: Journal) -> tuple[Changes, Mapping[str, object]]:
        if number is not None:
            record = find(journal, number)
        else:
            record = newest_in_force(journal, lambda ids: device.run(read_registers(ids)))
        return register_values(record), {"reason": "rollback", "undoes": record.seq}

    _change(port, baud, wanted, _state(state_directory), journal_file, yes=yes, save=save)


def _change(
    port: Path,
    baud: int | None,
    wanted: Callable[[Device, Journal], tuple[Changes, Mapping[str, object]]],
    state: Path,
    journal_file: Path | None,
    *,
    yes: bool,
    save: bool,
) -> None:
    """Read, show, and with `yes` journal, write, verify and tell how to go back."""
    permitted: set[int] = set()
    with open_device(port, baud, gate(permitted, save=save and yes)) as device:
        identity = device.run(identify_surely())
        journal = Journal.open(journal_file or journal_path(state, identity.serial))
        if other := find_record_of_other_device(journal.records(), identity.serial):
            raise JournalError(f"{journal.path}: {other}; nothing was written")
        changes, why = wanted(device, journal)
        if "undoes" not in why:  # what goes back to where it was is not locked out
            refuse_locked(journal)
        present = device.run(read_registers(changes))
        refuse_unprovable(present, changes)
        if save:
            refuse_unproven_save(device, journal, identity, changes)
        changes = to_write(present, changes)
        _show(identity, present, changes)
        if not changes and not save:
            return
        if not yes:
            click.echo("nothing was written; add --yes to do it")
            return
        if not identity.profile.writable:
            raise AhrsdError(f"nothing is written to it: {identity.profile.observed_for}")
        permitted.update(changes)
        record = apply(device, journal, identity, changes, **why)
        click.echo(f"written and verified in RAM, journal {journal.path} record {record.seq}")
        again = _again(port, record.seq, state, journal_file, baud)
        click.echo(f"to go back: {again}, or send")
        for line in wrg_lines(record):
            click.echo(f"  {line}")
        if save:
            save_to_flash(device, journal, identity, record)
            click.echo("saved to flash")
        if ROTATION in changes:
            click.echo(_ROTATION_ACTS_LATER)


def _again(
    port: Path, number: int, state: Path, journal_file: Path | None, baud: int | None
) -> str:
    """The command that undoes a record, as it works when it is pasted: with the same options."""
    words = ["ahrsd", "registers", "rollback", str(port), str(number), "--yes"]
    if journal_file is not None:
        words += ["--journal", str(journal_file)]
    elif state != default_state_directory():
        words += ["--state-directory", str(state)]
    if baud is not None:
        words += ["--baud", str(baud)]
    return shlex.join(words)


def _json(values: Changes, identity: Identity | None) -> str:
    """What `diff` and `export` read again."""
    registers = {str(number): list(row) for number, row in values.items()}
    device = {} if identity is None else {"device": describe(identity)}
    body = {"schema": "ahrsd.registers/1", **device, "registers": registers}
    return json.dumps(body, indent=1) + "\n"


def _show(identity: Identity, present: Changes, changes: Changes) -> None:
    click.echo(f"{identity.model}, serial {identity.serial}, firmware {identity.firmware}")
    for number, values in present.items():
        click.echo(f"{number:3}  {REGISTERS[number].name}")
        click.echo(f"  now  {described(number, values)}")
        if number in changes:
            click.echo(f"  new  {described(number, changes[number])}")
        else:
            click.echo("  holds the wanted values already")


def _print_record(record: Record) -> None:
    words = [f"{key}={record.facts[key]}" for key in _SHOWN if key in record.facts]
    click.echo(f"{record.seq:4}  {record.time}  {record.kind:12}  {' '.join(words)}".rstrip())
    for which in ("old", "new"):
        for number, values in register_values(record, which).items():
            click.echo(f"      {which}  {number:3}  {described(number, values)}")
    for line in wrg_lines(record):
        click.echo(f"      to go back send  {line}")


def _state(given: Path | None) -> Path:
    return given or default_state_directory()


# -- Values for a person ---------------------------------------------------------------------------


_PLACE = re.compile(r"(_[xyznedw]|_?[0-9]{1,2})$")  # of a value in its vector or matrix
_MATRIX, _ROW = 9, 3
_DIGITS = {"f32": 6, "f64": 9}  # 6 are all that the device prints of an f32


def described(number: int, values: Values) -> str:
    """The values on one line."""
    register = REGISTERS[number]
    if register.opaque:
        return " ".join(map(str, values)) + "  (fields are not documented)"
    pairs = list(zip(_fields(register, len(values)), values, strict=False))
    parts = []
    for (name, unit), group in groupby(pairs, key=lambda pair: (_stem(pair[0]), pair[0].unit)):
        texts = [_short(field, value) for field, value in group]
        text = texts[0] if len(texts) == 1 else f"[{_rows(texts)}]"
        parts.append(" ".join(part for part in (name, text, unit) if part))
    return "  ".join(parts)


def _fields(register: Register, count: int) -> list[RegisterField]:
    fields = list(register.fields)
    return fields + fields[-1:] * (count - len(fields)) if register.repeated else fields


def _stem(field: RegisterField) -> str:
    return _PLACE.sub("", field.name)


def _rows(texts: list[str]) -> str:
    """A matrix has its rows apart."""
    step = _ROW if len(texts) == _MATRIX else len(texts)
    return "; ".join(" ".join(texts[at : at + step]) for at in range(0, len(texts), step))


def _short(field: RegisterField, value: Value) -> str:
    if isinstance(value, str):
        return value or '""'
    if field.kind.startswith("hex"):
        return f"{int(value):0{2 if field.kind == 'hex8' else 4}X}"
    return f"{value:.{_DIGITS[field.kind]}g}" if field.kind in _DIGITS else str(value)
