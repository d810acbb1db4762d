"""Faults as a host of the emulated device sees them."""

import struct

import numpy as np
import pytest

from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import EmulatedTruth, make_motion
from drivers.vn100.emulator.scenarios import SCENARIOS, Setup, build

QUIET = {6: (0,)}
TIMES = {6: (0,), 75: (1, 8, 1, 0x0001)}  # TimeStartup at 100 Hz, 14 bytes
VALUES = {6: (0,), 75: (1, 8, 4, 0x0002)}  # UncompMag at 100 Hz, 18 bytes


def device(*faults, presets=QUIET, motion="tumble", **options) -> Emulator:
    return Emulator(
        EmulatedTruth(), make_motion(motion, 1), faults=faults, presets=presets, **options
    )


def say(made: Emulator, line: bytes, at_s: float, wait_s: float = 0.2) -> bytes:
    made.advance(at_s)
    made.receive(line, at_s)
    return made.advance(at_s + wait_s)


def times(wire: bytes) -> list[float]:
    assert len(wire) % 14 == 0
    return [struct.unpack_from("<Q", wire, at + 4)[0] / 1e9 for at in range(0, len(wire), 14)]


def test_reset_in_the_stream_lets_time_fall_and_ram_vanish():
    made = device("reset@5", presets=TIMES)
    assert b"50*58" in say(made, b"$VNWRG,07,50*58\r\n", 1.0)
    made.advance(4.5)
    stamps = times(made.advance(8.0))
    falls = [i for i in range(1, len(stamps)) if stamps[i] < stamps[i - 1]]
    assert len(falls) == 1
    assert stamps[falls[0]] == pytest.approx(0.5, abs=0.02)
    assert b"$VNRRG,07,40*5C" in say(made, b"$VNRRG,07*74\r\n", 8.1)
    assert made.counters["restarts"] == 1 and "restart" in made.take_log()


def test_unplug_with_and_without_power():
    for parameter, kept in ((1, b"$VNRRG,07,40*"), (0, b"$VNRRG,07,50*")):
        made = device(f"unplug={parameter}@5+2")
        say(made, b"$VNWRG,07,50*58\r\n", 1.0)
        made.advance(5.5)
        assert not made.plugged
        assert say(made, b"$VNRRG,07*74\r\n", 6.0) == b""
        made.advance(8.0)
        assert made.plugged
        assert say(made, b"$VNRRG,07*74\r\n", 8.1).startswith(kept)


def test_replug_brings_another_unit_in_factory_state():
    made = device("replug_other_serial@5", presets={**QUIET, 23: (1.1, *[0] * 11)})
    before = say(made, b"$VNRRG,03*70\r\n", 1.0)
    say(made, b"$VNASY,0*4F\r\n", 8.0)
    after = say(made, b"$VNRRG,03*70\r\n", 8.5)
    assert before.startswith(b"$VNRRG,03,0100130608*")
    assert after.startswith(b"$VNRRG,03,0100130609*")
    assert say(made, b"$VNRRG,23*72\r\n", 9.0) == b"$VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0*73\r\n"


def test_another_unit_starts_also_where_the_first_one_was_started_meanwhile():
    """It had sent the first one's last message over and over, because a reset had started that."""
    made = device("replug_other_serial@2+1", "reset@2.2", presets=TIMES)
    assert len(set(times(made.advance(1.9)))) > 100
    made.advance(3.5)
    assert b"\xfa" not in made.advance(5.0)  # in factory state: its own ASCII message
    assert say(made, b"$VNRRG,03*70\r\n", 5.1).count(b"$VNRRG,03,0100130609*") == 1


def test_power_cut_after_the_nth_write():
    made = device("power_cut_wrg=2@1+1")
    assert say(made, b"$VNWRG,07,50*58\r\n", 2.0) == b"$VNWRG,07,50*58\r\n"
    assert say(made, b"$VNWRG,07,20*XX\r\n", 2.5) == b""
    assert b"07,40" in say(made, b"$VNRRG,07*74\r\n", 5.0)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [("power_cut_wnv@1", (b"1,0,0", b"1,0,0")), ("torn_flash@1", (b"1.5,0,0", b"1,0,0"))],
)
def test_power_cut_during_a_save(fault, expected):
    """Torn: register 23 is among the lower half of the registers, 84 is not."""
    made = device(fault)
    say(made, b"$VNWRG,23,1.5,0,0,0,1,0,0,0,1,0,0,0*XX\r\n", 2.0)
    say(made, b"$VNWRG,84,1.5,0,0,0,1,0,0,0,1,0,0,0*XX\r\n", 2.5)
    assert say(made, b"$VNWNV*57\r\n", 3.0, 1.0) == b""
    say(made, b"$VNASY,0*4F\r\n", 7.0)
    assert say(made, b"$VNRRG,23*72\r\n", 7.5).startswith(b"$VNRRG,23," + expected[0])
    assert say(made, b"$VNRRG,84*7F\r\n", 8.0).startswith(b"$VNRRG,84," + expected[1])


def test_replies_late_lost_wrong_and_altered():
    read, reply = b"$VNRRG,07*74\r\n", b"$VNRRG,07,40*5C\r\n"
    late = device("late_reply=0.7@1+1")
    assert say(late, read, 1.5, 0.69) == b""
    assert late.advance(2.3) == reply
    lost = device("lost_reply@1+1")
    assert say(lost, b"$VNWRG,07,50*58\r\n", 1.5, 2.0) == b""
    assert say(lost, read, 4.0) == b"$VNRRG,07,50*5D\r\n"
    wrong = device("wrong_reply@1+1")
    assert say(wrong, read, 1.5).startswith(b"$VNRRG,21,0.234,0,0.4212,0,0,-9.79375*")
    altered = device("altered_reply@1+1")
    assert say(altered, read, 1.5) == b"$VNRRG,07,41*5D\r\n"
    for made in (late, wrong, altered):
        assert say(made, read, 5.0) == reply


def test_writes_can_be_refused_with_or_without_an_error():
    write, read = b"$VNWRG,07,50*58\r\n", b"$VNRRG,07*74\r\n"
    loud = device("refused_write=9@1")
    assert say(loud, write, 2.0) == b"$VNERR,09*78\r\n"
    silent = device("silent_refusal@1")
    assert say(silent, write, 2.0) == write
    one = device("silent_refusal=23@1")
    assert say(one, write, 2.0) == write
    assert say(loud, read, 3.0) == say(silent, read, 3.0) == b"$VNRRG,07,40*5C\r\n"
    assert say(one, read, 3.0) == b"$VNRRG,07,50*5D\r\n"


def test_collisions_hit_long_writes_while_streaming():
    numbers = ",".join(["1.23456789"] * 12).encode()
    write = b"$VNWRG,23," + numbers + b"*XX\r\n"
    made = device("collision=1", presets={})
    assert b"$VNERR,03*72\r\n" in say(made, write, 1.0)
    say(made, b"$VNASY,0*4F\r\n", 2.0)
    assert say(made, write, 3.0).startswith(b"$VNWRG,23,1.23457,")


def test_stuck_sensor_repeats_values_while_time_runs():
    made = device("stuck@1+1", presets={6: (0,), 75: (1, 8, 6, 0x0001, 0x0002)})
    wire = made.advance(3.0)
    rows = [wire[at : at + 28] for at in range(0, len(wire), 28)]
    fields = [row[14:26] for row in rows]
    stamps = [struct.unpack_from("<Q", row, 6)[0] / 1e9 for row in rows]
    assert np.diff(stamps).min() > 0.0099
    inside = {field for field, s in zip(fields, stamps, strict=True) if 1.0 <= s < 1.999}
    outside = [field for field, s in zip(fields, stamps, strict=True) if not 0.98 < s < 2.0]
    assert len(inside) == 1 and len(set(outside)) == len(outside) > 100


def test_mute_hears_and_off_does_not():
    for fault, rate in (("mute@1+2", b"50"), ("off@1+2", b"40")):
        made = device(fault)
        assert say(made, b"$VNWRG,07,50*58\r\n", 2.0) == b""
        assert b"$VNRRG,07," + rate in say(made, b"$VNRRG,07*74\r\n", 4.0)


def test_bursts_arrive_every_16_ms_and_lose_nothing():
    calm, bursty = device(presets=VALUES), device("burst_latency", presets=VALUES)
    arrivals = {at for at in range(2000) if bursty.advance(at / 1000)}
    assert all(at % 16 <= 1 for at in arrivals) and len(arrivals) > 100
    total = device("burst_latency", presets=VALUES).advance(2.1)
    assert total[: 18 * 190] == calm.advance(2.1)[: 18 * 190]


def test_foreign_writes_can_be_visible_or_invisible():
    aloud, silently = device("third_party_write@2"), device("third_party_change@2")
    assert aloud.advance(3.0).startswith(b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0.01*")
    assert silently.advance(3.0) == b""
    for made in (aloud, silently):
        assert say(made, b"$VNRRG,23*72\r\n", 4.0).startswith(
            b"$VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0.01*"
        )
    hsi = device("third_party_change=44@2")
    assert say(hsi, b"$VNRRG,44*73\r\n", 3.0).startswith(b"$VNRRG,44,1,3,5*")
    with pytest.raises(ValueError, match="nobody else writes register 7"):
        device("third_party_write=7@2")


def test_clock_step():
    stamps = times(device("clock_step=3@2", presets=TIMES).advance(4.0))
    assert sorted(np.round(np.diff(stamps), 2))[-1] == pytest.approx(3.01)


def test_wire_damage_reaches_the_host():
    clean = device(presets=VALUES).advance(20.0)
    for fault in ("byte_drop=0.01", "bit_flip=0.01", "noise_insert", "false_header", "garbage"):
        assert device(fault, presets=VALUES).advance(20.0) != clean
    assert device("byte_drop=0.01@30", presets=VALUES).advance(20.0) == clean


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenarios(name):
    made = build(Setup(name, seed=2))
    wire = made.advance(5.0)
    assert wire.count(b"$VNYMR") == pytest.approx(200, abs=2)
    firmware = say(made, b"$VNRRG,04*77\r\n", 6.0)
    assert SCENARIOS[name].firmware.encode() in firmware


def spread(wire: bytes) -> float:
    """Standard deviation of the uncompensated field's length, gauss."""
    lines = [line for line in wire.split(b"\r\n") if line.startswith(b"$VNIMU")]
    field = np.array([line.split(b"*")[0].split(b",")[1:4] for line in lines], float)
    return float(np.linalg.norm(field, axis=1).std())


def test_calibrated_scenario_needs_no_correction():
    made = build(Setup("calibrated", seed=4, output="imu"))
    np.testing.assert_allclose(spread(made.advance(60.0)), 2e-3, rtol=0.2)
    assert spread(build(Setup("rov", seed=4, output="imu")).advance(60.0)) > 0.03


def test_impossible_setups_are_refused_with_a_reason():
    with pytest.raises(ValueError, match="no scenario 'moon'; there are rov, "):
        build(Setup("moon"))
    with pytest.raises(ValueError, match="must divide 800"):
        build(Setup(output="binary", rate_hz=30))
    with pytest.raises(ValueError, match="does not fit"):
        build(Setup(output="binary", rate_hz=200))
    for rate_hz in (-5, 0, 77):
        with pytest.raises(ValueError, match="register 7 has 1, 2, 4, 5, 10, 20, 25, 40, 50, 100"):
            build(Setup(output="ascii", rate_hz=rate_hz))
    for firmware in ("x", "4", "3.0", "3.1.0.0-beta"):
        with pytest.raises(ValueError, match=r"2 or 3, or a version such as 3\.0\.0\.0"):
            build(Setup(firmware=firmware))


def test_a_clock_that_wraps_begins_again_and_the_device_does_not():
    made = device("clock_wrap@2", presets=TIMES)
    stamps = times(made.advance(3.0))
    fall = int(np.argmin(np.diff(stamps)))
    assert stamps[fall] == pytest.approx(2.0, abs=0.02)
    assert stamps[fall + 1] == pytest.approx(0.0, abs=0.02)
    assert made.counters["restarts"] == 0


def test_any_command_can_be_refused_with_a_code():
    refusing = device("refused_command=6@1+1")
    assert say(refusing, b"$VNRRG,23*72\r\n", 1.5).startswith(b"$VNERR,06*")
    assert say(refusing, b"$VNRRG,23*72\r\n", 2.5).startswith(b"$VNRRG,23,")
