"""The daemon on an emulated device: it stops in time, restores the device, and survives faults."""

from __future__ import annotations

import logging
import re
import threading
import time

import numpy as np
import pytest
from patience import PATIENCE_S
from planted_operator import Operator
from virtual_run import VirtualRun

from ahrsd.config.config import Config, core_settings
from ahrsd.daemon import host_clock
from ahrsd.daemon.core_runner import FoldedLog
from ahrsd.daemon.health_log import Watch
from ahrsd.events import SamplesSeen
from ahrsd.inputs import Examined, LinkLost, WallClock
from ahrsd.offline.replay import replay
from ahrsd.recording.capture import CaptureReader
from drivers.vn100.emulator.scenarios import Setup, build

OWN_STREAM = {"configure_stream": True, "rate_hz": 50.0}
LIMIT_S = 3.0
READ = rb"\$VNRRG,\d+(,\d)?\*[0-9A-F]{2}"


def registers(live, *numbers):
    return {n: live.emulator.memory.get(n, 1) for n in numbers}


def streaming(live):
    """Whether the emulated device is sending after all commands it received."""
    before = live.emulator.counters["messages"]
    live_s = threading.Event()
    live_s.wait(0.3)
    return live.emulator.counters["messages"] > before


def test_session_settings_are_restored(live):
    with live({"output": "ascii", "rate_hz": 40}, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.core.stream.facts.rate_hz > 49.0)
        assert registers(daemon, 6, 75) == {6: (0,), 75: (1, 16, 6, 1, 0x83F)}
        assert daemon.stop() < LIMIT_S
        assert daemon.emulator.memory.ram == daemon.before
        assert streaming(daemon)
        assert daemon.shell.finished
        assert daemon.error is None


@pytest.mark.parametrize("after_s", [0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6])
def test_daemon_can_be_stopped_at_any_moment_of_the_set_up(live, after_s):
    with live({"output": "ascii"}, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.heard)
        threading.Event().wait(after_s)
        assert daemon.stop() < LIMIT_S
        assert daemon.emulator.memory.ram == daemon.before
        assert streaming(daemon)
        assert daemon.error is None


def test_passive_sends_nothing_and_changes_nothing(live):
    with live({"output": "imu"}, mode="passive", device=OWN_STREAM) as daemon:
        daemon.flowing()
        assert daemon.stop() < LIMIT_S
        assert daemon.heard == b""
        assert daemon.emulator.memory.ram == daemon.before


def test_observe_sends_register_reads_only(live):
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        daemon.stop()
        sent = bytes(daemon.heard).split(b"\r\n")
        assert len(sent) > 20
        assert all(re.fullmatch(READ, line) for line in sent if line)


@pytest.mark.parametrize(
    "state", ["QUALIFIED", "PREPARING", "CHECKING", "STAGING", "STAGED", "TRIAL"]
)
def test_stop_in_a_transaction_leaves_the_old_values(live, state):
    with live({"output": "imu"}, mode="stage") as daemon:
        Operator(daemon, state, lambda: daemon.daemon.stop("test"))
        daemon.until(lambda: daemon.daemon._stop_reason)
        assert daemon.stop() < LIMIT_S
        assert state in daemon.states
        assert daemon.emulator.memory.ram == daemon.before
        assert daemon.shell.finished
        assert daemon.core.writeback.history.open is None
        assert streaming(daemon)


@pytest.mark.parametrize("state", ["CHECKING", "STAGING", "TRIAL"])
def test_device_unplugged_in_a_transaction_is_reconciled_afterwards(live, state):
    with live({"output": "imu"}, mode="stage") as daemon:

        def unplug():
            daemon.emulator.plugged = False
            threading.Timer(0.5, setattr, (daemon.emulator, "plugged", True)).start()

        Operator(daemon, state, unplug)
        daemon.until(lambda: daemon.states.count("RECONCILING") >= 1)
        daemon.until(lambda: daemon.states[-1] in ("OBSERVING", "TRIAL", "ROLLED_BACK"))
        held = {n: daemon.emulator.memory.get(n) for n in (23, 84)}
        changed = held != {n: daemon.before[n, 0] for n in (23, 84)}
        assert changed == (daemon.states[-1] == "TRIAL")
        daemon.flowing()
        assert daemon.stop() < LIMIT_S
        assert daemon.emulator.memory.ram == daemon.before


def test_daemon_stops_while_the_device_is_unplugged(live, caplog):
    with live({"output": "ascii"}, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.core.stream.facts.rate_hz > 49.0)
        daemon.emulator.plugged = False
        daemon.until(lambda: daemon.noted("link lost"))
        assert daemon.stop() < LIMIT_S
        assert daemon.shell.finished
        assert daemon.noted("not everything was put back")


def test_returning_device_is_reported_however_soon(live, caplog):
    caplog.set_level(logging.INFO, "ahrsd")
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        daemon.emulator.plugged = False
        daemon.until(lambda: "waiting for the device: " in caplog.text)
        daemon.emulator.plugged = True
        daemon.until(lambda: caplog.text.count(" open at ") == 2)
        assert daemon.stop() < LIMIT_S


def test_reset_is_noticed_and_the_session_is_set_up_again(live):
    setup = {"output": "ascii", "faults": ("reset@4",)}
    with live(setup, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.noted("output is gone: the device restarted"))
        daemon.until(lambda: daemon.notes.count("output set up") == 2)
        daemon.flowing()
        assert daemon.stop() < LIMIT_S
        assert daemon.emulator.memory.ram == daemon.before


def test_session_is_set_up_again_after_a_reset_to_silence(live):
    setup = {"output": "binary", "rate_hz": 40, "faults": ("reset@4",)}
    with live(setup, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.notes.count("output set up") == 1)
        silent = daemon.emulator.memory
        for port in (1, 2):
            silent.flash[6, port] = (0,)
        silent.flash[75, 0] = (0, 16, 1, 1)
        daemon.until(lambda: daemon.notes.count("output set up") == 2, 30.0)
        daemon.flowing()
        assert daemon.stop() < LIMIT_S


def test_another_device_starts_a_new_calibration_and_is_not_written(live):
    with live({"output": "imu", "faults": ("replug_other_serial@9+1",)}, mode="stage") as daemon:
        daemon.until(lambda: daemon.core.calibrator.started)
        first = daemon.core.calibrator
        daemon.until(lambda: daemon.noted("another device"), 20.0)
        daemon.flowing()
        assert daemon.core.calibrator is not first
        daemon.stop()
        assert daemon.core.device_session.identity.serial == daemon.emulator.serial
        assert b"VNWRG" not in daemon.heard


def test_stalled_device_is_reported_once_and_recovers(live, caplog):
    caplog.set_level(logging.INFO, "ahrsd")
    with live({"output": "imu", "faults": ("mute@3+8",)}) as daemon:
        daemon.until(lambda: "nothing comes from the device" in caplog.text, 20.0)
        daemon.until(lambda: "all is well again" in caplog.text, 20.0)
        daemon.flowing()
    assert caplog.text.count("nothing comes from the device") == 1


@pytest.mark.parametrize("outputs", ["off", "on, then the cable is pulled"])
def test_device_whose_outputs_are_off_is_not_called_silent(outputs):
    device = build(Setup("static", output="imu", faults=("mute@20",)))
    if outputs == "off":
        device.memory.preset(6, (0,))
        device.restart(0.0)
    run = VirtualRun(device, core_settings(Config()), step_s=0.1)
    watch, said = Watch(run.now_s), []
    while run.now_s < 40.0:
        run.run(1.0)
        said += [(run.now_s, r.text) for r in watch.look(run.core, run.now_s, "", True)]
    texts = [text.partition(":")[0] for _, text in said]
    answers = "the device answers and sends nothing by itself"
    assert texts == [answers] * (outputs == "off") + ["nothing comes from the device"]
    assert 25.0 <= said[-1][0] < 36.5  # the mute begins at 20 s, the last answer came before it


def test_device_that_did_not_answer_is_queried_again(live):
    with live({"output": "imu", "faults": ("lost_reply@0+4",)}) as daemon:
        daemon.until(lambda: daemon.noted("listening only"))
        daemon.until(lambda: daemon.core.device_session.identity, 20.0)
        daemon.until(lambda: daemon.states and daemon.states[-1] == "OBSERVING")
        assert daemon.stop() < LIMIT_S


def test_device_is_restored_after_an_exception_in_the_core(live, caplog):
    with live({"output": "ascii"}, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.core.stream.facts.rate_hz > 49.0)
        daemon.core.stream.take = None
        daemon.ended()
        assert isinstance(daemon.error, TypeError)
        assert daemon.emulator.memory.ram == daemon.before
        assert streaming(daemon)
    assert "internal error" in caplog.text


def test_output_is_on_after_an_exception_in_a_transaction(live):
    with live({"output": "imu"}, mode="stage") as daemon:

        def breakdown():
            daemon.core.device_session.receive = None

        Operator(daemon, "STAGING", breakdown)
        daemon.until(lambda: "STAGING" in daemon.states)
        daemon.ended()
        assert isinstance(daemon.error, TypeError)
        assert streaming(daemon)
        assert daemon.heard.rstrip().split(b"\r\n")[-1].startswith(b"$VNASY,1")


def test_run_continues_after_an_exception_in_the_estimator(live, caplog):
    with live({"output": "ascii"}, device=OWN_STREAM) as daemon:
        daemon.until(lambda: daemon.core.stream.facts.rate_hz > 49.0)
        daemon.core.calibrator.take = None
        daemon.until(lambda: daemon.core.estimation.state.failures)
        assert daemon.noted("ESTIMATOR FAILED: TypeError: 'NoneType' object is not callable")
        second = daemon.core.calibrator
        daemon.flowing()
        daemon.until(lambda: second.started, 30.0)
        assert daemon.stop() < LIMIT_S
        assert daemon.error is None
        assert daemon.emulator.memory.ram == daemon.before
    assert sum("Traceback" in getattr(r, "trace", "") for r in caplog.records) == 1
    recorded = [i.failure for i in CaptureReader(daemon.capture) if isinstance(i, Examined)]
    assert [text for text in recorded if text] == ["TypeError: 'NoneType' object is not callable"]
    again = replay(daemon.capture, Config())
    assert again.core.decisions.sha256 == daemon.core.decisions.sha256


def test_samples_continue_while_the_estimator_is_busy(live):
    """A long search must not delay a reader of the socket or a stop."""
    free = threading.Event()
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        busy = threading.Event()

        def search(_):
            busy.set()
            free.wait(PATIENCE_S)

        daemon.core.calibrator.take = search
        daemon.until(busy.is_set)  # after the device was identified
        seen = [e for e in list(daemon.events) if isinstance(e, SamplesSeen)]
        daemon.until(
            lambda: len([e for e in daemon.events if isinstance(e, SamplesSeen)]) > len(seen) + 3
        )
        assert not daemon.shell.worker.stuck
        assert daemon.stop() < LIMIT_S
        free.set()


def test_exception_in_the_reader_is_a_lost_link(live, monkeypatch):
    """The daemon must not continue without input and without noticing it."""
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        monkeypatch.setattr(threading, "excepthook", lambda _: None)
        daemon.daemon._link._port.read = None
        daemon.until(lambda: daemon.noted("the reading thread broke down"))
        daemon.flowing()
        daemon.stop()
    assert [i for i in CaptureReader(daemon.capture) if isinstance(i, LinkLost)]


def test_status_is_logged_periodically(live, caplog, monkeypatch):
    monkeypatch.setattr("ahrsd.daemon.health_log.STATUS_S", 2.0)
    caplog.set_level(logging.INFO, "ahrsd")
    line = (
        r"\d+ samples, (3[0-9]|4[0-9])\.\d Hz, \d+ gaps?, [A-Z]+, heading sigma \d+\.\d\d deg, "
        # a busy machine loses some samples
        r"waits for (motion\.\w+: .*drive|stream_health\.drops: .*rate)"
    )
    with live({"output": "imu"}, estimator={"epoch_steps": 64, "window_steps": 128}) as daemon:
        daemon.until(lambda: re.search(line, caplog.text), 30.0)


def test_repeated_log_lines_are_counted():
    lines = []
    folded = FoldedLog(lambda level, text: lines.append((level, text)))
    for at_s in range(50):
        folded.say(30, "VNERR 0B", float(at_s))
    assert lines == [(30, "VNERR 0B")]
    folded.say(20, "another", 50.0)
    assert lines[1:] == [(20, "another")]
    folded.settle(61.0)
    assert lines[2:] == [(30, "VNERR 0B (49 more times)")]
    folded.say(20, "another", 61.0)
    folded.settle(111.0)
    assert lines[3:] == [(20, "another (once more)")]
    for number in range(200):
        folded.say(20, f"text {number}", 62.0)
    assert len(folded._open) == 64
    folded.finish()
    assert len(lines) == 204


def test_suspension_of_the_host_restarts_the_link(live, monkeypatch):
    """The host clock stood still, so a stream without device time would not show the missing
    samples.
    """
    real, slept = time.clock_gettime, [0.0]

    def clock(which):
        return real(which) + slept[0] * (which == time.CLOCK_BOOTTIME)

    monkeypatch.setattr(time, "clock_gettime", clock)
    with live({"output": "ascii"}) as daemon:  # VNYMR: no time in it
        daemon.until(lambda: daemon.samples > 60)
        slept[0] = 3600.0
        daemon.until(lambda: daemon.noted("the host was suspended for 3600.0 s"))
        daemon.events.clear()
        daemon.until(lambda: any(isinstance(e, SamplesSeen) for e in list(daemon.events)))
        daemon.stop()
        first = next(e.block for e in daemon.events if isinstance(e, SamplesSeen))
        assert first.gap_before
        assert np.isnan(first.dt_s[0])
        assert daemon.error is None
    lost = [i for i in CaptureReader(daemon.capture) if isinstance(i, LinkLost)]
    assert [item.reason for item in lost] == ["the host was suspended for 3600.0 s"]


def test_setting_the_host_clock_moves_no_sample(live, monkeypatch):
    real, step = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + step[0])
    with live({"output": "binary"}) as daemon:
        daemon.flowing()
        outbox = daemon.core.writeback._outbox
        for days in (-1, 7):
            was_s, step[0] = outbox.wall_s, 86400.0 * days
            daemon.until(lambda was_s=was_s: abs(outbox.wall_s - was_s) > 80_000.0)
            daemon.flowing()
        daemon.stop()
        facts = daemon.core.stream.facts
        assert daemon.core.stream.gaps == []
        assert facts.samples == facts.expected
    told = [i for i in CaptureReader(daemon.capture) if isinstance(i, WallClock)]
    assert np.round(np.diff([i.wall_s for i in told]) / 86400.0, 2).tolist() == [-1.0, 8.0]
    assert {i.boot_id for i in told} == {host_clock.boot_id()}
    offsets_s = [i.boot_s - i.host_ns * 1e-9 for i in told]
    assert np.ptp(offsets_s) < 0.5  # boottime cannot be set
