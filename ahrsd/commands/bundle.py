"""`ahrsd bundle`: a support archive."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.errors import AhrsdError, DeviceError


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), default="ahrsd-bundle.tar.gz")
@click.option("--config", "path", type=click.Path(path_type=Path), help="The daemon's, TOML.")
def command(output: Path, path: Path | None) -> None:
    """Collect journal, newest capture, configuration, status and versions into one archive.

    It works beside a running daemon and without one; the name says the format (.tar.gz, .tgz, .tar,
    .zip). Links, FIFOs and devices are never opened, of large files only a part is taken, and what
    was left out is printed. The capture holds where the sensor was turned to, and the location if
    one is configured: look before you pass it on.
    """
    from ahrsd.bundle import collect, write_bundle
    from ahrsd.commands.running import connected
    from ahrsd.config import Config, load_config
    from ahrsd.config_text import print_config
    from ahrsd.logs import printable

    config = load_config(path) if path else Config()
    try:
        with connected(config.socket.path, config.state) as daemon:
            status = daemon.ask("status")
    except DeviceError as error:
        click.echo(f"{error}: the archive is made without its status", err=True)
        status = None
    try:
        bundle = collect(config.state, config.captures, print_config(config), status)
        write_bundle(output, bundle)
    except OSError as error:
        raise AhrsdError(f"{output}: cannot be written: {error.strerror}") from None
    size = output.stat().st_size
    click.echo(printable(f"{output}: {size / 1e6:.1f} MB: {', '.join(bundle.parts)}"))
    for text in bundle.left_out:
        click.echo(printable(f"left out: {text}"))
