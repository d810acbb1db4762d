"""Every command line in README and docs is one: its options exist, its arguments are taken."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from ahrsd.__main__ import group

PROJECT = Path(__file__).parents[2]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))]
_START = r"^(?:\$ )?(?:sudo )?(?:\S+/bin/)?ahrsd (.+)$"


def leaf_of(words: list[str]) -> tuple[click.Command, click.Context, list[str]]:
    """The command that the words name, its context, and what is left for it."""
    command: click.Command = group
    context = click.Context(group, info_name="ahrsd")
    while isinstance(command, click.Group):
        _, rest, _ = command.make_parser(context).parse_args(list(words))
        name, found, words = command.resolve_command(context, rest)
        command, context = found, click.Context(found, info_name=name, parent=context)
    return command, context, words


def wrong(line: str, *, whole: bool) -> str:
    """What is wrong with a command line, "" where nothing is. whole: no argument may be missing."""
    words = shlex.split(re.split(r"\s#|[|>&;]", line)[0].rstrip("\\ "), comments=True)
    words = [word.strip("[]") for word in words if word not in ("...", "[...]")]
    try:
        command, context, rest = leaf_of(words)
        given, left, _ = command.make_parser(context).parse_args(rest)
    except click.BadOptionUsage as error:  # within a sentence an option may stand without value
        return error.format_message() if whole else ""
    except click.UsageError as error:
        return error.format_message()
    if left:
        return f"too many arguments: {left}"
    missing = [
        param.name
        for param in command.params
        if isinstance(param, click.Argument)
        and param.required
        and not isinstance(given.get(param.name), str | list | tuple)
    ]
    return f"missing: {missing}" if whole and missing and "--help" not in words else ""


def lines_of(text: str) -> list[tuple[str, bool]]:
    """Command lines in blocks of code, and those within a sentence that say more than a name."""
    blocks = "\n".join(re.findall(r"^```(?:sh)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    blocks = blocks.replace("\\\n", " ")
    found = [(line, True) for line in re.findall(_START, blocks, re.MULTILINE)]
    inline = re.findall(r"`(?:sudo )?ahrsd ([^`\n]+)`", text)
    return found + [(line, False) for line in inline if "COMMAND" not in line]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_line_is_one(page):
    said = lines_of(page.read_text(encoding="utf-8"))
    found = {line: wrong(line, whole=whole) for line, whole in said}
    assert {line: words for line, words in found.items() if words} == {}


def test_enough_of_them_are_seen():
    said = [line for page in PAGES for line, _ in lines_of(page.read_text(encoding="utf-8"))]
    assert len(said) > 60


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("registers history PORT", "too many arguments: ['PORT']"),
        ("run --prot /dev/ttyUSB0", "No such option"),
        ("approve 12", "No such command 'approve'"),
        ("capture -o FILE", "missing: ['port']"),
        ("capture PORT -o a.mcap --seconds 60   # sends no byte", ""),
    ],
)
def test_the_check_would_notice(line, words):
    assert words in wrong(line, whole=True)
    assert bool(words) == bool(wrong(line, whole=True))
