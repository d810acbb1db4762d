"""Command sequences against a small device that keeps its registers as text, as the manual prints
them; the emulator, which shares the register map with the driver, is not asked here."""

from __future__ import annotations

import pytest

from drivers.vn100.calibration_stream import (
    CalibrationStream,
    DoesNotFit,
    NoStream,
    configure_stream,
    rate_divisor,
)
from drivers.vn100.commands import (
    CONFIGURATION,
    Identity,
    NoReply,
    NotAsKnown,
    Read,
    RestoreFailed,
    VerifyFailed,
    Word,
    differences,
    identify,
    missing,
    quiet,
    read_configuration,
    read_registers,
    restore,
    save_settings,
    write_verified,
)
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.registers import SESSION_SETTINGS, profile_of
from drivers.vn100.session import ProcedureFailed, ProcedureFinished, Session

NO_CALIBRATION = "1,0,0,0,1,0,0,0,1,0,0,0"
NEW_23 = (1.0021, 0.0123456, 0.0, 0.0123456, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 7.1384e-05)
NEW_23_TEXT = "1.0021,0.0123456,0,0.0123456,0.98,0,0,0,1.01,0.05,-0.03,7.1384E-05"
CALIBRATION_PACKET = bytes.fromhex(
    "FA0601003F08202BCE733A0B000000003D0A573E0AD723BDF628DC3ECDCC4C3D8FC2F5BDC3F51CC1"
    "6F12833A6F1203BB6F12033A0000FC4166A6CA420000A3FC"
)  # syn_time_imu_cal_set of the vector file
FACTORY = {
    1: "VN-100S-CR", 2: "7", 3: "0100130608", 4: "3.1.0.0", 5: "115200", 6: "14", 7: "40",
    21: "0.234,0,0.4212,0,0,-9.79375", 23: NO_CALIBRATION, 25: NO_CALIBRATION,
    26: "1,0,0,0,1,0,0,0,1", 30: "0,0,0,0,1,0,1", 32: "3,0,0,0,3,0,0,500000,0", 35: "1,1,1,1",
    36: "4,4,4,5,5,5,5.5,5.5,5.5", 38: "6,6,6,3,3,3,5,5,5", 43: "0,0,0", 44: "0,1,5",
    47: NO_CALIBRATION, 75: "0,1,00", 76: "0,1,00", 77: "0,1,00", 82: "0,0,0,0,0",
    83: "0,0,0,0,1000,0.000,+00.00000000,+000.00000000,+00000.000", 84: NO_CALIBRATION,
    85: "0,4,4,4,0,0,3,3,3,0",
}  # fmt: skip


def sentence(body):
    value = 0
    for byte in body.encode():
        value ^= byte
    return f"${body}*{value:02X}\r\n".encode()


class Device:
    """Answers on `port` of 2. refuses: beginning of a command, VNERR code; deaf: beginnings without
    an answer; keeps: register, what it stores whatever is written."""

    def __init__(self, port=1):
        self.ram = dict(FACTORY)
        self.port, self.other_type = port, "14"
        self.refuses, self.deaf, self.keeps = {}, set(), {}
        self.knows_ports = True
        self.async_on = True
        self.log = []

    def answer(self, line):
        body = line[1:].split("*")[0]
        assert sentence(body).decode().strip() == line, "checksum of the command"
        self.log.append(body)
        if any(body.startswith(start) for start in self.deaf):
            return b""
        for start, code in self.refuses.items():
            if body.startswith(start):
                return sentence(f"VNERR,{code:02X}")
        word, *rest = body.split(",")
        if word == "VNASY":
            self.async_on = rest == ["1"]
        if word not in ("VNRRG", "VNWRG"):
            return sentence(body)
        number = int(rest[0])
        if number not in self.ram:
            return sentence("VNERR,08")
        if word == "VNWRG":
            return self.write(number, rest[1:])
        if rest[1:] and not self.knows_ports:
            return sentence("VNERR,06")
        if rest[1:]:
            value = self.ram[number] if int(rest[1]) == self.port else self.other_type
            return sentence(f"VNRRG,{number:02d},{value},{rest[1]}")
        return sentence(f"VNRRG,{number:02d},{self.ram[number]}")

    def write(self, number, values):
        if number in (23, 25, 84):
            values = [f"{float(value):G}" for value in values]
        self.ram[number] = self.keeps.get(number, ",".join(values))
        return sentence(f"VNWRG,{number:02d},{','.join(values)}")

    def streaming(self):
        """What comes out of this port while async output is on."""
        for number in (75, 76, 77):
            mode, _, *content = self.ram[number].split(",")
            if int(mode) & self.port and self.async_on and content == ["06", "0001", "083F"]:
                return CALIBRATION_PACKET
        return b""


def run(device, procedure, allow=lambda _: True):
    """The procedure's result; raises what it raises. Nothing may be left to send."""
    session, now_s, events = Session(allow), 0.0, []
    events += session.start(procedure, now_s)
    while session.busy:
        lines = session.take_output().decode().splitlines()
        incoming = b"".join(device.answer(line) for line in lines) or device.streaming()
        now_s += 0.002
        events += session.receive(incoming, now_s)
        if not lines:
            now_s = max(now_s, session.deadline_s or now_s)
            events += session.tick(now_s)
    (end,) = [event for event in events if isinstance(event, ProcedureFinished | ProcedureFailed)]
    assert session.take_output() == b""
    if isinstance(end, ProcedureFailed):
        raise end.error
    return end.result


def test_identify_reads_model_firmware_and_serial_number():
    device = Device()
    assert run(device, identify()) == Identity(
        "VN-100S-CR", 7, 100130608, "3.1.0.0", profile_of("3.1.0.0")
    )
    assert device.log == ["VNRRG,01", "VNRRG,02", "VNRRG,03", "VNRRG,04"]


def test_unreadable_hardware_revision_is_ignored():
    device = Device()
    device.ram[2] = "7B"
    identity = run(device, identify())
    assert (identity.hardware, identity.serial) == (None, 100130608)


def test_identify_works_after_a_partial_command_of_another_program():
    device = Device()
    spoilt = iter([b"$VNERR,04*75\r\n"])
    answer = device.answer
    device.answer = lambda line: next(spoilt, None) or answer(line)
    assert run(device, identify()).serial == 100130608


def test_every_configuration_register_of_the_firmware_is_read():
    device = Device()
    values = run(device, read_configuration(profile_of("3.1.0.0")))
    assert sorted(values) == [n for n in CONFIGURATION if n != 74]
    assert values[44] == (0, 1, 5)
    assert values[21] == (0.234, 0.0, 0.4212, 0.0, 0.0, -9.79375)
    assert missing(profile_of("3.1.0.0"), values) == ()
    assert not any(line.startswith("VNWRG") for line in device.log)


def test_an_optional_register_may_be_missing_and_is_named():
    device, profile = Device(), profile_of("2.1.0.0")
    del device.ram[83]
    device.ram[74] = "0,0,0,0,0,0,0"
    values = run(device, read_configuration(profile))
    assert missing(profile, values) == (83,)
    assert values[74] == (0.0,) * 7


def test_a_device_without_an_essential_register_is_observed_only():
    device, profile = Device(), profile_of("3.1.0.0")
    held = {number: device.ram.pop(number) for number in (44, 75)}
    values = run(device, read_configuration(profile))
    assert missing(profile, values) == (44, 75)
    identity = Identity("VN-100S-CR", 7, 100130608, "3.1.0.0", profile)
    observed = identity.observed_without(values).profile
    assert not observed.writable
    assert observed.observed_for == "firmware 3.1.0.0 has no registers 44, 75"
    device.ram.update(held)
    assert identity.observed_without(run(device, read_configuration(profile))) is identity


def test_a_write_is_echoed_and_read_back_through_the_devices_own_rounding():
    device = Device()
    back = run(device, quiet(write_verified(23, NEW_23)))
    assert device.ram[23] == NEW_23_TEXT
    assert back == pytest.approx(NEW_23)
    assert device.log == [
        "VNASY,0",
        "VNWRG,23,1.0021,0.0123456,0,0.0123456,0.98,0,0,0,1.01,0.05,-0.03,0.000071384",
        "VNRRG,23",
        "VNASY,1",
    ]


def test_altered_write_fails_verification_and_output_is_resumed():
    device = Device()
    device.keeps[23] = NO_CALIBRATION
    with pytest.raises(VerifyFailed) as caught:
        run(device, quiet(write_verified(23, NEW_23)))
    assert caught.value.sent == NEW_23
    assert caught.value.read == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    assert sum(line.startswith("VNWRG,23") for line in device.log) == 3
    assert device.async_on


def test_write_without_a_reply_is_verified_by_a_read():
    device = Device()
    device.deaf.add("VNWRG,84")
    with pytest.raises(VerifyFailed):
        run(device, quiet(write_verified(84, NEW_23)))
    assert device.async_on

    device = Device()
    device.ram[84] = NEW_23_TEXT
    device.deaf.add("VNWRG,84")
    assert run(device, write_verified(84, NEW_23)) == pytest.approx(NEW_23)


@pytest.mark.parametrize("putting_back", [False, True])
def test_unit_that_takes_over_the_cable_in_a_silence_is_not_written(putting_back):
    device = Device()
    unit, answer = run(device, identify()).unit, device.answer

    def swapped(line):
        if line.startswith("$VNWRG"):
            device.ram[3] = "0000000007"
            device.deaf.add("VNWRG")
            answer(line)
            device.deaf.clear()
            return b""
        return answer(line)

    device.answer = swapped
    write = restore({23: NEW_23}, (23,), unit) if putting_back else None
    with pytest.raises(NotAsKnown, match="another device answers"):
        run(device, write or write_verified(23, NEW_23, unit=unit))
    assert sum(line.startswith("VNWRG") for line in device.log) == 1
    assert device.ram[23] == NO_CALIBRATION


def test_values_that_the_device_would_refuse_are_never_sent():
    device = Device()
    with pytest.raises(ValueError, match="finite"):
        run(device, quiet(write_verified(23, (float("nan"), *NEW_23[1:]))))
    assert device.log == ["VNASY,0", "VNASY,1"]


@pytest.mark.parametrize("code", [0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0C])
@pytest.mark.parametrize("command", ["VNWRG,23", "VNRRG,23"])
def test_output_is_on_again_after_every_refusal(code, command):
    device = Device()
    device.refuses[command] = code
    with pytest.raises(DeviceRefused) as caught:
        run(device, quiet(write_verified(23, NEW_23)))
    assert caught.value.code == code
    assert device.async_on
    assert device.log[-1] == "VNASY,1"


def test_output_is_resumed_when_the_pause_was_not_answered():
    device = Device()
    device.deaf.add("VNASY,0")
    device.async_on = False  # it was carried out, the answer got lost
    with pytest.raises(NoReply) as caught:
        run(device, quiet(write_verified(23, NEW_23)))
    assert caught.value.command == Word("VNASY", (0,))
    assert device.async_on
    assert device.ram[23] == NO_CALIBRATION


def test_saving_sends_one_vnwnv():
    device = Device()
    assert run(device, save_settings()) is None
    assert device.log == ["VNWNV"]


def test_settings_are_restored_in_an_order_that_fits_the_baud_rate():
    device = Device()
    device.ram.update({6: "14", 7: "40", 75: "1,16,15,0001,000C,0014", 76: "2,80,01,0008"})
    saved = run(device, read_registers(SESSION_SETTINGS))
    before = dict(device.ram)
    device.ram.update({6: "0", 75: "1,4,06,0001,083F", 77: "1,8,01,0008"})
    device.log.clear()
    assert run(device, quiet(restore(saved, SESSION_SETTINGS))) == (75, 77, 6)
    assert device.ram == before
    assert [line for line in device.log if line.startswith("VNWRG")] == [
        "VNWRG,75,0,1,00",
        "VNWRG,77,0,1,00",
        "VNWRG,75,1,16,15,0001,000C,0014",
        "VNWRG,06,14",
    ]


def test_unchanged_settings_are_not_written():
    device = Device()
    saved = run(device, read_registers(CONFIGURATION[:9]))
    device.log.clear()
    assert run(device, restore(saved, saved)) == ()
    assert all(line.startswith("VNRRG") for line in device.log)


def test_failed_setting_does_not_prevent_the_restoration_of_others():
    device = Device()
    saved = run(device, read_registers((6, 7, 44)))
    device.ram.update({6: "0", 7: "100", 44: "1,3,5"})
    device.refuses["VNWRG,44"] = 0x07
    with pytest.raises(RestoreFailed, match="register 44") as caught:
        run(device, quiet(restore(saved, (44, 6, 7))))
    assert list(caught.value.errors) == [44]
    assert (device.ram[6], device.ram[7]) == ("14", "40")
    assert device.async_on


def test_differences_have_old_and_new_values():
    assert differences({23: NEW_23, 75: (0, 1, 0)}, {23: NEW_23, 75: (0, 1, 0)}) == {}
    saved = {44: (0, 1, 5), 6: (14,), 7: (40,)}
    now = {44: (1, 3, 5), 6: (14,), 30: (0, 0, 0, 0, 1, 0, 1)}
    assert differences(saved, now) == {
        44: ((0, 1, 5), (1, 3, 5)),
        7: ((40,), None),
        30: (None, (0, 0, 0, 0, 1, 0, 1)),
    }


@pytest.mark.parametrize(
    ("rate_hz", "baud", "divisor"),
    [(100, 115200, 8), (160, 115200, 5), (200, 230400, 4), (800, 921600, 1), (50, 57600, 16)],
)
def test_rates_that_fit(rate_hz, baud, divisor):
    assert rate_divisor(rate_hz, baud) == divisor


@pytest.mark.parametrize(
    ("rate_hz", "baud", "says"),
    [
        (200, 115200, "needs 12800 bytes/s, 115200 baud carry 11520"),
        (800, 460800, "at most 720 Hz"),
        (150, 921600, "150 Hz is not 800 Hz over a whole number"),
        (0, 115200, "0 Hz"),
    ],
)
def test_rates_that_do_not_fit_are_refused_before_anything_is_sent(rate_hz, baud, says):
    device = Device()
    with pytest.raises(DoesNotFit, match=says):
        run(device, configure_stream(rate_hz, baud))
    assert device.log == []


@pytest.mark.parametrize("port", [1, 2])
@pytest.mark.parametrize("other_type", ["14", "0"])
@pytest.mark.parametrize("own_type", ["14", "0"])
def test_the_stream_is_set_up_on_the_port_in_use(port, other_type, own_type):
    device = Device(port)
    device.other_type, device.ram[6] = other_type, own_type
    stream = run(device, configure_stream(100, 115200))
    assert stream == CalibrationStream(75, (port, 8, 6, 1, 0x083F), 100.0)
    assert device.ram[75] == f"{port},8,06,0001,083F"
    assert device.ram[6] == "0"
    assert device.async_on
    other = 3 - port
    assert not any(line.startswith(f"VNWRG,75,{other}") for line in device.log)


@pytest.mark.parametrize("port", [1, 2])
def test_port_is_found_by_silence_without_port_parameters(port):
    device = Device(port)
    device.knows_ports = False
    assert run(device, configure_stream(100, 115200)).values[0] == port
    assert device.ram[75] == f"{port},8,06,0001,083F"


def test_outputs_of_the_other_port_are_unchanged():
    device = Device(1)
    device.ram.update({75: "2,16,01,0008", 76: "3,8,01,0009", 77: "1,4,01,0101"})
    stream = run(device, configure_stream(100, 115200))
    assert stream.output == 77
    assert device.ram[75] == "2,16,01,0008"
    assert device.ram[76] == "2,8,01,0009"
    assert device.ram[77] == "1,8,06,0001,083F"


def test_firmware_without_saturation_flags_gets_the_shorter_packet():
    device = Device()
    device.refuses["VNWRG,75,1,8,06,0001,083F"] = 0x07
    packet = bytes.fromhex("FA0601003F00") + CALIBRATION_PACKET[6:-4]
    crc = 0
    for byte in packet[1:]:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    device.streaming = lambda: packet + crc.to_bytes(2, "big") if device.async_on else b""
    stream = run(device, configure_stream(100, 115200))
    assert stream.values == (1, 8, 6, 1, 0x003F)
    assert stream.layout == "FA 06 0001 003F"


@pytest.mark.parametrize("problem", ["no room", "0C", "no stream"])
def test_failed_set_up_restores_the_settings(problem):
    device = Device()
    if problem == "no room":
        device.ram.update({75: "2,16,01,0008", 76: "3,8,01,0009", 77: "2,4,01,0101"})
    if problem == "0C":
        device.refuses["VNWRG,75,1,8"] = 0x0C
    if problem == "no stream":
        device.streaming = lambda: b""
    before = dict(device.ram)
    with pytest.raises(DeviceRefused if problem == "0C" else NoStream):
        run(device, configure_stream(100, 115200))
    assert device.ram == before
    assert device.async_on


def test_configuration_is_read_through_a_read_only_gate():
    device, sent = Device(), []

    def gate(command):
        sent.append(command)
        return isinstance(command, Read)

    run(device, read_configuration(profile_of("3.1.0.0")), gate)
    assert len(sent) == len(CONFIGURATION) - 1
