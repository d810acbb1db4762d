"""What clients set in the device for their session, and what the user had there before.

A driver sets its outputs at every start, in RAM. For the user's own configuration they count as
little as a session of ours: they are put back before a save and set again behind it, so that a
save of a calibration makes nothing else permanent. When the device restarts they are gone, and what
a client saves itself is the user's from then on.
"""

from __future__ import annotations

from collections.abc import Mapping

from drivers.vn100.registers import Values, same


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
