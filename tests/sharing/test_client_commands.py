"""What a client may send: the whole table, by register and command."""

from __future__ import annotations

import pytest

from ahrsd.sharing.arbiter import (
    GUARDED,
    ClientCommand,
    Kind,
    Refusal,
    SharePolicy,
    parse_client_command,
)
from ahrsd.writeback.permissions import permitted
from ahrsd.writeback.states import Mode, Purpose
from drivers.vn100.commands import Read, Word, Write
from drivers.vn100.registers import REGISTERS, format_reply, parse

OWNER, LISTENER = SharePolicy("/a", owner=True), SharePolicy("/b")
MATRIX = "1,0,0,0,1,0,0,0,1,0,0,0"


def refused(body: str, policy: SharePolicy) -> Refusal:
    """The refusal of a write: at once, or, for a register that is read first, if it holds
    another value.
    """
    answer = parse_client_command(body, policy)
    if isinstance(answer, ClientCommand):
        number = int(body.split(",")[1])
        assert (answer.kind, answer.command) == (Kind.COMPARE, Read(number))
        assert permitted(answer.command, Mode.PASSIVE, False, answer.purpose)
        wanted, answer = answer.unless
        assert wanted == parse(number, body.split(",")[2:])
    assert answer.code == 0x09
    return answer


@pytest.mark.parametrize("policy", [OWNER, LISTENER], ids=["owner", "listener"])
@pytest.mark.parametrize("number", [23, 25, 26, 43, 44, 74, 84])
def test_calibration_registers_are_refused_for_every_client(policy, number):
    row = REGISTERS[number]
    values = next(iter(row.defaults.values()))
    refusal = refused(f"VNWRG,{format_reply(number, values)}", policy)
    assert str(number) in refusal.why
    for mode in Mode:
        assert not permitted(Write(number, values), mode, True, Purpose.CLIENT)


@pytest.mark.parametrize("number", [23, 25, 26, 43, 44, 74, 84])
def test_calibration_registers_pass_for_a_permitted_owner_from_mode_stage(number):
    values = next(iter(REGISTERS[number].defaults.values()))
    body = f"VNWRG,{format_reply(number, values)}"
    passing = SharePolicy("/a", owner=True, calibration="pass")
    answer = parse_client_command(body, passing)
    assert answer == ClientCommand(Kind.CALIBRATE, body, Write(number, values))
    allowed = [m for m in Mode if permitted(answer.command, m, False, answer.purpose)]
    assert allowed == [Mode.STAGE, Mode.COMMIT]
    assert answer.purpose is Purpose.CLIENT_CALIBRATION
    nobody = SharePolicy("/b", calibration="pass")
    assert refused(body, nobody).code == 0x09


def test_permission_for_calibration_changes_nothing_else():
    passing = SharePolicy("/a", owner=True, calibration="pass")
    for number in REGISTERS:
        for values in REGISTERS[number].defaults.values():
            body = f"VNWRG,{format_reply(number, values)}"
            if number == 5 or number not in GUARDED:
                assert parse_client_command(body, passing) == parse_client_command(body, OWNER)
    for word in FOR_NOBODY:
        assert parse_client_command(word, passing) == parse_client_command(word, OWNER)
    for word, arguments in (("VNWNV", ()), ("VNRST", ()), ("VNRFS", ()), ("VNTAR", ())):
        command = Word(word, arguments)
        assert not permitted(command, Mode.COMMIT, True, Purpose.CLIENT_CALIBRATION)


@pytest.mark.parametrize("number", sorted(REGISTERS))
def test_each_register_has_one_rule(number):
    """Reads are permitted to all, writes to the owner, and protected registers are never sent."""
    read = parse_client_command(f"VNRRG,{number:02d}", LISTENER)
    assert isinstance(read, ClientCommand)
    assert read.command == Read(number)
    expected = Kind.MEMORY if number <= 4 and number else Kind.RATE if number == 5 else Kind.READ
    assert read.kind is expected
    row = REGISTERS[number]
    for values in row.defaults.values():
        body = f"VNWRG,{format_reply(number, values)}"
        owners, others = parse_client_command(body, OWNER), parse_client_command(body, LISTENER)
        if number == 5:
            assert owners.kind is others.kind is Kind.RATE
        elif row.writable and number not in GUARDED:
            assert owners == ClientCommand(Kind.WRITE, body, Write(number, values))
            assert permitted(owners.command, Mode.PASSIVE, False, Purpose.CLIENT)
            assert refused(body, LISTENER).code == 0x09
            assert isinstance(others, Refusal) == (number in {6, 7})
        else:
            assert refused(body, OWNER).code == refused(body, LISTENER).code == 0x09


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        ("VNWNV", Kind.SAVE), ("VNRST", Kind.RESET), ("VNKMD,1", Kind.WRITE),
        ("VNKAD,0", Kind.WRITE), ("VNASY,0", Kind.STREAM), ("VNASY,1", Kind.STREAM),
    ],
)  # fmt: skip
def test_commands_of_the_owner(body, kind):
    answer = parse_client_command(body, OWNER)
    assert isinstance(answer, ClientCommand)
    assert answer.kind is kind
    others = parse_client_command(body, LISTENER)
    assert others == answer if kind is Kind.STREAM else others.code == 0x09


FOR_NOBODY = ["VNRFS", "VNTAR", "VNSGB", "VNSFB", "VNSIH", "VNSPS", "VNFWU", "VNBLD", "VNSBL"]


@pytest.mark.parametrize("word", FOR_NOBODY)
def test_commands_refused_for_every_client(word):
    answer = parse_client_command(word, OWNER)
    assert (answer.code, word in answer.why) == (0x09, True)
    if word in ("VNRFS", "VNTAR", "VNSGB"):
        assert not permitted(Word(word), Mode.COMMIT, True, Purpose.CLIENT)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("VNXYZ", 0x04), ("VNASY,2", 0x04), ("VNASY,x", 0x04), ("VNRRG", 0x05), ("VNRRG,", 0x05),
        ("VNRRG,x", 0x08), ("VNRRG,199", 0x08), ("VNWRG,199,1", 0x08), ("VNRRG,06,9", 0x07),
        ("VNWRG,01,X", 0x09), ("VNWRG,06", 0x05), ("VNWRG,06,x", 0x07), ("VNWRG,75,1", 0x05),
        ("VNWRG,07,20,1,4", 0x06), ("", 0x04),
    ],
)  # fmt: skip
def test_wrong_lines_get_the_error_code_of_the_device(body, code):
    assert parse_client_command(body, OWNER).code == code


def test_save_and_reset_can_be_refused_by_policy():
    strict = SharePolicy("/a", owner=True, save="refuse", reset="refuse")
    assert "save" in parse_client_command("VNWNV", strict).why
    assert "reset" in parse_client_command("VNRST", strict).why


@pytest.mark.parametrize(
    "body",
    [
        "VNWRG,06,0", "VNWRG,07,20", "VNWRG,32,3,0,0,0,0,0,0,100000000,0",
        "VNWRG,30,0,0,0,0,1,0,1", "VNWRG,75,3,40,1,7FFF", "VNWRG,76,0,0,0",
        "VNWRG,85,0,4,4,4,4,0,3,3,3,0", "VNWRG,75,1,4,6,1,3E", "VNWRG,76,0,1,0",
        "VNWRG,06,0,1", "VNWRG,75,1,20,01,0721", "VNWRG,75,3,40,29,7FFF,0210,000C",
    ],
)  # fmt: skip
def test_start_up_settings_of_real_drivers_are_sent(body):
    answer = parse_client_command(body, OWNER)
    assert isinstance(answer, ClientCommand), answer
    assert answer.kind is Kind.WRITE
