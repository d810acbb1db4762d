"""Collects identity, registers and journal of a device; passes them on once all three are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ahrsd.core.device_session import DeviceSession
from ahrsd.inputs import JournalOpened
from ahrsd.writeback.actions import Action
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.transaction import StoredRecord, of_another_device
from drivers.vn100.procedures import Unit
from drivers.vn100.registers import COMPENSATING, Values, same


@dataclass(slots=True)
class DeviceRecord:
    """Waits for registers and journal of the device that was identified last."""

    _unit: Unit | None = None
    _values: dict[int, Values] | None = None
    _journal: Sequence[StoredRecord] | None = field(default=None)
    _journal_known: bool = False
    _breaks: int = -1
    _read_from_s: float = float("inf")

    def identified(self, unit: Unit) -> Unit | None:
        """A device said who it is: its journal is not open yet. Returns who was here before."""
        before, self._unit, self._journal_known = self._unit, unit, False
        return before

    def journal_read(self, item: JournalOpened) -> str:
        """Its journal; returns why it cannot be trusted, "" where it can."""
        records = [StoredRecord.of(r) for r in item.records]
        error = item.error or of_another_device(records, item.serial)
        self._journal = None if error else records
        self._journal_known, self._read_from_s = True, item.host_ns * 1e-9
        return error

    def registers_read(
        self, values: dict[int, Values], believed: Mapping[int, Values], breaks: int
    ) -> list[int]:
        """Its registers; those that somebody else changed, at a time that nobody knows.

        believed: what was held for true until now; breaks: how often link or device began anew,
        which explains a change
        """
        explained = breaks != self._breaks
        self._values, self._breaks = values, breaks
        read = [n for n in COMPENSATING if n in believed and n in values]
        return [] if explained else [n for n in read if not same(n, believed[n], values[n])]

    def report(
        self,
        device_session: DeviceSession,
        writeback: WriteBack,
        host_s: float,
    ) -> list[Action]:
        """Pass on to the write-back, once, when everything is there.

        Registers that this session changes are passed on with the values that the user had.
        """
        identity, values = device_session.identity, self._values
        if identity is None or values is None or not self._journal_known:
            return []
        self._values = None
        users = device_session.known(values, self._journal)
        return writeback.on_device(
            identity,
            users,
            self._journal,
            host_s,
            session_keys=device_session.session_keys,
            clients=frozenset(device_session.clients.now),
            read_from_s=self._read_from_s,
        )
