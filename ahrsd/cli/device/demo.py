"""`ahrsd demo`: the main job with no hardware."""

from __future__ import annotations

import logging
import shutil
import sys
import time
from pathlib import Path

import click

from ahrsd.cli import Number
from ahrsd.errors import EXIT_DONE, EXIT_NO, EXIT_USAGE, DeviceError


def _program(name: str) -> str:
    """How to call a program of this environment from this shell."""
    if shutil.which(name):
        return name
    beside = Path(sys.argv[0]).parent / name
    return str(beside) if beside.exists() else name


@click.command()
@click.option(
    "-o",
    "--output",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("ahrsd-demo"),
    show_default=True,
    help="Folder for its output.",
)
@click.option(
    "--seconds",
    type=Number(60.0),
    default=2400.0,
    show_default=True,
    help="Longest device time.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Chooses hidden truth, motion and noise.",
)
@click.option(
    "--speed",
    type=Number(1.0, 100.0),
    default=20.0,
    show_default=True,
    help="Device seconds per second.",
)
def command(directory: Path, seconds: float, seed: int, speed: float) -> None:
    """Calibrate an emulated VN-100 with hidden iron and gyro bias, and write its registers.

    The real daemon on one end of a pseudo-terminal, the emulated device on the other, both many
    times faster than real time. Exit 1 if the demo misses its goal. Files of an
    earlier demo in the folder are replaced.
    """
    from ahrsd.demo import FILES, lines, run_demo

    click.echo(f"An emulated VN-100 (seed {seed}) with hidden iron and gyro bias, and the real")
    click.echo(f"daemon on its serial port, {speed:g} times faster than real time.")
    click.echo("")
    if any((directory / name).is_file() for name in FILES):
        click.echo(f"{directory}: the files of an earlier demo will be replaced", err=True)
    log = logging.getLogger("ahrsd")
    if log.level == logging.WARNING:  # what is worth one with a device of one's own is planned here
        log.setLevel(logging.ERROR)
    started = time.monotonic()
    try:
        result = run_demo(directory, seconds=seconds, seed=seed, speed=speed, say=click.echo)
    except OSError as error:
        raise DeviceError(f"{directory}: {error}", EXIT_USAGE) from error
    click.echo("")
    for line in lines(result):
        click.echo(line)
    click.echo(f"It took {time.monotonic() - started:.0f} s. Look at the result:")
    report, recording, capture, *others = (directory / name for name in FILES)
    for what, how in (
        ("before and after", f"open {report} in a browser"),
        ("everything in time", f"{_program('rerun')} {recording}"),
        ("the same decisions", f"{_program('ahrsd')} replay {capture}"),
        ("for other programs", ", ".join(map(str, others))),
    ):
        click.echo(f"  {what:20}{how}")
    raise SystemExit(EXIT_DONE if result.good else EXIT_NO)
