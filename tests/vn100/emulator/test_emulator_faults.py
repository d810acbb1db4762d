"""Schedules of faults, and what each does to bytes."""

import math
import re

import pytest

from drivers.vn100.emulator.faults import FALSE_HEADERS, FAULTS, Fault, FaultPlan, parse_fault

MESSAGE = bytes(range(32, 127))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("byte_drop", Fault("byte_drop", 1e-3, 0.0, math.inf)),
        ("byte_drop=0.01@30+5", Fault("byte_drop", 0.01, 30.0, 5.0)),
        ("reset@60", Fault("reset", 0.0, 60.0, 0.0)),
        ("reset", Fault("reset", 0.0, 10.0, 0.0)),
        ("unplug=0@7.5+0.25", Fault("unplug", 0.0, 7.5, 0.25)),
        (" dipole@20 ", Fault("dipole", 5.0, 20.0, 4.0)),
    ],
)
def test_schedules(text, fault):
    assert parse_fault(text) == fault


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("byte_dorp", "no fault 'byte_dorp'; there are byte_drop, "),
        ("byte_drop@soon", "start must be a number >= 0, not 'soon'"),
        ("byte_drop=nan", "parameter must be a number >= 0, not 'nan'"),
        ("byte_drop=2", "parameter is a probability, at most 1"),
        ("lost_reply=1.5@3", "parameter is a probability, at most 1"),
        ("byte_drop@1+-2", "duration must be a number >= 0, not '-2'"),
        ("byte_drop@", "expected name[=parameter][@start[+duration]]"),
        ("", "expected name[=parameter][@start[+duration]]"),
    ],
)
def test_bad_schedules_say_what_is_allowed(text, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        parse_fault(text)


def test_every_fault_is_described():
    for name, kind in FAULTS.items():
        assert re.fullmatch(r"[a-z_]+", name)
        assert len(kind.description) > 10
        assert kind.duration_s >= 0


def distorted(schedule, messages=400, seed=1):
    plan = FaultPlan([schedule], seed)
    return [plan.distort(MESSAGE, index / 100) for index in range(messages)]


def test_no_fault_no_change():
    assert FaultPlan().distort(MESSAGE, 3.0) == MESSAGE


def test_faults_keep_to_their_time():
    out = distorted("garbage@1+1")
    assert all(message == MESSAGE for message in out[:100] + out[200:])
    assert not any(message == MESSAGE for message in out[100:200])


def test_byte_drop_loses_bytes_in_order():
    out = distorted("byte_drop=0.01")
    lost = sum(len(MESSAGE) - len(message) for message in out)
    assert lost == pytest.approx(0.01 * 400 * len(MESSAGE), rel=0.2)
    assert all(list(message) == sorted(message) for message in out)


def test_bit_flip_changes_one_bit_of_some_bytes():
    out = distorted("bit_flip=0.01")
    differing = [a ^ b for message in out for a, b in zip(message, MESSAGE, strict=True) if a != b]
    assert len(differing) == pytest.approx(0.01 * 400 * len(MESSAGE), rel=0.2)
    assert all(bits.bit_count() == 1 for bits in differing)
    assert len(set(differing)) == 8


def test_noise_is_inserted_and_nothing_lost():
    out = distorted("noise_insert=0.5")
    longer = [message for message in out if len(message) > len(MESSAGE)]
    assert len(longer) == pytest.approx(200, rel=0.2)
    assert all(1 <= len(message) - len(MESSAGE) <= 40 for message in longer)
    for message in longer:
        extra = len(message) - len(MESSAGE)
        assert any(message[:i] + message[i + extra :] == MESSAGE for i in range(len(MESSAGE) + 1))


def test_false_headers_come_before_messages():
    out = set(distorted("false_header=1"))
    assert out == {header + MESSAGE for header in FALSE_HEADERS}
    assert all(header[0] == 0xFA for header in FALSE_HEADERS)


def test_duplicates_and_silence_and_garbling():
    assert set(distorted("duplicate=1")) == {MESSAGE * 2}
    assert set(distorted("mute")) == {b""}
    assert set(distorted("off")) == {b""}
    garbled = distorted("baud_mismatch")
    assert MESSAGE not in garbled and len(set(garbled)) == 400


def test_commands_suffer_from_off_and_from_the_wrong_rate_only():
    assert FaultPlan(["off"]).distort_command(MESSAGE, 0) == b""
    assert FaultPlan(["mute"]).distort_command(MESSAGE, 0) == MESSAGE
    assert FaultPlan(["byte_drop=1"]).distort_command(MESSAGE, 0) == MESSAGE
    assert FaultPlan(["baud_mismatch"]).distort_command(MESSAGE, 0) != MESSAGE


def test_bursts_round_up_to_the_usb_timer():
    plan = FaultPlan(["burst_latency=16@1+1"])
    assert plan.release_s(0.5) == 0.5
    assert plan.release_s(1.0201) == pytest.approx(1.024)
    assert plan.release_s(1.024) == pytest.approx(1.024)


def test_same_seed_same_damage_and_faults_do_not_disturb_each_other():
    assert distorted("bit_flip=0.1", seed=3) == distorted("bit_flip=0.1", seed=3)
    assert distorted("bit_flip=0.1", seed=3) != distorted("bit_flip=0.1", seed=4)
    alone = FaultPlan(["byte_drop=0.5@0+1", "noise_insert@5"], 3)
    other = FaultPlan(["byte_drop=0.5@0+1", "garbage@5"], 3)
    assert alone.distort(MESSAGE, 0.5) == other.distort(MESSAGE, 0.5)


def test_intermittent_loses_whole_messages():
    out = distorted("intermittent=0.25")
    assert set(out) == {b"", MESSAGE}
    assert out.count(b"") == pytest.approx(100, rel=0.25)
