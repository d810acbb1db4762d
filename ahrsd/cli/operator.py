"""`ahrsd operator VERB [TEXT]`: a person's word to the running daemon."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.cli.running import state_options
from ahrsd.daemon.operator_inbox import VERBS
from ahrsd.errors import EXIT_BUSY, EXIT_NO, EXIT_USAGE, DeviceError

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

    The daemon's answer is printed. Exit 0 where it accepted the word, 1 where it refused it or
    does not trust the folder, 75 where no daemon listens or none answers. The daemon's user and
    root may do this, and nobody else: STATE/operator must belong to one of them.
    """
    from ahrsd.config.loading import default_state_directory
    from ahrsd.daemon.operator_inbox import NoAnswerInTime, OperatorBox, OperatorFolderError
    from ahrsd.printable import line

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
        raise DeviceError(f"no daemon took the word within {_WAIT_S:.0f} s", EXIT_BUSY)
    if not answer.accepted:
        raise DeviceError(f"refused: {line(answer.text)}", EXIT_NO)
    click.echo(f"accepted: {line(answer.text)}")
