"""Who the device is, what it holds, what its journal says: told to the write-back when complete."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ahrsd.core.device_session import Conversation
from ahrsd.inputs import JournalOpened
from ahrsd.writeback.actions import Action
from ahrsd.writeback.journal_history import of_another_device
from ahrsd.writeback.machine import WriteBack
from drivers.vn100.registers import Values, same

COMPENSATING = (23, 25, 26, 44, 84)  # what a sample went through depends on them


@dataclass(frozen=True, slots=True)
class RecordRead:
    """A journal record as the write-back reads it."""

    kind: str
    facts: dict[str, Any]

    @staticmethod
    def of(body: Mapping[str, Any]) -> RecordRead:
        """From `JournalOpened.records`."""
        return RecordRead(str(body["kind"]), dict(body["facts"]))


@dataclass(slots=True)
class Rollcall:
    """Waits for registers and journal of the device that was identified last."""

    _values: dict[int, Values] | None = None
    _journal: Sequence[RecordRead] | None = field(default=None)
    _journal_known: bool = False
    _breaks: int = -1
    _read_from_s: float = float("inf")

    def identified(self) -> None:
        """A device said who it is: its journal is not open yet."""
        self._journal_known = False

    def journal(self, item: JournalOpened) -> str:
        """Its journal; returns why it cannot be trusted, "" where it can."""
        records = [RecordRead.of(r) for r in item.records]
        error = item.error or of_another_device(records, item.serial)
        self._journal = None if error else records
        self._journal_known, self._read_from_s = True, item.host_ns * 1e-9
        return error

    def registers(
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

    def told(
        self,
        conversation: Conversation,
        writeback: WriteBack,
        host_s: float,
    ) -> list[Action]:
        """Tell the write-back, once, when everything is there.

        Registers that this session changes are told with the values that the user had.
        """
        identity, values = conversation.identity, self._values
        if identity is None or values is None or not self._journal_known:
            return []
        self._values = None
        users = conversation.known(values, self._journal)
        return writeback.on_device(
            identity,
            users,
            self._journal,
            host_s,
            session_keys=conversation.session_keys,
            read_from_s=self._read_from_s,
        )
