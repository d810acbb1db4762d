"""What is the user's in the device, kept while a session and clients have theirs there.

**Outputs.** A session changes registers 6 and 75 to 77. A program that is killed cannot put them
back, and the next one would take what it finds for the user's. So the user's values go into the
journal before the first byte (`OUTPUTS_KEPT`), and are done with when they were put back
(`OUTPUTS_BACK`).

A record that is still open tells a run whose outputs it finds, register by register: what only a
session leaves there (`calibration_stream.left_by_session`) stands for the value that was kept; any
other value was put there since, by a person or by a restart of the device, and is the user's own.

**Clients.** A driver sets its outputs at every start, in RAM. For the user's own configuration they
count as little as a session of ours: they are put back before a save and set again behind it, so
that a save of a calibration makes nothing else permanent. When the device restarts they are gone,
and what a client saves itself is the user's from then on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ahrsd.writeback.actions import Action, AppendToJournal, SetUpStream
from ahrsd.writeback.journal_history import JournalRecord, RecordKind
from drivers.vn100.calibration_stream import left_by_session
from drivers.vn100.registers import SESSION_SETTINGS, Values, register_lines, same

# -- Outputs of the session ------------------------------------------------------------------------


class KeptOutputs:
    """What is known of the user's outputs of one device, the one that was read last.

    users: by register, empty before a device was read
    left:  registers in which a session that did not end left its own values
    """

    def __init__(self) -> None:
        self.users: dict[int, Values] = {}
        self.left: tuple[int, ...] = ()
        self._serial: int | None = None
        self._kept: dict[int, Values] | None = None  # as the open record has them
        self._actions: list[Action] = []

    @property
    def kept(self) -> bool:
        """Whether the journal has the user's outputs as they are."""
        return self._kept == self.users

    def read(
        self, serial: int, registers: Mapping[int, Values], journal: Sequence[JournalRecord] | None
    ) -> None:
        """A device and its journal were read; None: the journal cannot be trusted.

        Then what this run itself has kept for the device is better than nothing.
        """
        if journal is not None or serial != self._serial:
            self._kept = open_record(journal or (), serial)
        self._serial = serial
        kept = self._kept or {}
        present = {n: registers[n] for n in SESSION_SETTINGS if n in registers}
        self.users = {
            n: kept[n] if n in kept and left_by_session(n, kept, value) else value
            for n, value in present.items()
        }
        self.left = tuple(n for n, value in present.items() if self.users[n] != value)

    def keep(self) -> None:
        """Set up the session's outputs, behind a record of the user's where there is none yet."""
        if self.kept:
            self._actions.append(SetUpStream())
        else:
            self._actions.append(AppendToJournal(RecordKind.OUTPUTS_KEPT, self._facts()))

    def give_back(self) -> None:
        """The user's outputs are in the device again."""
        self._actions.append(AppendToJournal(RecordKind.OUTPUTS_BACK, {"serial": self._serial}))

    def journalled(self, kind: RecordKind, error: str) -> bool:
        """A record of this kind is on the disk, or is not; what waited for it follows."""
        if error:
            return False
        self._kept = dict(self.users) if kind is RecordKind.OUTPUTS_KEPT else None
        if kind is RecordKind.OUTPUTS_KEPT:
            self._actions.append(SetUpStream())
        return True

    def take_actions(self) -> list[Action]:
        """What the core is to do now."""
        actions, self._actions = self._actions, []
        return actions

    def describe_left(self, *, put_back: bool) -> str:
        """For the log: what a killed session left, and what a person may do."""
        lines = " ".join(register_lines({n: self.users[n] for n in self.left}))
        text = f"outputs of a session that was killed are in the device; the user's are {lines}"
        if put_back:
            return text
        return f"{text}; type that or set device.configure_stream, until then nothing is saved"

    def _facts(self) -> dict[str, Any]:
        """`old` is what a person goes back to."""
        values = {str(number): list(row) for number, row in sorted(self.users.items())}
        return {"serial": self._serial, "old": values}


def open_record(journal: Sequence[JournalRecord], serial: int) -> dict[int, Values] | None:
    """The outputs that were kept and not put back; None where nothing is open."""
    kept: dict[int, Values] | None = None
    for record in journal:
        if record.kind == RecordKind.OUTPUTS_BACK:
            kept = None
        elif record.kind == RecordKind.OUTPUTS_KEPT and record.facts.get("serial") == serial:
            kept = {int(number): tuple(row) for number, row in record.facts["old"].items()}
    return kept


# -- Settings of clients ---------------------------------------------------------------------------


class ClientSettings:
    """Of one device. `now`: what the clients set; `users`: what these registers held before."""

    def __init__(self) -> None:
        self.now: dict[int, Values] = {}
        self.users: dict[int, Values] = {}
        self._serial: int | None = None

    def of(self, serial: int) -> None:
        """This device was identified; another one has none of it."""
        if self._serial != serial:
            self._serial = serial
            self.forget()

    def written(self, number: int, values: Values, before: Values | None) -> None:
        """A client's write was carried out; `before` None: nobody knows what was there."""
        if before is None:
            return
        users = self.users.setdefault(number, before)
        self.now[number] = values
        if same(number, users, values):  # the user's own again
            del self.users[number], self.now[number]

    def read(self, registers: Mapping[int, Values]) -> dict[int, Values]:
        """All registers were read; those that still hold a client's value, as the user had them."""
        for number in list(self.now):
            if not same(number, self.now[number], registers.get(number, ())):
                del self.users[number], self.now[number]
        return dict(self.users)

    def forget(self) -> None:
        """They are saved, and so the user's."""
        self.now, self.users = {}, {}
