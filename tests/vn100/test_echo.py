"""A line that echoes what is sent: the echo of a command is not its answer."""

from __future__ import annotations

import pytest

from drivers.vn100.commands import (
    NoReply,
    Read,
    Word,
    Write,
    identify,
    read_registers,
    save_settings,
    write_verified,
)
from drivers.vn100.messages import encode
from drivers.vn100.session import LineEchoes, ProcedureFailed, ProcedureFinished, Session

NEW = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.1, 0.0, 0.0)


class Line:
    """A device with a few registers behind an adapter that echoes every byte."""

    def __init__(self, *, end: bytes = b"\r\n", echoes: bool = True) -> None:
        self.registers = {1: "VN-100T-CR", 2: "7", 3: "0100056785", 4: "2.1.0.0", 6: "1", 0: ""}
        self.registers[23] = "1,0,0,0,1,0,0,0,1,0,0,0"
        self.end, self.echoes = end, echoes
        self.mute: set[str] = set()
        self.keeps: set[int] = set()  # writes to these are acknowledged and not carried out
        self.heard: list[str] = []

    def answer(self, sent: bytes) -> bytes:
        back = b""
        for line in sent.splitlines():
            body = line.decode()[1:].partition("*")[0]
            self.heard.append(body)
            back += (line + self.end) if self.echoes else b""
            if body.split(",")[0] not in self.mute:
                back += encode(self._reply(body))
        return back

    def _reply(self, body: str) -> str:
        word, *rest = body.split(",")
        if word == "VNRRG":
            value = self.registers[int(rest[0])]
            return f"VNRRG,{rest[0]},{value}" if value else f"VNRRG,{rest[0]}"
        if word == "VNWRG" and int(rest[0]) not in self.keeps:
            self.registers[int(rest[0])] = ",".join(rest[1:])
        return body

    def run(self, procedure):
        """Result or error of a procedure, and all events, in a time of its own."""
        session, now_s = Session(lambda _: True), 0.0
        events = session.start(procedure, now_s)
        while session.busy:
            now_s += 0.01
            back = self.answer(session.take_output())
            events += session.receive(back, now_s) if back else session.tick(now_s)
            assert now_s < 60.0
        return events


def outcome(events):
    return next(event for event in events if isinstance(event, ProcedureFinished | ProcedureFailed))


@pytest.mark.parametrize("end", [b"\r\n", b"\r", b"\r\r\n"])
def test_identity_is_read_despite_an_echo_that_is_reported_once(end):
    events = Line(end=end).run(identify())
    identity = outcome(events).result
    assert (identity.model, identity.firmware, identity.serial) == (
        *("VN-100T-CR", "2.1.0.0", 100056785),
    )
    assert events.count(LineEchoes()) == 1


def test_no_echo_is_reported_on_a_line_without_one():
    def procedure():
        values = yield from read_registers((1, 0))
        with pytest.raises(NoReply):  # answered without the port: reads like the command
            yield Read(6, port=1)
        return values

    line = Line(echoes=False)
    events = line.run(procedure())
    assert outcome(events).result == {1: ("VN-100T-CR",), 0: ("",)}
    assert LineEchoes() not in events


def test_echo_of_a_write_does_not_confirm_it():
    def procedure():
        yield from read_registers((1,))
        yield Write(23, NEW)

    line = Line()
    line.mute = {"VNWRG"}
    error = outcome(line.run(procedure())).error
    assert isinstance(error, NoReply)


def test_verified_write_succeeds_on_an_echoing_line():
    def procedure():
        yield from read_registers((1,))
        return (yield from write_verified(23, NEW))

    line = Line()
    assert outcome(line.run(procedure())).result == pytest.approx(NEW)
    line.keeps = {23}
    line.registers[23] = "1,0,0,0,1,0,0,0,1,0,0,0"
    assert isinstance(outcome(line.run(procedure())), ProcedureFailed)


def test_echo_of_a_save_does_not_confirm_it():
    def procedure():
        yield from read_registers((1,))
        yield from save_settings()

    line = Line()
    assert isinstance(outcome(line.run(procedure())), ProcedureFinished)
    line.mute = {"VNWNV"}
    error = outcome(line.run(procedure())).error
    assert isinstance(error, NoReply)
    assert error.command == Word("VNWNV")
