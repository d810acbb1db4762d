"""Samples of an earlier run: a killed run continues from them, or reports why not."""

from __future__ import annotations

import os
import re
from dataclasses import replace

import numpy as np
import pytest
from cabled_run import estimate, lenient_gates
from patience import PATIENCE_S
from recorded_run import LIMIT_S, RecordedRun

from ahrsd import events, inputs
from ahrsd.config.config import check_config
from ahrsd.core.decision_log import DecisionLog
from ahrsd.core.warm_start import CONFIRM_S, Present, WarmStart, too_old
from ahrsd.daemon.daemon import Recall
from ahrsd.offline.replay import replay
from ahrsd.recording import capture
from ahrsd.recording.capture import CaptureReader, Sent
from ahrsd.recording.earlier_run import earlier_inputs
from ahrsd.samples import SampleBlock
from ahrsd.telemetry.status import LinkFacts, StatusMaker
from ahrsd.telemetry.words import explain_json, explain_lines, status_lines
from ahrsd.writeback.journal_history import Stamp
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.registers import Unit

SCENE = Setup(
    "rov",
    seed=2,
    output="binary",
    rate_hz=50,
    baud=115200,
    motion=(("static", 12.0), ("tumble", 2000.0)),
)
HALF = replace(SCENE, rate_hz=25)  # for tests that drive for minutes
DRIVEN_S, MORE_S = 270.0, 110.0
VERDICT_S = 45.0  # maximum between two verdicts: a slot is held out
UNIT = Unit("VN-100", 7, "2.0.0.0")
FACTORY = {23: (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), 44: (0, 1, 5)}
NOW = inputs.WallClock(0, 1.8e9, "boot", 5000.0)


def recorded(folder, scene=SCENE, **tables):
    tables = {"gates": lenient_gates(), "write_back": {"recheck_s": 5.0}, **tables}
    return RecordedRun(build(scene), folder, **tables)


# -- a run that was killed -------------------------------------------------------------------------


def up_to(at_s, whole, folder):
    """The run up to this time: its capture so far, and the device, which was not written."""
    run = recorded(folder, HALF)
    run.emulator.advance(at_s)
    run.now_s = at_s
    for item in CaptureReader(whole.path):
        if item.host_ns > run.now_ns:
            break
        if isinstance(item, Sent):
            run.writer.write_sent(item.host_ns, item.data)
        else:
            run.writer.write(item)
    return run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run that continues for `MORE_S` after `DRIVEN_S`, and one that is killed then."""
    whole = recorded(tmp_path_factory.mktemp("whole"), HALF)
    whole.run(DRIVEN_S + 2.0 + MORE_S)
    whole.writer.close()
    killed = up_to(1.0 + DRIVEN_S, whole, tmp_path_factory.mktemp("killed"))
    killed.again(2.0)
    killed.run(MORE_S)
    killed.writer.close()
    return whole, killed, whole.qualified_s - 1.0


def test_killed_run_has_its_candidate_soon(runs):
    _, killed, cold_s = runs
    assert cold_s > 200.0
    warm_s = killed.qualified_s - killed.began_s
    assert CONFIRM_S < warm_s < CONFIRM_S + VERDICT_S
    assert killed.core.warm.text.endswith("this run agrees")


def test_killed_run_decides_as_an_uninterrupted_one(runs):
    whole, killed, _ = runs
    one, two = whole.core.calibrator.estimate, killed.core.calibrator.estimate
    assert one.converged
    assert two.converged
    np.testing.assert_allclose(two.hard_iron_gauss, one.hard_iron_gauss, atol=5e-4)
    np.testing.assert_allclose(two.soft_iron, one.soft_iron, atol=2e-3)
    np.testing.assert_allclose(two.gyro_bias_rad_s, one.gyro_bias_rad_s, atol=3e-4)
    gates = [{g.gate: g.ok for g in run.core.calibrator.gates} for run in runs[:2]]
    assert gates[0] == gates[1]
    assert killed.core.writeback.state == whole.core.writeback.state == "QUALIFIED"


@pytest.mark.slow
def test_replay_of_a_warm_started_run_decides_the_same(runs):
    _, killed, _ = runs
    done = replay(killed.path, killed.config)
    assert done.core.decisions.sha256 == killed.core.decisions.sha256
    assert done.core.decisions.sha256 != DecisionLog().sha256
    assert done.core.warm.text == killed.core.warm.text


def test_another_device_starts_without_earlier_samples(tmp_path):
    run = recorded(tmp_path)
    run.run(30.0)
    run.again(tell=False)
    *blocks, told = run.earlier()
    for item in (*blocks, replace(told, serial=told.serial + 1)):
        run.feed(item)
    run.run(10.0)
    assert "another device" in run.core.warm.text
    assert run.core.calibrator.collector._history._start_s > 30.0
    assert any("no warm start: they are of another device" in text for _, text in run.notes)


# -- device and age --------------------------------------------------------------------------------


def block(first_s=100.0, rows=300):
    t = first_s + np.arange(rows) / 33.0
    dt = np.full(rows, 1 / 33.0)
    spin = np.tile([0.0, 0.0, 0.2], (rows, 1))
    field = np.tile([0.2, 0.0, 0.4], (rows, 1))
    return SampleBlock(t, dt, t, field, spin, np.full((rows, 3), np.nan), {}, 0, True)


def told(**changes):
    given = {
        "source": "a.mcap",
        "model": UNIT.model,
        "serial": UNIT.serial,
        "firmware": UNIT.firmware,
        "registers": FACTORY,
        "boot_id": "boot",
        "boot_s": 4400.0,
        "wall_s": 1.8e9 - 600.0,
    }
    return inputs.EarlierRun(0, **{**given, **changes})


def present(**changes):
    given = {
        "unit": UNIT,
        "registers": FACTORY,
        "compensated": (False, False),
        "at_s": 900.0,
        "host_s": 0.0,
    }
    return Present(**{**given, **changes})


def warmed(run=None, clock=NOW, limit_s=LIMIT_S):
    warm = WarmStart(limit_s)
    warm.set_clock(clock)
    warm.add_samples(inputs.EarlierSamples(0, block()))
    warm.on_samples_complete(run or told())
    return warm


@pytest.mark.parametrize(
    ("run", "now", "clock", "words"),
    [
        ({"serial": 8}, {}, {}, "another device: VN-100 serial 8"),
        ({"firmware": "3.1.0.0"}, {}, {}, "another device"),
        ({"registers": {**FACTORY, 44: (1, 3, 5)}}, {}, {}, "register 44 held other values then"),
        ({"registers": {44: (0, 1, 5)}}, {}, {}, "register 23 held other values then"),
        ({"boot_s": 3100.0}, {}, {}, "32 min old, more than 30 min"),
        ({"boot_s": 5001.0}, {}, {}, "in the future"),
        ({"boot_id": "another"}, {}, {}, "from before the computer was started"),
        ({"boot_id": ""}, {}, {}, "their age is not known"),
        ({}, {}, {"wall_s": 1.8e9 + 86400.0}, "by the wall clock"),
        ({}, {"open": True}, {}, "a write is under way or on trial"),
        ({}, {"terms": True}, {}, "terms.model is set"),
        ({}, {"candidate": True}, {}, "has a candidate of its own"),
        ({"why": "a.mcap: damaged"}, {}, {}, "a.mcap: damaged"),
    ],
)
def test_unused_samples_are_reported_with_a_reason(run, now, clock, words):
    warm = warmed(told(**run), replace(NOW, **clock))
    blocks, _ = warm.take_due(present(**now), 900.0)
    assert blocks == []
    assert words in warm.text
    assert warm.text.startswith("not used: ")
    assert warm.confirms(estimate())


@pytest.mark.parametrize("wall_s", [0.0, 1.8e9, 1.8e9 - 90000.0])
def test_wrong_wall_clock_does_not_make_samples_recent(wall_s):
    now = Stamp(wall_s, "boot", 5000.0)
    assert too_old(Stamp(1.8e9, "boot", 4400.0), now, 1800.0) == ""
    assert "min old" in too_old(Stamp(wall_s, "boot", 3000.0), now, 1800.0)
    assert too_old(Stamp(wall_s, "before", 4400.0), now, 1800.0)


def test_samples_of_other_quantities_wait_for_the_right_stream():
    warm = warmed()
    assert warm.take_due(present(compensated=(True, True)), 900.0) == ([], "")
    assert "same quantities" in warm.text
    blocks, text = warm.take_due(present(), 900.0)
    assert len(blocks) == 1
    assert "300 samples up to 10.0 min old, from a.mcap" in text


def test_samples_precede_the_first_sample_of_a_restarted_device():
    blocks, _ = warmed().take_due(present(at_s=3.0), 3.0)
    assert blocks[-1].time_s[-1] == pytest.approx(3.0 - 600.0 - 1.0)


@pytest.mark.parametrize(("limit_s", "passive"), [(0.0, False), (1800.0, True)])
def test_warm_start_is_off_by_setting_and_in_passive(limit_s, passive):
    warm = WarmStart(limit_s, passive=passive)
    warm.add_samples(inputs.EarlierSamples(0, block()))
    assert warm.on_samples_complete(told()) == ""
    assert warm.take_due(present(), 900.0) == ([], "")
    assert warm.text.startswith("off: ")
    assert warm.confirms(estimate())


# -- this run must agree ---------------------------------------------------------------------------


def used():
    warm = warmed()
    warm.take_due(present(), 900.0)
    return warm


def seen(warm, seconds, rate=0.2, field=(0.27, 0.27, 0.31)):
    for k in range(round(4 * seconds)):
        t = 900.0 + 0.25 * k + np.arange(1, 11) / 40.0
        raw, spin = np.tile(field, (10, 1)), np.tile([0.01, -0.02, rate + 0.005], (10, 1))
        warm.add_live_samples(
            SampleBlock(t, np.full(10, 1 / 40.0), t, raw, spin, np.full((10, 3), np.nan), {})
        )


def right():
    """A raw field whose corrected magnitude is that of `estimate`."""
    return tuple(estimate().hard_iron_gauss + np.array([0.0, 0.0, estimate().field_gauss]))


def test_minute_of_turning_in_agreement_releases_the_candidate():
    warm = used()
    assert not warm.confirms(estimate())
    seen(warm, 59.0, field=right())
    assert not warm.confirms(estimate())
    assert "so far 59 s" in warm.holds
    seen(warm, 2.0, field=right())
    assert warm.confirms(estimate())
    assert warm.holds == ""


@pytest.mark.parametrize(
    ("rate", "field", "words"),
    [(0.0, right(), "90 deg of turning"), (0.2, (0.6, 0.0, 0.4), "does not agree")],
)
def test_rest_or_another_field_does_not_release_the_candidate(rate, field, words):
    warm = used()
    seen(warm, 300.0, rate, field)
    assert not warm.confirms(estimate())
    assert words in warm.holds


def test_doubt_restarts_the_minute_of_agreement():
    warm = used()
    seen(warm, 50.0, field=right())
    warm.restart_confirmation()
    seen(warm, 50.0, field=right())
    assert not warm.confirms(estimate())
    seen(warm, 20.0, field=right())
    assert warm.confirms(estimate())


def test_restarted_calibrator_has_no_earlier_samples():
    warm = used()
    warm.end("another device was here")
    assert warm.confirms(estimate())
    assert warm.text == "over: another device was here"


# -- the captures ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A capture of 40 s, whose device is read every five seconds."""
    run = recorded(tmp_path_factory.mktemp("short"))
    run.run(40.0)
    run.writer.close()
    return run


def read_again(short, folder, data=None, later_s=1.0, **changes):
    """What is read from a copy of the capture."""
    (folder / "ahrsd-1.mcap").write_bytes(short.path.read_bytes() if data is None else data)
    then = short.stamp
    now = replace(then, boot_s=then.boot_s + later_s, wall_s=then.wall_s + later_s)
    return earlier_inputs(folder, None, replace(now, **changes), LIMIT_S, 33.0)


def test_samples_between_two_readings_of_the_device_are_used(short, tmp_path):
    *samples, run = read_again(short, tmp_path)
    assert run.why == ""
    assert run.serial == 100130608
    assert run.registers[23] == FACTORY[23]
    last_s = samples[-1].block.host_s[-1]
    assert 30.0 < last_s < short.now_s - 0.5
    rows = sum(len(item.block) for item in samples)
    assert rows > 1000
    assert max(len(item.block) for item in samples) <= 300
    assert run.boot_s == pytest.approx(last_s, abs=0.01)


def test_earlier_samples_are_recorded_as_inputs(short, tmp_path):
    for item in read_again(short, tmp_path):
        again = capture.input_from_json(capture.input_to_json(item))
        assert capture.input_to_json(again) == capture.input_to_json(item)
        if isinstance(item, inputs.EarlierRun):
            assert again == item


def test_capture_truncated_by_a_kill_is_used(short, tmp_path):
    whole = short.path.read_bytes()
    *samples, run = read_again(short, tmp_path, whole[: 2 * len(whole) // 3])
    assert run.why == ""
    assert samples


def test_damaged_capture_is_not_used(short, tmp_path):
    data = bytearray(short.path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    (run,) = read_again(short, tmp_path, bytes(data))
    assert "ahrsd-1.mcap: damaged: " in run.why


def test_capture_of_another_boot_or_an_old_one_is_not_used(short, tmp_path):
    (run,) = read_again(short, tmp_path, boot_id="another")
    assert "from before the computer was started" in run.why
    (run,) = read_again(short, tmp_path, later_s=LIMIT_S + 60.0)
    assert "min old, more than 30 min" in run.why or "no reading" in run.why


def test_folder_without_a_capture_or_with_a_pipe_is_reported(tmp_path):
    now = Stamp(1.8e9, "boot", 100.0)
    (run,) = earlier_inputs(tmp_path, None, now, LIMIT_S, 33.0)
    assert run.why == "there is no earlier capture"
    os.mkfifo(tmp_path / "ahrsd-1.mcap")
    (tmp_path / "ahrsd-2.mcap").symlink_to(tmp_path / "elsewhere")
    (run,) = earlier_inputs(tmp_path, None, now, LIMIT_S, 33.0)
    assert run.why == "there is no earlier capture"
    (tmp_path / "ahrsd-3.mcap").write_bytes(b"no capture")
    (run,) = earlier_inputs(tmp_path, None, now, LIMIT_S, 33.0)
    assert "is not a capture of ahrsd" in run.why


def test_reading_that_takes_too_long_is_abandoned(short, tmp_path):
    (tmp_path / "ahrsd-1.mcap").write_bytes(short.path.read_bytes())
    (run,) = earlier_inputs(tmp_path, None, short.stamp, LIMIT_S, 33.0, lambda: False)
    assert "took too long" in run.why


def test_samples_that_made_the_estimator_fail_are_not_used_again(tmp_path):
    run = recorded(tmp_path)
    run.run(20.0)
    run.feed(inputs.Examined(run.now_ns, 1, "LinAlgError: Singular matrix"))
    run.run(2.0)
    run.again(tell=False)
    (told_,) = run.earlier()
    assert "its estimator failed: LinAlgError" in told_.why


def test_no_run_older_than_a_failure_is_read(tmp_path):
    run = recorded(tmp_path)
    run.run(20.0)
    run.again(tell=False)
    run.run(10.0)
    run.feed(inputs.Examined(run.now_ns, 1, "LinAlgError"))
    run.run(20.0)
    run.again(tell=False)
    *samples, told_ = run.earlier()
    assert told_.why == ""
    assert told_.source == "ahrsd-20261102T120000Z.mcap"
    assert samples[0].block.host_s[0] > 32.0


def test_two_runs_of_one_device_are_joined(tmp_path):
    run = recorded(tmp_path)
    run.run(20.0)
    run.again(tell=False)
    run.run(20.0)
    run.again(tell=False)
    *samples, told_ = run.earlier()
    assert told_.source == "ahrsd-20261102T120000Z.mcap, ahrsd-20261101T120000Z.mcap"
    times = np.concatenate([item.block.time_s for item in samples])
    assert (np.diff(times) > 0.0).all()
    assert times[0] < 10.0
    assert times[-1] > 30.0


def test_warm_started_run_that_was_cut_off_at_once_is_not_used(short, tmp_path):
    run = recorded(tmp_path)
    run.run(20.0)
    run.again()
    run.run(20.0)
    run.again(tell=False)
    (first,) = list(tmp_path.glob("*2T*.mcap"))
    assert not run.earlier()[-1].why  # it was closed
    whole = first.read_bytes()
    first.write_bytes(whole[:-40])
    (told_,) = run.earlier()
    assert "began warm and was cut off at once" in told_.why


def test_register_write_ends_the_collected_samples(tmp_path):
    run = recorded(tmp_path)
    run.run(20.0)
    run.writer.write_sent(run.now_ns, b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0.1,0,0*XX\r\n")
    run.run(1.0)
    run.again(tell=False)
    (told_,) = run.earlier()
    assert "register 23 was written" in told_.why


def test_exception_in_the_reading_thread_does_not_end_the_run():
    def broken(_go_on):
        raise RuntimeError("no such thing")

    recall = Recall(broken)
    recall._thread.join(PATIENCE_S)
    item = recall.take(5)
    assert item.host_ns == 5
    assert item.why == "RuntimeError: no such thing"
    assert recall.take(6) is None


def test_no_reading_thread_when_warm_start_is_off():
    assert Recall.of(check_config({"mode": "passive"}, "test"), None) is None
    assert Recall.of(check_config({"estimator": {"warm_start_s": 0.0}}, "test"), None) is None


def test_earlier_samples_alone_never_allow_a_save(short):
    """A verdict whose samples are all from before the warm start has no flash gates."""
    core = short.core
    core.writeback.on_doubt("samples of an earlier run", short.now_s)
    core.writeback.on_verdict(
        estimate(),
        (),
        core.at_s,
        short.now_s,
        flash_gates=(events.GateResult("a", 1.0, 1.0, True, 0.0, "", ""),),
        sampled_s=short.now_s - 1.0,
    )
    assert core.writeback._safe.flash_gates == ()


# -- output for a person ---------------------------------------------------------------------------


def test_status_and_explain_report_the_warm_start_and_what_it_delays(tmp_path):
    run = recorded(tmp_path)
    run.run(30.0)
    run.again()
    run.run(10.0)
    status = StatusMaker(0.0).make(run.core, LinkFacts("port", 115200, True), 1.0)
    (line,) = [one for one in status_lines(status) if one.startswith("warm start: ")]
    assert re.search(r"warm start: \d+ samples up to 0\.\d min old, from ahrsd-2026", line)
    assert "no candidate before 60 s and 90 deg" in status["write_back"]["holds"][0]
    assert line in explain_lines(explain_json(status))
