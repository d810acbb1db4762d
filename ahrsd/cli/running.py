"""Where the daemon lives: the options of every command that talks to it, and how hints name it."""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from ahrsd.cli.json_output import refuse_unwritable, write_json
from ahrsd.config.loading import Config, load_config
from ahrsd.printable import line
from ahrsd.telemetry.client import DaemonConnection, find_socket

_PLACE = click.Path(path_type=Path)
_SOCKET = click.option("--socket", "socket_path", type=_PLACE, help="The daemon's socket.")
_STATE_DIRECTORY = click.option(
    "--state-directory", "directory", type=_PLACE, help="The daemon's state directory."
)
_CONFIG = click.option(
    "--config", "config_path", type=_PLACE, help="The daemon's configuration, TOML."
)
#: Commands that a text may tell a person to type; each takes --state-directory.
_HINT = re.compile(
    r"ahrsd (?:operator|status|explain|watch|bundle"
    r"|registers (?:history|rollback|diff|lock|unlock|export))(?![\w-])"
)


@dataclass(frozen=True, slots=True)
class DaemonPlace:
    """Where the daemon lives that is meant.

    config: the daemon's, or the default; state: its state directory; socket: what was given or is
    configured; given: whether a person named a state directory, which a hint must repeat
    """

    config: Config
    state: Path
    socket: Path | None
    given: bool

    def connect(self) -> DaemonConnection:
        """A connection. Raises DeviceError where no daemon answers."""
        return DaemonConnection(self.socket or find_socket(self.state))

    def pasted(self, text: str) -> str:
        """The text with its hints as they work when they are pasted: for this daemon."""
        if not self.given:
            return text
        option = f" --state-directory {shlex.quote(str(self.state))}"
        return _HINT.sub(lambda found: found.group() + option, text)


def state_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--config and --state-directory; the function gets `directory`, None where neither is given.

    For what goes to the daemon through its folder and not through its socket.
    """

    @functools.wraps(function)
    def wrapped(
        *arguments: Any,  # noqa: ANN401
        config_path: Path | None,
        directory: Path | None,
        **options: Any,  # noqa: ANN401
    ) -> object:
        if directory is None and config_path is not None:
            directory = load_config(config_path).state
        return function(*arguments, directory=directory, **options)

    for option in (_STATE_DIRECTORY, _CONFIG):
        wrapped = option(wrapped)
    return wrapped


def place_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--config, --state-directory and --socket; the function gets them as one `place`."""

    @functools.wraps(function)
    def wrapped(
        *arguments: Any,  # noqa: ANN401
        config_path: Path | None,
        directory: Path | None,
        socket_path: Path | None,
        **options: Any,  # noqa: ANN401
    ) -> object:
        config = load_config(config_path) if config_path else Config()
        place = DaemonPlace(
            config,
            directory or config.state,
            socket_path or (config.socket.path if directory is None else None),
            directory is not None or config.state_directory is not None,
        )
        return function(*arguments, place=place, **options)

    for option in (_SOCKET, _STATE_DIRECTORY, _CONFIG):
        wrapped = option(wrapped)
    return wrapped


def print_answer(
    place: DaemonPlace,
    what: str,
    json_path: str | None,
    lines: Callable[[dict[str, Any]], list[str]],
) -> None:
    """Ask for `what`; print its `lines`, or the answer itself as JSON where that was asked for."""
    refuse_unwritable(json_path)
    with place.connect() as daemon:
        answer = daemon.ask(what)
    if json_path is not None:
        write_json(json_path, answer)
    if json_path != "-":
        click.echo(place.pasted("\n".join(map(line, lines(answer)))))
