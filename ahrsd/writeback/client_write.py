"""A client's write of what calibrates, where its share says `calibration_writes = "pass"`.

It is somebody's, so it is treated as one: journaled before it is sent, with the values before and
after; while it is on its way nobody knows what samples passed; and behind it, whatever was
answered, the device is read again, which is how a change by others is found as well. Registers that
changed that way are not saved by a save of ahrsd's.

Never while values of ahrsd's own are in RAM, are about to be or wait for their confirmation: what
is undone then, and over what, would depend on who was first. So it is refused, and a person ends
the trial first. A transaction that begins later has that person's values as its old ones.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.vn100.registers import Values


@dataclass(slots=True)
class ClientWrite:
    """What goes to the device, and for whom; whether the journal has it."""

    client: str
    number: int
    values: Values
    journaled: bool = False

    def is_of(self, client: str, number: int, values: Values) -> bool:
        """Whether this is that very write."""
        return (self.client, self.number, self.values) == (client, number, values)
