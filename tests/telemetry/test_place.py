"""Location of the daemon: one way to give it, and commands in hints that work when pasted."""

from __future__ import annotations

import inspect
import re
import shlex
import tarfile
import zipfile
from pathlib import Path

import click
import pytest

import ahrsd
from ahrsd.cli import COMMANDS
from ahrsd.cli.running import daemon as running_daemon
from ahrsd.cli.running.daemon import _HINT, DaemonPlace
from ahrsd.config.config import Config

TALK = ("status", "explain", "watch", "bundle", "operator")


def place(given: Path | None) -> DaemonPlace:
    return DaemonPlace(Config(), given or Path("/var/lib/ahrsd"), None, given is not None)


def test_hints_contain_the_given_location_of_the_daemon(tmp_path):
    text = "look at it (`ahrsd status`), then: ahrsd operator approve 3b08c2b4"
    assert place(None).pasted(text) == text
    folder = tmp_path / "of a boat"
    option = f"--state-directory '{folder}'"
    assert place(folder).pasted(text) == (
        f"look at it (`ahrsd status {option}`), then: ahrsd operator {option} approve 3b08c2b4"
    )
    found = place(folder).pasted("then: ahrsd operator approve 3b08c2b4").partition("then: ")[2]
    assert shlex.split(found)[1:] == [
        "operator", "--state-directory", str(folder), "approve", "3b08c2b4",
    ]  # fmt: skip


def option_names(command: click.Command) -> set[str]:
    return {name for option in command.params for name in option.opts}


def load(name: str) -> click.Command:
    from ahrsd.__main__ import group

    command = group.get_command(click.Context(group), name)
    assert command is not None
    return command


@pytest.mark.parametrize("name", TALK)
def test_every_client_command_has_the_same_options(name):
    assert {"--config", "--state-directory"} <= option_names(load(name))


def test_every_hint_to_a_client_command_is_completed():
    """Whatever command a text of the package names with backquotes: it is known to `pasted`."""
    assert set(TALK) <= set(COMMANDS)
    registers = load("registers")
    for folder in ("serving", "writeback"):
        for path in (Path(ahrsd.__file__).parent / folder).glob("*.py"):
            for words in re.findall(r'"[^"]*`(ahrsd [a-z]+(?: [a-z]+)?)', path.read_text()):
                name, *rest = words.split()[1:]
                if name == "run":
                    continue
                assert _HINT.match(words), (path.name, words)
                if name == "registers":
                    assert "--state-directory" in option_names(registers.commands[rest[0]])


@pytest.mark.parametrize("name", ["b.zip", "b.tar", "b.tgz", "b.tar.gz"])
def test_bundle_without_a_daemon_is_made_and_lists_what_is_missing(run, tmp_path, capsys, name):
    state = tmp_path / "state"
    state.mkdir()
    (state / "journal-1.jsonl").write_text("{}\n")
    target = tmp_path / name
    assert run("bundle", "-o", target, "--state-directory", state) == 0
    out, error = capsys.readouterr()
    inside = ["versions.json", "config.toml", "journal/journal-1.jsonl"]
    assert out == f"{target}: {target.stat().st_size / 1e6:.1f} MB: {', '.join(inside)}\n"
    assert "no status in the archive: " in error
    assert f"no capture in the archive: {state / 'captures'} has none" in error
    assert "no journal" not in error
    expected = [f"ahrsd-bundle/{one}" for one in inside]
    if name == "b.zip":
        with zipfile.ZipFile(target) as archive:
            assert archive.namelist() == expected
    else:
        with tarfile.open(target, "r:" if name == "b.tar" else "r:gz") as archive:
            assert archive.getnames() == expected


def test_bundle_of_an_unknown_format_is_refused(run, tmp_path, capsys):
    assert run("bundle", "-o", tmp_path / "b.rar") == 2
    assert "must end in .tar.gz, .tgz, .tar, .zip" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_help_of_bundle_lists_its_formats():
    assert ".zip" in inspect.getsource(running_daemon)
