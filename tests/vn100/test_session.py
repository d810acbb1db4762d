"""The conversation: which reply belongs to a command, late and foreign replies, and commands
that are always sent.

Lines are from the manual or recorded, except in the property test, which computes its own.
"""

from __future__ import annotations

import pytest

from drivers.vn100.commands import (
    QUIET,
    Cancelled,
    LinkGone,
    NoReply,
    NotPermitted,
    Pause,
    Read,
    TooLate,
    Word,
    Write,
    quiet,
    read,
    save_settings,
    write_verified,
)
from drivers.vn100.decode import Measurement
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.messages import Reply
from drivers.vn100.session import DeviceFault, ProcedureFinished, Session, Stray

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
OTHER = (1.02, 0.01, 0.0, 0.01, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 0.1)
READ_23 = b"$VNRRG,23*72\r\n"
WRITE_23 = b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76\r\n"
WRITE_23_OTHER = b"$VNWRG,23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1*6F\r\n"
REPLY_23 = b"$VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0*73\r\n"
REPLY_25 = b"$VNRRG,25,1,0,0,0,1,0,0,0,1,0,0,0*75\r\n"
REPLY_27 = (
    b"$VNRRG,27,+006.380,+000.023,-001.953,+1.0640,-0.2531,+3.0614,+00.005,+00.344,-09.758,"
    b"-0.001222,-0.000450,-0.001218*4F\r\n"
)
YMR = (
    b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,"
    b"-00.000018,+00.001122,-00.000551*69\r\n"
)
READ_1, READ_3, READ_4 = b"$VNRRG,01*72\r\n", b"$VNRRG,03*70\r\n", b"$VNRRG,04*77\r\n"
REPLY_1, REPLY_4 = b"$VNRRG,01,VN-200T-CR*31\r\n", b"$VNRRG,04,3.1.0.0*77\r\n"
ASY_0, ASY_1, WNV = b"$VNASY,0*4F\r\n", b"$VNASY,1*4E\r\n", b"$VNWNV*57\r\n"


def error(code):
    return {
        0x01: b"$VNERR,01*70\r\n", 0x02: b"$VNERR,02*73\r\n", 0x03: b"$VNERR,03*72\r\n",
        0x04: b"$VNERR,04*75\r\n", 0x05: b"$VNERR,05*74\r\n", 0x06: b"$VNERR,06*77\r\n",
        0x07: b"$VNERR,07*76\r\n", 0x08: b"$VNERR,08*79\r\n", 0x09: b"$VNERR,09*78\r\n",
        0x0A: b"$VNERR,0A*00\r\n", 0x0B: b"$VNERR,0B*03\r\n", 0x0C: b"$VNERR,0C*02\r\n",
        0xFF: b"$VNERR,FF*71\r\n",
    }[code]  # fmt: skip


def session(allow=lambda _: True):
    return Session(allow, reply_timeout_s=0.4)


def one(procedure):
    """A procedure of one command, whose result is the reply."""
    return (yield procedure)


def checksum(body):
    value = 0
    for byte in body.encode():
        value ^= byte
    return f"${body}*{value:02X}\r\n".encode()


def test_read_is_sent_and_its_reply_returned():
    s = session()
    assert s.start(read(23), 0.0) == []
    assert s.take_output() == READ_23
    assert s.take_output() == b""
    assert s.busy
    assert s.deadline_s == pytest.approx(0.4)
    assert s.receive(REPLY_23[:20], 0.01) == []
    assert s.receive(REPLY_23[20:], 0.02) == [ProcedureFinished(IDENTITY)]
    assert not s.busy
    assert s.deadline_s is None


def test_only_one_procedure_at_a_time():
    s = session()
    s.start(read(23), 0.0)
    with pytest.raises(RuntimeError, match="already running"):
        s.start(read(25), 0.0)


def test_a_measurement_never_answers_a_read_and_keeps_its_place():
    s = session()
    s.start(read(27), 0.0)
    events = s.receive(YMR + REPLY_27 + YMR, 0.1)
    assert [type(event) for event in events] == [Measurement, ProcedureFinished, Measurement]
    assert events[0].layout.name == "VNYMR"
    assert events[1].result[:3] == (6.38, 0.023, -1.953)


def test_reply_about_another_register_is_stray():
    s = session()
    s.start(read(23), 0.0)
    (event,) = s.receive(REPLY_25, 0.1)
    assert isinstance(event, Stray)
    assert (event.reply.word, event.reply.register) == ("VNRRG", 25)
    (event,) = s.receive(WRITE_23, 0.2)
    assert event == Stray(Reply("VNWRG", 23, tuple("100010001000")))
    assert s.receive(REPLY_23, 0.3) == [ProcedureFinished(IDENTITY)]


def test_malformed_reply_is_stray():
    s = session()
    s.start(read(44), 0.0)
    (event,) = s.receive(checksum("VNRRG,44,0,nan,5"), 0.1)
    assert isinstance(event, Stray)
    assert s.busy


def test_the_echo_of_a_write_must_be_what_was_sent():
    s = session()
    s.start(one(Write(23, IDENTITY)), 0.0)
    assert s.take_output() == WRITE_23
    (event,) = s.receive(WRITE_23_OTHER, 0.1)
    assert isinstance(event, Stray)
    (event,) = s.receive(WRITE_23, 0.2)
    assert isinstance(event, ProcedureFinished)


def test_silence_causes_three_attempts_and_no_reply():
    s = session()
    s.start(read(23), 0.0)
    assert s.take_output() == READ_23
    for now_s in (0.4, 0.8):
        assert s.tick(now_s - 0.01) == []
        assert s.take_output() == b""
        assert s.tick(now_s) == []
        assert s.take_output() == READ_23
    (event,) = s.tick(1.21)
    assert isinstance(event.error, NoReply)
    assert event.error.command == Read(23)
    assert "cable" in str(event.error)
    assert not s.busy


@pytest.mark.parametrize("code", [0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0C])
def test_a_refusal_ends_the_command(code):
    s = session()
    s.start(read(23), 0.0)
    (event,) = s.receive(error(code), 0.1)
    assert isinstance(event.error, DeviceRefused)
    assert event.error.code == code


@pytest.mark.parametrize("code", [0x02, 0x03])
def test_a_damaged_command_is_sent_again_at_once(code):
    s = session()
    s.start(read(23), 0.0)
    s.take_output()
    for _ in range(2):
        assert s.receive(error(code), 0.1) == []
        assert s.take_output() == READ_23
    (event,) = s.receive(error(code), 0.2)
    assert event.error.code == code


@pytest.mark.parametrize("code", [0x01, 0x0A, 0x0B, 0xFF])
def test_faults_are_events_at_any_time_and_answer_nothing(code):
    s = session()
    assert s.receive(error(code), 0.0) == [DeviceFault(code)]
    s.start(read(23), 0.1)
    assert s.receive(error(code), 0.2) == [DeviceFault(code)]
    assert s.receive(REPLY_23, 0.3) == [ProcedureFinished(IDENTITY)]


def test_a_refusal_without_a_command_is_a_fault():
    assert session().receive(error(0x07), 0.0) == [DeviceFault(0x07)]


def test_late_reply_answers_the_repeated_command_and_a_barrier_absorbs_the_second():
    def twice():
        first = yield from read(23)
        second = yield from read(23)
        return first, second

    s = session()
    s.start(twice(), 0.0)
    s.tick(0.4)
    assert s.take_output() == READ_23 + READ_23
    assert s.receive(REPLY_23, 0.45) == []
    assert s.take_output() == READ_1  # not register 23: the other attempt's reply may still come
    (stale,) = s.receive(REPLY_23, 0.5)
    assert isinstance(stale, Stray)
    assert s.receive(REPLY_1, 0.55) == []
    assert s.take_output() == READ_23
    fresh = checksum("VNRRG,23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1")
    assert s.receive(fresh, 0.6) == [ProcedureFinished((IDENTITY, OTHER))]


def test_a_late_reply_with_the_old_values_does_not_verify_a_write():
    """Read (answered late) ... write other values ... read: the old read's reply is not the new."""

    def sequence():
        yield from read(23)
        return (yield from write_verified(23, IDENTITY))

    s = session()
    s.start(sequence(), 0.0)
    s.tick(0.4)  # the first attempt's reply is late
    s.receive(REPLY_23, 0.5)
    s.take_output()
    s.receive(REPLY_23, 0.6)  # it comes, with values that the next write happens to have
    s.receive(REPLY_1, 0.61)
    assert s.take_output() == WRITE_23
    s.receive(WRITE_23, 0.62)
    assert s.take_output() == READ_23
    kept = checksum("VNRRG,23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1")
    assert s.receive(kept, 0.63) == []  # the device did not keep the write
    assert s.take_output() == WRITE_23
    for now_s in (0.7, 0.8):
        s.receive(WRITE_23 + kept, now_s)
    s.receive(b"", 0.9)
    assert not s.busy


def test_errors_during_a_barrier_belong_to_the_earlier_command():
    def sequence():
        with pytest.raises(NoReply):
            yield Read(85)
        return (yield from read(23))

    s = session()
    s.start(sequence(), 0.0)
    for now_s in (0.4, 0.81, 1.22):
        s.tick(now_s)
    assert s.take_output() == b"$VNRRG,85*7E\r\n" * 3 + READ_1
    assert s.receive(error(0x08), 1.25) == [DeviceFault(0x08)]
    s.receive(REPLY_1, 1.3)
    assert s.take_output() == READ_23
    assert s.receive(REPLY_23, 1.35) == [ProcedureFinished(IDENTITY)]


def test_silent_barrier_is_retried_and_ambiguous_commands_are_not_sent():
    def sequence():
        for command in (Read(23), Read(23), Read(25)):
            with pytest.raises(NoReply):
                yield command
        return "end"

    s = session()
    s.start(sequence(), 0.0)
    sent, now_s, events = b"", 0.0, []
    while s.busy:
        now_s = s.deadline_s
        events += s.tick(now_s)
        sent += s.take_output()
    assert events == [ProcedureFinished("end")]
    # the second read of 23 could be answered by the first's late reply: never sent
    assert sent == READ_23 * 3 + READ_1 + READ_3 + READ_4 + checksum("VNRRG,02") + (
        checksum("VNRRG,25") * 3
    )


def test_a_late_reply_is_forgotten_after_five_seconds():
    def sequence():
        with pytest.raises(NoReply):
            yield Read(23)
        yield Pause(6.0)
        return (yield from read(23))

    s = session()
    s.start(sequence(), 0.0)
    for now_s in (0.4, 0.81, 1.22, 7.3):
        s.tick(now_s)
    assert s.take_output() == READ_23 * 4


def test_the_gate_holds_back_every_command_and_its_repetitions():
    s = session(allow=lambda command: False)
    (event,) = s.start(read(23), 0.0)
    assert isinstance(event.error, NotPermitted)
    assert str(event.error) == "read of register 23 is not permitted in this mode"
    assert s.take_output() == b""

    asked = []
    s = session(allow=lambda command: not asked and asked.append(command) is None)
    s.start(one(Write(23, IDENTITY)), 0.0)
    assert s.take_output() == WRITE_23
    (event,) = s.tick(0.5)
    assert isinstance(event.error, NotPermitted)
    assert s.take_output() == b""


def test_observing_never_writes_even_to_clean_up():
    s = session(allow=lambda command: isinstance(command, Read))
    (event,) = s.start(quiet(write_verified(23, IDENTITY)), 0.0)
    assert isinstance(event.error, NotPermitted)
    assert s.take_output() == b""


def test_output_is_paused_and_resumed_around_a_sequence():
    s = session()
    s.start(quiet(read(23)), 0.0)
    assert s.take_output() == ASY_0
    s.receive(YMR + ASY_0, 0.1)
    assert s.take_output() == READ_23
    s.receive(REPLY_23, 0.2)
    assert s.take_output() == ASY_1
    assert s.receive(ASY_1, 0.3) == [ProcedureFinished(IDENTITY)]


@pytest.mark.parametrize("how", ["refused", "no reply", "cancelled"])
def test_output_is_resumed_however_the_sequence_ends(how):
    s = session()
    s.start(quiet(read(23)), 0.0)
    s.receive(ASY_0, 0.1)
    s.take_output()
    if how == "refused":
        events = s.receive(error(0x08), 0.2)
    elif how == "cancelled":
        events = s.cancel(0.2)
        assert s.cancel(0.2) == []
    else:
        events = s.tick(0.5) + s.tick(0.91) + s.tick(1.32)
    assert events == []
    assert s.take_output()[-len(READ_1) :] == READ_1  # the read may still be answered
    s.receive(REPLY_1, 1.4)
    assert s.take_output() == ASY_1
    (event,) = s.receive(ASY_1, 1.5)
    assert type(event.error) is {"refused": DeviceRefused, "cancelled": Cancelled}.get(how, NoReply)


def test_output_is_resumed_although_nothing_ever_answers():
    s = session()
    s.start(quiet(read(23)), 0.0)
    sent, events = b"", []
    while s.busy:
        events += s.tick(s.deadline_s)
        sent += s.take_output()
    assert ASY_1 in sent
    assert READ_23 not in sent
    assert isinstance(events[-1].error, NoReply)


def test_nothing_is_sent_when_the_link_is_gone():
    s = session()
    s.start(quiet(quiet(read(23))), 0.0)
    s.take_output()
    (event,) = s.link_lost(0.1)
    assert isinstance(event.error, LinkGone)
    assert s.take_output() == b""
    assert not s.busy
    assert s.deadline_s is None
    s.start(one(QUIET), 10.0)
    assert s.take_output() == ASY_0


def test_save_has_a_longer_timeout_and_one_attempt():
    s = session()
    s.start(save_settings(), 0.0)
    assert s.take_output() == WNV
    assert s.deadline_s == 2.0
    assert s.receive(WNV, 1.0) == []
    assert s.deadline_s == 2.5
    assert s.tick(2.5) == [ProcedureFinished(None)]

    s.start(save_settings(), 3.0)
    s.receive(WNV, 4.0)
    (event,) = s.receive(error(0x07), 4.5)
    assert event.error.code == 0x07

    s.start(save_settings(), 6.0)
    s.take_output()
    (event,) = s.tick(8.0)
    assert isinstance(event.error, NoReply)
    assert s.take_output() == b""


def test_pause_returns_what_was_received():
    s = session()
    s.start(one(Pause(0.3)), 0.0)
    s.receive(YMR + YMR, 0.1)
    assert s.tick(0.2) == []
    (event,) = s.tick(0.3)
    assert event.result.tokens == ("VNYMR",)


def test_partial_message_is_dropped_after_silence():
    s = session()
    s.receive(YMR[:50], 0.0)
    assert s.deadline_s == pytest.approx(0.5)
    s.tick(0.5)
    assert s.deadline_s is None
    (event,) = s.receive(YMR, 1.0)
    assert isinstance(event, Measurement)


def test_partial_message_waits_longer_on_the_network():
    s = session()
    s.receive(YMR[:50], 0.0)
    assert s.tick(0.4) == []
    (event,) = s.receive(YMR[50:], 0.45)
    assert isinstance(event, Measurement)
    assert s.deframer.counters.skipped_bytes == 0


def asked_then(command):
    """A read, and a command directly after it; returns how often that was too late."""
    late = 0
    while True:
        yield Read(23)
        try:
            yield command
        except TooLate:
            late += 1
        else:
            return late


@pytest.mark.parametrize(
    ("command", "sent"),
    [
        (Write(23, OTHER, once=True), WRITE_23_OTHER),
        (Word("VNWNV", behind=True), WNV),
    ],
    ids=["write", "save"],
)
def test_command_that_needs_a_recent_answer_is_withheld_when_it_is_old(command, sent):
    talk = session()
    talk.start(asked_then(command), 0.0)
    assert talk.take_output() == READ_23
    talk.receive(REPLY_23, 0.11)  # the cable may have been moved since it was asked
    assert talk.take_output() == READ_23
    talk.receive(REPLY_23, 0.20)
    assert talk.take_output() == sent
    events = talk.receive(checksum(sent.decode()[1:].split("*")[0]), 0.21)
    assert events == [ProcedureFinished(1)]


def test_answer_to_a_repeated_read_counts_as_old():
    talk = session()
    talk.start(asked_then(Word("VNWNV", behind=True)), 0.0)
    talk.take_output()
    talk.tick(0.4)
    assert talk.take_output() == READ_23
    talk.receive(REPLY_23, 0.42)
    assert talk.take_output() == READ_1  # a barrier: whether both are answered yet
    talk.receive(REPLY_1, 0.44)
    assert talk.take_output() == READ_23
    talk.receive(REPLY_23, 0.46)
    assert talk.take_output() == WNV


def test_answer_before_a_long_barrier_is_too_old():
    talk = session()
    talk.start(asked_then(Word("VNWNV", behind=True)), 0.0)
    talk.tick(0.4)
    talk.receive(REPLY_23, 0.45)
    talk.take_output()
    talk.receive(REPLY_1, 0.60)
    assert WNV not in talk.take_output()
