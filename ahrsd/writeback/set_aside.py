"""What was on trial, while a program on a shared port saves all of RAM.

Only what is proven may get to flash, so the trial's registers are undone before that save: with the
record of every rollback, and so with all that follows from it where the power goes. Behind the save
they are written again as a transaction of their own: prepared in the journal, checked, written,
read back, and tried from the beginning, for nothing that came in between is of the new values.
The approval is carried over, and with it all that a write needs (`Flow.aside_holds`). It counts as
a write of the day's budget; only the pause between two writes is not waited for.

The second write needs the save's acknowledgement and, `SETTLE_S` behind it, an answer of the device
that it is the same one and holds what it held: a driver that saves at its start may reset the
device next, and a save that failed is reported up to 1.5 s late.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ahrsd.writeback.transaction import Transaction

SETTLE_S: Final = 2.0


@dataclass(slots=True)
class SetAside:
    """What was undone, for whom; host times of the save's end and of the newest good answer."""

    transaction: Transaction
    client: str
    saved_s: float | None = None
    confirmed_s: float = float("-inf")  # when the device was asked

    @property
    def settled_s(self) -> float | None:
        """When the device may be asked; None while the save is not acknowledged."""
        return None if self.saved_s is None else self.saved_s + SETTLE_S

    def settled(self, host_s: float) -> bool:
        """Whether it may be asked now."""
        return self.settled_s is not None and host_s >= self.settled_s

    def waits_for_look(self, doubt_s: float, host_s: float) -> bool:
        """Whether all that lacks is that the device is asked. `doubt_s`: of the last doubt."""
        return self.settled(host_s) and not self.confirmed(doubt_s)

    def confirmed(self, doubt_s: float) -> bool:
        """Whether the device has shown, behind the save and any doubt, that it is as it was."""
        settled_s = self.settled_s
        return settled_s is not None and self.confirmed_s >= max(settled_s, doubt_s)
