"""`ahrsd page`: the page for the phone at the vehicle, in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.running.daemon import DaemonPlace, in_url, ip_address, place_options
from ahrsd.errors import EXIT_BUSY, AhrsdError, DeviceError
from ahrsd.foreign_file import ForeignFileError, read_regular
from ahrsd.printable import line

if TYPE_CHECKING:
    from ahrsd.daemon.operator_inbox import OperatorBox
    from ahrsd.page.access import Token

_ANSWER_S = 5.0
_WAITING = 32


@click.command()
@place_options
@click.option(
    "--address",
    default="127.0.0.1",
    show_default=True,
    help="Where to listen. Anybody who reaches another address can read the page.",
)
@click.option("--port", default=9191, show_default=True, type=click.IntRange(0, 65535))
@click.option(
    "--host",
    "names",
    multiple=True,
    metavar="NAME",
    help="A name under which the page is opened, in addition to this machine's addresses.",
)
@click.option(
    "--token-file",
    type=click.Path(path_type=Path),
    help="The operator's token, in a file of mode 0600: a candidate may be approved with it.",
)
def command(
    place: DaemonPlace, address: str, port: int, names: tuple[str, ...], token_file: Path | None
) -> None:
    """Serve a page for the phone at the vehicle: what to drive, heading, gates, estimate, alarms.

    It only shows, unless --token-file is given. It is a process of its own: whatever happens to
    it, the daemon does not notice. Exit 75 where the port is taken.
    """
    needed = [name for name in ("starlette", "uvicorn") if not importlib.util.find_spec(name)]
    if needed:
        are = "is" if len(needed) == 1 else "are"
        raise AhrsdError(f"{' and '.join(needed)} {are} missing: pip install 'ahrsd[page]'")
    from ahrsd.daemon.operator_inbox import OperatorBox
    from ahrsd.page.app import DaemonFeed, Site, make_app, serve

    token = None if token_file is None else _token(token_file)
    box = OperatorBox(place.state)
    known, feed = _names(names), DaemonFeed(place.connect)
    listener = _listen(address, port)
    site = Site(feed, lambda candidate: _approve(box, candidate), known, token)
    _say_where(listener, token is not None)
    feed.start()
    serve(make_app(site), listener)
    feed.stop()


def _names(given: tuple[str, ...]) -> frozenset[str]:
    from ahrsd.page.access import host_of

    for name in given:
        if not host_of(name):
            raise click.UsageError(f"--host {name}: must be a name such as rov.local")
    return frozenset(map(host_of, given))


def _token(path: Path) -> Token:
    """The token in a file that nobody else can read. Raises AhrsdError."""
    from ahrsd.page.access import Token, TokenError, token_in

    try:
        text = read_regular(path, 4096, follow=False).data.decode()
        if not _kept_by_systemd(path):
            _refuse_unless_private(path)
        return Token(token_in(text))
    except UnicodeDecodeError:
        raise AhrsdError(line(f"{path}: holds no text")) from None
    except (ForeignFileError, TokenError) as error:
        raise AhrsdError(line(f"{path}: {error}")) from None


def _kept_by_systemd(path: Path) -> bool:
    """Whether it is a credential of this unit: its access list admits this unit alone."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY", "")
    return bool(folder) and path.parent == Path(folder)


def _refuse_unless_private(path: Path) -> None:
    from ahrsd.page.access import TokenError

    status = path.lstat()
    if status.st_uid not in (os.geteuid(), 0):
        raise TokenError(f"belongs to user {status.st_uid}, who could approve writes")
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise TokenError(f"can be read by others: chmod 600 {path}")


def _listen(address: str, port: int) -> socket.socket:
    kind = socket.AF_INET6 if ip_address(address).version == 6 else socket.AF_INET
    listener = socket.socket(kind, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((address, port))
        listener.listen(_WAITING)
    except OSError as error:
        listener.close()
        text = f"{address} port {port}: {error.strerror}; --port and --address choose others"
        raise DeviceError(text, EXIT_BUSY) from None
    return listener


def _say_where(listener: socket.socket, may_approve: bool) -> None:
    address, port = listener.getsockname()[:2]
    found = ip_address(address)
    place = in_url(found, port)
    what = "shows, and approves with the token" if may_approve else "only shows"
    click.echo(f"http://{place}/ ({what})")
    if not found.is_loopback:
        more = "; the token goes over the network unencrypted" if may_approve else ""
        click.echo(f"anybody who reaches {place} can read it{more}", err=True)


def _approve(box: OperatorBox, candidate: str) -> tuple[bool, str]:
    """The same word as `ahrsd operator approve`."""
    from ahrsd.daemon.operator_inbox import NoAnswerInTime

    try:
        answer = box.say("approve", candidate, _ANSWER_S)
    except NoAnswerInTime as error:
        return False, f"the daemon {error}; look at its state before you try again"
    except OSError as error:
        why = str(error) if error.strerror is None else f"{box.folder}: {error.strerror}"
        return False, f"this page may not speak to the daemon: {why}"
    if answer is None:
        return False, f"no daemon took the command within {_ANSWER_S:.0f} s"
    return answer.accepted, line(answer.text)
