"""docs/guide/operating.md against the code: states, alarms, error codes, commands, the unit."""

import re
from pathlib import Path

from ahrsd.cli import COMMANDS
from ahrsd.telemetry.words import STATES
from drivers.vn100.errors import ERRORS

PROJECT = Path(__file__).parents[2]
PAGE = (PROJECT / "docs" / "guide" / "operating.md").read_text(encoding="utf-8")
SOURCES = "\n".join(
    path.read_text(encoding="utf-8")
    for folder in ("ahrsd", "drivers")
    for path in (PROJECT / folder).rglob("*.py")
)


def test_every_error_code_has_its_row_with_the_codes_own_words():
    rows = re.findall(r"^\| ([0-9A-F]{2}) \| ([^|]+) \| [^|]+ \| ([^|]+) \|$", PAGE, re.MULTILINE)
    assert {(int(code, 16), name, advice) for code, name, advice in rows} == {
        (row.code, row.name, row.advice) for row in ERRORS.values()
    }


def test_every_command_that_is_named_exists():
    code = re.findall(r"```(?:\w*)\n(.*?)```|`([^`\n]+)`", PAGE, re.DOTALL)
    text = "\n".join(block or inline for block, inline in code)
    commands = set(re.findall(r"(?:^|sudo )ahrsd (?:-v )?([a-z]+)\b", text, re.MULTILINE))
    assert commands <= set(COMMANDS)
    assert {"status", "explain", "watch", "bundle", "operator", "registers", "run"} <= commands


def test_documented_alarms_are_states_or_messages_of_the_program():
    table = PAGE[PAGE.index("## Alarms") : PAGE.index("What the device itself may answer")]
    alarms = re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)
    assert len(alarms) >= 8
    for alarm in alarms:
        parts = [part.strip(" ,") for part in alarm.split("...")]
        said = all(part in SOURCES for part in parts)
        assert alarm in STATES or said, alarm


def test_quoted_error_messages_are_those_of_the_program():
    table = PAGE[PAGE.index("## When it does not work") :]
    cells = re.findall(r"^\| ([^|]*`[^|]*) \|", table, re.MULTILINE)
    said = [text for cell in cells for text in re.findall(r"`([^`]+)`", cell)]
    assert len(said) >= 10
    sources = re.sub(r'"\s*f?"', "", SOURCES)  # texts that go over two lines
    for text in said:
        for part in re.split(r"\d+", text):  # what stands for a number
            assert part.strip() in sources, (text, part)


def test_the_states_that_need_a_person_are_explained():
    table = PAGE[PAGE.index("## What it says") : PAGE.index("## Allowing a write")]
    for state in ("OBSERVING", "CANDIDATE", "QUALIFIED", "TRIAL", "PROVEN", "COMMITTED", "FAULT"):
        assert f"`{state}`" in table


def test_documented_drop_in_lifts_the_restrictions_of_the_unit():
    unit = (PROJECT / "systemd" / "ahrsd.service").read_text(encoding="utf-8")
    drop_in = re.search(r"```\n\[Service\]\n(.*?)```", PAGE, re.DOTALL)
    keys = [line.split("=")[0] for line in drop_in[1].splitlines()]
    assert keys == ["PrivateNetwork", "RestrictAddressFamilies", "IPAddressAllow"]
    assert "PrivateNetwork=yes" in unit
    assert "RestrictAddressFamilies=AF_UNIX\n" in unit
