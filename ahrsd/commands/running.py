"""Reaching the running daemon: the options that `status`, `watch`, `explain` and `bundle` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from ahrsd.commands.json_output import write_json
from ahrsd.config import default_state_directory
from ahrsd.logs import printable
from ahrsd.serving.client import Asked, find_socket

F = TypeVar("F", bound=Callable[..., object])


def socket_options(command: F) -> F:
    """--socket and --state-directory."""
    place = click.Path(path_type=Path)
    command = click.option(
        "--state-directory", "directory", type=place, help="That of the daemon's configuration."
    )(command)
    return click.option("--socket", "path", type=place, help="The daemon's socket.")(command)


def connected(path: Path | None, directory: Path | None) -> Asked:
    """A connection. Raises DeviceError where no daemon answers."""
    return Asked(path or find_socket(directory or default_state_directory()))


def tell(
    daemon: Asked, what: str, json_path: str | None, lines: Callable[[dict[str, Any]], list[str]]
) -> None:
    """Ask for `what`; print its `lines`, or the answer itself as JSON where that was asked for."""
    with daemon:
        answer = daemon.ask(what)
    if json_path is not None:
        write_json(json_path, answer)
    if json_path != "-":
        click.echo("\n".join(map(printable, lines(answer))))
