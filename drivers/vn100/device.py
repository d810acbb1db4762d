"""A VN-100 on a port, for programs that wait: one procedure at a time, run to its end.

The daemon drives a `Session` itself; this is for command lines. However a run ends (error,
timeout, Ctrl-C), the procedure is cancelled first, so that what it changed is put back and the
asynchronous output is on again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self, TypeVar, cast

from drivers.serial_port import PortLost, SerialPort
from drivers.vn100.commands import (
    QUIET,
    Command,
    Procedure,
    Read,
    SessionError,
    Word,
    reply_time_s,
    resume,
)
from drivers.vn100.session import Event, ProcedureFailed, ProcedureFinished, Session

T = TypeVar("T")
Direction = Literal["rx", "tx"]
Tap = Callable[[Direction, int, bytes], None]

TIDY_S = 10.0  # for a cancelled procedure to put things back


class TookTooLong(SessionError):
    """A procedure did not end in time; it was cancelled."""


def reads_only(command: Command) -> bool:
    """Gate that lets nothing out but register reads."""
    return isinstance(command, Read)


class Device:
    """Runs procedures on an open port, which it closes at the end of its context.

    allow:    the gate of the session, by default reads only
    tap:      gets every byte of both directions with the host's monotonic ns, before any parser
    on_event: gets measurements, faults and stray replies, in order
    """

    def __init__(
        self,
        port: SerialPort,
        allow: Callable[[Command], bool] = reads_only,
        tap: Tap | None = None,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        self._port = port
        self._allow = allow
        self._tap = tap
        self._on_event = on_event
        self._session = Session(self._gate, reply_timeout_s=reply_time_s(port.baud))
        self._outcome: ProcedureFinished | ProcedureFailed | None = None
        self._quiet = False

    def run(self, procedure: Procedure[T], timeout_s: float = 60.0) -> T:
        """The procedure's result. Raises what it raises, TookTooLong, or PortLost."""
        self._outcome = None
        try:
            self._take(self._session.start(procedure, time.monotonic()))
            self._drive(time.monotonic() + timeout_s)
        finally:
            if self._session.busy:
                self._tidy()
        return cast("T", self._result(timeout_s))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if self._session.busy:  # even the tidying was interrupted
                self._drive(time.monotonic() + TIDY_S)
            if self._quiet:
                self.run(resume(), TIDY_S)
        finally:
            self._port.close()

    def _result(self, timeout_s: float) -> object:
        if self._outcome is None:
            raise TookTooLong(f"{self._port.path}: no end after {timeout_s:g} s, given up")
        if isinstance(self._outcome, ProcedureFailed):
            raise self._outcome.error
        return self._outcome.result

    def _gate(self, command: Command) -> bool:
        permitted = self._allow(command)
        if permitted and isinstance(command, Word) and command.word == QUIET.word:
            self._quiet = command == QUIET
        return permitted

    def _tidy(self) -> None:
        """Cancel, and let the procedure put things back; a timeout stays without an outcome."""
        outcome = self._outcome
        self._take(self._session.cancel(time.monotonic()))
        self._drive(time.monotonic() + TIDY_S)
        if self._session.busy:  # it cannot even tidy up: `__exit__` still asks for the output
            self._session.link_lost(time.monotonic())
        self._outcome = outcome

    def _drive(self, until_s: float) -> None:
        """Carry bytes and time between port and session until the procedure ended."""
        try:
            while self._session.busy and time.monotonic() < until_s:
                self._send()
                deadline_s = min(self._session.deadline_s or until_s, until_s)
                if self._port.wait_readable(deadline_s - time.monotonic()):
                    data = self._port.read()
                    if self._tap is not None:
                        self._tap("rx", time.monotonic_ns(), data)
                    self._take(self._session.receive(data, time.monotonic()))
                else:
                    self._take(self._session.tick(time.monotonic()))
        except PortLost:
            self._session.link_lost(time.monotonic())
            self._quiet = False
            raise

    def _send(self) -> None:
        data = self._session.take_output()
        if data:
            if self._tap is not None:
                self._tap("tx", time.monotonic_ns(), data)
            self._port.write(data)

    def _take(self, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, ProcedureFinished | ProcedureFailed):
                self._outcome = event
        for event in events:  # afterwards: it may raise
            if self._on_event is not None and not isinstance(
                event, ProcedureFinished | ProcedureFailed
            ):
                self._on_event(event)
