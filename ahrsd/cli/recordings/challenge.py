"""`ahrsd challenge`: the blind trials of `diagnose`, a tool of the source tree and of no wheel."""

from __future__ import annotations

import click

from ahrsd.errors import AhrsdError

_INSTALL = (
    "the blind trials are not in this installation: they are a tool of the source tree; clone it "
    "and install the clone with: pip install -e '.[trials]'"
)


@click.command(
    context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
    epilog="Not installed here; any use of it says how to install it.",
)
def _absent() -> None:
    """Sealed blind trials of `diagnose`."""
    raise AhrsdError(_INSTALL)


def _find() -> click.Command:
    try:
        from blind_trials.commands import command as found
    except ModuleNotFoundError as error:
        if error.name != "blind_trials":
            raise
        return _absent
    return found


command = _find()
