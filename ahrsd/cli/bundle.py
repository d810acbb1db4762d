"""`ahrsd bundle`: a support archive."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.cli.json_output import refuse_unwritable
from ahrsd.cli.running import DaemonPlace, place_options
from ahrsd.errors import AhrsdError, DeviceError


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), default="ahrsd-bundle.tar.gz",
              show_default=True, help="The archive: .tar.gz, .tgz, .tar or .zip.")  # fmt: skip
@place_options
def command(output: Path, place: DaemonPlace) -> None:
    """Collect journal, newest capture, configuration, status and versions into one archive.

    It works beside a running daemon and without one. Links, FIFOs and devices are never opened, of
    large files only a part is taken, and what was left out is printed. The capture holds where the
    sensor was turned to, and the location if one is configured: look before you pass it on.
    """
    from ahrsd.config.text import print_config
    from ahrsd.daemon.support_bundle import collect, format_of, write_bundle
    from ahrsd.printable import line

    format_of(output)
    refuse_unwritable(output)
    try:
        with place.connect() as daemon:
            status = daemon.ask("status")
    except DeviceError as error:
        click.echo(f"no status in the archive: {error}", err=True)
        status = None
    config = place.config.model_copy(update={"state_directory": place.state})
    try:
        bundle = collect(config.state, config.captures, print_config(config), status)
        write_bundle(output, bundle)
    except OSError as error:
        raise AhrsdError(f"{output}: cannot be written: {error.strerror}") from None
    for what, folder in (("journal/", config.state), ("captures/", config.captures)):
        if not any(name.startswith(what) for name in bundle.parts):
            click.echo(f"no {what.rstrip('s/')} in the archive: {folder} has none", err=True)
    size = output.stat().st_size
    click.echo(line(f"{output}: {size / 1e6:.1f} MB: {', '.join(bundle.parts)}"))
    for text in bundle.left_out:
        click.echo(line(f"left out: {text}"))
