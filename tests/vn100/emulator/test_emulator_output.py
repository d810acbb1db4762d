"""What the emulated device sends by itself: messages, layouts, order, rates and what fits the line.

Sums and layouts are checked by the functions below and not by the project's codec, so that a
mistake which codec and emulator share does not pass; two tests compare the two.
"""

import re
import struct

import numpy as np
import pytest
from quiet_device import Host, bodies, command, crc16, device, quiet

from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.emulator.physics import EmulatedTruth


@pytest.fixture
def host() -> Host:
    return Host(quiet())


def test_default_stream_is_vnymr_at_40_hz():
    lines = bodies(device("tumble").advance(10.0))
    assert len(lines) == 400  # the one of t = 10 s is still on the wire
    angles, fields = r"(,[+-]\d{3}\.\d{3}){3}", r"(,[+-]\d\d\.\d{4}){3}"
    pattern = "VNYMR" + angles + fields + r"(,[+-]\d\d\.\d{3}){3}(,[+-]\d\d\.\d{6}){3}"
    assert all(re.fullmatch(pattern, line) for line in lines)


SIZES = {
    1: 38,
    2: 51,
    8: 135,
    10: 38,
    11: 35,
    12: 44,
    13: 95,
    14: 122,
    16: 95,
    17: 95,
    19: 110,
    30: 75,
}


@pytest.mark.parametrize("ador", SIZES)
def test_ascii_messages_have_the_lengths_of_the_table(ador):
    wire = device(presets={6: (ador,), 7: (10,)}).advance(1.0)
    lines = wire.splitlines(keepends=True)
    assert len(lines) in (9, 10)
    assert {len(line) for line in lines} == {SIZES[ador]}


def test_count_and_status_are_appended_inside_the_checksum():
    made = device(presets={6: (1,), 7: (10,), 30: (3, 1, 0, 0, 1, 0, 1)})
    lines = bodies(made.advance(1.0))
    tails = [line.split(",")[4:] for line in lines]
    assert {tail[1] for tail in tails} == {"S0000"}
    counts = [int(tail[0][1:]) for tail in tails]
    assert all(re.fullmatch(r"T\d{10}", tail[0]) for tail in tails)
    assert set(np.diff(counts)) == {40}  # attitude ready, 400 Hz


def binary_device(values, motion="tumble", **options):
    return device(motion, presets={6: (0,), 5: (921600,), 75: values}, **options)


def packets(wire: bytes, header: bytes, length: int) -> list[bytes]:
    assert len(wire) % length == 0
    found = [wire[at : at + length] for at in range(0, len(wire), length)]
    for packet in found:
        assert packet.startswith(header)
        assert crc16(packet[1:]) == 0
    return found


def test_calibration_set_has_the_layout_of_the_recommended_frame():
    """syn_time_imu_cal_set of the vector file: FA 06 0100 3F08, 64 bytes."""
    truth = EmulatedTruth(hard_iron_gauss=np.array([0.1, 0, 0]))
    wire = binary_device((1, 8, 6, 0x0001, 0x083F), truth=truth).advance(2.0)
    found = packets(wire, bytes.fromhex("FA0601003F08"), 64)
    assert len(found) == 199 or len(found) == 200
    rows = [struct.unpack("<QH9f2fH", packet[6:-2]) for packet in found]
    times = np.array([row[0] for row in rows])
    assert set(times % 1000) == {0}
    np.testing.assert_allclose(np.diff(times), 10e6, atol=30e3)
    field, accel = np.array([row[2:5] for row in rows]), np.array([row[5:8] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(field - [0.1, 0, 0], axis=1), 0.49, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(accel, axis=1), 9.79375, atol=0.1)
    assert rows[0][11] == pytest.approx(25, abs=0.5) and rows[0][12] == pytest.approx(101.3, abs=1)
    assert {row[13] for row in rows} == {0}


def test_rates_of_a_binary_stream_integrate_to_its_quaternions():
    truth = EmulatedTruth(noise_gyro_rad_s=0, noise_mag_gauss=0, clock_jitter_s=0)
    wire = binary_device((1, 16, 0x14, 0x0008, 0x0004), truth=truth).advance(20.0)
    found = packets(wire, bytes.fromhex("FA1408000400"), 6 + 12 + 16 + 2)
    rows = np.array([struct.unpack("<7f", packet[6:-2]) for packet in found])

    def product(p, q):
        v = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
        return np.array([*v, p[3] * q[3] - p[:3] @ q[:3]])

    attitude = rows[0, 3:].astype(float)
    for rate in rows[1:, :3]:
        half = rate * 0.02 / 2
        angle = np.linalg.norm(half)
        attitude = product(attitude, np.array([*(np.sinc(angle / np.pi) * half), np.cos(angle)]))
    # the filter's yaw differs from the true one by a slowly varying constant (no iron: about 0)
    assert abs(attitude @ rows[-1, 3:]) == pytest.approx(1.0, abs=1e-5)


def test_order_at_a_common_instant_and_no_message_is_cut():
    made = device(
        presets={
            5: (921600,),
            7: (40,),
            75: (1, 20, 1, 0x0001),
            76: (1, 20, 1, 0x0008),
            77: (1, 20, 2, 0x0001),
        }
    )
    wire = made.advance(1.0)
    kinds = []
    while wire:
        for header, length in (
            (b"\xfa\x01\x01\x00", 14),
            (b"\xfa\x01\x08\x00", 18),
            (b"\xfa\x02\x01\x00", 14),
            (b"$VNYMR", 122),
        ):
            if wire.startswith(header):
                kinds.append(header[1:3])
                wire = wire[length:]
                break
        else:
            raise AssertionError(wire[:20])
    assert kinds[:8] == [b"\x01\x01", b"\x01\x08", b"\x02\x01", b"VN"] * 2


def test_replies_come_between_messages():
    host = Host(device(presets={7: (50,)}))
    wire = host.send(b"$VNRRG,23*72\r\n" * 5, 0.5)
    lines = bodies(wire)
    assert lines.count("VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0") == 5
    assert sum(line.startswith("VNYMR") for line in lines) >= 23


def test_vnasy_gates_output_only():
    host = Host(device())
    assert len(bodies(host.wait(1.0))) > 30
    assert bodies(host.send(b"$VNASY,0*4F\r\n", 0.1))[-1] == "VNASY,0"
    assert host.wait(2.0) == b""
    assert host.ask("VNRRG,07") == "VNRRG,07,40"
    assert len(bodies(host.send(b"$VNASY,1*4E\r\n", 1.0))) > 30


def test_output_routed_to_the_other_port_is_silence():
    host = Host(quiet())
    assert host.ask("VNWRG,75,2,8,06,0001,083F") == "VNWRG,75,2,8,06,0001,083F"
    assert host.wait(1.0) == b""
    other = Host(quiet(port=2))
    assert bodies(other.send(command("VNWRG,75,2,80,01,0001"), 0.02)) == ["VNWRG,75,2,80,01,0001"]
    assert len(packets(other.wait(1.0), b"\xfa\x01\x01\x00", 14)) == 10


ALL_FIELDS = [  # group byte, word, and the bytes of its fields by the compact table of 1.3
    (0x01, 0x3F3D, [8, 8, 12, 16, 12, 12, 24, 20, 28, 2, 4]),
    (0x02, 0x0191, [8, 8, 4, 4]),
    (0x04, 0x1FFF, [2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40]),
    (0x10, 0x11FF, [2, 12, 16, 36, 12, 12, 12, 12, 12, 12]),
]


@pytest.mark.parametrize(("group", "word", "sizes"), ALL_FIELDS)
def test_every_field_of_a_vn100_can_be_sent_and_is_finite(group, word, sizes):
    length = 4 + sum(sizes) + 2
    wire = binary_device((1, 8, group, word)).advance(1.0)
    header = bytes([0xFA, group]) + struct.pack("<H", word)
    found = packets(wire, header, length)
    assert len(found) >= 99
    decoded = decode(Deframer().feed(found[50])[0])
    assert isinstance(decoded, Measurement)
    assert np.isfinite(decoded.values).all()


@pytest.mark.slow
def test_compensated_set_agrees_with_the_codec_and_with_the_truth():
    """syn_time_imu_comp_uncomp: FA 06 8100 0E07; HSI is not applied, so Mag = UncompMag."""
    bias = np.array([0.01, -0.02, 0.03])
    truth = EmulatedTruth(gyro_bias_rad_s=bias, noise_gyro_rad_s=0)
    wire = binary_device((1, 80, 6, 0x0081, 0x070E), "static", truth=truth).advance(200.0)
    last = packets(wire, bytes.fromhex("FA0681000E07"), 92)[-1]
    raw = struct.unpack("<QI18f", last[6:-2])
    measured = decode(Deframer().feed(last)[0])
    assert isinstance(measured, Measurement)
    assert measured.values[0] == pytest.approx(raw[0] / 1e9)
    assert measured.values[1:] == raw[1:]
    named = dict(zip([c.name for c in measured.layout.columns], measured.values, strict=True))
    for axis, index in zip("xyz", range(3), strict=True):
        assert named[f"uncomp_mag_{axis}_gauss"] == named[f"mag_{axis}_gauss"]
        assert named[f"uncomp_gyro_{axis}_rad_s"] == pytest.approx(bias[index], abs=1e-7)
        assert named[f"gyro_{axis}_rad_s"] == pytest.approx(0, abs=1e-4)


def test_vnbom_polls_one_packet(host):
    host.ask("VNWRG,75,0,0,01,0009")
    assert host.wait(1.0) == b""
    answer = host.send(b"$VNBOM,1*45\r\n")
    assert answer.startswith(b"$VNBOM,1*45\r\n\xfa")  # the vendor's library waits for the line
    (packet,) = packets(answer.partition(b"\n")[2], bytes.fromhex("FA010900"), 26)
    nanoseconds, yaw, pitch, roll = struct.unpack("<Q3f", packet[4:-2])
    assert nanoseconds == pytest.approx((host.now_s - 0.1) * 1e9, abs=10e6)
    assert abs(pitch) < 4 and abs(roll) < 4 and abs(yaw) <= 180


FIT = [  # vn100-protocol 1.5: six observations on firmware 3.1.0.0
    (115200, 14, 40, "75,1,4,01,0009", True),
    (115200, 14, 40, "75,1,4,01,0101", True),
    (115200, 14, 40, "75,1,4,01,0128", False),
    (57600, 14, 40, "75,1,20,01,0009", False),
    (57600, 14, 4, "75,1,20,01,0009", True),
    (921600, 0, 0, "75,1,1,01,0739", True),
]


@pytest.mark.parametrize(("baud", "ador", "adof", "write", "accepted"), FIT)
def test_output_that_does_not_fit_is_refused(baud, ador, adof, write, accepted):
    made = device(presets={5: (baud,), 6: (ador,), 7: (adof,)})
    made.receive(command(f"VNWRG,{write}"), 0.1)
    wire = made.advance(0.3)
    assert (b"$VNWRG,75" in wire) == accepted
    assert (b"$VNERR,0C*02\r\n" in wire) == (not accepted)


def test_fit_check_of_rate_type_and_baud(host):
    host.ask("VNASY,0")
    assert host.ask("VNWRG,06,14") == "VNWRG,06,14"
    assert host.ask("VNWRG,07,100") == "VNERR,0C"
    assert host.ask("VNWRG,05,9600") == "VNERR,0C"
    assert host.ask("VNRRG,05") == "VNRRG,05,115200"


def test_full_queue_drops_whole_messages_and_says_so():
    made = quiet(presets={5: (9600,)})
    made.receive(b"$VNRRG,83*78\r\n" * 60, 0.1)
    wire = made.advance(1.2)
    assert made.overflows > 0
    made.receive(b"$VNRRG,07*74\r\n", 5.0)
    rest = made.advance(6.0)
    lines = bodies(wire + rest)
    assert {line[:8] for line in lines[:-2]} == {"VNRRG,83"}
    assert lines[-2:] == ["VNERR,0B", "VNRRG,07,40"]
    assert 20 < len(lines) < 62 - made.overflows + 1


def test_800_hz_binary_runs_and_carries_every_tick():
    wire = binary_device((1, 1, 1, 0x0739)).advance(1.0)
    found = packets(wire, bytes.fromhex("FA013907"), 110)
    ticks = [struct.unpack_from("<Q", packet, 4)[0] * 800 / 1e9 for packet in found]
    assert len(found) >= 798
    np.testing.assert_allclose(np.diff(ticks), 1, atol=0.02)


def test_time_startup_runs_by_the_devices_clock():
    truth = EmulatedTruth(clock_ppm=50.0, clock_jitter_s=0)
    wire = binary_device((1, 800, 1, 0x0001), truth=truth).advance(101.0)
    times = [
        struct.unpack_from("<Q", packet, 4)[0] for packet in packets(wire, b"\xfa\x01\x01\x00", 14)
    ]
    assert times[99] - times[0] == pytest.approx(99e9 * (1 + 50e-6), abs=2000)


@pytest.mark.parametrize("faults", [(), ("byte_drop=0.01", "dipole@1", "reset@2")])
def test_equal_arguments_give_equal_bytes_however_time_is_cut(faults):
    def run(steps, seed=5):
        made = device("survey", seed=seed, faults=faults)
        wire = b""
        for now_s in steps:
            if now_s == 1.5:
                made.receive(b"$VNRRG,23*72\r\n$VNRRG,54*XX\r\n", now_s)
            wire += made.advance(now_s)
        return wire

    fine = [step / 100 for step in range(1, 501)]
    assert run(fine) == run([1.5, 5.0])
    assert run([1.5, 5.0]) != run([1.5, 5.0], seed=6)
