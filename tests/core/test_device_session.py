"""Commands to the device and their order: the session with the emulated device, without a port."""

from __future__ import annotations

import re

import pytest

from ahrsd.core.device_session import (
    ASK_AGAIN_S,
    STOP_S,
    Closed,
    Completed,
    ConfigurationRead,
    DeviceSession,
    Identified,
    Phase,
    StreamChanged,
    Unanswered,
)
from ahrsd.writeback.actions import SetUpStream
from ahrsd.writeback.journal_history import RecordKind, StoredRecord
from ahrsd.writeback.states import Mode, Purpose
from drivers.vn100.commands import (
    LinkGone,
    Read,
    Word,
    Write,
    WrongDevice,
    quiet,
    read,
    write_verified,
)
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.registers import SESSION_SETTINGS

STEP_S = 0.01


class Talk:
    """A device session, an emulated device and one clock for both."""

    def __init__(self, mode=Mode.OBSERVE, change_stream=False, **setup):
        self.device = build(Setup(output=setup.pop("output", "imu"), **setup))
        self.before = dict(self.device.memory.ram)
        self.device_session = DeviceSession(mode, change_stream=change_stream, rate_hz=50.0)
        self.now_s = 1.0
        self.device.advance(self.now_s)
        self.said, self.sent, self.events = [], b"", []
        self.journal, self.disk_full = [], False
        self.device_session.on_opened(115200, self.now_s)

    def step(self):
        output = self.device_session.session.take_output()
        self.sent += output
        self.device.receive(output, self.now_s)
        self.now_s += STEP_S
        data = self.device.advance(self.now_s)
        if data:
            self.events += self.device_session.receive(data, self.now_s)
        due = self.device_session.deadline_s
        if due is not None and self.now_s >= due:
            self.events += self.device_session.tick(self.now_s)
        self.hear()

    def hear(self):
        """What the core does with the session's events; the journal answers at once."""
        said = self.device_session.take_events()
        self.said += said
        for one in said:
            if isinstance(one, ConfigurationRead):
                self.device_session.on_registers_and_journal(one.values, self.journal)
        actions = self.device_session.outputs.take_actions()
        while actions:
            action = actions.pop(0)
            if isinstance(action, SetUpStream):
                self.device_session.set_up_again(self.now_s)
                continue
            if not self.disk_full:
                self.journal.append(StoredRecord(action.kind.value, dict(action.facts)))
            error = "no space left" if self.disk_full else ""
            self.device_session.on_journalled(action.kind, error, self.now_s)
            actions += self.device_session.outputs.take_actions()

    def until(self, condition, seconds=20.0):
        end_s = self.now_s + seconds
        while not condition():
            assert self.now_s < end_s, (self.device_session.phase, self.said)
            self.step()
        return self

    def in_phase(self, phase):
        return self.until(lambda: self.device_session.phase is phase)

    def close(self, seconds=3.0):
        self.device_session.limit.begin(self.now_s)
        self.device_session.restore_and_close(self.now_s)
        self.until(lambda: self.device_session.phase is Phase.DONE, seconds)
        self.hear()
        return next(one for one in self.said if isinstance(one, Closed))

    def kinds(self):
        return [type(one) for one in self.said]


def test_device_is_identified_before_its_samples_count():
    talk = Talk().in_phase(Phase.READY)
    assert talk.kinds() == [Identified, ConfigurationRead]
    assert talk.said[0].identity.serial == talk.device.serial
    assert talk.said[1].values[23] == talk.before[23, 0]
    assert re.fullmatch(rb"(\$VNRRG,\d\d\*[0-9A-F]{2}\r\n)+", talk.sent)
    assert talk.close() == Closed(None)


def test_passive_sends_nothing():
    talk = Talk(Mode.PASSIVE, change_stream=True)
    assert talk.device_session.phase is Phase.READY
    talk.until(lambda: len(talk.events) > 20)
    assert talk.close() == Closed(None)
    assert talk.sent == b""
    assert talk.device_session.cleanup() is None
    assert not any(
        talk.device_session.allows_cleanup(c)
        for c in (Read(1), Write(6, (0,)), Word("VNASY", (1,)), Word("VNWNV"))
    )


AT_ONCE = (Phase.KEEPING, Phase.CLOSING)  # the journal answers before time passes


@pytest.mark.parametrize(
    "phase", [p for p in Phase if p not in (Phase.RUNNING, Phase.LOOKING, Phase.DONE, *AT_ONCE)]
)
def test_device_is_restored_when_closed_in_any_phase(phase):
    talk = Talk(change_stream=True)
    if phase is Phase.RESTORING:
        talk.in_phase(Phase.READY)
    elif phase is Phase.CLOSED:
        talk.in_phase(Phase.READY)
        talk.device_session.on_link_lost(talk.now_s)
    elif phase is Phase.SERVING:
        talk.in_phase(Phase.READY).device_session.serve(Read(23), talk.now_s)
        assert talk.device_session.phase is phase
    else:
        talk.in_phase(phase)
    closed = talk.until(lambda: talk.device_session.may_close).close()
    if phase is Phase.CLOSED:
        assert isinstance(closed.error, LinkGone)
        return
    assert closed == Closed(None)
    assert talk.device.memory.ram == talk.before


def test_session_can_close_while_reading():
    talk = Talk(faults=("off@1",))
    talk.until(lambda: talk.sent)
    assert talk.device_session.phase is Phase.IDENTIFYING
    assert talk.device_session.may_close
    assert talk.close(0.1) == Closed(None)


def test_silent_unknown_device_is_used_and_queried_again():
    talk = Talk(faults=("lost_reply@0+12",))
    talk.until(lambda: Unanswered in talk.kinds())
    talk.in_phase(Phase.READY)
    assert talk.now_s < 12.0 + ASK_AGAIN_S[1] + 2.0
    assert talk.kinds() == [Unanswered, Identified, ConfigurationRead]


def test_samples_of_a_known_device_are_unused_until_it_answers_again():
    """`Unanswered` makes the core use the stream as it is, except if the registers are known."""
    talk = Talk(faults=("lost_reply@3+8",)).in_phase(Phase.READY)
    talk.until(lambda: talk.now_s > 3.1)
    talk.device_session.identify_again(talk.now_s)
    talk.until(lambda: StreamChanged in talk.kinds())
    assert talk.said[-1].level == "warning"
    talk.in_phase(Phase.READY)
    known = [Identified, ConfigurationRead]
    assert talk.kinds() == [*known, StreamChanged, *known]


def test_settings_of_one_device_are_not_restored_to_another():
    talk = Talk(change_stream=True).in_phase(Phase.READY)
    talk.device_session.on_link_lost(talk.now_s)
    other = build(Setup(output="binary", rate_hz=20))
    other.replace_unit(7)
    talk.device, talk.before = other, dict(other.memory.ram)
    other.advance(talk.now_s)
    talk.device_session.on_opened(115200, talk.now_s)
    talk.in_phase(Phase.READY)
    assert talk.device_session.identity.serial == 7
    before = {key: other.memory.ram[key] for key in other.memory.ram if key[0] in SESSION_SETTINGS}
    assert talk.close() == Closed(None)
    after = {key: other.memory.ram[key] for key in before}
    assert after != before
    assert other.memory.ram == talk.before


def test_unidentified_device_is_not_written_at_the_end():
    """After replugging it may be another device, and an unidentified device is not restored."""
    talk = Talk(change_stream=True).in_phase(Phase.READY)
    talk.device_session.on_link_lost(talk.now_s)
    talk.device_session.on_opened(115200, talk.now_s)
    talk.device_session.on_link_lost(talk.now_s)
    sent = len(talk.sent)
    assert isinstance(talk.close().error, LinkGone)
    assert b"VNWRG" not in talk.sent[sent:]


def test_settings_are_restored_only_to_the_same_device():
    """Behind an adapter that stays plugged another device may answer: the serial number is read
    first.
    """
    talk = Talk(change_stream=True).in_phase(Phase.READY)
    talk.device.replace_unit(7)
    before = dict(talk.device.memory.ram)
    talk.device_session.identify_again(talk.now_s)
    assert isinstance(talk.close().error, WrongDevice)
    assert talk.device.memory.ram == before


def test_missing_output_is_set_up_again():
    talk = Talk(change_stream=True, output="ascii", faults=("reset@3",)).in_phase(Phase.READY)
    talk.until(lambda: talk.kinds().count(Identified) == 2)
    gone = talk.said[talk.kinds().index(Identified, 1) - 1]
    assert "output is gone" in gone.text
    talk.in_phase(Phase.READY)
    assert talk.device.memory.get(75)[:2] == (1, 16)
    assert talk.close() == Closed(None)
    assert talk.device.memory.ram == talk.before


def test_each_failed_set_up_cuts_the_stream_and_the_first_is_reported():
    """A device that restarted in between sends its own message, also the second time."""
    talk = Talk(change_stream=True, faults=("refused_write",)).in_phase(Phase.READY)
    talk.until(lambda: talk.kinds().count(StreamChanged) == 3, 60.0)
    texts = [one.text for one in talk.said if isinstance(one, StreamChanged)]
    assert "cannot be set up" in texts[0]
    assert texts[1:] == ["", ""]


def test_settings_that_cannot_be_restored_are_reported():
    talk = Talk(change_stream=True, faults=("refused_write@3",)).in_phase(Phase.READY)
    talk.until(lambda: talk.now_s > 3.1)
    closed = talk.close(STOP_S + 0.1)
    assert "settings not put back" in str(closed.error)
    assert "the next run" in str(closed.error)
    assert RecordKind.OUTPUTS_BACK not in [record.kind for record in talk.journal]
    assert not any("put back as they were" in getattr(one, "text", "") for one in talk.said)


def write_23(values):
    return quiet(write_verified(23, values))


def test_every_command_of_the_write_back_passes_the_gate():
    talk = Talk(Mode.STAGE).in_phase(Phase.READY)
    new = (*talk.before[23, 0][:9], 0.1, 0.2, 0.3)
    asked = []

    def gate(command):
        asked.append(command)
        return not isinstance(command, Write)

    talk.device_session.run("write", write_23(new), Purpose.STAGE, talk.now_s, gate)
    talk.until(lambda: Completed in talk.kinds())
    assert "VNWRG" not in talk.sent.decode()
    assert any(isinstance(command, Write) for command in asked)
    assert talk.device.memory.ram == talk.before
    talk.said.clear()
    talk.device_session.run("write", write_23(new), Purpose.STAGE, talk.now_s)
    talk.until(lambda: Completed in talk.kinds())
    assert talk.said[-1].error is None
    assert talk.device.memory.get(23)[9:] == pytest.approx((0.1, 0.2, 0.3), abs=1e-7)


def test_lost_link_ends_a_procedure_with_a_reason():
    talk = Talk(Mode.STAGE).in_phase(Phase.READY)
    talk.device_session.run("look", read(23), Purpose.STAGE, talk.now_s)
    talk.device_session.on_link_lost(talk.now_s)
    (done,) = [one for one in talk.device_session.take_events() if isinstance(one, Completed)]
    assert (done.name, type(done.error)) == ("look", LinkGone)
    assert talk.device_session.may_close


@pytest.mark.parametrize("phase", [Phase.SETTING_UP, Phase.READY])
def test_cleanup_restores_the_settings_of_the_session(phase):
    talk = Talk(change_stream=True).in_phase(phase)
    procedure = talk.device_session.cleanup()
    fresh = DeviceSession(Mode.STAGE, change_stream=True)
    fresh.phase = Phase.READY
    talk.device_session, broken = fresh, talk.device_session
    fresh.run("cleanup", procedure, Purpose.STREAM, talk.now_s, broken.allows_cleanup)
    talk.until(lambda: Completed in talk.kinds())
    assert talk.said[-1].error is None
    assert talk.device.memory.ram == talk.before


def test_cleanup_of_a_transaction_only_turns_the_output_on():
    talk = Talk(Mode.STAGE).in_phase(Phase.READY)
    assert talk.device_session.cleanup() is None
    talk.device_session.run("look", quiet(read(23)), Purpose.STAGE, talk.now_s)
    procedure = talk.device_session.cleanup()
    assert next(procedure) == Word("VNASY", (1,))
    assert talk.device_session.allows_cleanup(Word("VNASY", (1,)))
    assert not talk.device_session.allows_cleanup(Word("VNWNV"))
    assert not talk.device_session.allows_cleanup(Write(6, (0,)))
