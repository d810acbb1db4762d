"""`ahrsd run`: the daemon's options."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click

from ahrsd.cli.files import refuse_unwritable, write_json
from ahrsd.config.config import Config, Mode, load_config, print_config

if TYPE_CHECKING:
    from ahrsd.core.core import Core

# Whether it may be opened is for the driver to say: it knows the group that one must join.
_PORT = click.Path(path_type=Path, readable=False)


@click.command()
@click.option("--config", "path", type=click.Path(path_type=Path), help="Configuration, TOML.")
@click.option("--port", type=_PORT, help="Serial port of the device.")
@click.option(
    "--state-directory",
    "directory",
    type=click.Path(path_type=Path),
    help="Folder of journal, captures, socket and operator commands.",
)
@click.option(
    "--mode", type=click.Choice(get_args(Mode)), help="What the daemon may write (see above)."
)
@click.option("--wait", is_flag=True, help="Wait if the device is not there (for a service).")
@click.option("--json", "json_path", help="Closing summary as JSON into this file, - for stdout.")
@click.option(
    "--print-config", "print_only", is_flag=True, help="Print the configuration and exit."
)
def command(
    path: Path | None,
    port: Path | None,
    directory: Path | None,
    mode: Mode | None,
    wait: bool,
    json_path: str | None,
    print_only: bool,
) -> None:
    """Calibrate the device on a port from its own stream, and write back as far as the mode allows.

    \b
    passive  sends no byte
    observe  reads registers, says exactly what it would write (the default)
    stage    may write RAM
    commit   may write flash

    SIGHUP reads the configuration again: limits of the gates, the vehicle's files and the sizes of
    captures change at once, the rest at the next start; a file that is wrong changes nothing.
    """
    load = partial(_configured, path, port, directory, mode)
    config = load()
    if print_only:
        click.echo(print_config(config), nl=False)
        return
    if config.device.port is None:
        raise click.UsageError("no port: give --port, or device.port in the configuration")
    from ahrsd.cli.device.access import driver_errors
    from ahrsd.daemon.service import run_daemon
    from ahrsd.report.summary import summary_json, summary_lines

    def close(core: Core, recording: str) -> None:
        if json_path is not None:
            write_json(json_path, summary_json(core, recording))
        if json_path != "-":
            for line in summary_lines(core, recording):
                click.echo(line)

    refuse_unwritable(json_path, (path,))
    with driver_errors():
        raise SystemExit(run_daemon(config, close, wait=wait, load=load if path else None))


def _configured(
    path: Path | None, port: Path | None, directory: Path | None, mode: Mode | None
) -> Config:
    """The file, with what the command line says instead. Raises ConfigError."""
    config = load_config(path) if path else Config()
    if directory:
        config = config.model_copy(update={"state_directory": directory})
    if port:
        device = config.device.model_copy(update={"port": port})
        config = config.model_copy(update={"device": device})
    return config.model_copy(update={"mode": mode}) if mode else config
