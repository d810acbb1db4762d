"""`ahrsd operator VERB [TEXT]`: a person's word to the running daemon."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.commands.running import state_options
from ahrsd.errors import EXIT_BUSY, EXIT_USAGE, DeviceError
from ahrsd.operator_box import VERBS

_WAIT_S = 5.0


@click.command()
@click.argument("verb", type=click.Choice(VERBS))
@click.argument("text", default="")
@state_options
def command(verb: str, text: str, directory: Path | None) -> None:
    """Tell the running daemon what a person decided.

    \b
    approve ID     write candidate ID, which the daemon's log names
    arm            let this run write by itself (approval auto); disarm takes it back
    rollback       undo what was written and is not saved
    lock REASON    write nothing any more;  unlock REASON: it was looked at

    Whoever may write into the state directory may do this. Exit 75 where no daemon listens.
    """
    from ahrsd.config import default_state_directory
    from ahrsd.operator_box import OperatorBox

    if verb == "approve" and not text:
        raise click.UsageError("approve needs the candidate's ID; the daemon's log names it")
    box = OperatorBox(directory or default_state_directory())
    try:
        heard = box.heard(verb, text, _WAIT_S)
    except FileNotFoundError:
        raise DeviceError(f"no daemon has been here: {box.folder} is missing", EXIT_BUSY) from None
    except OSError as error:
        raise DeviceError(f"{box.folder}: {error.strerror}", EXIT_USAGE) from None
    if not heard:
        raise DeviceError(f"no daemon took the word within {_WAIT_S:.0f} s", EXIT_BUSY)
    click.echo(f"the daemon heard: {verb} {text}".rstrip() + "; its log says what follows")
