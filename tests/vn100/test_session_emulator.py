"""Session and procedures against the emulated device: both firmwares, both ports, every fault."""

from __future__ import annotations

import time

import numpy as np
import pytest
from counted_calls import counted_calls

from drivers.serial_port import SerialPort, detect_baud
from drivers.vn100.calibration_stream import configure_stream
from drivers.vn100.commands import (
    SessionError,
    identify,
    missing,
    quiet,
    read_configuration,
    read_registers,
    restore,
    save_settings,
    write_verified,
)
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.device import Device
from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.registers import SESSION_SETTINGS
from drivers.vn100.session import ProcedureFailed, ProcedureFinished, Session

NEW_23 = (1.0021, 0.0123456, 0.0, 0.0123456, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 7.1384e-05)
STEP_S = 0.004


class Bench:
    """An emulated device and a session beside it, in the emulator's time."""

    def __init__(self, setup):
        self.emulator = build(setup)
        self.session = Session(lambda command: True)
        self.now_s = 1.0  # it has booted
        self.emulator.advance(self.now_s)

    def step(self):
        """Bytes of both directions, once; the events."""
        self.emulator.receive(self.session.take_output(), self.now_s)
        self.now_s += STEP_S
        data = self.emulator.advance(self.now_s)
        events = self.session.receive(data, self.now_s) if data else []
        deadline_s = self.session.deadline_s
        if deadline_s is not None and self.now_s >= deadline_s:
            events += self.session.tick(self.now_s)
        return events

    def run(self, procedure):
        """ProcedureFinished or ProcedureFailed, within two minutes."""
        events, until_s = self.session.start(procedure, self.now_s), self.now_s + 120.0
        while self.session.busy:
            events += self.step()
            assert self.now_s < until_s
        (end,) = [
            event for event in events if isinstance(event, ProcedureFinished | ProcedureFailed)
        ]
        return end

    def measurements(self, seconds):
        until_s, events = self.now_s + seconds, []
        while self.now_s < until_s:
            events += self.step()
        return [event for event in events if isinstance(event, Measurement)]


@pytest.mark.parametrize(("firmware", "startup_bias"), [("2", 74), ("3", 43)])
def test_identity_and_configuration_of_both_firmwares(firmware, startup_bias):
    bench = Bench(Setup(firmware=firmware))
    identity = bench.run(identify()).result
    assert identity.model == "VN-100S-CR"
    assert identity.serial == bench.emulator.serial
    assert identity.profile.startup_bias == startup_bias
    values = bench.run(read_configuration(identity.profile)).result
    assert missing(identity.profile, values) == ()
    assert startup_bias in values
    assert values[44] == identity.profile.default(44)
    assert values[85] == (0, 4, 4, 4, 0, 0, 3, 3, 3, 0)


def test_a_verified_write_is_in_the_devices_memory_and_the_stream_goes_on():
    bench = Bench(Setup(rate_hz=40))
    end = bench.run(quiet(write_verified(23, NEW_23)))
    assert end.result == pytest.approx(NEW_23, rel=5e-6)
    assert bench.emulator.memory.get(23) == tuple(float(v) for v in np.float32(NEW_23))
    assert len(bench.measurements(1.0)) == pytest.approx(40, abs=1)


def test_saving_makes_it_survive_a_reset():
    bench = Bench(Setup(faults=("reset@5",)))
    bench.run(quiet(write_verified(84, NEW_23)))
    assert isinstance(bench.run(save_settings()), ProcedureFinished)
    bench.measurements(max(0.0, 7.0 - bench.now_s))
    assert bench.emulator.counters["restarts"] == 1
    values = bench.run(read_registers((84,))).result[84]
    assert values == pytest.approx(NEW_23, rel=5e-6)


@pytest.mark.parametrize("firmware", ["2", "3"])
@pytest.mark.parametrize("port", [1, 2])
@pytest.mark.parametrize("output", ["ascii", "binary"])
def test_the_calibration_stream_is_set_up_and_put_back(firmware, port, output):
    bench = Bench(Setup(firmware=firmware, port=port, output=output, rate_hz=40))
    keys = SESSION_SETTINGS
    before = bench.run(read_registers(keys)).result
    stream = bench.run(configure_stream(100.0, 115200)).result
    assert stream.values[0] == port
    assert stream.layout == "FA 06 0001 083F"
    bench.measurements(0.1)
    heard = bench.measurements(1.0)
    assert {measurement.layout.name for measurement in heard} == {stream.layout}
    assert len(heard) == pytest.approx(100, abs=1)
    assert isinstance(bench.run(quiet(restore(before, keys))), ProcedureFinished)
    assert bench.run(read_registers(keys)).result == before


FAULTS = [
    "late_reply@1+4", "late_reply=1.6@1+6", "lost_reply=0.5@1+6", "lost_reply@1+6",
    "wrong_reply=0.7@1+6", "altered_reply=0.5@1+6", "refused_write@1+6", "refused_write=3@1+6",
    "silent_refusal@1+6", "collision@1+6", "byte_drop=0.01@1+6", "bit_flip=0.01@1+6",
    "noise_insert=0.5@1+6", "garbage=0.3@1+6", "duplicate=0.7@1+6", "burst_latency=60@1+6",
    "false_header=0.5@1+6", "mute@1+3", "off@1.1+3", "reset@1.05", "power_cut@1.02",
]  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_verified_write_is_in_the_device_under_every_fault(fault, seed):
    """What must change: the write may fail, with a typed error. What must not: a verified write is
    in the memory, and once the fault is over the device streams (a resume may be needed)."""
    bench = Bench(Setup(seed=seed, faults=(fault,), rate_hz=20))
    end = bench.run(quiet(write_verified(23, NEW_23)))
    if isinstance(end, ProcedureFinished):
        assert bench.emulator.memory.get(23) == tuple(float(v) for v in np.float32(NEW_23))
    else:
        assert isinstance(end.error, SessionError | DeviceRefused)
    bench.measurements(max(0.0, 8.0 - bench.now_s))
    if not bench.measurements(0.5):
        assert isinstance(end, ProcedureFailed), "verified, yet left silent"
        assert isinstance(bench.run(quiet(read_registers((23,)))), ProcedureFinished)
    assert len(bench.measurements(1.0)) == pytest.approx(20, abs=1)


def test_output_is_on_again_if_no_command_is_lost():
    """Replies may be lost, late or wrong: as long as commands arrive, the output is on again."""
    for fault in ("lost_reply=0.5", "late_reply=0.7", "wrong_reply=0.5", "duplicate=0.5"):
        for seed in range(5):
            bench = Bench(Setup(seed=seed, faults=(f"{fault}@1+60",), rate_hz=20))
            bench.run(quiet(write_verified(23, NEW_23)))
            bench.measurements(0.5)
            assert bench.measurements(0.5), (fault, seed)


@pytest.mark.parametrize("baud", [57600, 230400])
def test_on_a_pty_from_an_unknown_rate_to_a_verified_write(baud):
    setup = Setup(baud=baud, output="imu", rate_hz=20, seed=3)
    with PtyEmulator(build(setup), speed=1.0) as served:
        time.sleep(0.6)  # it boots
        found = detect_baud(served.path, configured=115200, may_query=True)
        assert found.baud == baud
        heard = []
        port = SerialPort(served.path, found.baud)
        with Device(port, lambda command: True, on_event=heard.append) as device:
            identity = device.run(identify())
            assert identity.serial == served.emulator.serial
            assert device.run(quiet(write_verified(84, NEW_23))) == pytest.approx(NEW_23, 5e-6)
        assert served.emulator.memory.get(84) == tuple(float(v) for v in np.float32(NEW_23))


def test_session_costs_little_compared_with_parsing():
    bench = Bench(Setup(output="binary", rate_hz=800, baud=921600))
    chunks = []
    for _ in range(500):
        bench.now_s += STEP_S
        chunks.append(bench.emulator.advance(bench.now_s))

    def bare():
        deframer = Deframer()
        return sum(len([decode(frame) for frame in deframer.feed(chunk)]) for chunk in chunks)

    def session():
        conversation = Session(lambda command: True)
        return sum(len(conversation.receive(chunk, 0.0)) for chunk in chunks)

    session()  # what is made on first use
    (alone_calls, alone), (both_calls, both) = counted_calls(bare), counted_calls(session)
    print(f"{alone} packets, {both_calls / alone:.1f} calls each, {alone_calls / alone:.1f} bare")
    assert alone == both >= 1590
    assert both_calls < 1.5 * alone_calls
