"""How a conversation with a device begins, begins again after a while, and ends within a limit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from drivers.vn100.calibration_stream import DoesNotFit, NoStream, NotPutBack
from drivers.vn100.commands import Pause, Procedure, SessionError
from drivers.vn100.procedures import (
    SESSION_SETTINGS,
    Identity,
    identify,
    quiet,
    read,
    read_configuration,
    read_unit,
    restore,
)
from drivers.vn100.registers import Values, format_command, same

# First and longest wait: after the journal refused the user's outputs; where they could not be put
# back; where they were, but the session's not be set up (a trial fits into the last one)
KEEP_AGAIN_S, PUT_BACK_AGAIN_S, SET_UP_AGAIN_S = (30.0, 30.0), (0.5, 5.0), (5.0, 1800.0)
USUAL_REPLY_S = 0.4  # where replies may take longer, so may all of this
PATIENCE_S, STOP_S = 1.0, 1.5  # after a stop: for the write-back to end, and for everything


class WrongDevice(SessionError):
    """Another device than the one whose outputs were to be put back."""


class Unsteady(SessionError):
    """A register does not read the same twice."""


class OutOfTime(SessionError):
    """A stop took too long; the journal tells the next run what is to be put back."""

    def __init__(self, why: str) -> None:
        super().__init__(f"{why}; the next run with device.configure_stream puts it back")


@dataclass(slots=True)
class StopLimit:
    """The two times that a stop sets; None before it. `closing`: the first one is over."""

    scale: float = 1.0
    patience_s: float | None = None
    end_s: float | None = None
    closing: bool = False

    @property
    def due_s(self) -> float | None:
        """When to look next."""
        return self.end_s if self.closing else self.patience_s

    def begin(self, now_s: float) -> None:
        """A stop was asked for; a second one changes nothing."""
        if self.end_s is None:
            self.patience_s = now_s + self.scale * PATIENCE_S
            self.end_s = now_s + self.scale * STOP_S

    def patient(self, now_s: float) -> bool:
        """Whether others may still end what they have under way."""
        return self.patience_s is None or now_s < self.patience_s

    def over(self, now_s: float) -> bool:
        """Whether nothing more may be waited for."""
        return self.end_s is not None and now_s >= self.end_s


def again_after(error: Exception) -> tuple[float, float] | None:
    """The waits after a set-up that failed with `error`; None where it would fail for ever."""
    if isinstance(error, NotPutBack):
        return PUT_BACK_AGAIN_S
    return None if isinstance(error, DoesNotFit | NoStream) else SET_UP_AGAIN_S


def identify_in(seconds: float) -> Procedure[Identity]:
    """`identify_surely` after a while."""
    yield Pause(seconds)
    return (yield from identify_surely())


def identify_surely() -> Procedure[Identity]:
    """Who answers, asked twice: an altered reply must not pass for another device.

    Raises Unsteady.
    """
    identity = yield from identify()
    again = yield from read_unit()
    if again != identity.unit:
        raise Unsteady(f"the device says that it is {identity.unit}, then {again}")
    return identity


def read_surely(identity: Identity, twice: Iterable[int]) -> Procedure[dict[int, Values]]:
    """The configuration of this device, and at the end it still is this device that answers.

    Some registers are read `twice`; those that will be put back can be written.

    A reading that was altered on the way would else become what the user had. Raises Unsteady,
    RegisterValueError.
    """
    values = yield from read_configuration(identity.profile)
    for number in (n for n in twice if n in values):
        again = yield from read(number)
        if not same(number, values[number], again):
            raise Unsteady(f"register {number} reads {values[number]}, then {again}")
        if number in SESSION_SETTINGS:
            format_command(number, again, held=True)
    if (unit := (yield from read_unit())) != identity.unit:
        raise Unsteady(f"{unit} answers, and a moment ago it was {identity.unit}")
    return values


def put_back_to(
    serial: int | None, users: Mapping[int, Values], wait_s: float
) -> Procedure[object]:
    """The user's outputs, to the device with this serial number and to no other."""
    if wait_s:
        yield Pause(wait_s)
    answered = int((yield from read(3))[0])
    if answered != serial:
        raise WrongDevice(f"the device has the serial number {answered}, not {serial}")
    return (yield from quiet(restore(users, SESSION_SETTINGS)))
