"""The scripted device compared with the protocol's vectors, and the project's driver with the
device.

The device must be correct by the reference alone. That the driver understands it is an independent
check of both.
"""

from __future__ import annotations

import ast
import json
import os
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import write_observer
from patience import PATIENCE_S
from quiet_device import bodies
from scripted_vn100 import Cable, Iron, Motion, Served, Unit, Vehicle
from scripted_vn100.memory import TABLE, printed, stored
from scripted_vn100.physics import FIELD_N_GAUSS, table
from scripted_vn100.wire import BadLine, crc16, layout_of, packet, parse_command, sentence

from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer

VECTORS = Path(__file__).parents[3] / "fixtures" / "vn100" / "wire_examples.json"
IRON = Iron(
    np.array([[1.1, 0.02, 0.0], [0.02, 0.95, 0.01], [0.0, 0.01, 1.0]]),
    np.array([0.05, -0.03, 0.04]),
    np.array([0.01, -0.02, 0.005]),
)


def unit(output: dict[int, str] | None = None, **options: object) -> Unit:
    return Unit(100130608, IRON, Vehicle(Motion(2.0, 3.0)), presets=output or {6: "0"}, **options)


def ask(device: Unit, body: str) -> str:
    (answer,) = bodies(device.answer(sentence(body).strip(), 1.0)[1])
    return answer


@pytest.mark.parametrize("name", ["devices/scripted_vn100", "histories/write_observer.py"])
def test_scripted_device_and_observer_import_nothing_from_the_project(name):
    place = Path(write_observer.__file__).parents[1] / name
    files = sorted(place.glob("*.py")) if place.is_dir() else [place]
    assert files
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [a.name for a in node.names] if isinstance(node, ast.Import) else []
            assert not [n for n in names if n.split(".")[0] in ("ahrsd", "drivers")], file


def test_checksums_equal_those_of_the_protocol_vectors():
    checked = 0
    for case in json.loads(VECTORS.read_text()):
        raw = bytes.fromhex(case["hex"])
        if case["category"] != "valid":
            continue
        if case["kind"] == "binary":
            assert crc16(raw[1:]) == 0, case["name"]
        else:
            body, _, check = raw.strip().lstrip(b"$").partition(b"*")
            crc = len(check) == 4
            same = sentence(body.decode(), crc=crc).strip() == raw.strip()
            assert same or check == b"XX", case["name"]
        checked += 1
    assert checked > 80


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"$VNRRG,8*4C", 0x03), (b"$VNWRG,5,921600*61", 0x03), (b"$VNRRG,8", 0x03),
        (b"$VNRRG," + b"8" * 300 + b"*00", 0x02),
    ],
)  # fmt: skip
def test_wrong_lines_are_refused_with_the_error_code_of_the_device(line, code):
    with pytest.raises(BadLine) as caught:
        parse_command(line)
    assert caught.value.code == code


def test_both_kinds_of_checksum_and_the_bypass_are_accepted():
    assert parse_command(b"$VNRRG,8*4B") == ["VNRRG", "8"]
    assert parse_command(b"$VNRRG,8*040E") == ["VNRRG", "8"]
    assert parse_command(b"$VNRRG,23*XX") == ["VNRRG", "23"]


def test_registers_are_printed_and_refused_as_by_the_hardware():
    device = unit()
    assert ask(device, "VNRRG,4") == "VNRRG,04,3.1.0.0"
    assert ask(device, "VNRRG,07") == "VNRRG,07,40"
    assert ask(device, "VNRRG,3") == "VNRRG,03,0100130608"
    assert ask(device, "VNRRG,23") == "VNRRG,23,1,0,0,0,1,0,0,0,1,0,0,0"
    told = "VNWRG,23,1.00211,0,0,0,1,0,0,0,1,0.000071384,-0.03,0.1"
    assert ask(device, told) == "VNWRG,23,1.00211,0,0,0,1,0,0,0,1,7.1384E-05,-0.03,0.1"
    assert ask(device, "VNWRG,75,1,16,15,0001,0104,0014") == "VNERR,07"  # attitude bit 4: not sent
    assert ask(device, "VNWRG,75,1,8,06,0001,083F") == "VNWRG,75,1,8,06,0001,083F"
    assert ask(device, "VNRRG,99") == "VNERR,08"
    assert ask(device, "VNWRG,4,2.0") == "VNERR,09"
    assert ask(device, "VNWRG,23,1,2") == "VNERR,05"
    assert ask(device, "VNWRG,44,0,1,5,7") == "VNERR,06"
    assert ask(device, "VNWRG,7,33") == "VNERR,07"
    assert ask(device, "VNXXX") == "VNERR,04"
    assert printed(0.1 + 0.2) == "0.3"
    assert all(stored(n, text.split(",")) == text for n, (k, a, text) in TABLE.items() if a == "w")


def test_log_of_ram_and_flash_changes_names_the_writer():
    device, cable = unit(), None
    cable = Cable(device)
    cable.receive(sentence("VNWRG,84,1,0,0,0,1,0,0,0,1,0.01,0,0"), 1.0)
    cable.advance(1.1)
    cable.other_master("VNWRG,23,1,0,0,0,1,0,0,0,1,0.1,0,0", 1.2)
    cable.receive(sentence("VNWNV"), 1.3)
    assert cable.advance(1.5) == b""
    assert cable.advance(1.9) == b"$VNWNV*57\r\n"
    device.restart(2.0)
    assert device.memory.floats(84)[9] == 0.01
    assert [(c.what, c.who, c.register) for c in cable.log()] == [
        ("write", "host", 84), ("write", "other", 23), ("save", "host", 0), ("restart", "unit", 0),
    ]  # fmt: skip


def test_device_can_be_scripted_to_report_false_values():
    device = unit()
    device.lies.not_held, device.lies.reads_told = {84}, True
    value = "1,0,0,0,1,0,0,0,1,0.01,0,0"
    assert ask(device, f"VNWRG,84,{value}") == f"VNWRG,84,{value}"
    assert ask(device, "VNRRG,84") == f"VNRRG,84,{value}"
    assert device.memory.floats(84)[9] == 0.0
    device.lies.half_saved = True
    ask(device, "VNWRG,23," + value)
    ask(device, "VNWNV")
    device.restart(2.0)
    assert (device.memory.floats(23)[9], device.memory.floats(84)[9]) == (0.01, 0.0)


def test_simulated_field_is_rotated_by_the_gyro_rates():
    period_s = 0.02
    h, w, f = table(Motion(1.0, 4.0), period_s, 300)
    assert np.allclose(np.linalg.norm(h, axis=1), np.linalg.norm(FIELD_N_GAUSS))
    assert np.allclose(np.linalg.norm(f, axis=1), 9.81)
    change = (h[1:] - h[:-1]) / period_s
    middle = 0.5 * (h[1:] + h[:-1])
    assert np.abs(change - np.cross(middle, w[1:])).max() < 0.02
    assert np.linalg.eigvalsh(np.cov(h.T))[0] > 0.01


def test_registers_23_and_84_correct_the_output_that_the_driver_decodes():
    right = IRON.correction()
    presets = {
        6: "0", 75: "1,40,06,0001,083F",
        23: ",".join(printed(v) for v in right),
        84: "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005",
    }  # fmt: skip
    cable = Cable(unit(presets))
    deframer, rows = Deframer(), []
    frames = deframer.feed(cable.advance(6.0))
    for frame in frames:
        found = decode(frame)
        assert isinstance(found, Measurement)
        rows.append(found.values)
        layout = found.layout
    assert deframer.counters.skipped_bytes == 0
    data = np.array(rows)
    columns = [layout.index(f"uncomp_mag_{axis}_gauss") for axis in "xyz"]
    length = np.linalg.norm(data[:, columns], axis=1)
    assert length.std() / length.mean() < 0.006  # only noise: the iron is corrected
    time_s = data[:, layout.index("time_startup_s")]
    assert np.allclose(np.diff(time_s), 0.05, atol=1e-6)
    rest = data[time_s < 1.9][:, [layout.index(f"uncomp_gyro_{axis}_rad_s") for axis in "xyz"]]
    assert np.abs(rest.mean(axis=0)).max() < 3e-4


def test_packet_layout_equals_the_protocol_vector():
    names, form = layout_of(0x06, [0x0001, 0x083F])
    assert names == [
        "time_ns", "imu_status", "uncomp_mag", "uncomp_accel", "uncomp_gyro", "temp", "pres",
        "sens_sat",
    ]  # fmt: skip
    values = [12345678900000, 0, 0.21, -0.04, 0.43, 0.05, -0.12, -9.81, 0.001, -0.002, 0.0005]
    made = packet(0x06, [0x0001, 0x083F], form, [*values, 31.5, 101.325, 0])
    assert made.hex().upper() == (
        "FA0601003F08202BCE733A0B000000003D0A573E0AD723BDF628DC3ECDCC4C3D8FC2F5BDC3F51CC1"
        "6F12833A6F1203BB6F12033A0000FC4166A6CA420000A3FC"
    )
    assert struct.unpack("<H", made[4:6]) == (0x083F,)


def test_replacement_unit_has_its_own_serial_number_time_and_iron():
    first = unit({6: "0", 75: "1,80,01,0001"})
    cable = Cable(first)
    before = len(cable.advance(1.0))
    other = Unit(555, Iron(), first.vehicle, boot_s=-100.0, presets={6: "0", 75: "1,80,01,0001"})
    cable.exchange(other, 1.0, silent_s=2.0)
    assert cable.advance(2.9) == b""
    frames = Deframer().feed(cable.advance(4.0))
    assert before > 0
    assert decode(frames[0]).values[0] == pytest.approx(103.0, abs=0.2)
    cable.receive(sentence("VNRRG,3"), 4.0)
    assert b"VNRRG,03,0000000555" in cable.advance(4.1)


def test_replies_can_be_lost_doubled_and_delayed():
    cable = Cable(unit())
    cable.faults.lost = 1.0
    cable.receive(sentence("VNRRG,1"), 1.0)
    assert cable.advance(3.0) == b""
    cable.faults.lost, cable.faults.doubled, cable.faults.late = 0.0, 1.0, 1.0
    cable.receive(sentence("VNRRG,1"), 3.0)
    assert cable.advance(3.1) == b""
    assert cable.advance(3.3).count(b"VNRRG,01") == 2


def test_device_is_served_on_a_pty_in_real_time():
    with Served(Cable(unit({6: "19", 7: "40"}))) as served:
        port = os.open(served.path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(port, sentence("VNRRG,3"))
            heard, end = b"", time.monotonic() + PATIENCE_S
            while (b"VNRRG,03" not in heard or b"VNIMU" not in heard) and time.monotonic() < end:
                heard += os.read(port, 4096)
        finally:
            os.close(port)
    assert b"$VNRRG,03,0100130608*" in heard
    assert heard.count(b"$VNIMU,") > 0
