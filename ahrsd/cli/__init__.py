"""The command line: a command's module is imported only when that command runs.

The module of a command has its name, in `device`, `recordings` or `running`, and the command in it
is called `command`; of modules with several (`_SHARED`) each command has its own name. A command
that answers "no" ends with `raise SystemExit(EXIT_NO)`; whatever a person can put right is raised
as an `AhrsdError`.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import click

#: name -> what `ahrsd --help` says about it, so that the help imports none of them
COMMANDS: dict[str, str] = {
    "demo": "The whole job on an emulated VN-100, no hardware needed.",
    "run": "The daemon: estimate from the stream, judge, and write back as far as the mode allows.",
    "emulate": "An emulated VN-100 on a pseudo-terminal.",
    "capture": "Record what a device sends.",
    "convert": "Convert another program's recording into a Parquet table with its origin.",
    "replay": "The pipeline of `run` over a recording.",
    "calibrate": "Batch calibration of a recording.",
    "evaluate": "What a calibration is worth: heading, field and dead reckoning, before and after.",
    "simulate": "A simulated recording of a scenario, with the truth next to it.",
    "montecarlo": "Accuracy of the methods against truth and against the Cramér-Rao bound.",
    "diagnose": "Where a simulation and a recording differ, and which physics was left out.",
    "fleet": "An archive of recordings: calibrate and diagnose each one, and compare them.",
    "challenge": "Sealed blind trials of `diagnose`: make cases, run tools, score.",
    "operator": "Send a command to the running daemon: approve, lock, unlock, rollback.",
    "status": "The state of the running daemon.",
    "watch": "The running daemon, live on a terminal.",
    "page": "A page for the phone at the vehicle: what to drive, heading, gates, alarms.",
    "foxglove": "The running daemon for Foxglove, on a WebSocket.",
    "explain": "Which gate holds a write back, since when, and what would open it.",
    "bundle": "A support archive: journal, newest capture, status, versions.",
    "registers": "Read, compare, write and roll back the device's registers.",
}


#: what each package has
_PACKAGES = {
    "device": ("capture", "demo", "emulate", "registers", "run"),
    "recordings": (
        "calibrate", "challenge", "convert", "diagnose", "evaluate", "fleet", "montecarlo",
        "replay", "simulate",
    ),
    "running": ("foxglove", "page", "watch"),
}  # fmt: skip
#: commands that are not in a module of their own
_SHARED = dict.fromkeys(("status", "explain", "operator", "bundle"), "running.daemon")


def module_of(name: str) -> str:
    """Where the command of this name is."""
    if name in _SHARED:
        return f"ahrsd.cli.{_SHARED[name]}"
    (package,) = (package for package, names in _PACKAGES.items() if name in names)
    return f"ahrsd.cli.{package}.{name}"


_WHOLE = 1000  # characters of a help that are shown in a list


class WholeGroup(click.Group):
    """A group whose list of commands has whole sentences, wrapped and never cut."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Each command with the first sentences of its help."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, one.get_short_help_str(_WHOLE)) for name, one in commands if one]
            )


class Number(click.FloatRange):
    """A finite number: a range alone lets `nan` pass, which is neither below nor above."""

    def convert(
        self,
        value: Any,  # noqa: ANN401 - as in click
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> float:
        """See `click.ParamType`."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is called, and not before."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of a first visit."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command's module."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(module_of(cmd_name))
        command = getattr(module, cmd_name if cmd_name in _SHARED else "command")
        if not isinstance(command, click.Command):
            raise TypeError(f"{module.__name__} has no click command {cmd_name}")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The command list out of the table above."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))
