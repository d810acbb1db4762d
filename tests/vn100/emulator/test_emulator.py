"""The emulated device against bytes of the manual and of recordings.

Sums and lines are checked by the few functions below and not by the project's codec, so that a
mistake which codec and emulator share does not pass.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from quiet_device import Host, bodies, command, device, quiet

from drivers.vn100.emulator.emulator import BOOT_S
from drivers.vn100.emulator.physics import EmulatedTruth, draw_truth

WIRE = Path(__file__).parents[3] / "fixtures" / "vn100" / "wire_examples.json"


@pytest.fixture
def host() -> Host:
    return Host(quiet())


EXCHANGES = [  # vn100-protocol 1.1, 3, 9 and 13.1, as found in public documents and recordings
    (b"$VNRRG,07*74", b"$VNRRG,07,40*5C"),
    (b"$VNRRG,7*44", b"$VNRRG,07,40*5C"),
    (b"$VNRRG,23*72", b"$VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0*73"),
    (b"$VNRRG,25*74", b"$VNRRG,25,1,0,0,0,1,0,0,0,1,0,0,0*75"),
    (b"$VNRRG,84*7F", b"$VNRRG,84,1,0,0,0,1,0,0,0,1,0,0,0*7E"),
    (b"$VNRRG,26*77", b"$VNRRG,26,1,0,0,0,1,0,0,0,1*6A"),
    (b"$VNRRG,30*70", b"$VNRRG,30,0,0,0,0,1,0,1*6C"),
    (b"$VNRRG,35*75", b"$VNRRG,35,1,1,1,1*75"),
    (b"$VNRRG,44*73", b"$VNRRG,44,0,1,5*6B"),
    (b"$VNRRG,82*XX", b"$VNRRG,82,0,0,0,0,0*65"),
    (b"$VNRRG,51*XX", b"$VNRRG,51,1,0.1,0.01*5A"),
    (b"$VNRRG,4*47", b"$VNRRG,04,3.1.0.0*77"),
    (b"$VNRRG,83*78", b"$VNRRG,83,0,0,0,0,1000,0.000,+00.00000000,+000.00000000,+00000.000*"),
    (b"$VNRRG,03*70", b"$VNRRG,03,0100130608*"),
    (b"$VNWRG,07,50*58", b"$VNWRG,07,50*58"),
    (b"$VNWRG,07,0*6D", b"$VNWRG,07,0*6D"),
    (b"$VNWRG,06,0*6C", b"$VNWRG,06,0*6C"),
    (b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76", b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76"),
    (b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*8445", b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76"),
    (b"$VNWRG,44,2,3,5*6E", b"$VNWRG,44,2,3,5*6E"),
    (b"$VNWRG,44,0,1,5*6E", b"$VNWRG,44,0,1,5*6E"),
    (b"$VNWRG,75,0,1,00*59", b"$VNWRG,75,0,1,00*59"),
    (b"$VNWRG,75,1,4,01,0101*70", b"$VNWRG,75,1,4,01,0101*70"),
    (b"$VNWRG,75,1,16,15,0001,000C,0014*XX", b"$VNWRG,75,1,16,15,0001,000C,0014*31"),
    (b"$VNWRG,30,0,0,0,0,3,0,1*6B", b"$VNWRG,30,0,0,0,0,3,0,1*"),
    (b"$VNASY,0*4F", b"$VNASY,0*4F"),
    (b"$VNASY,1*4E", b"$VNASY,1*4E"),
    (b"$VNKMD,1*47", b"$VNKMD,1*47"),
    (b"$VNKAD,1*4B", b"$VNKAD,1*4B"),
    (b"$VNSGB*4E", b"$VNSGB*4E"),
    (b"$VNWNV*57", b"$VNWNV*57"),
    (b"$VNRST*4D", b"$VNRST*4D"),
    (b"$VNRFS*5F", b"$VNRFS*5F"),
    (b"$VNWRG,5,921600*61", b"$VNERR,03*72"),
    (b"$VNWRG,75,3,80,14,073E,0004*66", b"$VNERR,03*72"),
    (b"$VNTAR*5F", b"$VNERR,04*75"),
    (b"$VNFWU*XX", b"$VNERR,04*75"),
    (b"$VNWRG,07*XX", b"$VNERR,05*74"),
    (b"$VNRRG*XX", b"$VNERR,05*74"),
    (b"$VNWRG,44,0,1,5,1*XX", b"$VNERR,06*77"),
    (b"$VNWRG,44,0,1,9*XX", b"$VNERR,07*76"),
    (b"$VNWRG,06,21*XX", b"$VNERR,07*76"),
    (b"$VNWRG,07,30*XX", b"$VNERR,07*76"),
    (b"$VNWRG,05,12345*XX", b"$VNERR,07*76"),
    (b"$VNWRG,26,1,0,0,0,1,0,0,0,-1*XX", b"$VNERR,07*76"),
    (b"$VNWRG,26,1,0.1,0,0,1,0,0,0,1*XX", b"$VNERR,07*76"),
    (b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,nan*XX", b"$VNERR,07*76"),
    (b"$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,1E-3*XX", b"$VNERR,07*76"),
    (b"$VNWRG,75,1,16,04,2000*XX", b"$VNERR,07*76"),
    (b"$VNBOM,1*45", b"$VNERR,07*76"),
    (b"$VNRRG,99*XX", b"$VNERR,08*79"),
    (b"$VNRRG,74*XX", b"$VNERR,08*79"),
    (b"$VNWRG,47,1,0,0,0,1,0,0,0,1,0,0,0*XX", b"$VNERR,09*78"),
    (b"$VNWRG,04,9*XX", b"$VNERR,09*78"),
]


@pytest.mark.parametrize(("sent", "expected"), EXCHANGES, ids=[e[0].decode() for e in EXCHANGES])
@pytest.mark.parametrize("end", [b"\r\n", b"\n"])
def test_replies_of_the_manual(host, sent, expected, end):
    answer, _, stream = host.send(sent + end, 0.6).partition(b"\r\n")
    if expected.endswith(b"*"):
        bodies(answer + b"\r\n")
        assert answer.startswith(expected)
    else:
        assert answer == expected
    assert bool(stream) == answer.startswith((b"$VNWRG,75,1", b"$VNRFS"))


def test_the_valid_commands_of_the_wire_examples_are_all_understood():
    tried = 0
    for vector in json.loads(WIRE.read_text()):
        body = vector.get("ascii") or ""
        if vector["kind"] != "ascii" or not vector["valid"]:
            continue
        if body[1:6] not in ("VNWRG", "VNWNV", "VNKMD", "VNKAD", "VNASY", "VNSGB"):
            continue
        tried += 1
        host = Host(quiet(presets={5: (921600,)}))
        answer = host.send(bytes.fromhex(vector["hex"]), 0.7)
        (line,) = bodies(answer[: answer.index(b"\n") + 1])
        words, wanted = line.split(","), body[1:].split("*")[0].split(",")
        wanted[1:2] = (
            [f"{int(number):02d}" for number in wanted[1:2]] if len(wanted) > 2 else wanted[1:2]
        )
        assert words == wanted, vector["name"]
    assert tried >= 15


def test_firmware_2_has_its_own_registers():
    host = Host(quiet(firmware="2.1.0.0"))
    assert host.ask("VNRRG,44") == "VNRRG,44,1,3,5"
    assert host.ask("VNRRG,04") == "VNRRG,04,2.1.0.0"
    assert host.ask("VNRRG,43") == "VNERR,08"
    assert host.ask("VNRRG,74") == "VNRRG,74,0,0,0,0,0,0,0"
    assert host.ask("VNTAR") == "VNTAR"
    assert host.ask("VNWRG,07,0") == "VNERR,07"
    assert host.ask("VNRRG,21") == "VNRRG,21,1,0,1.8,0,0,-9.79375"


@pytest.mark.parametrize("generation", ["2.1.0.0", "3.1.0.0"])
def test_every_register_of_the_map_can_be_read(generation):
    from drivers.vn100.registers import REGISTERS

    host = Host(quiet(firmware=generation))
    for number, row in REGISTERS.items():
        answer = host.ask(f"VNRRG,{number:02d}")
        there = int(generation[0]) in row.generations
        assert answer.startswith(f"VNRRG,{number:02d}") if there else answer == "VNERR,08"


def test_a_float_is_stored_as_f32_and_printed_with_six_digits(host):
    written = "VNWRG,23,1.0021104,0.0000713841,0,0,1,0,0,0,1,0.05,-0.0300000001,0.1"
    stored = "23,1.00211,7.13841E-05,0,0,1,0,0,0,1,0.05,-0.03,0.1"
    assert host.ask(written) == f"VNWRG,{stored}"
    assert host.ask("VNRRG,23") == f"VNRRG,{stored}"


def test_ports_have_registers_of_their_own(host):
    assert host.ask("VNRRG,07,1") == "VNRRG,07,40,1"
    assert host.ask("VNWRG,07,20,2") == "VNWRG,07,20,2"
    assert host.ask("VNRRG,07,2") == "VNRRG,07,20,2"
    assert host.ask("VNRRG,07") == "VNRRG,07,40"
    assert host.ask("VNRRG,07,3") == "VNERR,07"
    assert host.ask("VNRRG,44,1") == "VNERR,06"


def test_commands_in_one_piece_or_many_are_answered_in_order(host):
    answer = host.send(b"$VNRRG,07*74\r\n$VNRRG,99*XX\r\n$VNRRG,07*00\r\n$VNRRG,06*75\r\n")
    assert bodies(answer) == ["VNRRG,07,40", "VNERR,08", "VNERR,03", "VNRRG,06,0"]
    for byte in b"$VNRRG,07*74\r\n":
        host.device.receive(bytes([byte]), host.now_s)
    assert bodies(host.wait(0.1)) == ["VNRRG,07,40"]


def test_a_line_of_more_than_256_bytes_overflows(host):
    answer = host.send(b"$VNWRG,23," + b"1" * 300 + b"*XX\r\n")
    assert bodies(answer)[0] == "VNERR,02"
    assert host.ask("VNRRG,07") == "VNRRG,07,40"


def test_replies_take_one_to_five_milliseconds_and_the_time_on_the_wire(host):
    sent_s = host.now_s
    host.device.receive(b"$VNRRG,07*74\r\n", sent_s)
    wire_s = len(b"$VNRRG,07,40*5C\r\n") * 10 / 115200
    assert host.device.advance(sent_s + 0.001 + wire_s - 1e-6) == b""
    assert host.device.advance(sent_s + 0.005 + wire_s + 1e-6) == b"$VNRRG,07,40*5C\r\n"


def test_register_30_chooses_the_checksum_of_replies(host):
    assert re.fullmatch(rb".*\*[0-9A-F]{4}\r\n", host.send(b"$VNWRG,30,0,0,0,0,3,0,1*6B\r\n"))
    assert host.send(b"$VNASY,0*4F\r\n") == b"$VNASY,0*4158\r\n"
    assert host.send(b"$VNRRG,99*XX\r\n").startswith(b"$VNERR,08*")
    assert host.send(b"$VNWRG,30,0,0,0,0,1,0,1*69\r\n") == b"$VNWRG,30,0,0,0,0,1,0,1*69\r\n"


def test_error_modes():
    host = Host(device(presets={7: (1,)}))
    host.wait(0.1)
    assert host.ask("VNWRG,30,0,0,0,0,1,0,0") == "VNWRG,30,0,0,0,0,1,0,0"
    assert host.send(command("VNRRG,99")) == b""
    host.ask("VNWRG,30,0,0,0,0,1,0,2")
    assert host.ask("VNRRG,99") == "VNERR,08"
    assert host.ask("VNRRG,06") == "VNRRG,06,0"


# ── RAM and flash ────────────────────────────────────────────────────────────────────────────────


def test_ram_is_lost_in_a_reset_and_kept_by_vnwnv(host):
    host.ask("VNWRG,07,20")
    assert host.send(command("VNRST"), 1.0) == b"$VNRST*4D\r\n"
    assert host.ask("VNRRG,07") == "VNRRG,07,40"
    host.ask("VNWRG,07,20")
    assert host.ask("VNWNV", 0.6) == "VNWNV"
    host.send(command("VNRST"), 1.0)
    assert host.ask("VNRRG,07") == "VNRRG,07,20"
    host.send(command("VNRFS"), 1.0)
    assert bodies(host.wait(0.1))[0].startswith("VNYMR")  # factory: streaming again
    assert b"$VNRRG,07,40*5C\r\n" in host.send(command("VNRRG,07"), 0.1)


def test_save_takes_half_a_second_and_later_commands_wait(host):
    host.device.receive(b"$VNWNV*57\r\n$VNRRG,07*74\r\n", host.now_s)
    assert host.wait(0.49) == b""
    assert bodies(host.wait(0.03)) == ["VNWNV", "VNRRG,07,40"]


def test_a_reset_in_the_middle_of_a_save_saves_nothing():
    host = Host(quiet(faults=["reset@1.3"]))
    host.wait(1.0)
    host.ask("VNWRG,07,20")
    assert host.send(command("VNWNV"), 1.5) == b""
    assert host.ask("VNRRG,07") == "VNRRG,07,40"


def test_after_a_reset_the_device_is_deaf_for_a_while(host):
    host.send(command("VNRST"), 0.1)
    assert host.send(command("VNRRG,07"), BOOT_S) == b""
    assert host.ask("VNRRG,07") == "VNRRG,07,40"


def test_baud_write_is_answered_at_the_old_rate(host):
    assert host.send(b"$VNWRG,05,921600*53\r\n", 0.005 + 22 * 10 / 115200) == (
        b"$VNWRG,05,921600*53\r\n"
    )
    host.wait(0.01)
    assert host.device.baud == 921600
    host.send(command("VNRST"), 1.0)
    assert host.device.baud == 115200


def test_rotation_acts_only_after_save_and_reset():
    host = Host(quiet(truth=EmulatedTruth(noise_mag_gauss=0)))

    def field():
        return [float(value) for value in host.ask("VNRRG,17").split(",")[2:]]

    x, y, z = field()
    host.ask("VNWRG,26,0,1,0,-1,0,0,0,0,1")
    assert host.ask("VNRRG,26") == "VNRRG,26,0,1,0,-1,0,0,0,0,1"
    assert field() == [x, y, z]
    host.ask("VNWNV", 0.6)
    assert field() == [x, y, z]
    host.send(command("VNRST"), 1.0)
    assert field() == [y, -x, z]


# ── the compensation chain through the registers ─────────────────────────────────────────────────


def test_worked_example_through_register_23():
    """5.2: m = (0.25, 0.10, 0.50) becomes (0.2053, 0.1294, 0.4040)."""
    truth = EmulatedTruth(
        field_n_gauss=np.zeros(3), hard_iron_gauss=np.array([0.25, 0.1, 0.5]), noise_mag_gauss=0
    )
    host = Host(quiet(truth=truth))
    assert host.ask("VNRRG,17") == "VNRRG,17,+00.2500,+00.1000,+00.5000"
    sent = b"$VNWRG,23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1*6F\r\n"
    assert host.send(sent) == sent
    assert host.ask("VNRRG,17") == "VNRRG,17,+00.2053,+00.1294,+00.4040"
    assert host.ask("VNRRG,54").startswith("VNRRG,54,+00.2053,+00.1294,+00.4040,")


def test_gyro_bias_written_to_84_disappears_from_the_uncompensated_rate():
    bias = np.array([0.004, -0.005, 0.002])
    host = Host(quiet(truth=EmulatedTruth(gyro_bias_rad_s=bias, noise_gyro_rad_s=0)))
    assert host.ask("VNRRG,54").split(",")[8:11] == ["+00.004000", "-00.005000", "+00.002000"]
    host.ask("VNWRG,84,1,0,0,0,1,0,0,0,1,0.004,-0.005,0.002")
    after = [float(value) for value in host.ask("VNRRG,54").split(",")[8:11]]
    np.testing.assert_allclose(after, 0, atol=1e-6)


@pytest.mark.parametrize(("firmware", "register"), [("3.1.0.0", 43), ("2.1.0.0", 74)])
def test_vnsgb_keeps_the_filters_bias_for_the_next_start(firmware, register):
    bias = np.array([0.004, -0.005, 0.002])
    host = Host(
        quiet(firmware=firmware, truth=EmulatedTruth(gyro_bias_rad_s=bias, noise_gyro_rad_s=0))
    )
    host.wait(120.0)
    host.ask("VNSGB")
    kept = [float(value) for value in host.ask(f"VNRRG,{register}").split(",")[2:5]]
    np.testing.assert_allclose(kept, bias * (1 - np.exp(-120 / 30)), rtol=0.01)
    host.ask("VNWNV", 0.6)
    host.send(command("VNRST"), 1.0)
    rate = [float(value) for value in host.ask("VNRRG,19").split(",")[2:]]
    np.testing.assert_allclose(rate, bias - np.array(kept), atol=2e-4)


def test_firmware_2_runs_and_applies_its_own_compensation():
    truth = draw_truth(3)
    host = Host(quiet(firmware="2.1.0.0", truth=truth, motion="tumble"))
    host.wait(60.0)
    solution = np.array([float(value) for value in host.ask("VNRRG,47").split(",")[2:]])
    np.testing.assert_allclose(solution[9:], truth.hard_iron_gauss, atol=0.01)
    host.ask("VNWRG,44,0,1,5")
    line = host.ask("VNRRG,17").split(",")[2:], host.ask("VNRRG,54").split(",")[2:5]
    np.testing.assert_allclose(*np.array(line, float), atol=0.05)  # 0.1 s apart, tumbling


def test_any_bytes_and_values_get_a_valid_answer():
    """Noise, mutilated commands, and commands with any values: every answer is a valid line."""
    draw = np.random.default_rng(1)
    host = Host(quiet(presets={5: (921600,)}, motion="tumble"))
    numbers = ["0", "1", "-1", "3", "255", "65535", "1000000", "3.4e38", "-0.5", "0.25", "", "nan"]
    numbers += ["340000000000000000000000000000000000000", "FFFF", "08", "083F", "+", "1.5.2", " 1"]
    words = ["VNRRG", "VNWRG", "VNWRG", "VNWRG", "VNASY", "VNKMD", "VNBOM", "VNSGB", "VNXYZ", "VN"]
    registers = [*map(str, [*range(90), 115, 116, 206, 227, 239]), "x", "-1", "1000"]
    for _ in range(1500):
        count = int(draw.choice([0, 1, 3, 4, 5, 9, 12, 13]))
        body = ",".join(
            [str(draw.choice(words)), str(draw.choice(registers))]
            + [str(draw.choice(numbers)) for _ in range(count)]
        )
        host.send(command(body) + draw.bytes(int(draw.integers(0, 20))), 0.01)
    host.send(b"\n" + command("VNRFS"), 1.0)
    assert host.device.counters["commands"] > 1000
    assert b"$VNRRG,07,40*5C\r\n" in host.send(b"\n" + command("VNRRG,07"))


def test_known_magnetic_disturbance_stops_the_on_board_compensation():
    host = Host(quiet(firmware="2.1.0.0", truth=draw_truth(3), motion="tumble"))
    host.ask("VNKMD,1")
    host.wait(30.0)
    assert host.ask("VNRRG,47") == "VNRRG,47,1,0,0,0,1,0,0,0,1,0,0,0"
    host.ask("VNKMD,0")
    host.wait(30.0)
    assert host.ask("VNRRG,47") != "VNRRG,47,1,0,0,0,1,0,0,0,1,0,0,0"


@pytest.mark.parametrize("firmware", ["2.1.0.0", "3.1.0.0"])
def test_fields_of_other_models_are_zero(firmware):
    """As the ROS 2 driver does; the VN-100 of public reports takes it and sends zeros."""
    host = Host(quiet(firmware=firmware, presets={5: (921600,)}))
    asked = "75,3,40,29,7FFF,0210,000C"
    line, _, stream = host.send(command(f"VNWRG,{asked}")).partition(b"\r\n")
    assert bodies(line + b"\r\n") == [f"VNWRG,{asked}"]
    stream += host.wait(1.0)
    header = bytes.fromhex("FA29FF7F10020C00")
    size = len(header) + 198 + 13 + 36 + 2
    packets = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert 20 <= len(packets) <= 24
    assert all(packet.startswith(header) for packet in packets)
    position = slice(8 + 24 + 12 + 16 + 12, 8 + 24 + 12 + 16 + 12 + 24)  # PosLla
    assert all(packet[position] == bytes(24) for packet in packets)


@pytest.mark.parametrize(
    ("sent", "on_3", "on_2"),
    [
        ("VNSIH,+090.000", "VNSIH,+090.000", "VNERR,04"),
        ("VNSIH", "VNERR,05", "VNERR,04"),
        ("VNSIH,north", "VNERR,07", "VNERR,04"),
        ("VNSFB", "VNSFB", "VNERR,04"),
        ("VNRRG,206", "VNRRG,206,0,0,0,0", "VNERR,08"),
        ("VNRRG,116", "VNRRG,116,0,0,0,0,0,0,0", "VNERR,08"),
    ],
)
def test_commands_of_the_current_vendor_library_are_answered(sent, on_3, on_2):
    assert Host(quiet(firmware="3.1.0.0")).ask(sent) == on_3
    assert Host(quiet(firmware="2.1.0.0")).ask(sent) == on_2


def test_an_initial_heading_turns_the_attitude_about_the_vertical():
    host = Host(quiet())
    before = [float(value) for value in host.ask("VNRRG,08").split(",")[2:]]
    host.ask("VNSIH,+090.000")
    yaw, pitch, roll = (float(value) for value in host.ask("VNRRG,08").split(",")[2:])
    assert abs(yaw - 90.0) < 2.0
    np.testing.assert_allclose((pitch, roll), before[1:], atol=0.5)


def test_a_poll_is_answered_by_a_line_and_a_packet():
    host = Host(quiet())
    host.ask("VNWRG,75,0,16,01,0009")
    answer = host.send(b"$VNBOM,1*XX\r\n")
    assert answer.startswith(b"$VNBOM,1*45\r\n" + bytes.fromhex("FA010900"))
    assert len(answer) == 13 + 26
