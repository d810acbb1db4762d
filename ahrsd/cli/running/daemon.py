"""Commands that talk with the running daemon, and how it is found: `ahrsd status`, `explain`,
`operator`, `bundle`. `watch` is in a module of its own, for what it draws with. Also where a
command that serves listens: the address that was given, and how it stands in a URL.
"""

from __future__ import annotations

import functools
import ipaddress
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from ahrsd.cli.files import refuse_unwritable, write_json
from ahrsd.config.config import Config, load_config
from ahrsd.daemon.operator_inbox import VERBS
from ahrsd.errors import EXIT_BUSY, EXIT_NO, EXIT_USAGE, AhrsdError, DeviceError
from ahrsd.printable import line
from ahrsd.telemetry.unix_socket import DaemonConnection, find_socket

# -- Where a command listens -----------------------------------------------------------------------


IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


def ip_address(text: str) -> IpAddress:
    """The address of --address.  click.UsageError where it is none."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        raise click.UsageError(f"--address {text}: must be an IP address") from None


def in_url(address: IpAddress, port: int) -> str:
    """`127.0.0.1:9191`, `[::1]:9191`."""
    return f"[{address}]:{port}" if address.version == 6 else f"{address}:{port}"


# -- The running daemon ----------------------------------------------------------------------------


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


@click.command()
@place_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def status(place: DaemonPlace, json_path: str | None) -> None:
    """Show device, stream, motion, estimate and write-back of the running daemon.

    Exit 75 where no daemon answers.
    """
    from ahrsd.telemetry.words import status_lines

    print_answer(place, "status", json_path, status_lines)


@click.command()
@place_options
@click.option("--json", "json_path", help="As JSON into this file, - for stdout.")
def explain(place: DaemonPlace, json_path: str | None) -> None:
    """Show which gates hold a write back, since when, and what to do about it.

    Exit 75 where no daemon answers.
    """
    from ahrsd.telemetry.words import explain_lines

    print_answer(place, "explain", json_path, explain_lines)


_WAIT_S = 5.0


@click.command()
@click.argument("verb", type=click.Choice(VERBS))
@click.argument("text", default="")
@state_options
def operator(verb: str, text: str, directory: Path | None) -> None:
    """Send an operator's command to the running daemon.

    \b
    approve ID     write candidate ID, which the daemon's log names
    arm            let this run write by itself (approval auto); disarm takes it back
    rollback       undo what was written and is not saved
    lock REASON    write nothing any more;  unlock REASON: allow it again

    The daemon's answer is printed. Exit 0 if it accepted the command, 1 if it refused it or
    does not trust the folder, 75 if no daemon listens or none answers. The daemon's user and
    root may do this, and nobody else: STATE/operator must belong to one of them.
    """
    from ahrsd.config.config import default_state_directory
    from ahrsd.daemon.operator_inbox import NoAnswerInTime, OperatorBox, OperatorFolderError

    if verb == "approve" and not text:
        raise click.UsageError("approve needs the candidate's ID; the daemon's log names it")
    box = OperatorBox(directory or default_state_directory())
    try:
        answer = box.say(verb, text, _WAIT_S)
    except FileNotFoundError:
        raise DeviceError(f"no daemon has been here: {box.folder} is missing", EXIT_BUSY) from None
    except NoAnswerInTime as error:
        raise DeviceError(f"the daemon {error}; see `ahrsd status`", EXIT_BUSY) from None
    except OperatorFolderError as error:
        raise DeviceError(str(error), EXIT_NO) from None
    except OSError as error:
        raise DeviceError(f"{box.folder}: {error.strerror}", EXIT_USAGE) from None
    if answer is None:
        raise DeviceError(f"no daemon took the command within {_WAIT_S:.0f} s", EXIT_BUSY)
    if not answer.accepted:
        raise DeviceError(f"refused: {line(answer.text)}", EXIT_NO)
    click.echo(f"accepted: {line(answer.text)}")


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), default="ahrsd-bundle.tar.gz",
              show_default=True, help="The archive: .tar.gz, .tgz, .tar or .zip.")  # fmt: skip
@place_options
def bundle(output: Path, place: DaemonPlace) -> None:
    """Collect journal, newest capture, configuration, status and versions into one archive.

    It works with and without a running daemon. Links, FIFOs and devices are never opened, of
    large files only a part is taken, and what was left out is printed. The capture shows how
    the sensor was turned, and the location if one is configured: check it before you pass it on.
    """
    from ahrsd.config.config import print_config
    from ahrsd.daemon.support_bundle import collect, format_of, write_bundle

    format_of(output)
    refuse_unwritable(output)
    try:
        with place.connect() as daemon:
            answer = daemon.ask("status")
    except DeviceError as error:
        click.echo(f"no status in the archive: {error}", err=True)
        answer = None
    config = place.config.model_copy(update={"state_directory": place.state})
    try:
        archive = collect(config.state, config.captures, print_config(config), answer)
        write_bundle(output, archive)
    except OSError as error:
        raise AhrsdError(f"{output}: cannot be written: {error.strerror}") from None
    for what, folder in (("journal/", config.state), ("captures/", config.captures)):
        if not any(name.startswith(what) for name in archive.parts):
            click.echo(f"no {what.rstrip('s/')} in the archive: {folder} has none", err=True)
    size = output.stat().st_size
    click.echo(line(f"{output}: {size / 1e6:.1f} MB: {', '.join(archive.parts)}"))
    for text in archive.left_out:
        click.echo(line(f"left out: {text}"))
