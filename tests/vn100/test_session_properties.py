"""Random conversations on a bad line: verified values are in the device, and reads are fresh.

The line keeps its order, as a wire does. Replies are lost or late, commands are lost, damaged or
not carried out, and another program sends in between.
"""

from __future__ import annotations

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.vn100.commands import NoReply, VerifyFailed, quiet, read, write_verified
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.session import ProcedureFailed, ProcedureFinished, Session

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
OTHER = (1.02, 0.01, 0.0, 0.01, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 0.1)
YMR = (
    b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,"
    b"-00.000018,+00.001122,-00.000551*69\r\n"
)


def checksum(body):
    value = 0
    for byte in body.encode():
        value ^= byte
    return f"${body}*{value:02X}\r\n".encode()


class Wire:
    """A device on a line that keeps its order: it stores, loses, is late, and serves a second
    program. What it holds in register 23 is the truth of the property."""

    def __init__(self, faults):
        self.register = dict.fromkeys((23, 25), ["9"] * 12)
        self.faults = faults
        self.queue = []  # (due_s, bytes), in order
        self.last_due_s = 0.0

    def command(self, line, now_s):
        fault = next(self.faults, "none")
        if fault == "lost on the way there":
            return
        if fault == "damaged on the way there":
            self.say(checksum("VNERR,03"), now_s, "none")
            return
        word, number, *values = line[1 : line.index("*")].split(",")
        reply = f"{word},{number}"
        if word == "VNWRG" and fault != "not kept":
            self.register[int(number)] = [f"{float(v):G}" for v in values]
        if word in ("VNRRG", "VNWRG"):
            stored = {1: ["VN-100"], 2: ["1"], 3: ["7"], 4: ["3.1.0.0"], **self.register}
            values = values if fault == "not kept" and word == "VNWRG" else stored[int(number)]
            reply += "," + ",".join(values)
        self.say(checksum(reply), now_s, fault)

    def say(self, data, now_s, fault):
        if fault == "reply lost":
            return
        delay_s = {"late": 0.5, "very late": 1.1, "later than all tries": 1.7}.get(fault, 0.004)
        self.last_due_s = max(self.last_due_s, now_s + delay_s)
        self.queue.append((self.last_due_s, data))

    def foreign(self, kind, now_s):
        """Another program on the same line, or noise that happens to be a sentence."""
        if kind == "read":
            self.say(checksum("VNRRG,23," + ",".join(self.register[23])), now_s, "none")
        elif kind == "write 25":
            self.register[25] = ["1"] * 12
            self.say(checksum("VNWRG,25," + ",".join(self.register[25])), now_s, "none")
        elif kind == "error":
            self.say(checksum("VNERR,07"), now_s, "none")
        elif kind == "measurement":
            self.say(YMR, now_s, "none")


FAULTS = st.sampled_from(
    ["none"] * 4
    + ["lost on the way there", "damaged on the way there", "not kept", "reply lost"]
    + ["late", "very late", "later than all tries"]
)


FOREIGN = st.sampled_from(["nothing"] * 3 + ["read", "write 25", "error", "measurement"])


VALUES = st.sampled_from([IDENTITY, OTHER])


def converse(s, wire, procedure, now_s, strangers, cut):
    """Run `procedure` to its end on `wire`; its last event and the time then."""
    events = s.start(procedure, now_s)
    while s.busy:
        for line in s.take_output().decode().splitlines():
            wire.command(line, now_s)
        wire.foreign(next(strangers, "nothing"), now_s)
        now_s = max(now_s, min([due_s for due_s, _ in wire.queue[:1]] + [s.deadline_s]))
        if wire.queue and wire.queue[0][0] <= now_s:
            data = wire.queue.pop(0)[1]
            events += s.receive(data[:cut], now_s)
            events += s.receive(data[cut:], now_s)
        else:
            events += s.tick(now_s)
        assert now_s < 500.0
    return next(
        event for event in events if isinstance(event, ProcedureFinished | ProcedureFailed)
    ), now_s


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    faults=st.lists(FAULTS, max_size=40),
    foreign=st.lists(FOREIGN, max_size=40),
    writes=st.lists(VALUES, min_size=1, max_size=4),
    cut=st.integers(1, 60),
)
def test_verified_means_that_the_device_holds_the_values(faults, foreign, writes, cut):
    wire, s, now_s = Wire(iter(faults)), Session(lambda command: True), 0.0
    strangers, verified = iter(foreign), 0
    for values in writes:
        procedure = quiet(write_verified(23, values))
        end, now_s = converse(s, wire, procedure, now_s, strangers, cut)
        if isinstance(end, ProcedureFinished):
            verified += 1
            assert [float(v) for v in wire.register[23]] == list(values)
        else:
            assert isinstance(end.error, NoReply | DeviceRefused | VerifyFailed)
    if not faults and not foreign:
        assert verified == len(writes)


@settings(max_examples=400, deadline=None)
@given(
    faults=st.lists(FAULTS, max_size=20),
    foreign=st.lists(FOREIGN.filter(lambda kind: kind != "read"), max_size=20),
)
def test_read_never_returns_an_outdated_value(faults, foreign):
    wire, s, now_s = Wire(iter(faults)), Session(lambda command: True), 0.0
    strangers, answers = iter(foreign), 0
    for number in range(8):
        wire.register[23] = [str(number)] * 12  # another program's write, between our reads
        end, now_s = converse(s, wire, read(23), now_s, strangers, 9)
        if isinstance(end, ProcedureFinished):
            answers += 1
            assert end.result == (float(number),) * 12
        else:
            assert isinstance(end.error, NoReply | DeviceRefused)
    if not faults and not foreign:
        assert answers == 8
